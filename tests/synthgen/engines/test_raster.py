from dataclasses import replace

import numpy as np
import pytest
from posecore.camera import Camera, intrinsics
from posecore.errors import RenderError
from posecore.se3 import make_T
from synthgen.engine import Engine
from synthgen.engines.make import make_engine
from synthgen.engines.raster import RasterEngine
from synthgen.image.sensor import display_from_linear
from synthgen.scene import Light, Material, Scene, SceneObject

CAMERA = Camera(K=intrinsics(300.0, 310.0, 81.5, 58.0), width_px=160, height_px=120)


def pose(x, y, z):
    return make_T(np.eye(3), np.array([x, y, z]))


@pytest.fixture
def engine(tug):
    made = make_engine("raster")
    made.load({1: tug, 2: tug})
    yield made
    made.close()


def scene_of(*objects, **settings):
    return Scene(camera=CAMERA, region_px=(0, 0, 160, 120), objects=objects, **settings)


def test_it_keeps_the_contract(engine):
    assert isinstance(engine, Engine)
    out = engine.render(scene_of(SceneObject(mesh_key=1, T_cam_obj=pose(0, 0, 0.5))))
    assert out.rgb_linear.shape == (120, 160, 3)
    assert out.rgb_linear.dtype == out.alpha.dtype == out.depth_m.dtype == np.float32
    assert np.array_equal(out.index >= 0, out.depth_m > 0)
    assert (out.alpha[out.index >= 0] > 0).all()
    assert (out.rgb_linear[out.alpha == 0] == 0).all()
    assert 0 < out.alpha[(out.alpha > 0) & (out.alpha < 1)].size < out.alpha.size / 10


def test_the_nearer_object_hides_the_farther_in_either_order(engine):
    near = SceneObject(mesh_key=1, T_cam_obj=pose(0.02, 0, 0.45))
    far = SceneObject(mesh_key=2, T_cam_obj=pose(0, 0, 0.6))
    a, b = engine.render(scene_of(near, far)), engine.render(scene_of(far, near))
    alone = engine.render(scene_of(near))
    assert np.array_equal(a.index == 0, alone.index == 0)
    assert np.array_equal(b.index == 1, alone.index == 0)
    assert np.array_equal(a.depth_m, b.depth_m)


def test_a_region_is_a_cut_of_the_whole_also_outside_the_image(engine):
    scene = scene_of(SceneObject(mesh_key=1, T_cam_obj=pose(-0.11, 0.01, 0.45)))
    whole = engine.render(scene)
    part = engine.render(replace(scene, region_px=(-30, 20, 90, 70)))
    assert (part.index[:, :30] >= 0).any()
    assert np.array_equal(part.index[:, 30:], whole.index[20:90, :60])
    np.testing.assert_allclose(part.depth_m[:, 30:], whole.depth_m[20:90, :60], atol=1e-6)


def test_ambient_light_shows_the_base_colour(engine):
    material = Material(base_rgb=(0.8, 0.4, 0.2))
    placed = SceneObject(mesh_key=1, T_cam_obj=pose(0, 0, 0.5), material=material)
    out = engine.render(scene_of(placed, ambient_rgb=(1.0, 1.0, 1.0)))
    shown = display_from_linear(out.rgb_linear)[out.alpha == 1]
    np.testing.assert_allclose(shown, np.broadcast_to((0.8, 0.4, 0.2), shown.shape), atol=0.01)


def test_a_lamp_lights_the_side_it_stands_on(engine):
    placed = SceneObject(mesh_key=1, T_cam_obj=pose(0, 0, 0.5), material=Material(base_rgb=(0.6, 0.6, 0.6)))
    sun = Light(kind="sun", direction_cam=(-1.0, 0.0, -0.3), strength=3.0)
    lamp = Light(kind="point", position_cam_m=(-1.0, 0.0, 0.2), strength=3.0 * 4 * np.pi * 1.09)
    for light in (sun, lamp):
        out = engine.render(scene_of(placed, lights=(light,), ambient_rgb=(0.0, 0.0, 0.0)))
        mirrored = engine.render(
            scene_of(placed, lights=(replace(light, direction_cam=(1.0, 0.0, -0.3), position_cam_m=(1.0, 0.0, 0.2)),))
        )
        assert out.rgb_linear.sum() > 0
        assert not np.array_equal(out.rgb_linear, mirrored.rgb_linear)


def test_hue_and_value_change_colours_but_not_geometry(engine):
    plain = SceneObject(mesh_key=1, T_cam_obj=pose(0, 0, 0.5))
    changed = replace(plain, material=Material(hue_shift=0.3, value=0.5))
    a, b = engine.render(scene_of(plain)), engine.render(scene_of(changed))
    assert np.array_equal(a.index, b.index)
    assert np.array_equal(a.alpha, b.alpha)
    inside = a.alpha == 1
    assert b.rgb_linear[inside].max(axis=-1).mean() < 0.6 * a.rgb_linear[inside].max(axis=-1).mean()


def test_rendering_before_loading_is_an_error():
    with pytest.raises(RenderError, match="load"):
        RasterEngine().render(scene_of(SceneObject(mesh_key=1, T_cam_obj=pose(0, 0, 0.5))))
