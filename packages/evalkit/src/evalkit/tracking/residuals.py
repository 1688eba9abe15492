"""Residuals of tracked poses of the object's centre, in camera axes: `R_est R_gt^-1` and `t_est - t_gt`.

For objects with symmetries, the residual is to the symmetry-equivalent ground truth nearest in rotation.
"""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int
from posecore import se3
from posecore.symmetry import Symmetric, symmetric_copies

TIE_RAD = 1e-6
"""Copies of a symmetric object whose residual angles differ by less are equally near."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Residuals:
    """Residuals of estimates in camera axes; NaN where there is no estimate.

    Attributes:
        R: (n, 3, 3) `R_est R_gt^-1`.
        dt_m: (n, 3) `t_est - t_gt`.
    """

    R: Float[np.ndarray, "n 3 3"]
    dt_m: Float[np.ndarray, "n 3"]

    @property
    def angle_rad(self) -> Float[np.ndarray, " n"]:
        """Rotation error."""
        return se3.rotation_angle_rad(self.R)

    @property
    def distance_m(self) -> Float[np.ndarray, " n"]:
        """Distance of the centres."""
        return np.asarray(np.linalg.norm(self.dt_m, axis=1))


def residuals(
    T_est: Float[np.ndarray, "n 4 4"], T_gt: Float[np.ndarray, "n 4 4"], info: Symmetric | None = None
) -> Residuals:
    """Residuals of a sequence, frames in order.

    Args:
        T_est: estimated poses of the centre, metres, NaN where there is none.
        T_gt: ground truth.
        info: symmetries in the same frame, None for none.
    """
    R, dt_m = _to_copies(T_est[:, :3, :3], T_est, T_gt, info)
    chosen = _nearest_copies(R)
    rows = np.arange(len(T_est))
    return Residuals(R=R[rows, chosen], dt_m=dt_m[rows, chosen])


def _nearest_copies(R: Float[np.ndarray, "n s 3 3"]) -> Int[np.ndarray, " n"]:
    """Copy with the smallest angle in each frame; of equal ones the nearest to the residual of the frame before."""
    angle = np.where(np.isnan(R[..., 0, 0]), np.inf, se3.rotation_angle_rad(R))
    chosen = np.asarray(angle.argmin(axis=1))
    smallest = angle.min(axis=1)
    ties = angle <= smallest[:, None] + TIE_RAD
    for row in np.flatnonzero(np.isfinite(smallest[1:]) & (ties[1:].sum(axis=1) > 1)) + 1:
        before = R[row - 1, chosen[row - 1]]
        if np.isfinite(before).all():
            equal = np.flatnonzero(ties[row])
            chosen[row] = equal[se3.rotation_angle_rad(R[row, equal] @ before.T).argmin()]
    return chosen


def changes(
    T_est: Float[np.ndarray, "n 4 4"], T_gt: Float[np.ndarray, "n 4 4"], info: Symmetric | None = None
) -> tuple[Float[np.ndarray, " m"], Float[np.ndarray, " m"]]:
    """Change of the residual from each frame to the next (m = n - 1), metres and radians; NaN beside a gap.

    The later frame's residual is to the symmetry-equivalent ground truth nearest to the earlier frame's residual.
    """
    errors = residuals(T_est, T_gt, info)
    before_R, before_t = errors.R[:-1], errors.dt_m[:-1]
    back = np.swapaxes(before_R, -1, -2) @ T_est[1:, :3, :3]
    R, dt_m = _to_copies(back, T_est[1:], T_gt[1:], info)
    angles_rad = se3.rotation_angle_rad(R @ np.swapaxes(before_R, -1, -2)[:, None])
    chosen = np.where(np.isnan(angles_rad), np.inf, angles_rad).argmin(axis=1)
    rows = np.arange(len(chosen))
    moved = np.linalg.norm(dt_m[rows, chosen] - before_t, axis=1)
    return np.asarray(moved), np.asarray(angles_rad[rows, chosen])


def _to_copies(
    R_near: Float[np.ndarray, "n 3 3"],
    T_est: Float[np.ndarray, "n 4 4"],
    T_gt: Float[np.ndarray, "n 4 4"],
    info: Symmetric | None,
) -> tuple[Float[np.ndarray, "n s 3 3"], Float[np.ndarray, "n s 3"]]:
    """Residuals to the symmetry-equivalent ground-truth poses: one for each discrete symmetry.

    With an axis of revolution, each is rotated about it to come nearest to `R_near`, exactly: sampled angles would put
    their step into the residual and shake it from frame to frame.
    """
    copies = symmetric_copies(T_gt, se3.make_T(R_near, np.zeros((len(R_near), 3))), info)
    R = T_est[:, None, :3, :3] @ np.swapaxes(copies[..., :3, :3], -1, -2)
    gone = np.isnan(R).any(axis=(-2, -1), keepdims=True)
    # Annotations are orthonormal to three digits only. A rotation times a stretch has that rotation as its nearest one,
    # so transposing instead of inverting the ground truth costs nothing.
    R = np.where(gone, np.nan, se3.nearest_rotation(np.where(gone, np.eye(3), R)))
    return np.asarray(R), np.asarray(T_est[:, None, :3, 3] - copies[..., :3, 3])


def euler_deg(R: Float[np.ndarray, "*b 3 3"]) -> Float[np.ndarray, "*b 3"]:
    """Roll, pitch, yaw in degrees with `R = Rz(yaw) Ry(pitch) Rx(roll)`: roll and yaw in (-180, 180], pitch in +-90.

    This is PCL's convention (`getTranslationAndEulerAngles`); the paper does not name its own.
    """
    roll = np.arctan2(R[..., 2, 1], R[..., 2, 2])
    pitch = np.arctan2(-R[..., 2, 0], np.hypot(R[..., 2, 1], R[..., 2, 2]))
    yaw = np.arctan2(R[..., 1, 0], R[..., 0, 0])
    return np.asarray(np.rad2deg(np.stack([roll, pitch, yaw], axis=-1)))
