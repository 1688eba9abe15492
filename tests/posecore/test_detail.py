"""Levels of detail: their errors, their choice, and what a render shows of them."""

from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
import trimesh
from posecore import camera, detail, se3
from posecore.detail import with_levels
from posecore.mesh import Mesh, load_mesh, save_ply
from posecore.raster import Instance, Rasteriser, rasteriser, selection
from posecore.raster.selection import MAX_ERROR_PX, RMS_ERROR_PX, level_number


def rough_ball(subdivisions: int = 5) -> Mesh:
    """A bumpy ball of 20 480 faces and about 100 mm, colours running over it, its origin 30 mm off."""
    ball = trimesh.creation.icosphere(subdivisions=subdivisions)
    unit = np.asarray(ball.vertices)
    radius_m = 0.05 * (1 + 0.15 * np.sin(3 * unit[:, 0] + 1) * np.cos(4 * unit[:, 1]) + 0.01 * np.sin(40 * unit[:, 2]))
    return Mesh(
        vertices_m=unit * radius_m[:, None] + [0.03, 0.0, 0.0],
        faces=np.asarray(ball.faces, np.int32),
        normals=unit.astype(np.float32),
        vertex_rgb=(127 + 100 * np.sin(2 * unit)).astype(np.uint8),
    )


@pytest.fixture(scope="module")
def ball() -> Mesh:
    return with_levels(rough_ball())


def views(mesh: Mesh, side_px: int, n: int = 6) -> tuple[np.ndarray, np.ndarray]:
    """A camera in which the diameter covers 0.8 of the side, and poses in front of it."""
    K = camera.intrinsics(8 * 0.8 * side_px, 8 * 0.8 * side_px, side_px / 2, side_px / 2)
    rng = np.random.default_rng(0)
    R = [se3.random_rotation(rng) for _ in range(n)]
    T = [se3.make_T(r, np.array([0.0, 0.0, 8 * mesh.diameter_m]) - r @ mesh.center_m) for r in R]
    return K, np.stack(T)


def test_levels_halve_the_faces_and_their_errors_grow(ball: Mesh) -> None:
    faces = [len(level.faces) for level in ball.levels]
    assert faces == [8192, 4096, 2048, 1024, 512, 256]
    assert list(np.diff([level.rms_error for level in ball.levels]) > 0) == [True] * 5
    assert all(level.is_closed and level.rms_error <= level.max_error for level in ball.levels)


@pytest.mark.parametrize("number", [2, 5])
def test_errors_are_the_distances_between_the_surfaces(ball: Mesh, number: int) -> None:
    """Against trimesh's exact nearest points, at other points than those that were measured."""
    full, less = (mesh.vertices_m[mesh.faces] for mesh in (ball, ball.level(number)))
    rng = np.random.default_rng(0)
    distances = []
    for one, other in ((full, less), (less, full)):
        weights = rng.dirichlet(np.ones(3), 150)
        for corners, weight in zip(one[rng.integers(len(one), size=150)], weights, strict=True):
            point = weight @ corners
            nearest = trimesh.triangles.closest_point(other, np.broadcast_to(point, (len(other), 3)))
            distances.append(np.linalg.norm(nearest - point, axis=1).min())
    distances = np.array(distances)
    level = ball.levels[number - 1]
    assert np.sqrt((distances**2).mean()) / ball.diameter_m == pytest.approx(level.rms_error, rel=0.3)
    assert distances.max() / ball.diameter_m <= 1.05 * level.max_error


@pytest.mark.parametrize("change", ["faces are missing", "a face too many"])
def test_errors_are_measured_from_both_surfaces(monkeypatch: pytest.MonkeyPatch, change: str) -> None:
    """A level that lacks half of the mesh is on it everywhere; one with a face beside it is near to all of the mesh."""
    plain = rough_ball(4)

    def simplified(points: np.ndarray, faces: np.ndarray, **_: object) -> tuple[np.ndarray, np.ndarray]:
        if change == "faces are missing":
            return points, faces[points[faces].mean(axis=1)[:, 2] > 0]
        if len(points) > plain.vertices_m.shape[0]:
            return points, faces
        beside = np.float32([[0, 0, 150], [1, 0, 150], [0, 1, 150]])  # millimetres
        return np.concatenate([points, beside]), np.concatenate([faces, [np.arange(3) + len(points)]]).astype(np.int32)

    monkeypatch.setattr(detail.fast_simplification, "simplify", simplified)
    ball = with_levels(plain)
    assert ball.levels and min(level.max_error for level in ball.levels) > 0.5


