"""Contours, their 3D points and distance transforms."""

import numpy as np
import pytest
import trimesh
from posecore import camera, contour, se3
from posecore.errors import RenderError
from posecore.mesh import Mesh
from posecore.raster import Rasteriser

K = camera.intrinsics(300.0, 300.0, 64.0, 64.0)


def disc(radius: float = 30.0, side: int = 128) -> np.ndarray:
    u, v = np.meshgrid(np.arange(side) + 0.5, np.arange(side) + 0.5)
    return np.hypot(u - side / 2, v - side / 2) < radius


def test_contour_is_the_mask_minus_its_erosion() -> None:
    mask = np.zeros((7, 8), bool)
    mask[2:5, 2:6] = True
    expected = mask.copy()
    expected[3, 3:5] = False
    np.testing.assert_array_equal(contour.contour_mask(mask), expected)


def test_a_silhouette_cut_by_the_border_has_no_contour_there() -> None:
    mask = np.zeros((10, 10), bool)
    mask[:, :5] = True
    found = contour.contour_mask(mask)
    np.testing.assert_array_equal(np.flatnonzero(found.any(axis=0)), [4])
    assert found[:, 4].all()


def test_distance_transform_is_exact() -> None:
    edge = contour.contour_mask(disc())
    on = np.argwhere(edge)
    rows, columns = np.indices(edge.shape)
    brute = np.sqrt(((rows[..., None] - on[:, 0]) ** 2 + (columns[..., None] - on[:, 1]) ** 2).min(axis=-1))
    np.testing.assert_array_equal(contour.distance_transform_px(edge), brute.astype(np.float32))


def test_no_contour_is_an_error() -> None:
    empty = np.zeros((8, 8), bool)
    with pytest.raises(RenderError, match="no contour"):
        contour.distance_transform_px(empty)
    with pytest.raises(RenderError, match="no contour"):
        contour.sample_contour(empty, np.zeros((8, 8), np.float32), K, 4, np.random.default_rng(0))


def test_trace_visits_outline_and_hole_once_and_stays_on_the_contour() -> None:
    mask = disc(40) & ~disc(15)
    pixels = contour.trace(mask)
    assert len(np.unique(pixels, axis=0)) == len(pixels)
    assert contour.contour_mask(mask)[pixels[:, 0], pixels[:, 1]].all()
    radius = np.hypot(pixels[:, 0] + 0.5 - 64, pixels[:, 1] + 0.5 - 64)
    assert (radius > 35).sum() > 200 and (radius < 20).sum() > 70


def test_samples_are_even_along_the_contour_and_without_replacement() -> None:
    mask = disc()
    points = contour.sample_contour(mask, mask.astype(np.float32), K, 100, np.random.default_rng(3))
    uv = camera.project(K, points.astype(np.float64))
    assert len(np.unique(uv.round(3), axis=0)) == 100
    angle = np.sort(np.arctan2(uv[:, 1] - 64, uv[:, 0] - 64))
    gaps = np.diff(np.append(angle, angle[0] + 2 * np.pi))
    assert gaps.max() < 2.5 * 2 * np.pi / 100


def test_more_points_than_pixels_repeats_pixels() -> None:
    mask = np.zeros((8, 8), bool)
    mask[3:5, 3:5] = True
    assert contour.sample_contour(mask, mask.astype(np.float32), K, 50, np.random.default_rng(0)).shape == (50, 3)


def test_lifted_points_lie_on_the_object_and_project_to_its_rim() -> None:
    ball = trimesh.creation.icosphere(4, 0.05)
    mesh = Mesh(
        vertices_m=np.asarray(ball.vertices),
        faces=np.asarray(ball.faces, np.int32),
        normals=np.asarray(ball.vertex_normals, np.float32),
    )
    T = se3.make_T(np.eye(3), np.array([0.02, -0.01, 0.4]))
    with Rasteriser({1: mesh}) as rasteriser:
        layers = rasteriser.render(1, K, T[None], 128, 128, rgb=False)
    points = contour.sample_contour(layers.mask[0], layers.depth_m[0], K, 100, np.random.default_rng(1))
    radius = np.linalg.norm(points - T[:3, 3], axis=1)
    np.testing.assert_allclose(radius, 0.05, atol=3e-4)  # the icosphere's own faceting
    uv = camera.project(K, points.astype(np.float64))
    edge = np.argwhere(contour.contour_mask(layers.mask[0]))[:, ::-1] + 0.5
    assert np.linalg.norm(uv[:, None] - edge, axis=-1).min(axis=1).max() < 1e-3
