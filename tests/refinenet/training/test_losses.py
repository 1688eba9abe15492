from dataclasses import replace

import numpy as np
import pytest
import torch
from posecore import contour, se3
from posecore.raster import Rasteriser
from refinenet.batch import LossTarget
from refinenet.config import LossConfig
from refinenet.data.objects import farthest_points
from refinenet.geometry import poses
from refinenet.geometry.poses import PoseUpdate
from refinenet.geometry.symmetry import ObjectPoints
from refinenet.training import losses
from torch.autograd import gradcheck

PATCH_PX = 128
FOCAL_PX = 560.0
OF_POSES = [name for name in losses.LOSSES if name != "flow+point"]
"""The other one asks for more than a pose: see test_flow.py."""


def make_target(mesh, rasteriser, pairs, seed=0):
    """Targets of (truth, hypothesis) pose pairs seen by one crop camera, float64."""
    rng = np.random.default_rng(seed)
    K = np.array([[FOCAL_PX, 0, PATCH_PX / 2], [0, FOCAL_PX, PATCH_PX / 2], [0, 0, 1.0]])
    rows = []
    for truth, guess in pairs:
        layers = rasteriser.render(1, K, np.stack([truth, guess]), PATCH_PX, PATCH_PX, rgb=False)
        points = [contour.sample_contour(layers.mask[i], layers.depth_m[i], K, 100, rng) for i in range(2)]
        transforms = [contour.distance_transform_px(contour.contour_mask(layers.mask[i])) for i in range(2)]
        rows.append((truth, guess, K, *points, *transforms))
    columns = [torch.from_numpy(np.stack(column).astype(np.float64)) for column in zip(*rows, strict=True)]
    return LossTarget(*columns, torch.zeros(len(rows), dtype=torch.int64))


def object_points(mesh, symmetries=None):
    symmetries = np.eye(4)[None] if symmetries is None else symmetries
    points = farthest_points(mesh.vertices_m, 40)
    valid = torch.ones(1, len(symmetries), dtype=torch.bool)
    no_axes = torch.zeros(1, 0, 3, dtype=torch.float64), torch.zeros(1, 3, dtype=torch.float64)
    return ObjectPoints(torch.from_numpy(points)[None], torch.from_numpy(symmetries)[None], valid, *no_axes)


@pytest.fixture(scope="module")
def truths(mesh):
    rng = np.random.default_rng(3)
    t = np.array([0.0, 0.0, 6 * mesh.diameter_m])
    return [se3.make_T(se3.random_rotation(rng), t) for _ in range(12)]


@pytest.fixture(scope="module")
def rasteriser(mesh):
    with Rasteriser({1: mesh}) as opened:
        yield opened


@pytest.fixture(scope="module")
def shifted(mesh, rasteriser, truths):
    """Hypotheses moved and turned in the image plane: the silhouette's rim stays the rim."""
    rng = np.random.default_rng(4)
    pairs = []
    for truth in truths:
        dR = se3.rotation_from_rotvec(np.array([0.0, 0.0, rng.choice([-1, 1]) * rng.uniform(0.15, 0.4)]))
        dt = rng.uniform(-1, 1, 3) * 0.12 * mesh.diameter_m * np.array([1, 1, 0.5])
        pairs.append((truth, se3.apply_update(truth, dR, dt)))
    return make_target(mesh, rasteriser, pairs)


@pytest.fixture(scope="module")
def turned(mesh, rasteriser, truths):
    """Hypotheses turned by 15 degrees about any axis and moved."""
    rng = np.random.default_rng(5)
    pairs = [(truth, se3.perturb(truth, np.deg2rad(15), 0.15 * mesh.diameter_m, rng)) for truth in truths]
    return make_target(mesh, rasteriser, pairs)


def true_update(target):
    return poses.update_between(target.T_cam_obj_hypothesis, target.T_cam_obj)


def identity(target):
    b = len(target.K_crop)
    return PoseUpdate(torch.eye(3, dtype=torch.float64).repeat(b, 1, 1), torch.zeros(b, 3, dtype=torch.float64))


@pytest.mark.parametrize("name", ["contour", "contour-forward"])
def test_contour_loss_vanishes_at_the_true_update_up_to_a_pixel(mesh, shifted, name):
    chosen = losses.make_loss(LossConfig(name=name, gamma=1.0), object_points(mesh))
    at_truth = chosen(true_update(shifted), shifted)
    directions = 2 if name == "contour" else 1
    assert (at_truth < 0.6 * directions).all()  # contour pixels lie up to half a pixel inside the silhouette's edge
    assert (chosen(identity(shifted), shifted) > 3 * at_truth).all()


def test_contour_loss_at_the_true_update_of_turned_pairs(turned):
    """The rim of another view is another curve on the object: small, not zero, and far below the start."""
    at_truth, at_start = (losses.contour_loss_px(u, turned) for u in (true_update(turned), identity(turned)))
    assert (at_truth < 5.0).all()
    assert at_truth.median() < 1.5
    assert at_truth.mean() < 0.4 * at_start.mean()


