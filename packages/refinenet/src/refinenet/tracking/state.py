"""Track state machine: next status, predicted pose, poses at other depths. No images."""

from dataclasses import dataclass
from enum import StrEnum

import numpy as np
from jaxtyping import Float
from posecore import se3
from posecore.errors import ConfigError


class TrackState(StrEnum):
    """State of a track after a frame."""

    TRACKING = "tracking"
    """The pose reached the tracking threshold."""
    UNCERTAIN = "uncertain"
    """The pose is below the tracking threshold, or missing for a few frames; the next frame starts at the last pose."""
    LOST = "lost"
    """The pose was missing for too long; there is none until a pose reaches the tracking threshold."""


@dataclass(frozen=True, kw_only=True)
class TrackingConfig:
    """Thresholds of the track state machine.

    Attributes:
        tracking_threshold: least confidence of a pose for the state `tracking`.
        accept_threshold: least confidence of a pose that is accepted at all.
        patience: consecutive frames without an accepted pose until the track is lost.
        depth_step: fraction of its depth by which each hypothesis is also shifted nearer and farther; 0 for none.
            With a network that hardly corrects depth, the pose would otherwise drift in depth from frame to frame.
    """

    tracking_threshold: float = 0.35
    accept_threshold: float = 0.2
    patience: int = 5
    depth_step: float = 0.02

    def __post_init__(self) -> None:
        if not 0 <= self.accept_threshold <= self.tracking_threshold <= 1:
            raise ConfigError(
                f"accept_threshold is {self.accept_threshold} and tracking_threshold is "
                f"{self.tracking_threshold}, expected 0 <= accept_threshold <= tracking_threshold <= 1"
            )
        if not 0 <= self.depth_step < 0.5:
            raise ConfigError(f"depth_step is {self.depth_step}, expected 0 to under 0.5")
        if self.patience < 1:
            raise ConfigError(f"patience is {self.patience}, expected 1 frame or more")


# Measured with gradient confidences on rendered frames of the example object: refined poses have about 0.5 (a tenth is
# under 0.42), the ground-truth pose 0.65, a pose 40 degrees and 0.2 diameters off 0.05 with a deviation of 0.05.
GRADIENT_TRACKING = TrackingConfig(tracking_threshold=0.35, accept_threshold=0.2)
LEARNED_TRACKING = TrackingConfig(tracking_threshold=0.5, accept_threshold=0.2)
SEARCH_TRACKING = TrackingConfig(tracking_threshold=0.4, accept_threshold=0.4, depth_step=0.0)
"""For `search`, which fails below its own least similarity."""
UNSCORED_TRACKING = TrackingConfig(tracking_threshold=0.5, accept_threshold=0.2, depth_step=0.0)
"""For methods without confidences: every pose that does not fail is accepted, and no depth is better than another."""


@dataclass(frozen=True, kw_only=True)
class TrackStatus:
    """State of a track, and the number of consecutive frames without an accepted pose."""

    state: TrackState = TrackState.TRACKING
    missed: int = 0


def next_status(status: TrackStatus, confidence: float | None, config: TrackingConfig) -> TrackStatus:
    """Status after a frame whose best pose has this confidence; None where refinement failed.

    A pose at the tracking threshold puts any track into the state `tracking`. A pose that is only accepted leaves a
    lost track lost.
    """
    if confidence is not None and confidence >= config.tracking_threshold:
        return TrackStatus()
    if status.state is TrackState.LOST:
        return status
    if confidence is not None and confidence >= config.accept_threshold:
        return TrackStatus(state=TrackState.UNCERTAIN)
    missed = status.missed + 1
    return TrackStatus(state=TrackState.LOST if missed >= config.patience else TrackState.UNCERTAIN, missed=missed)


@dataclass(frozen=True, kw_only=True, eq=False)
class Observation:
    """An accepted pose, of the object's centre, and its frame number."""

    frame: int
    T_cam_obj: Float[np.ndarray, "4 4"]


def predicted(before: Observation, last: Observation, frame: int) -> Float[np.ndarray, "4 4"]:
    """Pose in a frame, extrapolated from two observations at constant velocity.

    The velocity is constant in camera axes about the object's centre, as pose updates are. The extrapolation is no
    longer than the time between the observations: after a longer gap the motion has probably changed.
    """
    dR, dt_m = se3.update_between(before.T_cam_obj, last.T_cam_obj)
    fraction = min(1.0, (frame - last.frame) / (last.frame - before.frame))
    return se3.apply_update(
        last.T_cam_obj, se3.rotation_from_rotvec(fraction * se3.rotvec_from_rotation(dR)), fraction * dt_m
    )


def at_depths(T_cam_obj: Float[np.ndarray, "4 4"], step: float) -> list[Float[np.ndarray, "4 4"]]:
    """A pose, then its copies shifted along its origin's ray by a fraction of the depth, nearer and farther.

    No copies at step 0. The origin has to be the object's centre.
    """
    poses = []
    for factor in (1.0, 1.0 - step, 1.0 + step) if step else (1.0,):
        T = T_cam_obj.copy()
        T[:3, 3] *= factor
        poses.append(T)
    return poses
