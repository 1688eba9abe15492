"""The GL rasteriser against its numpy twin, known corners, and its own repetition."""

from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import trimesh
from posecore import camera, se3
from posecore.errors import RenderError
from posecore.mesh import Mesh, load_mesh
from posecore.raster import DirectionalLight, Instance, Rasteriser, Shading, reference
from scipy.spatial import ConvexHull

K = camera.intrinsics(310.0, 285.0, 70.3, 50.8)


def mesh_of(shape: trimesh.Trimesh, rgb: tuple[int, int, int] = (200, 40, 90)) -> Mesh:
    return Mesh(
        vertices_m=np.asarray(shape.vertices, np.float64),
        faces=np.asarray(shape.faces, np.int32),
        normals=np.asarray(shape.vertex_normals, np.float32),
        vertex_rgb=np.tile(np.array(rgb, np.uint8), (len(shape.vertices), 1)),
    )


BOX = mesh_of(trimesh.creation.box((0.11, 0.07, 0.05)))
RING = mesh_of(trimesh.creation.torus(0.05, 0.015, major_sections=24, minor_sections=12))


@pytest.fixture(scope="module")
def rasteriser() -> Iterator[Rasteriser]:
    with Rasteriser({1: BOX, 2: RING}) as r:
        yield r


def poses(n: int, z_m: float = 0.4, seed: int = 0) -> np.ndarray:
    rng = np.random.default_rng(seed)
    return np.stack([
        se3.make_T(se3.random_rotation(rng), np.array([rng.uniform(-0.04, 0.04), rng.uniform(-0.03, 0.03), z_m]))
        for _ in range(n)
    ])  # fmt: skip


@pytest.mark.parametrize(("obj_id", "mesh"), [(1, BOX), (2, RING)])
def test_mask_and_depth_equal_the_numpy_twin(rasteriser: Rasteriser, obj_id: int, mesh: Mesh) -> None:
    T = poses(10, seed=obj_id)
    layers = rasteriser.render(obj_id, K, T, 140, 100)
    for i in range(len(T)):
        depth_m, mask = reference.render(mesh, K, T[i], 140, 100)
        assert (mask != layers.mask[i]).sum() <= 1  # a pixel centre may lie on an edge within float32
        both = mask & layers.mask[i]
        assert np.median(np.abs(depth_m - layers.depth_m[i])[both]) < 1e-6
        assert (np.abs(depth_m - layers.depth_m[i])[both] < 1e-5).mean() > 0.998


def test_mask_is_the_hull_of_the_projected_corners(rasteriser: Rasteriser) -> None:
    """A box's silhouette is a convex polygon: every pixel centre inside it is drawn, every one outside is not."""
    centres = np.stack(np.meshgrid(np.arange(140) + 0.5, np.arange(100) + 0.5), axis=-1)
    for T in poses(20, seed=5):
        mask = rasteriser.render(1, K, T[None], 140, 100).mask[0]
        hull = ConvexHull(camera.project(K, se3.apply(T, BOX.vertices_m)))
        outside_px = (centres @ hull.equations[:, :2].T + hull.equations[:, 2]).max(axis=-1)  # signed, per hull edge
        clear = np.abs(outside_px) > 0.01
        np.testing.assert_array_equal(mask[clear], outside_px[clear] < 0)


def many_meshes(repository: Path) -> dict[int, Mesh]:
    shapes = (trimesh.creation.icosphere(4, 0.05), trimesh.creation.cone(0.05, 0.1))
    examples = [load_mesh(repository / "examples" / "objects" / f"{name}.ply") for name in ("tug", "bobbin")]
    return dict(enumerate([BOX, RING, *map(mesh_of, shapes), *examples], 1))


