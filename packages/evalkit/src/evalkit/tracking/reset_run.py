"""RBOT's protocol: a tracker that fails is set back to the truth and goes on from there.

Source: Tjaden et al., "A Region-based Gauss-Newton Approach to Real-Time Monocular Multiple Object Tracking", TPAMI
2018, section on the RBOT data set.
"""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from time import perf_counter
from typing import Protocol, TypeVar, runtime_checkable

import numpy as np
from jaxtyping import Bool, Float
from posecore.errors import ConfigError
from posecore.symmetry import Symmetric

from evalkit.tracking.residuals import residuals
from evalkit.tracking.scores import LIMIT_M, LIMIT_RAD

Array = np.ndarray
Frame = TypeVar("Frame", contravariant=True)


@runtime_checkable
class Tracker(Protocol[Frame]):
    """What `run_with_resets` drives."""

    def initialise(self, frame: Frame, T_cam_obj: Float[Array, "4 4"]) -> None:
        """Start from a pose that is right in this frame."""
        ...

    def track(self, frame: Frame) -> Float[Array, "4 4"] | None:
        """The pose in the next frame, metres; None where the tracker says that it has lost the object."""
        ...


@dataclass(frozen=True, kw_only=True, eq=False)
class ResetRun:
    """A sequence tracked under RBOT's protocol.

    Attributes:
        T_est: (n, 4, 4) the tracker's own poses, metres; NaN where it had none, and in the first frame.
        given: (n,) frames in which it was set to the truth: the first one and each that failed.
        tracked: (n,) frames within 5 cm and 5 degrees.
        time_s: (n,) time of `track`; NaN in the first frame.
    """

    T_est: Float[Array, "n 4 4"]
    given: Bool[Array, " n"]
    tracked: Bool[Array, " n"]
    time_s: Float[Array, " n"]

    @property
    def success(self) -> float:
        """Share of tracked frames; the first is not counted. NaN for a single frame."""
        return float(self.tracked[1:].mean()) if len(self.tracked) > 1 else float("nan")

    def resets(self, scene_id: int, obj_id: int, im_ids: Sequence[int]) -> list[dict[str, int]]:
        """The run's part of `resets` in the sidecar of its result file; `im_ids` has the image of each frame."""
        given = zip(im_ids, self.given.tolist(), strict=True)
        return [{"scene_id": scene_id, "im_id": int(im_id), "obj_id": obj_id} for im_id, was in given if was]


def run_with_resets(
    tracker: Tracker[Frame],
    frames: Iterable[Frame],
    truths: Iterable[Float[Array, "4 4"]],
    *,
    info: Symmetric | None = None,
) -> ResetRun:
    """Track a sequence under RBOT's protocol.

    The tracker starts from the truth of the first frame. After a frame whose pose is missing or off by 5 cm or
    5 degrees or more it is set to the truth of that frame; the frame has failed.

    Args:
        tracker: any.
        frames: what it is given, one after the other; only one is held at a time.
        truths: true pose `T_cam_obj` of each frame, metres.
        info: symmetries of the object, None for none.

    Raises:
        ConfigError: there is no frame, or one without a true pose.
        ValueError: frames and truths differ in number.
    """
    poses, given, tracked, times = [], [], [], []
    for number, (frame, truth) in enumerate(zip(frames, truths, strict=True)):
        if not np.isfinite(truth).all():
            raise ConfigError(f"frame {number} has no true pose to set a tracker to; leave it out")
        pose, is_tracked, time_s = None, False, float("nan")
        if number:
            begun = perf_counter()
            pose = tracker.track(frame)
            time_s = perf_counter() - begun
            is_tracked = pose is not None and _is_tracked(pose, truth, info)
        if not is_tracked:
            tracker.initialise(frame, truth)
        poses.append(np.full((4, 4), np.nan) if pose is None else np.asarray(pose, np.float64))
        given.append(not is_tracked)
        tracked.append(is_tracked)
        times.append(time_s)
    if not poses:
        raise ConfigError("a sequence without frames cannot be tracked; give at least one frame and its true pose")
    return ResetRun(T_est=np.array(poses), given=np.array(given), tracked=np.array(tracked), time_s=np.array(times))


def _is_tracked(T_est: Float[Array, "4 4"], T_gt: Float[Array, "4 4"], info: Symmetric | None) -> bool:
    left = residuals(np.asarray(T_est, np.float64)[None], np.asarray(T_gt, np.float64)[None], info)
    return bool((left.distance_m[0] < LIMIT_M) and (left.angle_rad[0] < LIMIT_RAD))
