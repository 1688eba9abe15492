"""The square crop window of scene and hypothesis patches."""

from dataclasses import dataclass
from typing import Literal

import cv2
import numpy as np
from jaxtyping import Bool, Float, Shaped, UInt8

from posecore import se3


@dataclass(frozen=True, kw_only=True)
class Window:
    """Square region of the image plane in continuous pixels; it may reach beyond the image.

    Attributes:
        x0_px: Left edge.
        y0_px: Top edge.
        side_px: Side length, positive.
    """

    x0_px: float
    y0_px: float
    side_px: float

    def as_array(self) -> Float[np.ndarray, "3"]:
        """(x0, y0, side) in pixels, the form stored in shards."""
        return np.array([self.x0_px, self.y0_px, self.side_px])


def centred(u_px: float, v_px: float, side_px: float) -> Window:
    """Window of the given side around an image point."""
    return Window(x0_px=float(u_px - side_px / 2), y0_px=float(v_px - side_px / 2), side_px=float(side_px))


def silhouette_box(
    vertices_m: Float[np.ndarray, "v 3"], K: Float[np.ndarray, "3 3"], T_cam_obj: Float[np.ndarray, "4 4"]
) -> Float[np.ndarray, "4"]:
    """Bounding box (x0, y0, x1, y1) in pixels of the projected object, not clipped by the image.

    The silhouette's box is the box of the projected vertices, so nothing is rendered. Infinite in every direction
    when a vertex lies in or behind the camera's plane.
    """
    p = vertices_m @ T_cam_obj[:3, :3].T + T_cam_obj[:3, 3]
    if p[:, 2].min() <= 1e-9:
        return np.array([-np.inf, -np.inf, np.inf, np.inf])
    uv = p[:, :2] / p[:, 2:] * np.array([K[0, 0], K[1, 1]]) + K[:2, 2]
    return np.concatenate([uv.min(axis=0), uv.max(axis=0)])


def fixed_side_px(
    vertices_m: Float[np.ndarray, "v 3"],
    K: Float[np.ndarray, "3 3"],
    distance_min_m: float,
    padding: float = 0.1,
    n_views: int = 256,
) -> float:
    """The paper's window side: largest box side over many viewpoints at the smallest distance, plus padding.

    Viewpoints are a Fibonacci sphere with the object centred on the optical axis. Source: ECCV 2018 paper, 3.1;
    method.md, "The pair".
    """
    R = se3.rotations_along(se3.even_directions(n_views))
    p = np.einsum("bij,vj->bvi", R, vertices_m) + np.array([0.0, 0.0, distance_min_m])
    depth = np.maximum(p[..., 2:], 1e-3 * distance_min_m)
    uv = p[..., :2] / depth * np.array([K[0, 0], K[1, 1]])
    return float((uv.max(axis=1) - uv.min(axis=1)).max() * (1.0 + padding))


def fixed_window(
    vertices_m: Float[np.ndarray, "v 3"],
    K: Float[np.ndarray, "3 3"],
    T_cam_obj: Float[np.ndarray, "4 4"],
    side_px: float,
) -> Window:
    """Window of fixed side centred on the box of the hypothesis' silhouette."""
    x0, y0, x1, y1 = silhouette_box(vertices_m, K, T_cam_obj)
    return centred((x0 + x1) / 2, (y0 + y1) / 2, side_px)


def diameter_window(
    K: Float[np.ndarray, "3 3"],
    T_cam_obj: Float[np.ndarray, "4 4"],
    center_m: Float[np.ndarray, "3"],
    diameter_m: float,
    scale: float = 1.5,
) -> Window:
    """Window whose side follows the hypothesis' depth: `scale` x f x diameter / z around the projected centre.

    Args:
        K: Camera matrix.
        T_cam_obj: Hypothesis.
        center_m: The object's box centre in object coordinates.
        diameter_m: The object's diameter.
        scale: Window side over the projected diameter.

    Needs the centre in front of the camera.
    """
    c = T_cam_obj[:3, :3] @ center_m + T_cam_obj[:3, 3]
    u, v = c[:2] / c[2] * np.array([K[0, 0], K[1, 1]]) + K[:2, 2]
    return centred(u, v, scale * float(np.sqrt(K[0, 0] * K[1, 1])) * diameter_m / c[2])


