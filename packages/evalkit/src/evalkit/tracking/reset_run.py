"""RBOT's protocol: a tracker that fails is reset to the ground truth and continues from there.

Source: Tjaden et al., "A Region-based Gauss-Newton Approach to Real-Time Monocular Multiple Object Tracking", TPAMI
2018, section on the RBOT data set.
"""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from time import perf_counter
from typing import Protocol, TypeVar, runtime_checkable

import numpy as np
from jaxtyping import Bool, Float
from posecore import se3
from posecore.bop import ModelInfo
from posecore.errors import ConfigError

from evalkit.tracking.residuals import residuals
from evalkit.tracking.scores import LIMIT_M, LIMIT_RAD

Frame = TypeVar("Frame", contravariant=True)


@runtime_checkable
class ResettableTracker(Protocol[Frame]):
    """Interface of a tracker for `run_with_resets`."""

    def initialise(self, frame: Frame, T_cam_obj: Float[np.ndarray, "4 4"]) -> None:
        """Start from the ground-truth pose of this frame."""
        ...

    def track(self, frame: Frame) -> Float[np.ndarray, "4 4"] | None:
        """The pose in the next frame, metres; None if the tracker has lost the object."""
        ...


@dataclass(frozen=True, kw_only=True, eq=False)
class ResetRun:
    """A sequence tracked under RBOT's protocol.

    Attributes:
        T_est: (n, 4, 4) the tracker's poses, metres; NaN without a pose, and in the first frame.
        was_initialised: (n,) frames in which the tracker was set to the ground truth: the first and each failed one.
        tracked: (n,) frames within 5 cm and 5 degrees.
        time_s: (n,) time of `track`; NaN in the first frame.
    """

    T_est: Float[np.ndarray, "n 4 4"]
    was_initialised: Bool[np.ndarray, " n"]
    tracked: Bool[np.ndarray, " n"]
    time_s: Float[np.ndarray, " n"]

    @property
    def success(self) -> float:
        """Fraction of tracked frames without the first. NaN for a single frame."""
        return float(self.tracked[1:].mean()) if len(self.tracked) > 1 else float("nan")

    def resets(self, scene_id: int, obj_id: int, im_ids: Sequence[int]) -> list[dict[str, int]]:
        """The run's part of `resets` in the sidecar of its result file; `im_ids` are the images of the frames."""
        frames = zip(im_ids, self.was_initialised.tolist(), strict=True)
        return [{"scene_id": scene_id, "im_id": int(im_id), "obj_id": obj_id} for im_id, is_reset in frames if is_reset]


def run_with_resets(
    tracker: ResettableTracker[Frame],
    frames: Iterable[Frame],
    T_gt: Iterable[Float[np.ndarray, "4 4"]],
    *,
    center_m: Float[np.ndarray, "3"],
    info: ModelInfo | None = None,
) -> ResetRun:
    """Track a sequence under RBOT's protocol.

    The tracker starts from the ground truth of the first frame. A frame has failed if its pose is missing or off by
    5 cm or 5 degrees or more; the tracker is then reset to the ground truth of that frame.

    Args:
        tracker: to evaluate.
        frames: its inputs in order; only one is held at a time.
        T_gt: ground-truth pose `T_cam_obj` of each frame, metres.
        center_m: centre of the object (`Mesh.center_m`), which the 5 cm are measured at, object frame, metres.
        info: symmetries of the object, None for none.

    Raises:
        ConfigError: there is no frame, or a frame without a ground-truth pose.
        ValueError: frames and poses differ in number.
    """
    about_center = None if info is None else info.with_origin_at(center_m)
    poses, was_initialised, tracked, times = [], [], [], []
    for number, (frame, pose_gt) in enumerate(zip(frames, T_gt, strict=True)):
        if not np.isfinite(pose_gt).all():
            raise ConfigError(f"frame {number} has no ground-truth pose for a reset; leave it out")
        pose, is_tracked, time_s = None, False, float("nan")
        if number:
            begun = perf_counter()
            pose = tracker.track(frame)
            time_s = perf_counter() - begun
            is_tracked = pose is not None and _is_tracked(pose, pose_gt, center_m, about_center)
        if not is_tracked:
            tracker.initialise(frame, pose_gt)
        poses.append(np.full((4, 4), np.nan) if pose is None else np.asarray(pose, np.float64))
        was_initialised.append(not is_tracked)
        tracked.append(is_tracked)
        times.append(time_s)
    if not poses:
        raise ConfigError(
            "a sequence without frames cannot be tracked; give at least one frame and its ground-truth pose"
        )
    return ResetRun(
        T_est=np.array(poses),
        was_initialised=np.array(was_initialised),
        tracked=np.array(tracked),
        time_s=np.array(times),
    )


def _is_tracked(
    T_est: Float[np.ndarray, "4 4"],
    T_gt: Float[np.ndarray, "4 4"],
    center_m: Float[np.ndarray, "3"],
    info: ModelInfo | None,
) -> bool:
    est, gt = (se3.with_origin_at(np.asarray(T, np.float64)[None], center_m) for T in (T_est, T_gt))
    errors = residuals(est, gt, info)
    return bool((errors.distance_m[0] < LIMIT_M) and (errors.angle_rad[0] < LIMIT_RAD))
