"""EEVEE: the same layers as Cycles. Few renders: a software GL takes seconds for each."""

import numpy as np
import pytest
from blender_scenes import SKEWED, at, box, box_and_plate, scene_of
from synthgen.engines.make import make_engine
from synthgen.scene import Light, SceneObject

pytestmark = [pytest.mark.blender, pytest.mark.slow]


def test_eevee_labels_pixels_as_cycles_does():
    meshes = {1: box(0.06, 0.09, 0.04), 2: box(0.02, 0.2, 0.02)}
    scene = scene_of(
        SceneObject(mesh_key=1, T_cam_obj=at(0.02, 0.03, 0.45, (0.4, -0.5, 0.3))),
        SceneObject(mesh_key=2, T_cam_obj=at(0.02, 0.03, 0.38, (0.0, 0.3, 0.4))),
        camera=SKEWED,
        region_px=(40, 20, 96, 80),
        lights=(Light(kind="sun", direction_cam=(0.5, -0.5, -1.0), strength=2.0),),
        samples=4,
    )
    layers = {}
    for name in ("cycles", "eevee"):
        engine = make_engine(name, threads=2)
        engine.load(meshes)
        layers[name] = engine.render(scene)
        engine.close()
    cycles, eevee = layers["cycles"], layers["eevee"]
    assert set(np.unique(eevee.index)) == {-1, 0, 1}
    assert (cycles.index != eevee.index).sum() <= 2
    both = (cycles.index >= 0) & (cycles.index == eevee.index)
    np.testing.assert_allclose(eevee.depth_m[both], cycles.depth_m[both], atol=0.5e-3)
    assert np.abs(eevee.alpha - cycles.alpha).mean() < 0.02
    assert eevee.rgb_linear[both].mean() == pytest.approx(cycles.rgb_linear[both].mean(), rel=0.3)


@pytest.mark.parametrize(("size_m", "diameters"), [(0.002, 8.0), (10.0, 8.0), (10.0, 500.0)])
def test_depths_of_tiny_and_far_objects_are_precise(size_m, diameters):
    meshes, scene, z_m = box_and_plate(size_m, diameters)
    engine = make_engine("eevee", threads=2)
    engine.load(meshes)
    layers = engine.render(scene)
    engine.close()
    for index in (0, 1):
        hit = layers.index == index
        assert hit.sum() > 80
        np.testing.assert_allclose(layers.depth_m[hit], z_m[index], rtol=1e-5)
