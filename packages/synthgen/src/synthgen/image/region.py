"""Image regions to render for crop windows, and windows and cameras in a scaled image."""

import math
from collections.abc import Sequence

import numpy as np
from jaxtyping import Bool, Float
from posecore.camera import Camera
from posecore.window import Window

_REGION_MARGIN_PX = 3  # reach of interpolation and of the anti-aliasing blur beyond a crop window


def inside_image(window: Window, patch_px: int, camera: Camera) -> Bool[np.ndarray, "p p"]:
    """Mask of the patch pixels inside the camera's image."""
    centres = (np.arange(patch_px) + 0.5) * (window.side_px / patch_px)
    x, y = window.x0_px + centres, window.y0_px + centres
    return ((y >= 0) & (y < camera.height_px))[:, None] & ((x >= 0) & (x < camera.width_px))[None, :]


def contains(window: Window, box_px: Float[np.ndarray, "4"]) -> bool:
    """Whether a box (x0, y0, x1, y1) lies wholly inside a window."""
    x0, y0, x1, y1 = box_px
    right, bottom = window.x0_px + window.side_px, window.y0_px + window.side_px
    return bool(x0 >= window.x0_px and y0 >= window.y0_px and x1 <= right and y1 <= bottom)


def pixel_bounds(windows: Sequence[Window]) -> tuple[int, int, int, int]:
    """Box of whole pixels (x0, y0, width, height) around the windows, with a margin."""
    m = _REGION_MARGIN_PX
    x0 = int(np.floor(min(w.x0_px for w in windows))) - m
    y0 = int(np.floor(min(w.y0_px for w in windows))) - m
    x1 = int(np.ceil(max(w.x0_px + w.side_px for w in windows))) + m
    y1 = int(np.ceil(max(w.y0_px + w.side_px for w in windows))) + m
    return x0, y0, x1 - x0, y1 - y0


def render_region(windows: Sequence[Window], camera: Camera) -> tuple[int, int, int, int]:
    """Region (x0, y0, width, height) of the image under the windows; crops are filled outside the image."""
    x0, y0, width, height = pixel_bounds(windows)
    left, top = max(x0, 0), max(y0, 0)
    right, bottom = min(x0 + width, camera.width_px), min(y0 + height, camera.height_px)
    return left, top, right - left, bottom - top


def scaled_camera(camera: Camera, scale: float) -> Camera:
    """The camera of the resized image, its size rounded up to whole pixels."""
    if scale == 1.0:
        return camera
    size = (math.ceil(camera.width_px * scale), math.ceil(camera.height_px * scale))
    return Camera(K=np.diag([scale, scale, 1.0]) @ camera.K, width_px=size[0], height_px=size[1])


def scaled_window(window: Window, scale: float) -> Window:
    """The window in an image resized by a factor."""
    return Window(x0_px=window.x0_px * scale, y0_px=window.y0_px * scale, side_px=window.side_px * scale)


def window_in_region(window: Window, region_px: tuple[int, int, int, int]) -> Window:
    """The window in a region's pixels."""
    return Window(x0_px=window.x0_px - region_px[0], y0_px=window.y0_px - region_px[1], side_px=window.side_px)
