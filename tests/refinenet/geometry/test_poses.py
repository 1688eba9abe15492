import numpy as np
import torch
from posecore import camera, se3
from refinenet.geometry import poses
from torch.autograd import gradcheck


def rotations(n, seed=0):
    rng = np.random.default_rng(seed)
    return np.stack([se3.random_rotation(rng) for _ in range(n)])


def small_rotations(n, seed=0, angle_rad=0.5):
    rng = np.random.default_rng(seed)
    return se3.rotation_from_rotvec(rng.normal(size=(n, 3)) * angle_rad)


def crops(n, seed=0):
    rng = np.random.default_rng(seed)
    K = np.tile(np.array([[340.0, 0, 0], [0, 345.0, 0], [0, 0, 1]]), (n, 1, 1))
    K[:, :2, 2] = rng.uniform(-150, 200, (n, 2))
    return K


def random_poses(n, seed=0):
    rng = np.random.default_rng(seed)
    return se3.make_T(rotations(n, seed), np.column_stack([rng.normal(size=(n, 2)) * 0.1, rng.uniform(0.5, 1.5, n)]))


def test_quaternion_is_the_twin_of_posecore():
    R = rotations(50)
    quat = se3.quat_wxyz_from_rotation(R)
    np.testing.assert_allclose(poses.rotation_from_quat_wxyz(torch.from_numpy(3.0 * quat)).numpy(), R, atol=1e-12)
    R = small_rotations(50)
    found = poses.quat_wxyz_from_rotation(torch.from_numpy(R)).numpy()
    np.testing.assert_allclose(found, se3.quat_wxyz_from_rotation(R), atol=1e-9)


def test_6d_of_a_rotations_columns_is_that_rotation():
    R = torch.from_numpy(rotations(20))
    x = torch.cat((2.0 * R[:, :, 0], 0.3 * R[:, :, 1] + 5.0 * R[:, :, 0]), dim=1)
    torch.testing.assert_close(poses.rotation_from_6d(x), R)


def test_6d_gives_rotations_for_any_input():
    R = poses.rotation_from_6d(torch.randn(100, 6, dtype=torch.float64, generator=torch.manual_seed(0))).numpy()
    assert se3.is_rotation(R, 1e-9).all()


def test_rotation_angle():
    angles = np.array([0.0, 1e-4, 0.1, 1.0, 3.0, np.pi])
    R = se3.rotation_from_rotvec(np.outer(angles, [0.6, 0.0, 0.8]))
    np.testing.assert_allclose(poses.rotation_angle_deg(torch.from_numpy(R)).numpy(), np.rad2deg(angles), atol=1e-5)


def test_projection_is_the_twin_of_posecore():
    rng = np.random.default_rng(1)
    points = rng.normal(size=(4, 30, 3)) * 0.2 + [0, 0, 1.0]
    K = crops(4)
    found = poses.project(torch.from_numpy(K), torch.from_numpy(points)).numpy()
    np.testing.assert_allclose(found, camera.project(K, points), rtol=1e-12)


def test_points_at_and_behind_the_camera_are_finite_with_a_gradient_towards_the_front():
    z = torch.tensor([0.5, 0.01, 0.0, -0.3, -2.0], dtype=torch.float64, requires_grad=True)
    depth = poses.positive_depth_m(z)
    assert (depth > 0).all()
    depth.sum().backward()
    assert torch.isfinite(z.grad).all()
    assert (z.grad > 0).all()
    assert (depth.diff() < 0).all()


def test_gradients():
    K, T = torch.from_numpy(crops(3)), torch.from_numpy(random_poses(3))
    x = torch.randn(3, 6, dtype=torch.float64, generator=torch.manual_seed(0)).requires_grad_()
    v = (0.1 * torch.randn(3, 3, dtype=torch.float64)).requires_grad_()

    def update(x, v):
        return poses.crop_update(poses.rotation_from_6d(x), v, T, K, 64)[:2]

    assert gradcheck(update, (x, v))
    assert gradcheck(poses.rotation_from_quat_wxyz, torch.randn(3, 4, dtype=torch.float64).requires_grad_())
    points = torch.randn(3, 5, 3, dtype=torch.float64).requires_grad_()  # half of them behind the camera
    assert gradcheck(lambda p: poses.project(K, p), points)


def test_ray_rotation_takes_the_axis_to_the_patch_centre():
    K = crops(10)
    A = poses.ray_rotation(torch.from_numpy(K), 64).numpy()
    assert se3.is_rotation(A, 1e-9).all()
    np.testing.assert_allclose(camera.project(K, A[:, :, 2][:, None])[:, 0], 32.0, atol=1e-9)


def test_crop_update_moves_the_projection_by_shares_of_the_patch():
    K, T = crops(10), random_poses(10)
    rng = np.random.default_rng(2)
    v = rng.normal(size=(10, 3)) * 0.1
    update = poses.crop_update(*map(torch.from_numpy, (rotations(10), v, T, K)), 64)
    moved = se3.apply_update(T, update.dR.numpy(), update.dt.numpy())
    shift = camera.project(K, moved[:, None, :3, 3]) - camera.project(K, T[:, None, :3, 3])
    np.testing.assert_allclose(shift[:, 0], 64 * v[:, :2], atol=1e-9)
    focal = (K[:, 0, 0] + K[:, 1, 1]) / 2
    np.testing.assert_allclose(np.log(moved[:, 2, 3] / T[:, 2, 3]), v[:, 2] * 64 / focal, atol=1e-9)


def test_crop_update_does_not_depend_on_the_focal_length():
    """The same picture through a longer lens from further away asks for the same outputs."""
    K, T = crops(1), random_poses(1)
    far_K, far_T = K.copy(), T.copy()
    far_K[:, 0, 0] *= 2
    far_K[:, 1, 1] *= 2
    far_T[:, 2, 3] *= 2
    v = np.array([[0.05, -0.03, 0.1]])
    near = poses.crop_update(*map(torch.from_numpy, (np.eye(3)[None], v, T, K)), 64)
    far = poses.crop_update(*map(torch.from_numpy, (np.eye(3)[None], v, far_T, far_K)), 64)
    np.testing.assert_allclose(near.dt[:, 2], far.dt[:, 2], rtol=0.1)


def test_apply_and_between_are_inverse():
    T, T_other = torch.from_numpy(random_poses(8, 1)), torch.from_numpy(random_poses(8, 2))
    torch.testing.assert_close(poses.apply_update(T, poses.update_between(T, T_other)), T_other)
