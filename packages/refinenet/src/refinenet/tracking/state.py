"""Tracking as a rule of its own: what a track's state becomes, where it looks next, which symmetric copy it takes."""

from dataclasses import dataclass
from enum import StrEnum

import numpy as np
from jaxtyping import Float
from posecore import se3
from posecore.errors import ConfigError
from posecore.symmetry import Symmetric, align_ball, is_ball, rotations_about_axis

Array = np.ndarray


class TrackState(StrEnum):
    """How well a track knows where its object is."""

    TRACKING = "tracking"
    """The pose fits."""
    UNCERTAIN = "uncertain"
    """It fits badly, or has for a few frames not been found; the next frame is searched near the last pose that fit."""
    LOST = "lost"
    """It was not found for too long; there is no pose until one fits again."""


@dataclass(frozen=True, kw_only=True)
class TrackingConfig:
    """When a pose fits, and when a track is lost.

    Attributes:
        sure: smallest confidence of a pose that fits.
        found: smallest confidence of a pose that is believed at all.
        patience: frames in a row without such a pose until the track is lost.
        depth_step: share of its depth by which each start is also tried nearer and farther; 0 tries its depth alone.
            A network that hardly corrects depth would otherwise let it drift from frame to frame without end.
    """

    sure: float = 0.35
    found: float = 0.2
    patience: int = 5
    depth_step: float = 0.02

    def __post_init__(self) -> None:
        if not 0 <= self.found <= self.sure <= 1:
            raise ConfigError(f"found is {self.found} and sure is {self.sure}, expected 0 <= found <= sure <= 1")
        if not 0 <= self.depth_step < 0.5:
            raise ConfigError(f"depth_step is {self.depth_step}, expected 0 to under 0.5")
        if self.patience < 1:
            raise ConfigError(f"patience is {self.patience}, expected 1 frame or more")


# Measured with gradient confidences on rendered frames of the example object: refined poses have about 0.5 (a tenth of
# them under 0.42), a true pose 0.65, one that is 40 degrees and 0.2 diameters off 0.05 with a deviation of 0.05.
GRADIENT_TRACKING = TrackingConfig(sure=0.35, found=0.2)
LEARNED_TRACKING = TrackingConfig(sure=0.5, found=0.2)
SEARCH_TRACKING = TrackingConfig(sure=0.4, found=0.4, depth_step=0.0)
"""For `search`, whose poses under its own least agreement fail."""
UNJUDGED_TRACKING = TrackingConfig(sure=0.5, found=0.2, depth_step=0.0)
"""For methods without confidences: a pose fits unless it fails, and none of three depths is the best."""


@dataclass(frozen=True, kw_only=True)
class Standing:
    """State of a track, and for how many frames in a row no pose was believed."""

    state: TrackState = TrackState.TRACKING
    missed: int = 0


def next_standing(standing: Standing, confidence: float | None, config: TrackingConfig) -> Standing:
    """State after a frame whose best pose has this confidence, None where refinement failed.

    A pose that fits makes any track one that tracks. One that is only believed leaves a lost track lost: it takes a
    pose that fits to start again.
    """
    if confidence is not None and confidence >= config.sure:
        return Standing()
    if standing.state is TrackState.LOST:
        return standing
    if confidence is not None and confidence >= config.found:
        return Standing(state=TrackState.UNCERTAIN)
    missed = standing.missed + 1
    return Standing(state=TrackState.LOST if missed >= config.patience else TrackState.UNCERTAIN, missed=missed)


@dataclass(frozen=True, kw_only=True, eq=False)
class Sighting:
    """A believed pose and the number of its frame."""

    frame: int
    T_cam_obj: Float[Array, "4 4"]


def predicted(before: Sighting, last: Sighting, frame: int) -> Float[Array, "4 4"]:
    """Where the object is in a frame if it goes on as between two sightings.

    Velocity is constant in camera axes about the object's origin, as pose updates are. It is carried on for no longer
    than it was measured over: an object that was not seen for a while has probably not kept on turning.
    """
    dR, dt_m = se3.update_between(before.T_cam_obj, last.T_cam_obj)
    share = min(1.0, (frame - last.frame) / (last.frame - before.frame))
    return se3.apply_update(
        last.T_cam_obj, se3.rotation_from_rotvec(share * se3.rotvec_from_rotation(dR)), share * dt_m
    )


def at_depths(T_cam_obj: Float[Array, "4 4"], step: float) -> list[Float[Array, "4 4"]]:
    """A pose, and the same moved along its ray by a share of its depth, nearer and farther; alone with step 0."""
    poses = []
    for factor in (1.0, 1.0 - step, 1.0 + step) if step else (1.0,):
        T = T_cam_obj.copy()
        T[:3, 3] *= factor
        poses.append(T)
    return poses


def nearest_copy(
    T_cam_obj: Float[Array, "4 4"], T_cam_obj_before: Float[Array, "4 4"], symmetries: Symmetric
) -> Float[Array, "4 4"]:
    """The pose that looks the same as `T_cam_obj` and is turned least against the one before.

    Every listed discrete symmetry is tried. The angle about an axis of revolution is solved for, not sampled, so an
    object that does not turn visibly does not turn at all.

    Args:
        T_cam_obj: New pose.
        T_cam_obj_before: Pose to stay near to.
        symmetries: Of the object.
    """
    copies = [T_cam_obj @ S for S in (np.eye(4), *symmetries.symmetries_discrete)]
    continuous = symmetries.symmetries_continuous
    if is_ball(continuous):
        copies = [copy @ align_ball(continuous, copy, T_cam_obj_before) for copy in copies]
    elif continuous:
        copies = [
            copy @ _untwist(copy, T_cam_obj_before, continuous[0].axis, continuous[0].offset_m) for copy in copies
        ]
    angles = [se3.rotation_angle_rad(copy[:3, :3] @ T_cam_obj_before[:3, :3].T) for copy in copies]
    return np.asarray(copies[int(np.argmin(angles))])


def _untwist(
    T: Float[Array, "4 4"],
    T_before: Float[Array, "4 4"],
    axis: tuple[float, float, float],
    offset_m: tuple[float, float, float],
) -> Float[Array, "4 4"]:
    """The turn S about an axis for which the rotation of T S is nearest to that of the pose before.

    The trace of R_before^T R S(angle) is constant + B cos(angle) + C sin(angle); the angle that makes it largest makes
    the rotation between them smallest.
    """
    unit = np.asarray(axis, np.float64) / np.linalg.norm(axis)
    M = T_before[:3, :3].T @ T[:3, :3]
    cross = np.array([[0.0, -unit[2], unit[1]], [unit[2], 0.0, -unit[0]], [-unit[1], unit[0], 0.0]])
    angle_rad = np.arctan2(np.trace(M @ cross), np.trace(M) - unit @ M @ unit)
    return np.asarray(rotations_about_axis(unit, np.array([angle_rad]), np.asarray(offset_m, np.float64))[0])
