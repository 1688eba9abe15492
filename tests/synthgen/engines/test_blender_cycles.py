"""Cycles: geometry held against projection and the rasteriser, colours against known ones, and the same bytes twice."""

import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import cv2
import numpy as np
import pytest
from blender_scenes import MATT, SKEWED, at, box, box_and_plate, busy_scene, quad, scene_of
from posecore import se3
from posecore.camera import Camera, intrinsics, project
from posecore.errors import MeshError, RenderError
from posecore.mesh import Mesh, load_mesh
from posecore.raster import Instance, Rasteriser
from synthgen.engine import Engine, RenderedScene
from synthgen.engines.make import make_engine
from synthgen.scene import Light, Material, SceneObject

pytestmark = pytest.mark.blender

TUG, BOBBIN, BOX, CORNERS, TEXTURE = 1, 2, 3, 4, 5
CORNER_RGB = np.array([[255, 0, 0], [0, 255, 0], [0, 0, 255], [255, 255, 0]], np.uint8)


@pytest.fixture(scope="module")
def meshes(tug_ply: Path, bobbin_ply: Path) -> dict[int, Mesh]:
    # Texture rows go from top to bottom: red, green / yellow, blue, as the corners' colours go round.
    texture = CORNER_RGB[[0, 1, 3, 2]].reshape(2, 2, 3).repeat(32, axis=0).repeat(32, axis=1)
    return {
        TUG: load_mesh(tug_ply),
        BOBBIN: load_mesh(bobbin_ply),
        BOX: box(0.06, 0.09, 0.04),
        CORNERS: quad(vertex_rgb=CORNER_RGB),
        TEXTURE: quad(texture_rgb=texture),
    }


@pytest.fixture(scope="module")
def cycles(meshes: dict[int, Mesh]) -> Iterator[Engine]:
    engine = make_engine("cycles", threads=2)
    engine.load(meshes)
    yield engine
    engine.close()


def same(a: RenderedScene, b: RenderedScene) -> bool:
    return all(getattr(a, n).tobytes() == getattr(b, n).tobytes() for n in ("rgb_linear", "alpha", "depth_m", "index"))


@pytest.mark.slow
def test_importing_the_contract_leaves_blender_alone():
    code = "import sys, synthgen.engines.make, synthgen.scene; sys.exit('bpy' in sys.modules)"
    assert subprocess.run([sys.executable, "-c", code], check=False).returncode == 0


@pytest.mark.parametrize("region", [(-10, -20, 190, 170), (0, 0, 160, 120), (100, 60, 90, 101)])
def test_box_covers_exactly_the_pixels_between_its_projected_corners(cycles, meshes, region):
    T = at(0.02, 0.03, 0.45, (0.4, -0.5, 0.3))
    layers = cycles.render(
        scene_of(SceneObject(mesh_key=BOX, T_cam_obj=T), camera=SKEWED, region_px=region, samples=32)
    )
    x0, y0, width, height = region
    uv = project(SKEWED.K, se3.apply(T, meshes[BOX].vertices_m)) - np.array([x0, y0])
    outline = cv2.convexHull(uv.astype(np.float32))
    inside = np.array(
        [[cv2.pointPolygonTest(outline, (j + 0.5, i + 0.5), True) for j in range(width)] for i in range(height)]
    )
    mask = layers.index == 0
    assert mask.any()
    assert mask[inside > 0.02].all()
    assert not mask[inside < -0.02].any()
    np.testing.assert_array_equal(mask, layers.depth_m > 0)
    if region[2] == 190:  # wholly in sight: the antialiased picture lies over the mask, without a shift
        moments = cv2.moments(outline)
        v, u = np.indices(layers.alpha.shape) + 0.5
        weight = layers.alpha / layers.alpha.sum()
        assert (u * weight).sum() == pytest.approx(moments["m10"] / moments["m00"], abs=0.03)
        assert (v * weight).sum() == pytest.approx(moments["m01"] / moments["m00"], abs=0.03)


def test_depth_is_camera_z_at_the_pixel_centre(cycles):
    normal = se3.rotation_from_rotvec(np.array([0.5, 0.3, 0.0]))[:, 2]
    T = at(0.0, 0.0, 0.5, (0.5, 0.3, 0.0))
    layers = cycles.render(scene_of(SceneObject(mesh_key=CORNERS, T_cam_obj=T), samples=3))
    v, u = np.nonzero(layers.depth_m)
    rays = np.stack([(u + 0.5 - 32.0) / 128.0, (v + 0.5 - 32.0) / 128.0, np.ones_like(u)], axis=1)
    expected = (normal @ T[:3, 3]) / (rays @ normal)  # the plane's equation; the rays have z = 1
    np.testing.assert_allclose(layers.depth_m[v, u], expected, atol=1e-5)


