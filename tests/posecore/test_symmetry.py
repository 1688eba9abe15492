"""Symmetries: sampled groups are groups, keep their axis, and reach every pose they should."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from posecore import se3
from posecore.bop import ModelInfo
from posecore.symmetry import (
    ContinuousSymmetry,
    align_ball,
    is_ball,
    nearest_symmetric,
    rotations_about_axis,
    symmetric_copies,
    symmetry_transforms,
)

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


QUARTERS = rotations_about_axis(np.array([0.0, 1.0, 1.0]), np.array([0.5, 1.0, 1.5]) * np.pi, np.array([0.0, 0.01, 0]))
BALL = [ContinuousSymmetry((0.0, 0.0, 1.0), (0.05, 0.02, 0.0)), X_AXIS]
KINDS = {
    "none": info(),
    "discrete": info(discrete=QUARTERS),
    "axis": info(continuous=[Z_AXIS]),
    "axis of any length": info(continuous=[ContinuousSymmetry((0.0, 3.0, 4.0), (0.0, 0.01, 0.02))]),
    "axis with flip": info(discrete=[FLIP], continuous=[Z_AXIS]),
    "ball": info(continuous=BALL),
}
POINTS_M = np.random.default_rng(2).normal(size=(40, 3)) * np.array([0.03, 0.02, 0.05])


def random_poses(count, seed):
    rng = np.random.default_rng(seed)
    R = np.stack([se3.random_rotation(rng) for _ in range(count)])
    return se3.make_T(R, rng.normal(size=(count, 3)) * 0.1 + np.array([0.0, 0.0, 1.0]))


def angles(T, T_other):
    return se3.rotation_angle_rad(T[..., :3, :3] @ np.swapaxes(T_other[..., :3, :3], -1, -2))


def point_distances(T, T_other):
    return np.linalg.norm(se3.apply(T, POINTS_M) - se3.apply(T_other, POINTS_M), axis=-1).mean(axis=-1)


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("by", ["rotation", "points"])
def test_the_nearest_symmetric_pose_is_one_and_undoes_any_symmetry(kind, by):
    T = random_poses(6, 3)
    every = symmetry_transforms(KINDS[kind], max_step_rad=0.7)
    for S in every[:: max(1, len(every) // 20)]:
        found = nearest_symmetric(T @ S, T, KINDS[kind], by=by, points_m=POINTS_M)
        np.testing.assert_allclose(found, T, atol=1e-7)


@pytest.mark.parametrize("kind", KINDS)
def test_none_of_all_sampled_poses_is_nearer_by_rotation(kind):
    T, T_reference = random_poses(10, 4), random_poses(10, 5)
    found = nearest_symmetric(T, T_reference, KINDS[kind])
    step_rad = np.pi / 60
    every = T[:, None] @ symmetry_transforms(KINDS[kind], max_step_rad=step_rad)
    sampled = angles(every, T_reference[:, None]).min(axis=1)
    assert (angles(found, T_reference) <= sampled + 1e-9).all()
    if kind != "ball":
        assert (angles(found, T_reference) >= sampled - step_rad).all()


@pytest.mark.parametrize("kind", KINDS)
def test_none_of_all_sampled_poses_is_nearer_by_points(kind):
    """In the neighbourhood of a pose, where the mean and the mean squared distance agree to a few percent."""
    T = random_poses(10, 6)
    rng = np.random.default_rng(7)
    every = symmetry_transforms(KINDS[kind], max_step_rad=np.pi / 60)
    T_reference = np.stack([se3.perturb(pose, 0.3, 0.01, rng) for pose in T @ every[len(every) // 3]])
    found = nearest_symmetric(T, T_reference, KINDS[kind], by="points", points_m=POINTS_M)
    sampled = point_distances(T[:, None] @ every, T_reference[:, None]).min(axis=1)
    assert (point_distances(found, T_reference) <= 1.03 * sampled).all()


def test_batches_and_single_poses_agree_and_missing_estimates_do_no_harm():
    T, T_reference = random_poses(6, 8).reshape(2, 3, 4, 4), random_poses(6, 9).reshape(2, 3, 4, 4)
    T_reference[1, 1] = np.nan
    for kind in KINDS.values():
        found = nearest_symmetric(T, T_reference, kind)
        np.testing.assert_array_equal(found[0, 2], nearest_symmetric(T[0, 2], T_reference[0, 2], kind))
        if kind is not KINDS["ball"]:
            np.testing.assert_array_equal(found[1, 1], T[1, 1])


def test_of_equally_near_poses_the_first_is_taken():
    twice = info(discrete=[np.eye(4) + 1e-12, *QUARTERS[1:2]])
    T = random_poses(3, 10)
    np.testing.assert_array_equal(nearest_symmetric(T, T, twice), T)


def test_copies_are_one_for_each_discrete_symmetry():
    T, T_reference = random_poses(4, 11), random_poses(4, 12)
    assert symmetric_copies(T, T_reference, None).shape == (4, 1, 4, 4)
    assert symmetric_copies(T, T_reference, KINDS["discrete"]).shape == (4, 4, 4, 4)
    assert symmetric_copies(T, T_reference, KINDS["axis with flip"]).shape == (4, 2, 4, 4)
    aligned = symmetric_copies(T, T_reference, KINDS["ball"])[:, 0]
    expected = [pose @ align_ball(BALL, pose, other) for pose, other in zip(T, T_reference, strict=True)]
    np.testing.assert_allclose(aligned, expected, atol=1e-12)


def test_points_are_needed_by_points():
    with pytest.raises(ValueError, match="needs points_m"):
        nearest_symmetric(np.eye(4), np.eye(4), KINDS["axis"], by="points")
