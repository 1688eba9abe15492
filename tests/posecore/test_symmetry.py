"""Symmetries: sampled groups are groups, keep their axis, and reach every pose they should."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from posecore import se3
from posecore.bop import ModelInfo
from posecore.symmetry import ContinuousSymmetry, align_ball, is_ball, rotations_about_axis, symmetry_transforms

Z_AXIS = ContinuousSymmetry((0.0, 0.0, 1.0), (0.01, 0.02, 0.0))
X_AXIS = ContinuousSymmetry((1.0, 0.0, 0.0), (0.05, 0.02, 0.03))
FLIP = rotations_about_axis(np.array([1.0, 0.0, 0.0]), np.array([np.pi]), np.array([0.01, 0.02, 0.0]))[0]


def info(*, discrete=(), continuous=()):
    return ModelInfo(diameter_m=0.1, symmetries_discrete=tuple(discrete), symmetries_continuous=tuple(continuous))


def nearest_distance(S, transforms):
    return np.abs(transforms - S).max(axis=(1, 2)).min()


def test_no_symmetry_is_the_identity_alone():
    assert np.array_equal(symmetry_transforms(info()), np.eye(4)[None])


def test_bop_step_gives_315_turns_and_the_identity_first():
    transforms = symmetry_transforms(info(continuous=[Z_AXIS]))
    assert transforms.shape == (315, 4, 4)
    assert np.array_equal(transforms[0], np.eye(4))


def test_points_on_the_axis_stay():
    transforms = symmetry_transforms(info(continuous=[Z_AXIS]), max_step_rad=0.5)
    on_axis = np.array([[0.01, 0.02, z] for z in (-1.0, 0.0, 3.0)])
    assert np.allclose(se3.apply(transforms, on_axis), on_axis, atol=1e-12)


@pytest.mark.parametrize("discrete", [(), (FLIP,)])
def test_turns_and_flip_close_under_composition(discrete):
    transforms = symmetry_transforms(info(discrete=discrete, continuous=[Z_AXIS]), max_step_rad=np.pi / 6)
    assert len(transforms) == 12 * (1 + len(discrete))
    for first in transforms[::5]:
        for second in transforms[::3]:
            assert nearest_distance(first @ second, transforms) < 1e-9


def test_parallel_axes_are_one_axis():
    opposite = ContinuousSymmetry((0.0, 0.0, -1.0), (0.01, 0.02, 5.0))
    assert not is_ball([Z_AXIS, opposite])
    assert len(symmetry_transforms(info(continuous=[Z_AXIS, opposite]))) == 315


def test_two_axes_reach_every_rotation_about_their_common_point():
    z_axis = ContinuousSymmetry((0.0, 0.0, 1.0), (0.05, 0.02, 0.0))
    transforms = symmetry_transforms(info(continuous=[z_axis, X_AXIS]))
    center = np.array([[0.05, 0.02, 0.03]])
    assert np.allclose(se3.apply(transforms, center), center, atol=1e-9)
    rng = np.random.default_rng(0)
    for _ in range(50):
        R = se3.random_rotation(rng)
        gaps = se3.rotation_angle_rad(np.swapaxes(transforms[:, :3, :3], 1, 2) @ R)
        assert np.rad2deg(gaps.min()) < 13.0


@given(st.integers(0, 10_000))
def test_align_ball_takes_over_the_other_rotation_and_keeps_the_center(seed):
    rng = np.random.default_rng(seed)
    z_axis = ContinuousSymmetry((0.0, 0.0, 1.0), (0.05, 0.02, 0.0))
    T, other = (se3.make_T(se3.random_rotation(rng), rng.normal(size=3)) for _ in range(2))
    S = align_ball([z_axis, X_AXIS], T, other)
    center = np.array([[0.05, 0.02, 0.03]])
    assert np.allclose((T @ S)[:3, :3], other[:3, :3])
    assert np.allclose(se3.apply(T @ S, center), se3.apply(T, center))
