"""Scores of one track: RMS by axis, frames within 5 cm and 5 degrees, jitter, time."""

from collections.abc import Mapping

import numpy as np
from jaxtyping import Bool, Float

from evalkit.tracking.residuals import Residuals, changes, euler_deg, residuals
from evalkit.tracking.tracks import Track

Array = np.ndarray
LIMIT_M, LIMIT_RAD = 0.05, np.deg2rad(5.0)
"""A frame is tracked where both errors are below: RBOT's criterion."""
AXES = ("x", "y", "z")
ANGLES = ("roll", "pitch", "yaw")

TRACKING_DEFINITIONS: Mapping[str, str] = {
    "x, y, z": "root mean square of estimated minus true origin along the camera's right, down and forward axes, over "
    "the frames with an estimate that the tracker was not given",
    "roll, pitch, yaw": "root mean square of the Euler angles of R_est R_gt^-1 = Rz(yaw) Ry(pitch) Rx(roll), camera "
    "axes: no wrap-around, no gimbal lock near the truth",
    "5 cm 5°": "share of frames with a distance of origins under 5 cm and a rotation error under 5°; frames without an "
    "estimate fail. With `resets` in the sidecar it is RBOT's protocol: frames in which the tracker was set to the "
    "truth count as failed, but for the first of a sequence, which is not counted",
    "lost": "frames without an estimate",
    "jitter": "change of the residual from one frame to the next: length in mm, angle in degrees; frames beside a lost "
    "or a given one have none",
    "symmetries": "the residual is to the copy of the truth with the smallest angle, of equal ones to that nearest to "
    "the residual of the frame before; jitter takes the copy nearest to the frame before, so that a tracker that "
    "turns smoothly from one copy to the next is no jittering one",
}


def track_scores(track: Track) -> dict[str, float]:
    """Scores of one track, keys with units; NaN where there is nothing to take a mean of.

    Args:
        track: at least one frame.

    Returns:
        `frames` (those counted), `lost`, `failed`, `resets` (NaN for a run without), `x_rms_mm` ... `yaw_rms_deg`,
        `success_5cm5deg`, `jitter_mm_median`, `jitter_mm_p95`, `jitter_deg_median`, `jitter_deg_p95`, `time_ms_mean`.
        See `TRACKING_DEFINITIONS`.
    """
    found = np.isfinite(track.T_est).all(axis=(1, 2))
    given = np.zeros(len(found), bool) if track.given is None else track.given
    counted = np.ones(len(found), bool)
    counted[0] = not given[0]
    own = found & ~given
    left = residuals(track.T_est, track.T_gt, track.info)
    tracked = own & (left.distance_m < LIMIT_M) & (left.angle_rad < LIMIT_RAD)
    result = {
        "frames": float(counted.sum()),
        "lost": float((counted & ~found).sum()),
        "failed": float((counted & ~tracked).sum()),
        "resets": float("nan") if track.given is None else float((given & counted).sum()),
        "success_5cm5deg": _mean(tracked[counted].astype(np.float64)),
    }
    result |= _rms(left, own)
    moved_m, turned_rad = changes(track.T_est, track.T_gt, track.info)
    beside = own[1:] & own[:-1] & (np.diff(track.frame) == 1)
    for unit, values in (("mm", 1e3 * moved_m[beside]), ("deg", np.rad2deg(turned_rad[beside]))):
        result[f"jitter_{unit}_median"] = _quantile(values, 0.5)
        result[f"jitter_{unit}_p95"] = _quantile(values, 0.95)
    timed = found & (np.nan_to_num(track.time_s, nan=-1.0) >= 0)
    return result | {"time_ms_mean": _mean(1e3 * track.time_s[timed])}


def _rms(left: Residuals, own: Bool[Array, " n"]) -> dict[str, float]:
    dt_m, angles = left.dt_m[own], euler_deg(left.R[own])
    moved = {f"{axis}_rms_mm": 1e3 * np.sqrt(_mean(dt_m[:, i] ** 2)) for i, axis in enumerate(AXES)}
    turned = {f"{name}_rms_deg": np.sqrt(_mean(angles[:, i] ** 2)) for i, name in enumerate(ANGLES)}
    return {name: float(value) for name, value in (moved | turned).items()}


def _mean(values: Float[Array, " n"]) -> float:
    return float(values.mean()) if len(values) else float("nan")


def _quantile(values: Float[Array, " n"], share: float) -> float:
    return float(np.quantile(values, share)) if len(values) else float("nan")
