"""Losses between a predicted pose update and the ground truth: contour, point, flow and regression, all per sample."""

from collections.abc import Callable
from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from refinenet.batch import LossTarget
from refinenet.config import ConfidenceTarget, LossConfig, LossName
from refinenet.geometry import poses
from refinenet.geometry.poses import PoseUpdate
from refinenet.geometry.symmetry import ObjectPoints, nearest_by_rotation
from refinenet.models.flow_solver import offsets_to_px, weighted

MAX_FLOW_COST = 50.0
"""Bound of a surface point's cost in `flow_loss`: a point far off would dominate all others."""
POSE_QUALITY_SCALE = 0.06
"""Point error, as a fraction of the bounding-box diagonal, at which the pose quality is 1 / e: a few pixels of a patch,
within reach of the flow."""


def sample_distance(distance_px: Float[Tensor, "b p p"], uv_px: Float[Tensor, "b n 2"]) -> Float[Tensor, "b n"]:
    """Distance transform at continuous pixels, bilinear between pixel centres (which lie at + 0.5).

    Beyond the outermost pixel centres the value is that of the nearest border pixel plus the distance to it: plain
    border padding would have no gradient there, and a point outside would never return.
    """
    patch_px = distance_px.shape[-1]
    # grid_sample's backward pass on a CPU reads outside of the patch at NaN; the overshoot below stays NaN.
    inside = torch.clamp(torch.nan_to_num(uv_px), 0.5, patch_px - 0.5)
    grid = inside * (2.0 / patch_px) - 1.0
    value = torch.nn.functional.grid_sample(
        distance_px[:, None], grid[:, None], mode="bilinear", padding_mode="border", align_corners=False
    )
    return value[:, 0, 0] + torch.linalg.vector_norm(uv_px - inside, dim=-1)


def forward_contour_loss_px(update: PoseUpdate, target: LossTarget) -> Float[Tensor, " b"]:
    """Mean scene distance of the hypothesis' contour points after the update, projected; patch pixels.

    Source: Manhardt et al., Deep Model-Based 6D Pose Refinement in RGB, ECCV 2018, Eq. 3, about the pivot.
    """
    t = target.T_cam_obj_hypothesis[:, None, :3, 3]
    updated_m = (target.hypothesis_contour_m - t) @ update.dR.transpose(1, 2) + t + update.dt[:, None]
    return sample_distance(target.scene_distance_px, poses.project(target.K_crop, updated_m)).mean(-1)


def contour_loss_px(update: PoseUpdate, target: LossTarget) -> Float[Tensor, " b"]:
    """Contour loss in both directions, sum of two means, patch pixels.

    At the true update both terms vanish up to the contour's discretisation (half a pixel) for translations and
    rotations about the viewing axis. A rotation by theta out of the image plane carries rim points off a curved
    object's rim: a residual of about (1 - cos theta) times the silhouette's radius stays, 0.4 px at 15 degrees on a
    64 px patch.

    Source: ECCV 2018 paper, Eq. 3 and 4, about the pivot.
    """
    t = target.T_cam_obj[:, None, :3, 3]
    reverted_m = (target.scene_contour_m - t) @ update.dR + t - update.dt[:, None]
    uv_px = poses.project(target.K_crop, reverted_m)
    backward = sample_distance(target.hypothesis_distance_px, uv_px).mean(-1)
    return forward_contour_loss_px(update, target) + backward


def mse_loss(update: PoseUpdate, target: LossTarget, gamma: float) -> Float[Tensor, " b"]:
    """Distance of unit quaternions plus gamma times the distance of translations in metres (paper, Eq. 2)."""
    true = poses.update_between(target.T_cam_obj_hypothesis, target.T_cam_obj)
    quat = poses.quat_wxyz_from_rotation(update.dR) - poses.quat_wxyz_from_rotation(true.dR)
    return torch.linalg.vector_norm(quat, dim=-1) + gamma * torch.linalg.vector_norm(update.dt - true.dt, dim=-1)


