"""Scores of a track: RMS by axis, frames within 5 cm and 5 degrees, jitter, time."""

from collections.abc import Mapping

import numpy as np
from jaxtyping import Bool, Float

from evalkit.tracking.residuals import Residuals, changes, euler_deg, residuals
from evalkit.tracking.tracks import SequenceTrack

LIMIT_M, LIMIT_RAD = 0.05, np.deg2rad(5.0)
"""Limits of both errors of a tracked frame: RBOT's criterion."""
AXES = ("x", "y", "z")
ANGLES = ("roll", "pitch", "yaw")

TRACKING_DEFINITIONS: Mapping[str, str] = {
    "x, y, z": "root mean square of estimated minus ground-truth centre along the camera's right, down and forward "
    "axes, over the frames with an estimate of the tracker, without frames in which it was initialised",
    "roll, pitch, yaw": "root mean square of the Euler angles of R_est R_gt^-1 = Rz(yaw) Ry(pitch) Rx(roll), camera "
    "axes: no wrap-around, no gimbal lock near the ground truth",
    "5 cm 5°": "fraction of frames with a distance of centres under 5 cm and a rotation error under 5°; frames without "
    "an estimate fail. With `resets` in the sidecar it is RBOT's protocol: frames in which the tracker was reset to "
    "the ground truth count as failed; the first frame of a sequence is not counted",
    "lost": "frames without an estimate",
    "jitter": "change of the residual from one frame to the next: length in mm, angle in degrees; none for "
    "frames beside a lost frame or an initialisation",
    "symmetries": "the residual is to the symmetry-equivalent ground truth with the smallest angle, of equal ones to "
    "the one nearest to the residual of the previous frame; jitter is measured to the one nearest to the previous "
    "frame, so that a smooth rotation from one to the next is not jitter",
}


def track_scores(track: SequenceTrack) -> dict[str, float]:
    """Scores of a track, keys with units; NaN for means over no values.

    Args:
        track: at least one frame.

    Returns:
        `frames` (number counted), `lost`, `failed`, `resets` (NaN for a run without), `x_rms_mm` ... `yaw_rms_deg`,
        `success_5cm5deg`, `jitter_mm_median`, `jitter_mm_p95`, `jitter_deg_median`, `jitter_deg_p95`, `time_ms_mean`.
        See `TRACKING_DEFINITIONS`.
    """
    has_estimate = np.isfinite(track.T_est).all(axis=(1, 2))
    was_initialised = np.zeros(len(has_estimate), bool) if track.was_initialised is None else track.was_initialised
    counted = np.ones(len(has_estimate), bool)
    counted[0] = not was_initialised[0]
    is_estimated = has_estimate & ~was_initialised
    errors = residuals(track.T_est, track.T_gt, track.info)
    tracked = is_estimated & (errors.distance_m < LIMIT_M) & (errors.angle_rad < LIMIT_RAD)
    result = {
        "frames": float(counted.sum()),
        "lost": float((counted & ~has_estimate).sum()),
        "failed": float((counted & ~tracked).sum()),
        "resets": float("nan") if track.was_initialised is None else float((was_initialised & counted).sum()),
        "success_5cm5deg": _mean(tracked[counted].astype(np.float64)),
    }
    result |= _rms(errors, is_estimated)
    translations_m, rotations_rad = changes(track.T_est, track.T_gt, track.info)
    beside = is_estimated[1:] & is_estimated[:-1] & (np.diff(track.frame) == 1)
    for unit, values in (("mm", 1e3 * translations_m[beside]), ("deg", np.rad2deg(rotations_rad[beside]))):
        result[f"jitter_{unit}_median"] = _quantile(values, 0.5)
        result[f"jitter_{unit}_p95"] = _quantile(values, 0.95)
    timed = has_estimate & (np.nan_to_num(track.time_s, nan=-1.0) >= 0)
    return result | {"time_ms_mean": _mean(1e3 * track.time_s[timed])}


def _rms(errors: Residuals, is_estimated: Bool[np.ndarray, " n"]) -> dict[str, float]:
    dt_m, angles = errors.dt_m[is_estimated], euler_deg(errors.R[is_estimated])
    translation_rms = {f"{axis}_rms_mm": 1e3 * np.sqrt(_mean(dt_m[:, i] ** 2)) for i, axis in enumerate(AXES)}
    rotation_rms = {f"{name}_rms_deg": np.sqrt(_mean(angles[:, i] ** 2)) for i, name in enumerate(ANGLES)}
    return {name: float(value) for name, value in (translation_rms | rotation_rms).items()}


def _mean(values: Float[np.ndarray, " n"]) -> float:
    return float(values.mean()) if len(values) else float("nan")


def _quantile(values: Float[np.ndarray, " n"], fraction: float) -> float:
    return float(np.quantile(values, fraction)) if len(values) else float("nan")