@pytest.mark.parametrize("side_px", [24, 64, 160])
def test_a_render_shows_the_mesh_to_a_tenth_of_a_pixel(ball: Mesh, side_px: int) -> None:
    """Silhouettes by a tenth of a pixel of the outline, depths by what a tenth of a pixel changes, colours by noise."""
    K, T = views(ball, side_px)
    numbers = {level_number(ball, K, pose) for pose in T}
    assert min(numbers) > 0
    with Rasteriser({1: replace(ball, levels=()), 2: ball}) as drawer:
        full, less = (drawer.render(i, K, T, side_px, side_px) for i in (1, 2))
    both = full.mask & less.mask
    inner = np.stack([cv2.erode(mask.astype(np.uint8), np.ones((3, 3), np.uint8)) for mask in both]) > 0
    outline_px = np.pi * 0.8 * side_px
    assert ((full.mask != less.mask).sum(axis=(1, 2)) < 2 * RMS_ERROR_PX * outline_px).all()
    for one, other in ((full.mask, less.mask), (less.mask, full.mask)):
        reached = [cv2.dilate(mask.astype(np.uint8), np.ones((5, 5), np.uint8)) > 0 for mask in one]
        assert not (other & ~np.stack(reached)).any()  # nothing is more than MAX_ERROR_PX off
    px_m = ball.diameter_m / (0.8 * side_px)
    error_m = np.abs(full.depth_m - less.depth_m)[inner]
    assert np.sqrt((error_m**2).mean()) < 5 * RMS_ERROR_PX * px_m  # surfaces are steep at the outline
    assert np.median(error_m) < RMS_ERROR_PX * px_m
    assert np.abs(full.rgb[both].astype(int) - less.rgb[both]).mean() < 3


def test_the_level_follows_the_drawn_size_and_nothing_else(ball: Mesh) -> None:
    numbers = []
    for side_px in (16, 64, 256, 4096):
        K, T = views(ball, side_px)
        number = level_number(ball, K, T[0])
        numbers.append(number)
        assert {level_number(ball, K, pose) for pose in T} == {number}
        if number:
            px = K[0, 0] / 8
            assert ball.levels[number - 1].rms_error * px <= RMS_ERROR_PX * 1.001
            assert ball.levels[number - 1].max_error * px <= MAX_ERROR_PX * 1.001
    assert numbers == sorted(numbers, reverse=True) and numbers[0] > numbers[1] > 0 and numbers[3] == 0
    assert len(ball.level(numbers[1]).faces) <= 64**2
    K, T = views(ball, 64)
    T[0, 2, 3] = 0.5 * ball.diameter_m
    assert level_number(ball, K, T[0]) == 0


def test_a_render_with_levels_does_not_depend_on_its_batch_mates(ball: Mesh) -> None:
    K, T = views(ball, 48, n=12)
    T[:, 2, 3] *= np.geomspace(0.2, 4, 12)
    assert len({level_number(ball, K, pose) for pose in T}) > 3
    with Rasteriser({1: ball}) as drawer:
        batch = drawer.render(1, K, T, 48, 48)
        for i in range(12):
            alone = drawer.render(1, K, T[i : i + 1], 48, 48)
            np.testing.assert_array_equal(alone.rgb[0], batch.rgb[i])
            np.testing.assert_array_equal(alone.depth_m[0], batch.depth_m[i])


def test_the_copy_in_a_dataset_has_the_same_levels(ball: Mesh, tmp_path: Path) -> None:
    save_ply(ball, tmp_path / "copy.ply")
    copy = with_levels(load_mesh(tmp_path / "copy.ply"))
    for stored, own in zip(copy.levels, ball.levels, strict=True):
        np.testing.assert_array_equal(stored.faces, own.faces)
        np.testing.assert_array_equal(stored.sources, own.sources)
        np.testing.assert_allclose(stored.offsets, own.offsets, rtol=1e-6, atol=1e-9)


def test_scaled_and_recoloured_copies_share_the_levels(ball: Mesh) -> None:
    half, white = ball.scaled(0.5), ball.recoloured((255, 255, 255))
    assert half.levels is ball.levels is white.levels
    np.testing.assert_allclose(half.center_m, 0, atol=1e-12)
    assert half.diameter_m == pytest.approx(ball.diameter_m / 2)
    assert half.is_closed and white.diameter_m == ball.diameter_m
    np.testing.assert_allclose(half.level(2).vertices_m, (ball.level(2).vertices_m - ball.center_m) / 2, atol=1e-9)
    assert (white.level(2).colours == 255).all()
    np.testing.assert_array_equal(ball.level(2).colours, ball.colours[ball.levels[1].sources])


