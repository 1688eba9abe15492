"""Pinhole camera: OpenCV axes (x right, y down, z forward), continuous pixel coordinates.

Pixel (row i, column j) covers [j, j+1) x [i, i+1); its centre is (j + 0.5, i + 0.5).
"""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from posecore.errors import CameraError
from posecore.window import Window

SMALLEST_FOCAL_PX, LARGEST_PX = 1e-2, 1e7
"""Range of focal lengths and principal points, within which no projection of an object in range overflows."""
LARGEST_SIDE_PX = 1 << 16


@dataclass(frozen=True, kw_only=True, eq=False)
class Camera:
    """Intrinsics and image size.

    Attributes:
        K: (3, 3) float64, pixels; zero skew.
        width_px: Image width.
        height_px: Image height.
    """

    K: Float[np.ndarray, "3 3"]
    width_px: int
    height_px: int

    def __post_init__(self) -> None:
        K = np.asarray(self.K, np.float64)
        object.__setattr__(self, "K", K)
        if K.shape != (3, 3) or not np.isfinite(K).all() or K[0, 0] <= 0 or K[1, 1] <= 0:
            raise CameraError(f"camera matrix: found {K.tolist()}, expected a finite 3 x 3 with positive fx and fy")
        if abs(K[0, 1]) > 1e-9 or abs(K[2, 2] - 1.0) > 1e-9:
            raise CameraError(f"camera matrix: found skew {K[0, 1]} and K[2,2] {K[2, 2]}, expected 0 and 1")
        if not min(K[0, 0], K[1, 1]) >= SMALLEST_FOCAL_PX or np.abs(K).max() > LARGEST_PX:
            raise CameraError(
                f"camera matrix: found {K.tolist()}, expected focal lengths from {SMALLEST_FOCAL_PX:g} px and nothing "
                f"beyond {LARGEST_PX:g} px"
            )
        if not (1 <= self.width_px <= LARGEST_SIDE_PX and 1 <= self.height_px <= LARGEST_SIDE_PX):
            raise CameraError(
                f"image size: found {self.width_px} x {self.height_px} px, expected sides of 1 to {LARGEST_SIDE_PX}"
            )


def intrinsics(fx: float, fy: float, cx: float, cy: float) -> Float[np.ndarray, "3 3"]:
    """Camera matrix from focal lengths and principal point, pixels."""
    return np.array([[fx, 0.0, cx], [0.0, fy, cy], [0.0, 0.0, 1.0]])


def project(K: Float[np.ndarray, "*k 3 3"], p_cam: Float[np.ndarray, "*b n 3"]) -> Float[np.ndarray, "*c n 2"]:
    """Project camera-frame points (metres) to pixels: u = fx X/Z + cx, v = fy Y/Z + cy.

    A point in the camera's plane (Z = 0) gives inf or NaN; one behind it gives its mirrored projection.
    """
    with np.errstate(divide="ignore", invalid="ignore"):
        xy = p_cam[..., :2] / p_cam[..., 2:]
    focal = np.stack([K[..., 0, 0], K[..., 1, 1]], -1)
    return np.asarray(xy * focal[..., None, :] + K[..., None, :2, 2])


def back_project(
    K: Float[np.ndarray, "3 3"], uv_px: Float[np.ndarray, "*n 2"], depth_m: Float[np.ndarray, "*n"]
) -> Float[np.ndarray, "*n 3"]:
    """Lift pixels with camera z (metres) to camera-frame points."""
    x = (uv_px[..., 0] - K[0, 2]) / K[0, 0] * depth_m
    y = (uv_px[..., 1] - K[1, 2]) / K[1, 1] * depth_m
    return np.stack([x, y, depth_m * np.ones_like(x)], -1)


def crop_K(K: Float[np.ndarray, "3 3"], window: Window, patch_px: int) -> Float[np.ndarray, "3 3"]:
    """Intrinsics of the square patch that `window.cut` makes of the image."""
    scale = patch_px / window.side_px
    return intrinsics(
        K[0, 0] * scale, K[1, 1] * scale, (K[0, 2] - window.x0_px) * scale, (K[1, 2] - window.y0_px) * scale
    )