@pytest.mark.slow
@pytest.mark.parametrize("name", ["raster", "cycles"])
@pytest.mark.parametrize("size_m", [0.002, 0.1, 10.0])
@pytest.mark.parametrize("diameters", [1.5, 8.0, 103.0, 500.0])
def test_objects_of_any_size_are_drawn_at_any_distance(name, size_m, diameters):
    """What is a thousandth of the object nearer hides it, and depths are exact to 2e-7 of themselves."""
    meshes, scene, (box_z_m, plate_z_m) = box_and_plate(size_m, diameters)
    engine = make_engine(name, threads=2)
    engine.load(meshes)
    layers = engine.render(scene)
    engine.close()
    f = scene.camera.K[0, 0] * size_m
    for index, z_m, width, height in ((0, box_z_m, 0.6, 0.5), (1, plate_z_m, 0.2, 0.2)):
        hit = layers.index == index
        rows, columns = np.flatnonzero(hit.any(axis=1)), np.flatnonzero(hit.any(axis=0))
        assert np.ptp(columns) + 1 == pytest.approx(f * width / z_m, abs=1.01)
        assert np.ptp(rows) + 1 == pytest.approx(f * height / z_m, abs=1.01)
        np.testing.assert_allclose(layers.depth_m[hit], z_m, rtol=2e-7)
    assert (layers.index[31:33, 31:33] == 1).all()


def test_geometry_agrees_with_the_rasteriser(cycles, meshes):
    rng = np.random.default_rng(3)
    with Rasteriser(meshes) as raster:
        for number in range(50):
            key = (TUG, BOBBIN)[number % 2]
            K = intrinsics(*rng.uniform(300, 700, 2), *rng.uniform(30, 90, 2))
            T = se3.make_T(se3.random_rotation(rng), np.array([0.0, 0.0, rng.uniform(0.5, 1.0)]))
            T[:3, 3] += [(64 - K[0, 2]) / K[0, 0] * T[2, 3], (64 - K[1, 2]) / K[1, 1] * T[2, 3], 0.0]
            camera = Camera(K=K, width_px=128, height_px=128)
            layers = cycles.render(
                scene_of(SceneObject(mesh_key=key, T_cam_obj=T), camera=camera, region_px=(0, 0, 128, 128), samples=1)
            )
            depth = raster.render(key, K, T[None], 128, 128, rgb=False).depth_m[0]
            ours, theirs = layers.index == 0, depth > 0
            assert (ours & theirs).sum() / (ours | theirs).sum() >= 0.995
            assert np.median(np.abs(layers.depth_m - depth)[ours & theirs]) <= 0.5e-3


def test_occlusion_agrees_with_the_rasteriser(cycles, meshes):
    scene = busy_scene(8, (TUG, BOX, BOBBIN, BOX, BOX, TUG), region_px=(-20, -20, 104, 104))
    K = scene.camera.K + np.array([[0, 0, 20], [0, 0, 20], [0, 0, 0]])
    with Rasteriser(meshes) as raster:
        instances = [Instance(obj_id=o.mesh_key, T_cam_obj=o.T_cam_obj) for o in scene.objects]
        expected = raster.render_scene(instances, K, 104, 104).instance
    index = cycles.render(scene).index
    assert len(np.unique(index)) >= 5
    assert (index != expected).sum() <= 4


def test_same_scene_gives_the_same_bytes_after_any_history_and_on_any_threads(cycles, meshes):
    scenes = [
        busy_scene(1, (TUG, BOX)),
        busy_scene(2, (BOX, BOX, BOX, TUG), samples=3),
        busy_scene(4, (BOBBIN,), samples=5),
    ]
    first = [cycles.render(scene) for scene in scenes]
    for number in (2, 0, 1, 1, 0):
        assert same(cycles.render(scenes[number]), first[number])
    other = make_engine("cycles", threads=1)
    other.load({9: meshes[BOX], **dict(reversed(meshes.items()))})
    for number in (2, 1, 0):  # the reverse order: nothing may remember the number of samples or of lights
        assert same(other.render(scenes[number]), first[number])
    other.close()


def test_noise_follows_the_seed(cycles):
    a, b = (cycles.render(busy_scene(5, (TUG,), samples=2, render_seed=seed)) for seed in (1, 2))
    np.testing.assert_array_equal(a.index, b.index)
    assert (a.rgb_linear != b.rgb_linear).any()


@pytest.mark.parametrize("key", [CORNERS, TEXTURE])
def test_vertex_and_texture_colours_are_where_they_belong_and_linear(cycles, key):
    layers = cycles.render(scene_of(SceneObject(mesh_key=key, T_cam_obj=at(0, 0, 0.5), material=MATT), samples=64))
    rows, columns = (8, 8, 55, 55), (8, 55, 55, 8)  # the square covers rows and columns 6.4 to 57.6
    got = layers.rgb_linear[rows, columns]
    np.testing.assert_allclose(got, CORNER_RGB / 255.0, atol=0.12 if key == CORNERS else 0.03)


