"""Pose errors of a network on held-out pairs, and the log that metrics are written to."""

import json
from collections.abc import Iterable, Mapping
from contextlib import suppress
from pathlib import Path
from types import TracebackType
from typing import Any

import torch
from jaxtyping import Float
from posecore.files import storage_error, write_atomic
from torch import Tensor, nn
from torch.utils.tensorboard import SummaryWriter

from refinenet.batch import Batch
from refinenet.geometry import poses
from refinenet.geometry.symmetry import ObjectPoints, nearest_by_angle, nearest_by_points
from refinenet.models.migration import migrated_metrics
from refinenet.training.losses import confidence_targets, pose_quality


def pose_errors(
    T_cam_obj: Float[Tensor, "b 4 4"],
    T_true: Float[Tensor, "b 4 4"],
    object_index: Tensor,
    objects: ObjectPoints,
) -> dict[str, Float[Tensor, " b"]]:
    """Errors of each pose: rotation_deg, x_mm, y_mm, z_mm (absolute), add_mm (mean point distance).

    All are those of the symmetric twin of the truth that is nearest: by angle for the rotation, else by points.
    """
    twin = nearest_by_angle(T_cam_obj, T_true, object_index, objects)
    angle_deg = poses.rotation_angle_deg(T_cam_obj[:, :3, :3] @ twin[:, :3, :3].transpose(1, 2))
    twin, distance_m = nearest_by_points(T_cam_obj, T_true, object_index, objects)
    move_mm = 1e3 * (T_cam_obj[:, :3, 3] - twin[:, :3, 3]).abs()
    return {
        "rotation_deg": angle_deg,
        "x_mm": move_mm[:, 0],
        "y_mm": move_mm[:, 1],
        "z_mm": move_mm[:, 2],
        "add_mm": 1e3 * distance_m,
    }


@torch.no_grad()
def measure(
    network: nn.Module,
    batches: Iterable[Batch],
    objects: ObjectPoints,
    device: torch.device,
    confidence_target: str = "visible_iou",
    min_pose_quality: float = 0.0,
) -> dict[str, float]:
    """Errors before and after one update: mean of each, and the rotation's median.

    Keys: validation/rotation_before_deg, validation/rotation_after_deg, validation/rotation_median_after_deg,
    validation/x_before_mm and so on; from a network with that output also validation/confidence_error, the mean
    distance of its confidence from what it is to say of each start.

    Errors are those of the pairs that the loss counts, as many as validation/pairs says: what it leaves out because it
    is too far off to be mended would drown them. The confidence is asked about all.
    """
    was_training = network.training
    network.eval()
    collected: dict[str, list[Tensor]] = {}
    counted: list[Tensor] = []
    off: list[Tensor] = []
    for batch in batches:
        batch = batch.to(device)
        counted.append(pose_quality(batch.target, objects).cpu() >= min_pose_quality)
        start, update = batch.inputs.T_cam_obj, network(batch.inputs)
        if update.confidence is not None:
            wanted = confidence_targets(confidence_target, batch.target, objects)
            off.append((torch.sigmoid(update.confidence) - wanted).abs().cpu())
        for when, pose in (("before", start), ("after", poses.apply_update(start, update))):
            errors = pose_errors(pose, batch.target.T_cam_obj, batch.target.object_index, objects)
            for name, values in errors.items():
                what, unit = name.rsplit("_", 1)
                collected.setdefault(f"validation/{what}_{when}_{unit}", []).append(values.cpu())
    network.train(was_training)
    chosen = torch.cat(counted)
    if not chosen.any():
        chosen[:] = True
    joined = {key: torch.cat(values)[chosen].double() for key, values in collected.items()}
    result = {"validation/pairs": float(chosen.sum())}
    result |= {key: float(values.mean()) for key, values in joined.items()}
    for when in ("before", "after"):
        rotation_deg = joined[f"validation/rotation_{when}_deg"]
        result[f"validation/rotation_median_{when}_deg"] = float(rotation_deg.quantile(0.5))
    if off:
        result["validation/confidence_error"] = float(torch.cat(off).double().mean())
    return result


class MetricLog:
    """Appends metrics to `metrics.jsonl` and to TensorBoard event files in one folder.

    Args:
        folder: Of the run.
        start: Lines of later steps, left by a run that was killed after its last checkpoint, are dropped.

    Raises:
        StorageError: No rights, no space, or a file stands in the folder's place.
    """

    def __init__(self, folder: Path, start: int) -> None:
        self._path = folder / "metrics.jsonl"
        kept = [line for line in self._lines() if line["step"] <= start]
        write_atomic(self._path, "".join(json.dumps(line) + "\n" for line in kept).encode())
        events = folder / "tensorboard"
        try:
            self._writer = SummaryWriter(str(events), purge_step=start + 1)
        except OSError as error:
            raise storage_error(events, error) from error

    def _lines(self) -> list[dict[str, Any]]:
        if not self._path.is_file():
            return []
        lines: list[dict[str, Any]] = []
        for text in self._path.read_text(errors="replace").splitlines():
            try:
                line = json.loads(text)
            except ValueError:  # the line a killed run was writing
                break
            if not isinstance(line, dict) or not isinstance(line.get("step"), int):
                break
            lines.append(migrated_metrics(line))
        return lines

    def write(self, step: int, values: Mapping[str, float]) -> None:
        """One line of metrics of a step; units are in the keys.

        Raises:
            StorageError: No rights or no space any more.
        """
        try:
            with self._path.open("a") as stream:
                stream.write(json.dumps({"step": step, **values}) + "\n")
            for key, value in values.items():
                self._writer.add_scalar(key, value, step)
        except OSError as error:
            raise storage_error(self._path, error) from error

    def __enter__(self) -> "MetricLog":
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        with suppress(OSError):  # events that a full disk refused; the error that ends the run says so
            self._writer.close()
