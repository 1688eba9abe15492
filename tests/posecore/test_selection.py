"""What is drawn of a mesh: each bound of a level on its own, and the radius under which nothing is left out."""

import numpy as np
import pytest
from posecore import se3
from posecore.mesh import DetailLevel, Mesh
from posecore.raster.selection import MAX_ERROR_PX, RMS_ERROR_PX, SPACING_PX, is_in_image, level_number

PX = 100.0
"""Pixels for a diameter of the mesh on the axis at DEPTH_M."""
DEPTH_M = 2.0
K = np.array([[PX * DEPTH_M, 0.0, 50.0], [0.0, PX * DEPTH_M, 50.0], [0.0, 0.0, 1.0]])
BOUNDS = {"rms_error": RMS_ERROR_PX, "max_error": MAX_ERROR_PX, "spacing": SPACING_PX}


def mesh_of(vertices_m: np.ndarray, *levels: DetailLevel) -> Mesh:
    faces = np.array([[0, 1, 2], [0, 1, 3], [0, 2, 3], [1, 2, 3]], np.int32)
    return Mesh(vertices_m=vertices_m, faces=faces, normals=np.eye(4, 3, dtype=np.float32), levels=levels)


def tetrahedron(*levels: DetailLevel) -> Mesh:
    """A regular one of diameter 1 with a corner in a corner of its box, which reaches far from the box's centre."""
    a, b = np.sqrt(8) / 3, np.sqrt(2) / 6
    return mesh_of(np.array([[0.0, 0.0, 0.0], [a, b, b], [b, a, b], [b, b, a]]), *levels)


def level(**bounds: float) -> DetailLevel:
    """A level whose errors are far below their bounds at `PX`, but for these fractions of them."""
    values = {name: bounds.get(name, 0.1) * limit_px / PX for name, limit_px in BOUNDS.items()}
    empty = np.zeros((0, 3), np.float32)
    return DetailLevel(
        offsets=empty, sources=np.zeros(0, np.int64), faces=empty.astype(np.int32), is_closed=True, **values
    )


def at(mesh: Mesh, x: float = 0.0, y: float = 0.0) -> np.ndarray:
    """Pose with the mesh's centre at DEPTH_M, moved by multiples of it."""
    return se3.make_T(np.eye(3), DEPTH_M * np.array([x, y, 1.0]) - mesh.center_m)


@pytest.mark.parametrize("name", list(BOUNDS))
def test_a_level_is_drawn_within_each_of_its_bounds_alone(name: str) -> None:
    for fraction, number in ((0.99, 1), (1.01, 0)):
        mesh = tetrahedron(level(**{name: fraction}))
        assert level_number(mesh, K, at(mesh)) == number


@pytest.mark.parametrize("name", list(BOUNDS))
@pytest.mark.parametrize(("x", "y"), [(0.75, 0.0), (0.0, -0.75)])
def test_a_level_off_the_axis_shows_more_of_its_error(name: str, x: float, y: float) -> None:
    """At 0.75 of the depth beside the axis the distance is 1.25 of the depth."""
    for fraction, number in ((0.79, 1), (0.81, 0)):
        mesh = tetrahedron(level(**{name: fraction}))
        assert level_number(mesh, K, at(mesh, x, y)) == number


@pytest.mark.parametrize("stretched", [np.diag([2.0, 1.0, 1.0]), np.diag([1.0, 2.0, 1.0])])
def test_the_longer_focal_length_counts(stretched: np.ndarray) -> None:
    for fraction, number in ((0.49, 1), (0.51, 0)):
        mesh = tetrahedron(level(rms_error=fraction))
        assert level_number(mesh, stretched @ K, at(mesh)) == number


def test_the_coarsest_level_that_fits_is_drawn() -> None:
    mesh = tetrahedron(level(), level(spacing=0.9), level(spacing=1.1), level(max_error=2.0))
    assert level_number(mesh, K, at(mesh)) == 2
    assert level_number(mesh, np.diag([0.1, 0.1, 1.0]) @ K, at(mesh)) == 4


PLANES = [(1.0, 0.0, 0.25), (-1.0, 0.0, 0.25), (0.0, 1.0, 0.25), (0.0, -1.0, 0.25)]
"""Planes of the image's sides in camera axes, pointing inward: f x + c z = 0 and so on."""


@pytest.mark.parametrize("plane", PLANES)
def test_nothing_that_reaches_into_the_image_is_left_out_and_no_more_than_that_is_kept(plane: tuple) -> None:
    """The corner that is farthest from the centre points into the image: 0.8165 diameters, the bound is 0.8661."""
    mesh, inward = tetrahedron(), np.array(plane) / np.linalg.norm(plane)
    reach = mesh.vertices_m[0] - mesh.center_m
    assert np.linalg.norm(reach) == pytest.approx(0.8165, abs=1e-4) and mesh.diameter_m == pytest.approx(1.0)
    assert np.linalg.norm(mesh.vertices_m - mesh.center_m, axis=1).max() == np.linalg.norm(reach)
    on_plane = DEPTH_M * np.array([-plane[0] * 0.25, -plane[1] * 0.25, 1.0])
    R = turned_onto(reach / np.linalg.norm(reach), inward)
    for outside, is_drawn in ((0.81, True), (0.866, True), (0.87, False)):
        T = se3.make_T(R, on_plane - outside * inward - R @ mesh.center_m)
        assert is_in_image(mesh, K, T, 100, 100) == is_drawn
        corner = se3.apply(T, mesh.vertices_m[:1])[0] @ inward
        assert (corner > 0) == (outside < 0.8165)


def turned_onto(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """A rotation of one unit vector onto another."""
    axis, cos = np.cross(a, b), float(a @ b)
    return se3.rotation_from_rotvec(axis / np.linalg.norm(axis) * np.arccos(cos))