def cut(
    image: Shaped[np.ndarray, "h w *c"],
    window: Window,
    patch_px: int,
    *,
    interpolation: Literal["linear", "area", "nearest"] = "linear",
    fill: float = 0.0,
) -> Shaped[np.ndarray, "p p *c"]:
    """Resample a window of the image to a square patch; outside the image the patch holds `fill`.

    "linear" samples at patch pixel centres; "area" first blurs when the patch is smaller than the window, so that
    fine texture does not alias; "nearest" keeps labels whole.
    """
    scale = window.side_px / patch_px
    if interpolation == "area" and scale > 1.2:
        sigma = 0.5 * float(np.sqrt(scale**2 - 1))
        image = cv2.GaussianBlur(image, (0, 0), sigma, borderType=cv2.BORDER_REPLICATE)
    # cv2 counts pixel centres as integers: x_src + 0.5 = x0 + (x_dst + 0.5) * scale
    M = np.array(
        [
            [scale, 0.0, window.x0_px + 0.5 * scale - 0.5],
            [0.0, scale, window.y0_px + 0.5 * scale - 0.5],
        ]
    )
    flags = cv2.INTER_NEAREST if interpolation == "nearest" else cv2.INTER_LINEAR
    return cv2.warpAffine(
        image,
        M,
        (patch_px, patch_px),
        flags=flags | cv2.WARP_INVERSE_MAP,
        borderMode=cv2.BORDER_CONSTANT,
        borderValue=[fill] * 4,
    )


def pixels_inside(window: Window, patch_px: int, width_px: int, height_px: int) -> Bool[np.ndarray, "p p"]:
    """Mask of the patch pixels whose centres lie in the image."""
    centre = (np.arange(patch_px) + 0.5) * window.side_px / patch_px
    u, v = window.x0_px + centre, window.y0_px + centre
    return ((v >= 0) & (v < height_px))[:, None] & ((u >= 0) & (u < width_px))[None]


def cut_rgb(
    image: UInt8[np.ndarray, "h w 3"], window: Window, patch_px: int, border: Literal["zero", "replicate"] = "zero"
) -> UInt8[np.ndarray, "p p 3"]:
    """The scene patch of a window, antialiased; reads only the window's part of the image.

    Outside the image the patch is black, or with `replicate` continues the image's border, so that there is no edge.
    """
    margin = 8 + int(2 * window.side_px / patch_px)
    x0, y0 = int(np.floor(window.x0_px)) - margin, int(np.floor(window.y0_px)) - margin
    if border == "replicate":
        size = int(np.ceil(window.side_px)) + 2 * margin + 1
        columns = np.arange(x0, x0 + size).clip(0, image.shape[1] - 1)
        rows = np.arange(y0, y0 + size).clip(0, image.shape[0] - 1)
        padded = np.ascontiguousarray(image[rows[:, None], columns])
        shifted = Window(x0_px=window.x0_px - x0, y0_px=window.y0_px - y0, side_px=window.side_px)
        return np.asarray(cut(padded, shifted, patch_px, interpolation="area"))
    x1, y1 = int(x0 + window.side_px + 2 * margin + 2), int(y0 + window.side_px + 2 * margin + 2)
    x0, y0, x1, y1 = max(x0, 0), max(y0, 0), min(x1, image.shape[1]), min(y1, image.shape[0])
    if x1 <= x0 or y1 <= y0:
        return np.zeros((patch_px, patch_px, 3), np.uint8)
    part = Window(x0_px=window.x0_px - x0, y0_px=window.y0_px - y0, side_px=window.side_px)
    return np.asarray(cut(np.ascontiguousarray(image[y0:y1, x0:x1]), part, patch_px, interpolation="area"))