def test_rotating_about_the_camera_centre_would_not_vanish(shifted):
    """What the paper's Eq. 3 says when read literally; guards the choice of the object's origin."""
    dR, dt = true_update(shifted)[:2]
    t = shifted.T_cam_obj_hypothesis[:, :3, 3]
    about_camera = PoseUpdate(dR, dt + (dR @ t[..., None])[..., 0] - t)
    moved = about_camera.dt.norm(dim=-1) - dt.norm(dim=-1)
    off_axis = moved.abs() > 1e-3
    assert off_axis.any()
    worse = losses.contour_loss_px(about_camera, shifted) > losses.contour_loss_px(PoseUpdate(dR, dt), shifted)
    assert worse[off_axis].all()


def test_gradient_points_home(turned):
    """A small step against the gradient, from the hypothesis, brings the pose nearer to the truth."""
    dt = torch.zeros(len(turned.K_crop), 3, dtype=torch.float64, requires_grad=True)
    update = PoseUpdate(identity(turned).dR, dt)
    losses.contour_loss_px(update, turned).sum().backward()
    home = true_update(turned).dt[:, :2]
    cosine = -(dt.grad[:, :2] * home).sum(-1) / (dt.grad[:, :2].norm(dim=-1) * home.norm(dim=-1))
    assert (cosine > 0).double().mean() > 0.9
    assert cosine.mean() > 0.6


@pytest.mark.slow
@pytest.mark.parametrize("name", OF_POSES)
def test_descent_on_each_loss_finds_the_pose(mesh, shifted, name):
    """Gradient descent on the update itself, in the parametrisation of the compact network."""
    chosen = losses.make_loss(LossConfig(name=name, gamma=10.0), object_points(mesh))
    rotation = torch.tensor([[1.0, 0, 0, 0, 1, 0]], dtype=torch.float64).repeat(len(shifted.K_crop), 1).requires_grad_()
    v = torch.zeros(len(shifted.K_crop), 3, dtype=torch.float64, requires_grad=True)
    optimiser = torch.optim.Adam([rotation, v], lr=0.02)
    schedule = torch.optim.lr_scheduler.CosineAnnealingLR(optimiser, 150)
    for _ in range(150):
        update = poses.crop_update(
            poses.rotation_from_6d(rotation), v, shifted.T_cam_obj_hypothesis, shifted.K_crop, PATCH_PX
        )
        optimiser.zero_grad()
        chosen(update, shifted).sum().backward()
        optimiser.step()
        schedule.step()
    found = poses.apply_update(shifted.T_cam_obj_hypothesis, PoseUpdate(update.dR.detach(), update.dt.detach()))
    before, after = (poses.update_between(T, shifted.T_cam_obj) for T in (shifted.T_cam_obj_hypothesis, found))
    # Depth is left out: one direction of the contour loss can hide an error in it by turning the object.
    sideways = [u.dt[:, :2].norm(dim=-1).median() for u in (before, after)]
    assert sideways[1] < 0.2 * sideways[0]
    angles = [poses.rotation_angle_deg(u.dR).median() for u in (before, after)]
    assert angles[1] < 0.5 * angles[0]


def test_distance_is_bilinear_between_pixel_centres():
    distance = torch.arange(16, dtype=torch.float64).reshape(1, 4, 4)
    uv = torch.tensor([[[0.5, 0.5], [1.0, 0.5], [2.5, 3.5], [2.0, 2.0]]], dtype=torch.float64)
    expected = torch.tensor([[0.0, 0.5, 14.0, 7.5]], dtype=torch.float64)
    torch.testing.assert_close(losses.sample_distance(distance, uv), expected)


def test_the_confidence_is_drawn_to_the_visible_iou(mesh, shifted):
    """Added to any loss where there is a confidence; least where its sigmoid is the overlap."""
    b = len(shifted.K_crop)
    target = shifted._replace(visible_iou=torch.linspace(0.1, 0.9, b, dtype=torch.float32))
    logits = torch.zeros(b, requires_grad=True)
    chosen = losses.make_loss(LossConfig(name="contour", confidence_weight=2.0), object_points(mesh))
    plain, still = losses.contour_loss_px(identity(target), target), identity(target)
    with_logits = chosen(still._replace(confidence=logits), target)
    torch.testing.assert_close(chosen(still, target), plain)
    torch.testing.assert_close((with_logits - plain).float(), torch.full((b,), 2 * float(np.log(2))))
    (gradient,) = torch.autograd.grad(with_logits.sum(), logits)
    torch.testing.assert_close(gradient, 2 * (0.5 - target.visible_iou))


def test_what_is_far_off_teaches_the_confidence_alone(mesh, turned):
    objects = object_points(mesh)
    close = losses.pose_quality(turned, objects)
    limit = float(close.median())
    b = len(close)
    still = identity(turned)._replace(confidence=torch.zeros(b, dtype=torch.float64))
    config = LossConfig(name="point", confidence_target="pose_quality")
    plain, limited = (
        losses.make_loss(replace(config, min_pose_quality=least), objects)(still, turned) for least in (0.0, limit)
    )
    alone = losses.confidence_loss(still, close)
    far = close < limit
    assert 0 < far.sum() < b
    torch.testing.assert_close(limited[far].float(), alone[far].float())
    torch.testing.assert_close(limited[~far], plain[~far])
    assert (plain[far] > alone[far] + 0.1).all()


