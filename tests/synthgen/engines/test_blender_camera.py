"""The lens and the occupied region: plain arithmetic, without Blender."""

import numpy as np
import pytest
from blender_scenes import SKEWED, at, box
from posecore import se3
from posecore.camera import project
from synthgen.engines.blender.camera import (
    USUAL_CLIP_M,
    blender_from_opencv,
    clip_range_m,
    lens_for,
    occupied_region,
)

REGION = (-20, -60, 160, 220)


def corners(*poses: np.ndarray) -> np.ndarray:
    points = np.unique(box(0.06, 0.09, 0.04).vertices_m, axis=0)
    return np.stack([se3.apply(T, points) for T in poses])


def test_axes_turn_about_x_by_half_a_turn():
    T = blender_from_opencv(at(1.0, 2.0, 3.0))
    np.testing.assert_array_equal(T[:3, 3], (1.0, -2.0, -3.0))
    assert np.linalg.det(T[:3, :3]) == pytest.approx(1.0)


def test_lens_keeps_the_ratio_of_the_focal_lengths():
    lens = lens_for(SKEWED, REGION)
    assert lens.pixel_aspect_y / lens.pixel_aspect_x == pytest.approx(SKEWED.K[0, 0] / SKEWED.K[1, 1])
    assert min(lens.pixel_aspect_x, lens.pixel_aspect_y) == 1.0


def test_occupied_region_holds_every_projected_corner_and_stays_inside():
    points = corners(at(-0.03, 0.0, 0.5, (0.3, 0.2, 0.1)), at(-0.01, 0.02, 0.6))
    x0, y0, width, height = occupied_region(SKEWED, REGION, points)
    uv = project(SKEWED.K, points.reshape(-1, 3))
    assert (uv > (x0 + 1, y0 + 1)).all()
    assert (uv < (x0 + width - 1, y0 + height - 1)).all()
    assert width * height < REGION[2] * REGION[3]
    left, top, wide, high = occupied_region(SKEWED, (0, 0, 60, 30), points)
    assert left >= 0 and top >= 0
    assert left + wide <= 60 and top + high <= 30


def test_occupied_region_is_none_out_of_sight_and_everything_around_the_camera():
    assert occupied_region(SKEWED, REGION, corners(at(5.0, 0.0, 0.5))) is None
    assert occupied_region(SKEWED, REGION, corners(at(0.0, 0.0, 0.0), at(0.0, 0.0, 0.5))) == REGION


@pytest.mark.parametrize(("scale", "z_m"), [(1.0, 0.4), (50.0, 90.0)])
def test_the_usual_clipping_planes_hold_what_fits(scale, z_m):
    assert clip_range_m(scale * corners(at(0.0, 0.0, z_m / scale))) == USUAL_CLIP_M


@pytest.mark.parametrize(("scale", "z_m"), [(0.02, 0.0095), (80.0, 103.0), (80.0, 5000.0), (1.0, 150.0)])
def test_the_clipping_planes_of_tiny_and_far_objects_are_around_them(scale, z_m):
    """Nothing is cut off, and a depth buffer of 24 bits has steps of a millionth of the depth."""
    points = scale * corners(at(0.0, 0.0, z_m / scale), at(0.0, 0.0, 0.5 * z_m / scale))
    near_m, far_m = clip_range_m(points)
    assert 0.0 < near_m < points[..., 2].min()
    assert points[..., 2].max() < far_m
    assert z_m**2 * (far_m - near_m) / (near_m * far_m * 2**24) < 1e-6 * z_m


def test_a_table_behind_the_camera_leaves_the_near_plane_in_front():
    points = np.concatenate([corners(at(0.0, 0.0, 150.0)), 300 * corners(at(0.0, 0.0, -0.01))])
    near_m, far_m = clip_range_m(points)
    assert near_m == pytest.approx(0.05 * 150.0) and far_m > 150.0
