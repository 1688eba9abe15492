import numpy as np
import pytest
from blender_scenes import at, quad, scene_of
from posecore.camera import back_project
from synthgen.engines.make import make_engine
from synthgen.image import pattern
from synthgen.image.sensor import linear_from_display
from synthgen.scene import Material, Pattern, SceneObject

PATTERN = Pattern(accent_rgb=(0.0, 0.0, 1.0), wave=(90.0, 20.0, 0.0), warp=(0.0, 60.0, 0.0), bend=2.0, sharpness=3.0)
LOOK = Material(base_rgb=(1.0, 0.5, 0.0), pattern=PATTERN, roughness=1.0, specular=0.0)


def test_bands_repeat_along_the_wave_and_keep_their_bounds():
    straight = Pattern(accent_rgb=(1.0, 1.0, 1.0), wave=(2 * np.pi * 10, 0.0, 0.0), sharpness=8.0)
    x = np.linspace(0, 1, 1000, endpoint=False) + 5e-4
    weight = pattern.accent_weight(straight, np.stack([x, 0.3 + 0 * x, 7.0 * x], axis=1))
    assert (weight.min(), weight.max()) == (0.0, 1.0)
    assert weight.mean() == pytest.approx(0.5, abs=0.01)
    np.testing.assert_allclose(weight[:100], weight[300:400], atol=1e-9)
    assert (np.diff(weight > 0.5) != 0).sum() == 19


@pytest.mark.parametrize("name", ["raster", pytest.param("cycles", marks=pytest.mark.blender)])
def test_both_engines_show_the_formula(name):
    engine = make_engine(name, threads=1)
    engine.load({1: quad()})
    T = at(0.01, -0.02, 0.5, (0.2, 0.4, 0.3))
    scene = scene_of(SceneObject(mesh_key=1, T_cam_obj=T, material=LOOK), samples=32)
    layers = engine.render(scene)
    engine.close()
    inside = layers.alpha > 0.999
    inside[:-1] &= layers.alpha[1:] > 0.999
    v, u = np.nonzero(inside & (layers.index == 0))
    p_cam = back_project(scene.camera.K, np.stack([u, v], -1) + 0.5, layers.depth_m[v, u])
    p_obj = (p_cam - T[:3, 3]) @ T[:3, :3]
    weight = pattern.accent_weight(PATTERN, p_obj)[:, None]
    base = linear_from_display(np.array([[[255, 128, 0]]], np.uint8))[0]
    expected = base * (1 - weight) + np.array([0.0, 0.0, 1.0]) * weight
    difference = np.abs(layers.rgb_linear[v, u] - expected)
    assert np.quantile(difference, 0.9) < 0.12  # a pixel of the picture is an average, the formula a point
    assert difference.mean() < 0.05
    assert len(v) > 1000


def test_a_patterned_thing_that_is_hidden_wholly_changes_nothing():
    engine = make_engine("raster", threads=1)
    engine.load({1: quad()})
    front = SceneObject(mesh_key=1, T_cam_obj=at(0.0, 0.0, 0.5), material=Material(base_rgb=(0.2, 0.5, 0.1)))
    behind = SceneObject(mesh_key=1, T_cam_obj=at(0.0, 0.0, 0.6), material=LOOK)
    alone, both = (engine.render(scene_of(*items, samples=4)) for items in ((front,), (front, behind)))
    engine.close()
    assert (alone.index == 0).any()
    np.testing.assert_array_equal(both.index, alone.index)
    np.testing.assert_array_equal(both.rgb_linear, alone.rgb_linear)
