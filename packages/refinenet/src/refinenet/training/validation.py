"""Pose errors of a network on validation pairs, before and after one update."""

from collections.abc import Iterable

import torch
from jaxtyping import Float
from torch import Tensor, nn

from refinenet.batch import Batch
from refinenet.config import LossConfig
from refinenet.geometry import poses
from refinenet.geometry.symmetry import ObjectPoints, nearest_by_angle, nearest_by_points
from refinenet.training.losses import confidence_target, pose_quality


def pose_errors(
    T_cam_obj: Float[Tensor, "b 4 4"],
    T_gt: Float[Tensor, "b 4 4"],
    object_index: Tensor,
    objects: ObjectPoints,
) -> dict[str, Float[Tensor, " b"]]:
    """Errors of each pose: rotation_deg, x_mm, y_mm, z_mm (absolute, of the pivot), add_mm (mean point distance).

    The ground truth is its nearest symmetry-equivalent pose: by angle for the rotation, by points for the others.
    """
    nearest = nearest_by_angle(T_cam_obj, T_gt, object_index, objects)
    angle_deg = poses.rotation_angle_deg(T_cam_obj[:, :3, :3] @ nearest[:, :3, :3].transpose(1, 2))
    nearest, distance_m = nearest_by_points(T_cam_obj, T_gt, object_index, objects)
    error_mm = 1e3 * (T_cam_obj[:, :3, 3] - nearest[:, :3, 3]).abs()
    return {
        "rotation_deg": angle_deg,
        "x_mm": error_mm[:, 0],
        "y_mm": error_mm[:, 1],
        "z_mm": error_mm[:, 2],
        "add_mm": 1e3 * distance_m,
    }


@torch.no_grad()
def measure(
    network: nn.Module, batches: Iterable[Batch], objects: ObjectPoints, device: torch.device, loss: LossConfig
) -> dict[str, float]:
    """Errors before and after one update: mean of each error, and median of the rotation error.

    Keys: validation/rotation_before_deg, validation/rotation_after_deg, validation/rotation_median_after_deg,
    validation/x_before_mm and so on; for a network with a confidence also validation/confidence_error, its mean
    absolute difference from the confidence target of the hypothesis.

    Pose errors are those of the pairs above `min_pose_quality`, as in the loss; validation/pairs is their number. The
    confidence error is that of all pairs.
    """
    was_training = network.training
    network.eval()
    collected: dict[str, list[Tensor]] = {}
    included: list[Tensor] = []
    confidence_errors: list[Tensor] = []
    for batch in batches:
        batch = batch.to(device)
        included.append(pose_quality(batch.target, objects).cpu() >= loss.min_pose_quality)
        hypothesis, update = batch.inputs.T_cam_obj, network(batch.inputs)
        if update.confidence is not None:
            probability = confidence_target(loss.confidence_target, batch.target, objects)
            confidence_errors.append((torch.sigmoid(update.confidence) - probability).abs().cpu())
        for when, pose in (("before", hypothesis), ("after", poses.apply_update(hypothesis, update))):
            errors = pose_errors(pose, batch.target.T_cam_obj, batch.target.object_index, objects)
            for name, values in errors.items():
                quantity, unit = name.rsplit("_", 1)
                collected.setdefault(f"validation/{quantity}_{when}_{unit}", []).append(values.cpu())
    network.train(was_training)
    rows = torch.cat(included)
    if not rows.any():
        rows[:] = True
    joined = {key: torch.cat(values)[rows].double() for key, values in collected.items()}
    result = {"validation/pairs": float(rows.sum())}
    result |= {key: float(values.mean()) for key, values in joined.items()}
    for when in ("before", "after"):
        rotation_deg = joined[f"validation/rotation_{when}_deg"]
        result[f"validation/rotation_median_{when}_deg"] = float(rotation_deg.quantile(0.5))
    if confidence_errors:
        result["validation/confidence_error"] = float(torch.cat(confidence_errors).double().mean())
    return result
