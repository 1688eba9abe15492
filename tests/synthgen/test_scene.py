"""Scene records: checked when they are made, and plain enough to travel."""

import pickle
from typing import Any

import numpy as np
import pytest
from posecore.camera import Camera, intrinsics
from posecore.errors import ConfigError
from synthgen.engines.make import make_engine
from synthgen.scene import Background, Light, Material, Scene, SceneObject, Sensor


def scene(**changes: Any) -> Scene:
    fields: dict[str, Any] = {
        "camera": Camera(K=intrinsics(500.0, 500.0, 64.0, 48.0), width_px=128, height_px=96),
        "region_px": (-4, 8, 32, 32),
        "objects": (SceneObject(mesh_key=1, T_cam_obj=np.eye(4)),),
        "lights": (Light(kind="sun"),),
    }
    return Scene(**{**fields, **changes})


def test_scene_survives_pickling():
    before = scene()
    after = pickle.loads(pickle.dumps(before))
    assert after.region_px == before.region_px
    assert after.lights == before.lights
    np.testing.assert_array_equal(after.objects[0].T_cam_obj, before.objects[0].T_cam_obj)


def test_pose_is_a_read_only_copy():
    T = np.eye(4)
    item = SceneObject(mesh_key=1, T_cam_obj=T)
    T[0, 3] = 1.0
    assert item.T_cam_obj[0, 3] == 0.0
    with pytest.raises(ValueError, match="read-only"):
        item.T_cam_obj[0, 3] = 1.0


def test_equal_numbers_make_equal_records():
    assert Material(base_rgb=(1.0, 0.5, 0.0)) == Material(base_rgb=(1, 0.5, 0))


@pytest.mark.parametrize("T", [np.diag([2.0, 2.0, 2.0, 1.0]), np.diag([-1.0, 1.0, 1.0, 1.0]), np.full((4, 4), np.nan)])
def test_pose_that_is_not_rigid_is_refused(T):
    with pytest.raises(ConfigError, match="T_cam_obj"):
        SceneObject(mesh_key=1, T_cam_obj=T)


@pytest.mark.parametrize(
    ("make", "key"),
    [
        (lambda: Material(roughness=1.5), "material.roughness"),
        (lambda: Material(base_rgb=(0.0, 0.0, 2.0)), "material.base_rgb"),
        (lambda: Light(kind="point", strength=-1.0), "light.strength"),
        (lambda: Light(kind="sun", direction_cam=(0.0, 0.0, 0.0)), "light.direction_cam"),
        (lambda: Light(kind="area"), "light.size_m"),
        (lambda: Light(kind="point", position_cam_m=(0.0, 0.0, float("nan"))), "light.position_cam_m"),
        (lambda: Background(kind="photo"), "background.path"),
        (lambda: Background(kind="procedural", path="a.png"), "background.path"),
        (lambda: Sensor(jpeg_quality=0), "sensor.jpeg_quality"),
        (lambda: scene(region_px=(0, 0, 0, 5)), "scene.region_px"),
        (lambda: scene(objects=()), "scene.objects"),
        (lambda: scene(samples=0), "scene.samples"),
        (lambda: scene(render_seed=-1), "scene.render_seed"),
    ],
)
def test_wrong_value_is_refused_by_name(make, key):
    with pytest.raises(ConfigError, match=key):
        make()


def test_unknown_engine_is_refused_by_name():
    with pytest.raises(ConfigError, match=r"povray.*cycles, eevee, raster"):
        make_engine("povray")
