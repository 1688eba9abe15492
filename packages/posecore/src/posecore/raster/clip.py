"""The projection of camera coordinates to GL clip space."""

import numpy as np
from jaxtyping import Float


def clip_from_cam(
    K: Float[np.ndarray, "3 3"], width_px: int, height_px: int, near_m: float, far_m: float
) -> Float[np.ndarray, "4 4"]:
    """Projection to GL clip space with image row 0 at the framebuffer's first row, so nothing is flipped on reading."""
    w, h = float(width_px), float(height_px)
    depth_scale = (far_m + near_m) / (far_m - near_m)
    depth_shift = -2.0 * far_m * near_m / (far_m - near_m)
    return np.array(
        [
            [2 * K[0, 0] / w, 0.0, 2 * K[0, 2] / w - 1.0, 0.0],
            [0.0, 2 * K[1, 1] / h, 2 * K[1, 2] / h - 1.0, 0.0],
            [0.0, 0.0, depth_scale, depth_shift],
            [0.0, 0.0, 1.0, 0.0],
        ]
    )