def point_loss_px(
    update: PoseUpdate, target: LossTarget, objects: ObjectPoints, rotation_weight: float = 1.0
) -> Float[Tensor, " b"]:
    """Disentangled point loss: rotation, image-plane position and depth, each with the other two at the ground truth.

    Each term is the mean L1 distance of model points, in metres times f_crop / z: patch pixels, comparable with the
    contour loss. The ground truth is the symmetry-equivalent pose of the nearest rotation; a symmetry whose axis misses
    the pivot translates the pivot, too.

    Source: Labbe et al., CosyPose, ECCV 2020, and Simonelli et al., Disentangling Monocular 3D Object Detection.
    """
    predicted = poses.apply_update(target.T_cam_obj_hypothesis, update)
    T_gt = nearest_by_rotation(predicted, target.T_cam_obj, target.object_index, objects)
    t_gt = T_gt[:, :3, 3]
    points = objects.points_m[target.object_index]
    rotated_m = points @ (predicted[:, :3, :3] - T_gt[:, :3, :3]).transpose(1, 2)
    rotation_m = rotated_m.abs().sum(-1).mean(-1)

    # Translations are compared at the true rotation: all model points have the same error, so one point is enough.
    t = predicted[:, :3, 3]
    ray = t[:, :2] / poses.positive_depth_m(t[:, 2:])
    plane_m = (ray * t_gt[:, 2:] - t_gt[:, :2]).abs().sum(-1)
    scale = t[:, 2] / t_gt[:, 2]
    depth_m = ((scale[:, None] - 1) * t_gt).abs().sum(-1)
    px_per_m = target.K_crop[:, 0, 0] / t_gt[:, 2]
    return (rotation_weight * rotation_m + plane_m + depth_m) * px_per_m


def flow_loss(update: PoseUpdate, target: LossTarget, objects: ObjectPoints) -> Float[Tensor, " b"]:
    """Mean negative log-likelihood of the true offsets of a hypothesis' visible surface, under `update.flow`.

    Offsets have a two-dimensional Laplace distribution whose scales the network predicts: errors behind an occluder
    cost little where the predicted certainty is low. The ground truth is the symmetry-equivalent pose nearest to the
    hypothesis.
    """
    flow = update.flow
    assert flow is not None
    T_gt = nearest_by_rotation(target.T_cam_obj_hypothesis, target.T_cam_obj, target.object_index, objects)
    true_px = offsets_to_px(flow, target.T_cam_obj_hypothesis, T_gt, target.K_crop)
    error = weighted(flow.offset_px - true_px, flow.certainty)
    length = torch.sqrt(error.square().sum(-1) + 1e-4)
    cost = length - torch.log(flow.certainty[..., 0]) - torch.log(flow.certainty[..., 2])
    cost = torch.where(flow.on_object, cost.clamp(max=MAX_FLOW_COST), 0.0)
    return cost.sum(-1) / flow.on_object.sum(-1).clamp(min=1)


def pose_quality(target: LossTarget, objects: ObjectPoints) -> Float[Tensor, " b"]:
    """Quality of each hypothesis in (0, 1]: exp(-error / `POSE_QUALITY_SCALE`), 1 at the ground truth.

    The error is the mean distance of projected model points to those of the nearest symmetry-equivalent ground truth,
    as a fraction of the bounding-box diagonal projected at the ground truth's depth.
    """
    T_gt = nearest_by_rotation(target.T_cam_obj_hypothesis, target.T_cam_obj, target.object_index, objects)
    points_m = objects.points_m[target.object_index]
    uv_px, true_px = (
        poses.project(target.K_crop, points_m @ T[:, :3, :3].transpose(1, 2) + T[:, None, :3, 3])
        for T in (target.T_cam_obj_hypothesis, T_gt)
    )
    size_m = torch.linalg.vector_norm(points_m.amax(1) - points_m.amin(1), dim=-1)
    size_px = size_m * target.K_crop[:, 0, 0] / T_gt[:, 2, 3]
    return torch.exp(-torch.linalg.vector_norm(uv_px - true_px, dim=-1).mean(-1) / (POSE_QUALITY_SCALE * size_px))


