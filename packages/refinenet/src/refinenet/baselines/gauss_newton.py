"""Gauss-Newton steps on se(3) about the object's centre, for residuals in the image plane."""

import numpy as np
from jaxtyping import Float
from posecore import se3

TUKEY = 4.6851
"""Width of Tukey's weight in standard deviations, for 95 % efficiency on normally distributed residuals."""


def projection_jacobian(
    K: Float[np.ndarray, "3 3"],
    p_cam_m: Float[np.ndarray, "n 3"],
    center_cam_m: Float[np.ndarray, "3"],
    length_m: float,
) -> Float[np.ndarray, "n 2 6"]:
    """Jacobian of the projections of surface points with respect to the object's pose.

    Args:
        K: Camera matrix.
        p_cam_m: Points, camera frame, in front of the camera.
        center_cam_m: The object's centre, camera frame, where the pose has its origin.
        length_m: Unit of translation. The object's radius makes a step of 1 move the image about as far in rotation
            as in translation, so that one damping suits both.

    Returns:
        d(u, v) / d(rotation vector in rad, translation in `length_m`), in pixels.
    """
    z = p_cam_m[:, 2]
    x, y = p_cam_m[:, 0] / z, p_cam_m[:, 1] / z
    zero = np.zeros_like(z)
    by_point = np.stack(
        [
            np.stack([K[0, 0] / z, zero, -K[0, 0] * x / z], -1),
            np.stack([zero, K[1, 1] / z, -K[1, 1] * y / z], -1),
        ],
        axis=1,
    )
    # d(exp(w) q)/dw = -[q]x with q the point relative to the centre, and g . (w x q) = w . (q x g)
    by_rotation = np.cross((p_cam_m - center_cam_m)[:, None], by_point)
    return np.concatenate([by_rotation, by_point * length_m], axis=-1)


def step(
    J: Float[np.ndarray, "n 6"], residual: Float[np.ndarray, " n"], weight: Float[np.ndarray, " n"], damping: float
) -> Float[np.ndarray, "6"]:
    """The x that minimises sum w (r + J x)^2, damped.

    Args:
        J: Rows.
        residual: Residual of each row.
        weight: Not negative.
        damping: Fraction of the mean diagonal that is added to the diagonal: a direction without evidence, such as a
            rotation about an axis of symmetry, gets no step.
    """
    H = J.T @ (J * weight[:, None])
    return np.asarray(np.linalg.solve(H + (damping * np.trace(H) / 6 + 1e-12) * np.eye(6), -J.T @ (weight * residual)))


def apply_step(
    T_cam_obj: Float[np.ndarray, "4 4"], x: Float[np.ndarray, "6"], length_m: float
) -> Float[np.ndarray, "4 4"]:
    """The pose after a step x of `step`, whose translation is in units of `length_m`."""
    return se3.apply_update(T_cam_obj, se3.rotation_from_rotvec(x[:3]), x[3:] * length_m)


def tukey_weight(residual: Float[np.ndarray, " n"], sigma: float) -> Float[np.ndarray, " n"]:
    """Tukey's biweight: 1 for no residual, 0 from 4.7 standard deviations on."""
    return np.square(1 - np.square(residual / (TUKEY * sigma)).clip(0, 1))