@pytest.mark.parametrize("side_px", [48, 64])
def test_a_render_does_not_depend_on_its_batch_mates(repository: Path, side_px: int) -> None:
    """A pose alone, and at each index of a batch of 64 of six meshes: the same bytes."""
    T, rng = poses(64, seed=4), np.random.default_rng(3)
    Ks = np.stack([camera.intrinsics(*rng.uniform(200, 300, 2), *rng.uniform(20, 30, 2)) for _ in T])
    meshes = many_meshes(repository)
    obj_ids = np.arange(64) % len(meshes) + 1
    with Rasteriser(meshes) as rasteriser:
        alone = [rasteriser.render(int(obj_ids[i]), Ks[i], T[i : i + 1], side_px, side_px) for i in range(64)]
        for shift in (0, 1, 17, 63):
            order = (np.arange(64) + shift) % 64
            batch = rasteriser.render(obj_ids[order], Ks[order], T[order], side_px, side_px)
            outlines = rasteriser.render(obj_ids[order], Ks[order], T[order], side_px, side_px, rgb=False)
            for row, i in enumerate(order):
                np.testing.assert_array_equal(batch.depth_m[row], alone[i].depth_m[0])
                np.testing.assert_array_equal(batch.rgb[row], alone[i].rgb[0])
                np.testing.assert_array_equal(outlines.mask[row], alone[i].mask[0])


@pytest.mark.parametrize(("n", "side_px"), [(9, 1024), (130, 32)])
def test_a_batch_larger_than_its_framebuffers_is_complete(rasteriser: Rasteriser, n: int, side_px: int) -> None:
    T = np.repeat(poses(1), n, axis=0)
    K = camera.intrinsics(1.5 * side_px, 1.5 * side_px, side_px / 2, side_px / 2)
    layers = rasteriser.render(1, K, T, side_px, side_px, rgb=False)
    assert layers.mask[0].any()
    assert (layers.depth_m == layers.depth_m[0]).all()


@pytest.mark.parametrize("size_m", [0.002, 0.1, 10.0])
@pytest.mark.parametrize("diameters", [1.0, 8.0, 103.0, 500.0])
def test_near_and_far_objects_of_any_size_are_drawn(size_m: float, diameters: float) -> None:
    """Two coloured plates, a thousandth of their size apart: the front one hides the other, wherever it lies."""
    half = size_m / 2
    corners = np.array([[-half, -half], [half, -half], [half, half], [-half, half]])
    vertices_m = np.concatenate([np.column_stack([corners, np.full(4, z)]) for z in (0.0, 1e-3 * size_m)])
    faces = np.array([[0, 1, 2], [0, 2, 3], [4, 5, 6], [4, 6, 7]], np.int32)
    rgb = np.repeat([[255, 0, 0], [0, 0, 255]], 4, axis=0).astype(np.uint8)
    plates = Mesh(vertices_m=vertices_m, faces=faces, normals=np.tile([0.0, 0.0, -1.0], (8, 1)), vertex_rgb=rgb)
    T = se3.make_T(np.eye(3), np.array([0.0, 0.0, diameters * plates.diameter_m]))
    K = camera.intrinsics(40 * diameters, 40 * diameters, 32, 32)
    with Rasteriser({1: plates}) as rasteriser:
        layers = rasteriser.render(1, K, T[None], 64, 64)
        scene = rasteriser.render_scene([Instance(obj_id=1, T_cam_obj=T)], K, 64, 64)
    side_px = 40 / np.sqrt(2)
    assert layers.mask.sum() == pytest.approx(side_px**2, abs=2 * side_px)
    assert (layers.rgb[layers.mask][:, 0] > 0).all() and not layers.rgb[layers.mask][:, 2].any()
    np.testing.assert_allclose(layers.depth_m[layers.mask], T[2, 3], rtol=1e-6)
    np.testing.assert_array_equal(scene.depth_m, layers.depth_m[0])


def test_two_rasterisers_in_one_process_do_not_disturb_each_other(rasteriser: Rasteriser) -> None:
    T = poses(1)
    before = rasteriser.render(1, K, T, 140, 100).depth_m
    for _ in range(2):  # also one made after another was closed
        with Rasteriser({1: RING}) as other:
            assert other.render(1, K, T, 140, 100).mask.any()
    np.testing.assert_array_equal(rasteriser.render(1, K, T, 140, 100).depth_m, before)


def test_other_threads_draw_the_same(rasteriser: Rasteriser) -> None:
    T = poses(8)
    here = rasteriser.render(2, K, T, 140, 100)
    with ThreadPoolExecutor(4) as pool:
        others = list(pool.map(lambda _: rasteriser.render(2, K, T, 140, 100), range(12)))
        with pool.submit(Rasteriser, {2: RING}).result() as made_there:
            others.append(made_there.render(2, K, T, 140, 100))
    for there in others:
        np.testing.assert_array_equal(there.rgb, here.rgb)
        np.testing.assert_array_equal(there.depth_m, here.depth_m)