def confidence_target(name: ConfidenceTarget, target: LossTarget, objects: ObjectPoints) -> Float[Tensor, " b"]:
    """Regression target of the confidence for each hypothesis, in [0, 1]: visible IoU or pose quality."""
    if name == "pose_quality":
        return pose_quality(target, objects)
    assert target.visible_iou is not None
    return target.visible_iou


def confidence_loss(update: PoseUpdate, probability: Float[Tensor, " b"]) -> Float[Tensor, " b"]:
    """Cross-entropy of the confidence against its target."""
    assert update.confidence is not None
    return torch.nn.functional.binary_cross_entropy_with_logits(
        update.confidence.float(), probability, reduction="none"
    )


PoseLoss = Callable[[PoseUpdate, LossTarget, LossConfig, ObjectPoints], Float[Tensor, " b"]]


def _contour(update: PoseUpdate, target: LossTarget, config: LossConfig, objects: ObjectPoints) -> Float[Tensor, " b"]:
    """`contour_loss_px` to the nearest symmetry-equivalent ground truth: their contours are the same."""
    if objects.symmetric:
        predicted = poses.apply_update(target.T_cam_obj_hypothesis, update)
        T_gt = nearest_by_rotation(predicted, target.T_cam_obj, target.object_index, objects)
        target = target._replace(T_cam_obj=T_gt)
    return contour_loss_px(update, target)


def _contour_forward(
    update: PoseUpdate, target: LossTarget, config: LossConfig, objects: ObjectPoints
) -> Float[Tensor, " b"]:
    return forward_contour_loss_px(update, target)


def _mse(update: PoseUpdate, target: LossTarget, config: LossConfig, objects: ObjectPoints) -> Float[Tensor, " b"]:
    return mse_loss(update, target, config.gamma)


def _point(update: PoseUpdate, target: LossTarget, config: LossConfig, objects: ObjectPoints) -> Float[Tensor, " b"]:
    return point_loss_px(update, target, objects, config.rotation_weight)


def _contour_point(
    update: PoseUpdate, target: LossTarget, config: LossConfig, objects: ObjectPoints
) -> Float[Tensor, " b"]:
    contour_px = _contour(update, target, config, objects)
    return contour_px + config.point_weight * _point(update, target, config, objects)


def _flow_point(
    update: PoseUpdate, target: LossTarget, config: LossConfig, objects: ObjectPoints
) -> Float[Tensor, " b"]:
    return flow_loss(update, target, objects) + config.point_weight * _point(update, target, config, objects)


LOSSES: dict[LossName, PoseLoss] = {
    "contour": _contour,
    "contour-forward": _contour_forward,
    "mse": _mse,
    "point": _point,
    "contour+point": _contour_point,
    "flow+point": _flow_point,
}
PIXEL_LOSSES: frozenset[LossName] = frozenset(("contour", "contour-forward", "point", "contour+point"))
"""Losses in patch pixels, unless a confidence is trained with them."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Loss:
    """Loss of a run: pose loss plus, for updates with a confidence, its weighted cross-entropy.

    Attributes:
        config: Which pose loss, and its weights.
        objects: Model points and symmetries, on the device of the updates.
    """

    config: LossConfig
    objects: ObjectPoints

    def __call__(self, update: PoseUpdate, target: LossTarget) -> Float[Tensor, " b"]:
        """Loss of each sample."""
        config = self.config
        value = LOSSES[config.name](update, target, config, self.objects)
        if config.min_pose_quality > 0:
            value = torch.where(pose_quality(target, self.objects) >= config.min_pose_quality, value, 0.0)
        if update.confidence is None:
            return value
        probability = confidence_target(config.confidence_target, target, self.objects)
        return value + config.confidence_weight * confidence_loss(update, probability)


def make_loss(config: LossConfig, objects: ObjectPoints) -> Loss:
    """The configured loss."""
    return Loss(config=config, objects=objects)