def test_base_colour_and_value_replace_the_meshs_own(cycles):
    def mean(**changes: object) -> np.ndarray:
        material = Material(roughness=1.0, specular=0.0, **changes)
        thing = SceneObject(mesh_key=TEXTURE, T_cam_obj=at(0, 0, 0.5), material=material)
        return cycles.render(scene_of(thing, samples=64)).rgb_linear[20:40, 20:40].mean(axis=(0, 1))

    np.testing.assert_allclose(mean(base_rgb=(0.5, 0.5, 0.5)), 0.2140, atol=0.01)  # sRGB 0.5 is 0.2140 linear
    np.testing.assert_allclose(mean(base_rgb=(0.5, 0.5, 0.5), value=2.0), 0.4280, atol=0.02)
    np.testing.assert_allclose(mean(base_rgb=(1.0, 0.0, 0.0), hue_shift=1 / 3), (0.0, 1.0, 0.0), atol=0.03)
    assert np.ptp(mean(saturation=0.0)) < 0.01


def test_objects_of_one_mesh_have_their_own_materials(cycles):
    things = [
        SceneObject(
            mesh_key=BOX,
            T_cam_obj=at(x, 0.0, 0.5),
            material=Material(base_rgb=rgb, roughness=1.0, specular=0.0),
        )
        for x, rgb in ((-0.06, (1.0, 0.0, 0.0)), (0.06, (0.0, 0.0, 1.0)))
    ]
    layers = cycles.render(scene_of(*things))
    assert layers.rgb_linear[layers.index == 0].mean(axis=0).argmax() == 0
    assert layers.rgb_linear[layers.index == 1].mean(axis=0).argmax() == 2


@pytest.mark.parametrize("kind", ["sun", "area", "point"])
def test_light_comes_from_where_it_stands(cycles, kind):
    def lit_from(x: float, y: float) -> np.ndarray:
        light = Light(kind=kind, position_cam_m=(x, y, 0.5), direction_cam=(x, y, 0.0), strength=5.0, size_m=0.1)
        thing = SceneObject(mesh_key=BOBBIN, T_cam_obj=at(0, 0, 0.5), material=MATT)
        layers = cycles.render(scene_of(thing, lights=(light,), ambient_rgb=(0.0, 0.0, 0.0)))
        return layers.rgb_linear.sum(axis=2)

    from_right, from_above = lit_from(1.0, 0.0), lit_from(0.0, -1.0)
    assert from_right[:, 32:].sum() > 2 * from_right[:, :32].sum()
    assert from_above[:32].sum() > 2 * from_above[32:].sum()


def test_empty_region_has_no_depth_and_index(cycles):
    layers = cycles.render(
        scene_of(SceneObject(mesh_key=BOX, T_cam_obj=at(0, 0, 0.5)), region_px=(5000, 5000, 3, 2), samples=1)
    )
    assert layers.rgb_linear.shape == (2, 3, 3)
    assert (layers.index == -1).all()
    assert not layers.depth_m.any()
    assert not layers.alpha.any()


def test_rendering_says_nothing(cycles, capfd):
    cycles.render(busy_scene(6, (TUG, BOX), samples=1))
    assert capfd.readouterr() == ("", "")


def test_unknown_mesh_key_is_one_line(cycles):
    with pytest.raises(RenderError, match=r"^object 0: mesh key 77 is not loaded \(loaded: 1, 2, 3, 4, 5\)$"):
        cycles.render(scene_of(SceneObject(mesh_key=77, T_cam_obj=at(0, 0, 0.5))))


def test_broken_mesh_is_refused(cycles):
    mesh = box(0.1, 0.1, 0.1)
    broken = Mesh(vertices_m=mesh.vertices_m[:10], faces=mesh.faces, normals=mesh.normals[:10], path="cut.ply")
    with pytest.raises(MeshError, match=r"cut.ply: got vertex indices 0 to 35, expected 0 to 9"):
        cycles.load({6: broken})


def test_a_write_that_fails_is_one_line(cycles, tmp_path, monkeypatch):
    monkeypatch.setattr(cycles, "_file", tmp_path / "missing" / "layers.exr")
    with pytest.raises(RenderError) as caught:
        cycles.render(busy_scene(6, (TUG,), samples=1))
    assert "\n" not in str(caught.value)


def test_datablocks_are_reused_and_removed(meshes):
    import bpy

    def count() -> list[int]:
        data = bpy.data
        return [len(x) for x in (data.objects, data.meshes, data.materials, data.images, data.lights, data.scenes)]

    before = count()
    engine = make_engine("cycles", threads=1)
    engine.load(meshes)
    folder = engine._file.parent
    scenes = [busy_scene(seed, (TUG, BOX, BOX), samples=1, region_px=(0, 0, 8, 8)) for seed in range(12)]
    for scene in scenes:
        engine.render(scene)
    full = count()
    engine.load(meshes)
    for scene in scenes:
        engine.render(scene)
    assert count() == full
    engine.close()
    engine.close()
    assert count() == before
    assert not folder.exists()