def test_outside_the_patch_the_distance_grows_with_the_way_back():
    distance = torch.full((1, 8, 8), 2.0, dtype=torch.float64)
    uv = torch.tensor([[[-99.5, 4.0], [4.0, 107.5], [-2.5, -3.5]]], dtype=torch.float64, requires_grad=True)
    charged = losses.sample_distance(distance, uv)
    torch.testing.assert_close(charged, torch.tensor([[102.0, 102.0, 7.0]], dtype=torch.float64))
    charged.sum().backward()
    assert (uv.grad.norm(dim=-1) > 0.99).all()


@pytest.mark.parametrize("name", OF_POSES)
def test_gradcheck(mesh, turned, name):
    few = turned.mapped(lambda x: x[:2])
    chosen = losses.make_loss(LossConfig(name=name, gamma=10.0), object_points(mesh))
    generator = torch.manual_seed(0)
    quat = torch.tensor([[1.0, 0.02, 0.03, -0.01]] * 2, dtype=torch.float64).requires_grad_()
    dt = (0.003 * torch.randn(2, 3, dtype=torch.float64, generator=generator)).requires_grad_()

    def value(quat, dt):
        return chosen(PoseUpdate(poses.rotation_from_quat_wxyz(quat), dt), few)

    assert gradcheck(value, (quat, dt), eps=1e-7, atol=1e-4, rtol=1e-3)


def test_losses_stay_finite_behind_the_camera(mesh, turned):
    b = len(turned.K_crop)
    update = PoseUpdate(identity(turned).dR, torch.tensor([[0.0, 0.0, -2.0]], dtype=torch.float64).repeat(b, 1))
    for dt in (update.dt, -turned.T_cam_obj_hypothesis[:, :3, 3]):
        leaf = dt.clone().requires_grad_()
        for name in OF_POSES:
            chosen = losses.make_loss(LossConfig(name=name, gamma=10.0), object_points(mesh))
            values = chosen(PoseUpdate(update.dR, leaf), turned)
            (gradient,) = torch.autograd.grad(values.sum(), leaf)
            assert torch.isfinite(values).all()
            assert torch.isfinite(gradient).all()


def test_point_loss_is_zero_at_the_truth_and_at_its_symmetric_twins(mesh, turned):
    half_turn = se3.make_T(se3.rotation_from_rotvec(np.array([0, 0, np.pi])), np.zeros(3))
    objects = object_points(mesh, np.stack([np.eye(4), half_turn]))
    true = true_update(turned)
    torch.testing.assert_close(losses.point_loss_px(true, turned, objects), torch.zeros(12, dtype=torch.float64))
    twin = turned.T_cam_obj @ torch.from_numpy(half_turn)
    update = poses.update_between(turned.T_cam_obj_hypothesis, twin)
    assert (losses.point_loss_px(update, turned, objects) < 1e-9).all()
    assert (losses.point_loss_px(update, turned, object_points(mesh)) > 1).all()


def test_point_loss_follows_a_symmetry_whose_axis_misses_the_origin(mesh, turned):
    half_turn = se3.make_T(se3.rotation_from_rotvec(np.array([0, 0, np.pi])), np.array([0.04, -0.02, 0]))
    objects = object_points(mesh, np.stack([np.eye(4), half_turn]))
    torch.testing.assert_close(losses.point_loss_px(true_update(turned), turned, objects), torch.zeros(12).double())
    twin = turned.T_cam_obj @ torch.from_numpy(half_turn)
    update = poses.update_between(turned.T_cam_obj_hypothesis, twin)
    assert (losses.point_loss_px(update, turned, objects) < 1e-9).all()


def test_point_loss_is_disentangled(mesh, turned):
    """An error in depth alone leaves the gradient of the rotation at zero."""
    true = true_update(turned)
    quat = poses.quat_wxyz_from_rotation(true.dR).requires_grad_()
    ray = turned.T_cam_obj[:, :3, 3] * 0.05
    objects = object_points(mesh)
    wrong = losses.point_loss_px(PoseUpdate(poses.rotation_from_quat_wxyz(quat), true.dt + ray), turned, objects)
    assert (wrong > 1).all()
    wrong.sum().backward()
    right = torch.zeros_like(quat).copy_(quat.detach()).requires_grad_()
    losses.point_loss_px(PoseUpdate(poses.rotation_from_quat_wxyz(right), true.dt), turned, objects).sum().backward()
    torch.testing.assert_close(quat.grad, right.grad)


def test_points_that_are_no_numbers_give_a_loss_that_is_none_and_no_crash():
    uv = torch.full((2, 5, 2), float("nan"), requires_grad=True)
    values = losses.sample_distance(torch.rand(2, 16, 16), uv)
    assert torch.isnan(values).all()
    values.sum().backward()