def test_hard_edges_stay_hard() -> None:
    """A dense box whose faces share no vertices: each vertex of a level has the normal of its side."""
    box = trimesh.creation.box((0.1, 0.06, 0.04))
    for _ in range(5):
        box = box.subdivide()
    corners = box.faces.reshape(-1)
    soup = with_levels(
        Mesh(
            vertices_m=np.asarray(box.vertices)[corners],
            faces=np.arange(len(corners), dtype=np.int32).reshape(-1, 3),
            normals=np.repeat(box.face_normals, 3, axis=0).astype(np.float32),
        )
    )
    for number in range(1, len(soup.levels) + 1):
        less = soup.level(number)
        triangles = less.vertices_m[less.faces]
        normals = np.cross(triangles[:, 1] - triangles[:, 0], triangles[:, 2] - triangles[:, 0])
        has_area = np.linalg.norm(normals, axis=1) > 1e-12
        normals = normals[has_area] / np.linalg.norm(normals[has_area], axis=1, keepdims=True)
        assert (np.einsum("fki,fi->fk", less.normals[less.faces[has_area]], normals) > 0.99).all()


def test_small_and_textured_meshes_have_none(ball: Mesh) -> None:
    plain = replace(ball, levels=())
    assert with_levels(replace(plain, faces=ball.faces[: detail.FEWEST_FACES])).levels == ()
    uv, texture = np.zeros((len(ball.vertices_m), 2), np.float32), np.zeros((2, 2, 3), np.uint8)
    assert with_levels(replace(plain, vertex_rgb=None, uv=uv, texture_rgb=texture)).levels == ()


def test_what_is_out_of_sight_is_left_out_and_nothing_else(ball: Mesh, monkeypatch: pytest.MonkeyPatch) -> None:
    """Objects around and across the border of an image: with and without the test of their spheres, the same bytes."""
    K, T = views(ball, 64)
    rng = np.random.default_rng(2)
    T = np.repeat(T, 20, axis=0)
    T[:, :2, 3] += rng.uniform(-2, 2, (len(T), 2)) * ball.diameter_m
    drawn = [selection.is_in_image(ball, K, pose, 64, 64) for pose in T]
    assert 0.2 < np.mean(drawn) < 0.9
    instances = [Instance(obj_id=1, T_cam_obj=pose) for pose in T[:9]]
    with Rasteriser({1: ball}) as drawer:
        fast, fast_scene = drawer.render(1, K, T, 64, 64), drawer.render_scene(instances, K, 64, 64)
        monkeypatch.setattr(rasteriser, "is_in_image", lambda *_: True)
        slow, slow_scene = drawer.render(1, K, T, 64, 64), drawer.render_scene(instances, K, 64, 64)
    np.testing.assert_array_equal(fast.depth_m, slow.depth_m)
    np.testing.assert_array_equal(fast.rgb, slow.rgb)
    np.testing.assert_array_equal(fast_scene.instance, slow_scene.instance)
    assert fast.mask[np.array(drawn)].any()


def test_a_picture_has_the_colours_and_instances_of_the_scene(ball: Mesh) -> None:
    K, T = views(ball, 64)
    T[1:, 0, 3] += 0.04
    instances = [Instance(obj_id=1, T_cam_obj=pose, tint=(1.0, 0.5, 0.2)) for pose in T[:3]]
    with Rasteriser({1: ball}) as drawer:
        scene, labels = (drawer.render_scene(instances, K, 64, 64, rgb=rgb) for rgb in (True, False))
        rgb, instance = drawer.render_picture(instances, K, 64, 64)
    np.testing.assert_array_equal(rgb, scene.rgb)
    for layer in (instance, labels.instance):
        np.testing.assert_array_equal(layer, scene.instance)
    np.testing.assert_array_equal(labels.depth_m, scene.depth_m)


def uv_ball(rows: int, columns: int) -> Mesh:
    """A ball as exporters write it: each pole is as many vertices at one position as there are meridians."""
    polar, azimuth = np.meshgrid(np.linspace(0, np.pi, rows + 1), np.linspace(0, 2 * np.pi, columns + 1), indexing="ij")
    unit = np.stack([np.sin(polar) * np.cos(azimuth), np.sin(polar) * np.sin(azimuth), np.cos(polar)], axis=-1)
    unit = unit.round(12).reshape(-1, 3)
    a = (np.arange(rows)[:, None] * (columns + 1) + np.arange(columns)).reshape(-1)
    b, c, d = a + 1, a + columns + 1, a + columns + 2
    faces = np.concatenate([np.stack([a, c, b], axis=-1), np.stack([b, c, d], axis=-1)])
    return Mesh(vertices_m=0.05 * unit, faces=faces.astype(np.int32), normals=unit)


def test_many_vertices_at_one_position_cost_no_more_each(monkeypatch):
    calls, einsum = [], np.einsum
    monkeypatch.setattr(detail.np, "einsum", lambda *args, **options: calls.append(1) or einsum(*args, **options))
    mesh = with_levels(uv_ball(20, 400))
    assert len(mesh.levels) >= 4
    assert len(calls) <= 2 * len(mesh.levels)
    for level in mesh.levels:
        assert (einsum("vi,vi->v", mesh.normals[level.sources], level.offsets) > 0.4).all()