def test_scene_keeps_the_nearest_instance(rasteriser: Rasteriser) -> None:
    near, far = np.eye(4), np.eye(4)
    near[:3, 3], far[:3, 3] = [0.0, 0.0, 0.4], [0.0, 0.0, 0.6]
    layers = rasteriser.render_scene(
        [Instance(obj_id=1, T_cam_obj=far), Instance(obj_id=2, T_cam_obj=near)], K, 140, 100
    )
    alone = rasteriser.render(2, K, near[None], 140, 100)
    np.testing.assert_array_equal(layers.instance == 1, alone.mask[0])
    assert set(np.unique(layers.instance)) == {-1, 0, 1}
    assert (layers.depth_m[layers.instance == -1] == 0).all()


def test_textures_are_upright_and_not_mirrored() -> None:
    """A quad with a four-colour texture, facing the camera: image and texture agree corner by corner."""
    texture = np.zeros((64, 64, 3), np.uint8)
    texture[:32, :32], texture[:32, 32:], texture[32:, :32], texture[32:, 32:] = (
        (250, 0, 0), (0, 250, 0), (0, 0, 250), (250, 250, 0),
    )  # fmt: skip
    quad = Mesh(
        vertices_m=np.array([[-0.1, -0.1, 0], [0.1, -0.1, 0], [0.1, 0.1, 0], [-0.1, 0.1, 0]]),
        faces=np.array([[0, 1, 2], [0, 2, 3]], np.int32),
        normals=np.tile(np.array([0, 0, -1], np.float32), (4, 1)),
        uv=np.array([[0, 1], [1, 1], [1, 0], [0, 0]], np.float32),  # v points up, camera y points down
        texture_rgb=texture,
    )
    T = np.eye(4)
    T[2, 3] = 0.5
    with Rasteriser({1: quad}) as r:
        rgb = r.render(
            1, camera.intrinsics(100, 100, 32, 32), T[None], 64, 64, shading=Shading(ambient=1, diffuse=0)
        ).rgb
    assert rgb is not None
    for (u, v), wanted in {(18, 18): (250, 0, 0), (46, 18): (0, 250, 0), (18, 46): (0, 0, 250)}.items():
        np.testing.assert_allclose(rgb[0, v, u], wanted, atol=3)


def test_light_from_the_right_brightens_the_right_side() -> None:
    ball = mesh_of(trimesh.creation.icosphere(3, 0.05), rgb=(200, 200, 200))
    T = np.eye(4)
    T[2, 3] = 0.4
    light = Shading(ambient=0.1, diffuse=0.9, lights=(DirectionalLight(direction_cam=(1.0, 0.0, 0.0)),))
    with Rasteriser({1: ball}) as r:
        rgb = r.render(1, K, T[None], 140, 100, shading=light).rgb
    assert rgb is not None
    grey = rgb[0].astype(float).mean(axis=-1)
    assert grey[50, 70 + 25] > 3 * grey[50, 70 - 25]


def test_leaving_out_back_faces_changes_nothing(rasteriser: Rasteriser) -> None:
    assert RING.is_closed
    open_twin = mesh_of(trimesh.creation.torus(0.05, 0.015, major_sections=24, minor_sections=12))
    open_twin.__dict__["is_closed"] = False
    T = poses(10, z_m=0.5)
    closed = rasteriser.render(2, K, T, 140, 100)
    with Rasteriser({2: open_twin}) as other:
        full = other.render(2, K, T, 140, 100)
    np.testing.assert_array_equal(closed.mask, full.mask)
    # on the rim a front and a back face may tie within the depth buffer's resolution
    assert (np.abs(closed.depth_m - full.depth_m) > 1e-6).sum() <= 5


