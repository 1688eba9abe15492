"""Losses between a predicted pose update and the truth: contour, point, flow and regression, all per sample."""

from collections.abc import Callable

import torch
from jaxtyping import Float
from torch import Tensor

from refinenet.batch import LossTarget
from refinenet.geometry import poses
from refinenet.geometry.poses import PoseUpdate
from refinenet.geometry.symmetry import ObjectPoints, nearest_by_rotation
from refinenet.models.flow_solver import offsets_to_px, weighted


def sample_distance(distance_px: Float[Tensor, "b p p"], uv_px: Float[Tensor, "b n 2"]) -> Float[Tensor, "b n"]:
    """Distance transform at continuous pixels, bilinear between pixel centres (which lie at + 0.5).

    Beyond the outermost pixel centres a point is charged the nearest border value plus its distance from there:
    plain border padding would leave it no gradient, and a point lost outside would never come back.
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
    """Mean scene distance of the hypothesis' contour points, moved by the update and projected; patch pixels.

    Source: Manhardt et al., Deep Model-Based 6D Pose Refinement in RGB, ECCV 2018, Eq. 3, about the object's origin.
    """
    t = target.T_cam_obj_hypothesis[:, None, :3, 3]
    moved = (target.hypothesis_contour_m - t) @ update.dR.transpose(1, 2) + t + update.dt[:, None]
    return sample_distance(target.scene_distance_px, poses.project(target.K_crop, moved)).mean(-1)


def contour_loss_px(update: PoseUpdate, target: LossTarget) -> Float[Tensor, " b"]:
    """Contour loss in both directions, sum of two means, patch pixels.

    At the true update both terms vanish up to the contour's discretisation (half a pixel) for translations and turns
    about the viewing axis. A turn of theta out of the image plane carries rim points off a curved object's rim: a
    residual of about (1 - cos theta) times the silhouette's radius stays, 0.4 px at 15 degrees on a 64 px patch.

    Source: ECCV 2018 paper, Eq. 3 and 4, about the object's origin.
    """
    t = target.T_cam_obj[:, None, :3, 3]
    moved_back = (target.scene_contour_m - t) @ update.dR + t - update.dt[:, None]
    uv_px = poses.project(target.K_crop, moved_back)
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
    """Disentangled point loss: rotation, image-plane position and depth, each with the other two at their truth.

    Each term is the mean L1 distance of model points, in metres times f_crop / z: patch pixels, comparable with the
    contour loss. The truth is the object's symmetric twin of it whose rotation is nearest; a symmetry whose axis misses
    the object's origin moves that, too.

    Source: Labbe et al., CosyPose, ECCV 2020, and Simonelli et al., Disentangling Monocular 3D Object Detection.
    """
    predicted = poses.apply_update(target.T_cam_obj_hypothesis, update)
    T_true = nearest_by_rotation(predicted, target.T_cam_obj, target.object_index, objects)
    t_true = T_true[:, :3, 3]
    points = objects.points_m[target.object_index]
    turned = points @ (predicted[:, :3, :3] - T_true[:, :3, :3]).transpose(1, 2)
    rotation_m = turned.abs().sum(-1).mean(-1)

    # Translations alone are compared at the true rotation: every model point moves alike, so one point stands for all.
    t = predicted[:, :3, 3]
    ray = t[:, :2] / poses.positive_depth_m(t[:, 2:])
    plane_m = (ray * t_true[:, 2:] - t_true[:, :2]).abs().sum(-1)
    scale = t[:, 2] / t_true[:, 2]
    depth_m = ((scale[:, None] - 1) * t_true).abs().sum(-1)
    px_per_m = target.K_crop[:, 0, 0] / t_true[:, 2]
    return (rotation_weight * rotation_m + plane_m + depth_m) * px_per_m


def flow_loss(update: PoseUpdate, target: LossTarget, objects: ObjectPoints) -> Float[Tensor, " b"]:
    """Mean negative log likelihood of the true offsets of a hypothesis' visible surface, under `update.flow`.

    Offsets err by a Laplace distribution of two dimensions whose scales the network says, so that what it cannot see,
    as behind an occluder, costs little where it says so. The truth is the symmetric twin nearest to the hypothesis.
    """
    flow = update.flow
    assert flow is not None
    T_true = nearest_by_rotation(target.T_cam_obj_hypothesis, target.T_cam_obj, target.object_index, objects)
    true_px = offsets_to_px(flow, target.T_cam_obj_hypothesis, T_true, target.K_crop)
    error = weighted(flow.offset_px - true_px, flow.certainty)
    length = torch.sqrt(error.square().sum(-1) + 1e-4)
    cost = length - torch.log(flow.certainty[..., 0]) - torch.log(flow.certainty[..., 2])
    # a cost without a bound, of a surface far from where it is thought to be, would drown all others
    cost = torch.where(flow.on_object, cost.clamp(max=MOST_FLOW_COST), 0.0)
    return cost.sum(-1) / flow.on_object.sum(-1).clamp(min=1)


def pose_quality(target: LossTarget, objects: ObjectPoints) -> Float[Tensor, " b"]:
    """How near hypotheses are to the truth as the camera sees it, in [0, 1]: 1 there, 1 / e `CLOSE` away.

    What counts is the mean distance of projected model points, as a share of the object's box diagonal at the truth's
    depth, to the nearest symmetric twin.
    """
    T_true = nearest_by_rotation(target.T_cam_obj_hypothesis, target.T_cam_obj, target.object_index, objects)
    points_m = objects.points_m[target.object_index]
    uv_px, true_px = (
        poses.project(target.K_crop, points_m @ T[:, :3, :3].transpose(1, 2) + T[:, None, :3, 3])
        for T in (target.T_cam_obj_hypothesis, T_true)
    )
    size_m = torch.linalg.vector_norm(points_m.amax(1) - points_m.amin(1), dim=-1)
    size_px = size_m * target.K_crop[:, 0, 0] / T_true[:, 2, 3]
    return torch.exp(-torch.linalg.vector_norm(uv_px - true_px, dim=-1).mean(-1) / (CLOSE * size_px))


def confidence_targets(name: str, target: LossTarget, objects: ObjectPoints | None) -> Float[Tensor, " b"]:
    """What a confidence is to say of hypotheses: their visible overlap, or their pose_quality."""
    if name == "pose_quality":
        assert objects is not None
        return pose_quality(target, objects)
    assert target.visible_iou is not None
    return target.visible_iou


def confidence_loss(update: PoseUpdate, wanted: Float[Tensor, " b"]) -> Float[Tensor, " b"]:
    """Cross-entropy of the confidence against how well the hypothesis fits, which it was asked about."""
    assert update.confidence is not None
    return torch.nn.functional.binary_cross_entropy_with_logits(update.confidence.float(), wanted, reduction="none")


PIXEL_LOSSES = ("contour", "contour-forward", "point", "contour+point")
"""Those in patch pixels, as long as no confidence is trained beside them."""
LOSSES = ("contour", "contour-forward", "mse", "point", "contour+point", "flow+point")
MOST_FLOW_COST = 50.0
CLOSE = 0.06
"""Share of the box diagonal at which pose_quality is 1 / e: a few pixels of a patch, within reach of the flow."""


def make_loss(
    name: str,
    *,
    gamma: float,
    point_weight: float,
    rotation_weight: float = 1.0,
    confidence_weight: float = 1.0,
    confidence_target: str = "visible_iou",
    min_pose_quality: float = 0.0,
    objects: ObjectPoints | None,
) -> Callable[[PoseUpdate, LossTarget], Float[Tensor, " b"]]:
    """The loss called `name`, one of `LOSSES`, as a function of an update and its target.

    Args:
        name: which.
        gamma: weight of the translation in `mse`, per metre.
        point_weight: weight of the point loss in `contour+point` and `flow+point`.
        rotation_weight: weight of the rotation within the point loss.
        confidence_weight: weight of the confidence's cross-entropy, added for updates that carry a confidence.
        confidence_target: what it is compared with, see `confidence_targets`.
        min_pose_quality: hypotheses less close to the truth have no part in the loss but for their confidence.
        objects: model points and symmetries; only `mse`, and the contour losses of objects without symmetries, can do
            without.
    """

    def flow(update: PoseUpdate, target: LossTarget) -> Float[Tensor, " b"]:
        assert objects is not None
        return flow_loss(update, target, objects)

    def points(update: PoseUpdate, target: LossTarget) -> Float[Tensor, " b"]:
        assert objects is not None
        return point_loss_px(update, target, objects, rotation_weight)

    def twin(update: PoseUpdate, target: LossTarget) -> LossTarget:
        """What contours are compared with: they look alike at every twin, and their poses must not differ."""
        if objects is None or not objects.symmetric:
            return target
        predicted = poses.apply_update(target.T_cam_obj_hypothesis, update)
        T_true = nearest_by_rotation(predicted, target.T_cam_obj, target.object_index, objects)
        return target._replace(T_cam_obj=T_true)

    def contour(update: PoseUpdate, target: LossTarget) -> Float[Tensor, " b"]:
        return contour_loss_px(update, twin(update, target))

    table: dict[str, Callable[[PoseUpdate, LossTarget], Float[Tensor, " b"]]] = {
        "contour": contour,
        "contour-forward": forward_contour_loss_px,
        "mse": lambda update, target: mse_loss(update, target, gamma),
        "point": points,
        "contour+point": lambda update, target: contour(update, target) + point_weight * points(update, target),
        "flow+point": lambda update, target: flow(update, target) + point_weight * points(update, target),
    }
    pose = table[name]

    def loss(update: PoseUpdate, target: LossTarget) -> Float[Tensor, " b"]:
        value = pose(update, target)
        if min_pose_quality > 0:
            assert objects is not None
            value = torch.where(pose_quality(target, objects) >= min_pose_quality, value, 0.0)
        if update.confidence is None:
            return value
        wanted = confidence_targets(confidence_target, target, objects)
        return value + confidence_weight * confidence_loss(update, wanted)

    return loss
