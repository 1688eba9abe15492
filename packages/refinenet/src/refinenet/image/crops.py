"""Crop windows of hypotheses, and the resampling map from a stored patch to a new crop."""

from collections.abc import Mapping
from typing import Any

import cv2
import numpy as np
from jaxtyping import Float
from posecore.mesh import Mesh
from posecore.window import Window, diameter_window, fixed_window

from refinenet.config import WindowConfig


def hypothesis_window(
    config: WindowConfig,
    K: Float[np.ndarray, "3 3"],
    T_cam_obj: Float[np.ndarray, "4 4"],
    mesh: Mesh,
    fixed_side_px: float,
) -> Window:
    """The window around a hypothesis in training; `refine.patches` computes the same one for an image at inference.

    Args:
        config: Kind and scale.
        K: Intrinsics of the image that the window is cut from, a full image or a patch.
        T_cam_obj: Hypothesis, metres.
        mesh: Object.
        fixed_side_px: Side of a `fixed` window in that image's pixels.
    """
    if config.kind == "fixed":
        return fixed_window(mesh.vertices_m, K, T_cam_obj, fixed_side_px)
    return diameter_window(K, T_cam_obj, mesh.center_m, mesh.diameter_m, config.scale)


def fixed_sides_px(objects_card: Mapping[str, Mapping[str, Any]]) -> dict[int, float]:
    """Side of the `fixed` window of every object on a data card, in pixels of the images it was rendered in."""
    return {int(key): float(entry["window_side_px"]) for key, entry in objects_card.items()}


def optical_axis_rotation(angle_rad: float) -> Float[np.ndarray, "3 3"]:
    """Rotation of the scene about the camera's optical axis."""
    c, s = np.cos(angle_rad), np.sin(angle_rad)
    return np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])


def crop_affine(
    stored: Window,
    stored_px: int,
    K: Float[np.ndarray, "3 3"],
    rotation: Float[np.ndarray, "3 3"],
    window: Window,
    patch_px: int,
) -> Float[np.ndarray, "2 3"]:
    """Affine map from the stored patch's pixels to the new patch's, both continuous (pixel centre at + 0.5).

    Args:
        stored: Window of the stored patch.
        stored_px: Side of the stored patch in its own pixels.
        K: Intrinsics of the full image.
        rotation: Rotation about the optical axis, see `optical_axis_rotation`.
        window: New window, in the image of the rotated camera.
        patch_px: Side of the new patch.
    """
    image_from_stored = _similarity(stored.side_px / stored_px, stored.x0_px, stored.y0_px)
    scale = patch_px / window.side_px
    patch_from_image = _similarity(scale, -window.x0_px * scale, -window.y0_px * scale)
    return np.asarray((patch_from_image @ K @ rotation @ np.linalg.inv(K) @ image_from_stored)[:2])


def _similarity(scale: float, dx: float, dy: float) -> Float[np.ndarray, "3 3"]:
    return np.array([[scale, 0.0, dx], [0.0, scale, dy], [0.0, 0.0, 1.0]])


def warp(image: np.ndarray, affine: Float[np.ndarray, "2 3"], patch_px: int, nearest: bool = False) -> np.ndarray:
    """Resample an image by a continuous-pixel affine map; outside, labels are zero and colours are replicated.

    A map that shrinks colours blurs them first, as much as `posecore.window.cut` does with "area".
    """
    shrink = 1.0 / float(np.sqrt(abs(np.linalg.det(affine[:, :2]))))
    if not nearest and shrink > 1.2:
        image = cv2.GaussianBlur(image, (0, 0), 0.5 * np.sqrt(shrink**2 - 1), borderType=cv2.BORDER_REPLICATE)
    centred = affine.copy()
    centred[:, 2] += 0.5 * affine[:, :2].sum(axis=1) - 0.5  # cv2 counts pixel centres as integers
    flags = cv2.INTER_NEAREST if nearest else cv2.INTER_LINEAR
    # colours of the outermost half pixel must not fade to black: the stored window's edge would show
    border = cv2.BORDER_CONSTANT if nearest else cv2.BORDER_REPLICATE
    return np.asarray(cv2.warpAffine(image, centred, (patch_px, patch_px), flags=flags, borderMode=border))