def test_open_and_inverted_meshes_are_drawn_from_both_sides(rasteriser: Rasteriser) -> None:
    open_box = Mesh(vertices_m=BOX.vertices_m, faces=BOX.faces[:-2], normals=BOX.normals)
    inverted = Mesh(vertices_m=BOX.vertices_m, faces=BOX.faces[:, ::-1].copy(), normals=BOX.normals)
    assert BOX.is_closed and not open_box.is_closed and not inverted.is_closed
    T = poses(5)
    with Rasteriser({1: inverted}) as other:
        np.testing.assert_array_equal(other.render(1, K, T, 140, 100).mask, rasteriser.render(1, K, T, 140, 100).mask)


def test_a_mesh_far_off_its_origin_is_drawn_like_one_at_it(rasteriser: Rasteriser) -> None:
    """Parts keep the coordinates of the whole machine: the origin may lie 20 m behind what is seen."""
    away = np.array([0.0, 0.0, -20.0])
    far = Mesh(vertices_m=RING.vertices_m + away, faces=RING.faces, normals=RING.normals, vertex_rgb=RING.vertex_rgb)
    T = np.eye(4)[None].repeat(2, axis=0)
    T[:, 2, 3] = [0.4, 0.25]
    moved = T.copy()
    moved[:, :3, 3] -= away
    wanted = rasteriser.render(2, K, T, 140, 100)
    with Rasteriser({2: far}) as other:
        found = other.render(2, K, moved, 140, 100)
    assert wanted.mask.any(axis=(1, 2)).all()
    assert (wanted.mask != found.mask).sum() <= 40  # float32 holds 20 m to a micrometre: the rim may move
    both = wanted.mask & found.mask
    assert np.abs(wanted.depth_m - found.depth_m)[both].max() < 1e-4


def test_object_behind_the_camera_is_not_drawn(rasteriser: Rasteriser) -> None:
    T = poses(1)
    T[0, 2, 3] = -0.4
    assert not rasteriser.render(1, K, T, 140, 100).mask.any()


def test_a_table_whose_centre_is_behind_the_camera_is_drawn_to_its_end() -> None:
    near, table = np.eye(4), np.eye(4)
    near[2, 3], table[:3, 3] = 0.4, [0.0, 0.1, -0.5]
    instances = [Instance(obj_id=1, T_cam_obj=near), Instance(obj_id=2, T_cam_obj=table)]
    with Rasteriser({1: BOX, 2: mesh_of(trimesh.creation.box((0.4, 0.02, 4.0)))}) as rasteriser:
        layers = rasteriser.render_scene(instances, K, 140, 100)
    assert layers.depth_m[layers.instance == 1].max() > 1.2


def test_object_through_the_camera_plane_is_clipped_not_mirrored(rasteriser: Rasteriser) -> None:
    T = np.eye(4)
    T[2, 3] = 0.02
    depth_m = rasteriser.render(1, K, T[None], 140, 100).depth_m
    assert depth_m.max() <= 0.05 and (depth_m >= 0).all()


def test_same_input_twice_gives_the_same_bytes(rasteriser: Rasteriser) -> None:
    T = poses(6)
    first, second = rasteriser.render(2, K, T, 140, 100), rasteriser.render(2, K, T, 140, 100)
    np.testing.assert_array_equal(first.depth_m, second.depth_m)
    np.testing.assert_array_equal(first.rgb, second.rgb)


def test_unknown_object_is_an_error(rasteriser: Rasteriser) -> None:
    with pytest.raises(RenderError, match="object 9 has no mesh"):
        rasteriser.render(9, K, poses(1), 32, 32)


def test_a_mesh_and_its_copy_with_another_origin_are_drawn_alike() -> None:
    """Bit for bit: float32 has no digits to spare for an origin 2 m off. The shift is exact in binary."""
    exact = replace(BOX, vertices_m=np.round(BOX.vertices_m * 2**20) / 2**20)
    shift_m, T = np.array([2.0, -1.0, 0.5]), poses(8)
    with Rasteriser({1: exact, 2: exact.with_origin_at(-shift_m)}) as rasteriser:
        plain = rasteriser.render(1, K, T, 140, 100)
        other = rasteriser.render(2, K, se3.with_origin_at(T, -shift_m), 140, 100)
    assert plain.mask.any()
    np.testing.assert_array_equal(plain.depth_m, other.depth_m)
    np.testing.assert_array_equal(plain.rgb, other.rgb)
