"""Rigid transforms: invariants and round trips with random poses."""

import numpy as np
import pytest
from posecore import se3

RNG = np.random.default_rng(0)


def random_pose(rng: np.random.Generator) -> np.ndarray:
    return se3.make_T(se3.random_rotation(rng), rng.uniform(-1, 1, 3) + np.array([0, 0, 2]))


def test_inverse_undoes_a_batch_of_transforms() -> None:
    T = np.stack([random_pose(RNG) for _ in range(20)])
    np.testing.assert_allclose(se3.inverse(T) @ T, np.broadcast_to(np.eye(4), T.shape), atol=1e-12)


def test_apply_is_the_homogeneous_product() -> None:
    T, points = random_pose(RNG), RNG.normal(size=(7, 3))
    homogeneous = np.hstack([points, np.ones((7, 1))]) @ T.T
    np.testing.assert_allclose(se3.apply(T, points), homogeneous[:, :3], atol=1e-12)


@pytest.mark.parametrize("angle", [0.0, 1e-9, 1e-4, 1.0, np.pi - 1e-6, np.pi])
def test_rotation_angle_is_exact_near_zero_and_pi(angle: float) -> None:
    R = se3.rotation_from_rotvec(se3.random_direction(RNG) * angle)
    assert se3.rotation_angle_rad(R) == pytest.approx(angle, abs=1e-10)


def test_quaternion_and_rotation_vector_round_trips() -> None:
    for _ in range(50):
        R = se3.random_rotation(RNG)
        np.testing.assert_allclose(se3.rotation_from_quat_wxyz(se3.quat_wxyz_from_rotation(R)), R, atol=1e-12)
        np.testing.assert_allclose(se3.rotation_from_rotvec(se3.rotvec_from_rotation(R)), R, atol=1e-9)
        assert se3.quat_wxyz_from_rotation(R)[0] >= 0


def test_quaternion_order_is_wxyz() -> None:
    quarter_turn_about_z = se3.rotation_from_quat_wxyz(np.array([1.0, 0.0, 0.0, 1.0]))
    np.testing.assert_allclose(quarter_turn_about_z @ [1, 0, 0], [0, 1, 0], atol=1e-12)


def test_random_rotations_are_uniform_over_so3() -> None:
    rng = np.random.default_rng(1)
    R = np.stack([se3.random_rotation(rng) for _ in range(4000)])
    assert se3.is_rotation(R).all()
    # every entry of a uniform rotation has mean 0 and variance 1/3; its angle has mean pi/2 + 2/pi
    assert np.abs(R.mean(axis=0)).max() < 0.04
    assert np.abs(R.var(axis=0) - 1 / 3).max() < 0.03
    assert se3.rotation_angle_rad(R).mean() == pytest.approx(np.pi / 2 + 2 / np.pi, abs=0.03)


def test_is_rotation_refuses_scale_and_reflection() -> None:
    R = se3.random_rotation(RNG)
    assert se3.is_rotation(R)
    assert not se3.is_rotation(1.01 * R)
    assert not se3.is_rotation(R @ np.diag([1.0, 1.0, -1.0]))


def test_nearest_rotation_repairs_noise_and_keeps_rotations() -> None:
    R = se3.random_rotation(RNG)
    np.testing.assert_allclose(se3.nearest_rotation(R), R, atol=1e-12)
    assert se3.is_rotation(se3.nearest_rotation(R + RNG.normal(scale=0.05, size=(3, 3))), tol=1e-9)
    assert se3.is_rotation(se3.nearest_rotation(R @ np.diag([1.0, 1.0, -1.0])), tol=1e-9)


def test_update_between_is_the_inverse_of_apply_update() -> None:
    a, b = random_pose(RNG), random_pose(RNG)
    np.testing.assert_allclose(se3.apply_update(a, *se3.update_between(a, b)), b, atol=1e-12)


def test_update_turns_about_the_object_origin() -> None:
    T = random_pose(RNG)
    turned = se3.apply_update(T, se3.random_rotation(RNG), np.zeros(3))
    np.testing.assert_allclose(turned[:3, 3], T[:3, 3], atol=1e-15)


def test_perturb_has_the_asked_angle_and_length() -> None:
    T = random_pose(RNG)
    moved = se3.perturb(T, 0.3, 0.05, RNG)
    dR, dt = se3.update_between(T, moved)
    assert se3.rotation_angle_rad(dR) == pytest.approx(0.3, abs=1e-12)
    assert np.linalg.norm(dt) == pytest.approx(0.05, abs=1e-12)


def test_an_origin_elsewhere_is_the_same_pose_and_comes_back() -> None:
    T, points_m = np.stack([random_pose(RNG) for _ in range(5)]), RNG.normal(size=(5, 3))
    moved = se3.with_origin_at(T, points_m)
    np.testing.assert_allclose(moved, T @ se3.make_T(np.broadcast_to(np.eye(3), (5, 3, 3)), points_m), atol=1e-15)
    np.testing.assert_allclose(se3.with_origin_at(moved, -points_m), T, atol=1e-15)
    for i in range(5):  # bit for bit the same without the others
        assert np.array_equal(se3.with_origin_at(T[i], points_m[i]), moved[i])