def test_of_vertices_at_one_position_the_first_that_fits_best_is_taken():
    mesh = uv_ball(6, 30)
    rng = np.random.default_rng(0)
    mesh = replace(mesh, normals=rng.integers(-2, 3, mesh.normals.shape).astype(np.float64))  # of which many are equal
    positions = detail._Positions(mesh)
    point = rng.integers(0, len(positions.points_mm), 500)
    normal = rng.normal(size=(500, 3))
    chosen = positions._fitting(point, normal)
    for p, n, index in zip(point, normal, chosen, strict=True):
        members = np.arange(positions._begin[p], positions._begin[p + 1])
        fit = np.einsum("mi,i->m", mesh.normals[positions._members[members]], n)
        assert index == members[np.flatnonzero(fit >= fit.max() - 1e-12)[0]]


def box_with_needles() -> Mesh:
    """A box of 100 mm, finely cut and rotated, float32 millimetres, without normals; needles lie along its edges.

    Every second triangle's longest edge has a further vertex in its middle, which a needle joins to it.
    """
    box = trimesh.creation.box((100.0, 60.0, 40.0))
    for _ in range(5):
        box = box.subdivide()
    vertices, faces = np.asarray(box.vertices) @ se3.rotation_from_rotvec(np.array([0.3, 0.5, 0.2])).T, box.faces
    split, rest = faces[::2], faces[1::2]
    middle = len(vertices) + np.arange(len(split))
    a, b, c = split.T
    parts = [rest, np.stack([a, middle, c], 1), np.stack([middle, b, c], 1), np.stack([a, b, middle], 1)]
    vertices = np.concatenate([vertices, (vertices[a] + vertices[b]) / 2]) + np.array([31.0, -7.0, 12.0])
    faces = np.concatenate(parts)
    return Mesh(
        vertices_m=vertices.astype(np.float32).astype(np.float64) / 1e3,
        faces=faces.astype(np.int32),
        normals=np.asarray(trimesh.Trimesh(vertices, faces, process=False).vertex_normals, np.float32),
        vertex_rgb=np.random.default_rng(0).integers(0, 255, (len(vertices), 3)).astype(np.uint8),
        has_normals=False,
    )


def test_levels_of_copies_are_the_copied_levels() -> None:
    """Needles have an area or none by rounding, and what is drawn of a copy is that of the original nevertheless."""
    mesh = with_levels(box_with_needles())
    own = mesh.level(1)
    shift_m = np.array([0.7, -1.3, 0.11])
    for copy, vertices_m in (
        (mesh.with_origin_at(shift_m), own.vertices_m - shift_m),
        (mesh.scaled(0.731), (own.vertices_m - mesh.center_m) * 0.731),
        (mesh.recoloured((1, 2, 3)).with_origin_at(shift_m), own.vertices_m - shift_m),
    ):
        less = copy.level(1)
        np.testing.assert_allclose(less.vertices_m, vertices_m, atol=1e-12)
        np.testing.assert_array_equal(less.faces, own.faces)
        np.testing.assert_array_equal(less.normals, own.normals)
        np.testing.assert_array_equal(copy.drawn.faces, mesh.drawn.faces)
        assert copy.sha256 == ""
    np.testing.assert_array_equal(mesh.scaled(2.0).level(1).colours, own.colours)
    assert (mesh.recoloured((1, 2, 3)).level(1).colours == [1, 2, 3]).all()


def test_needles_leave_hard_edges_hard() -> None:
    drawn = box_with_needles().drawn
    corners = drawn.vertices_m[drawn.faces]
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    area = np.linalg.norm(normals, axis=1)
    is_face = area > 1e-3 * area.max()
    assert is_face.mean() < 0.8
    cosines = np.einsum("fki,fi->fk", drawn.normals[drawn.faces], normals / np.maximum(area, 1e-30)[:, None])[is_face]
    assert cosines.min() > 0.999


def test_vertices_without_a_face_do_not_move_the_levels(ball: Mesh) -> None:
    plain = replace(ball, levels=())
    far = {
        "vertices_m": np.vstack([plain.vertices_m, [[9.0, 9.0, 9.0]]]),
        "normals": np.vstack([plain.normals, [[0.0, 0.0, 1.0]]]).astype(np.float32),
        "vertex_rgb": np.vstack([plain.vertex_rgb, [[0, 0, 0]]]).astype(np.uint8),
    }
    other = replace(plain, **far)
    other.__dict__["diameter_m"] = ball.diameter_m
    less = with_levels(other).level(2)
    np.testing.assert_allclose(less.vertices_m, ball.level(2).vertices_m, atol=1e-12)
    np.testing.assert_array_equal(less.colours, ball.level(2).colours)
