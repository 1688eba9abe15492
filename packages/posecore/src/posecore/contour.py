"""Contours of silhouettes, their 3D points and distance transforms."""

import cv2
import numpy as np
from jaxtyping import Bool, Float, Int

from posecore.camera import back_project
from posecore.errors import RenderError

_SQUARE = np.ones((3, 3), np.uint8)


def contour_mask(mask: Bool[np.ndarray, "h w"]) -> Bool[np.ndarray, "h w"]:
    """Silhouette minus its 3 x 3 erosion.

    Where the silhouette is cut by the patch's border there is no contour: the outside counts as silhouette.
    """
    inner = cv2.erode(mask.astype(np.uint8), _SQUARE, borderType=cv2.BORDER_CONSTANT, borderValue=[1])
    return np.asarray(mask & (inner == 0))


def distance_transform_px(contour: Bool[np.ndarray, "h w"]) -> Float[np.ndarray, "h w"]:
    """Unsigned exact Euclidean distance from every pixel centre to the nearest contour pixel's centre.

    Raises:
        RenderError: There is no contour pixel.
    """
    if not contour.any():
        raise RenderError("the silhouette has no contour inside the patch, so it has no distance transform")
    approximate = cv2.distanceTransform((~contour).astype(np.uint8), cv2.DIST_L2, cv2.DIST_MASK_PRECISE)
    # cv2's last bit depends on how its buffers lie in memory. Squared distances between pixel centres are whole
    # numbers, so rounding them makes the root exact, and the same at every call.
    return np.asarray(np.sqrt(np.rint(np.square(approximate))))


def trace(mask: Bool[np.ndarray, "h w"]) -> Int[np.ndarray, "n 2"]:
    """Contour pixels (row, column) in order along the outlines, outer ones and holes, each once."""
    outlines, _ = cv2.findContours(mask.astype(np.uint8), cv2.RETR_LIST, cv2.CHAIN_APPROX_NONE)
    if not outlines:
        return np.zeros((0, 2), np.int64)
    pixels = np.concatenate(outlines)[:, 0, ::-1].astype(np.int64)
    pixels = pixels[contour_mask(mask)[pixels[:, 0], pixels[:, 1]]]
    _, first = np.unique(pixels[:, 0] * mask.shape[1] + pixels[:, 1], return_index=True)
    return np.asarray(pixels[np.sort(first)])


def sample_contour(
    mask: Bool[np.ndarray, "h w"],
    depth_m: Float[np.ndarray, "h w"],
    K: Float[np.ndarray, "3 3"],
    n: int,
    rng: np.random.Generator,
) -> Float[np.ndarray, "n 3"]:
    """Draw contour points evenly along the contour and lift them with the same render's depth.

    Args:
        mask: Silhouette.
        depth_m: Camera z of the same render.
        K: Camera matrix of the same image.
        n: Number of points; without replacement where that many contour pixels exist.
        rng: Draws the position of the first point along the contour.

    Returns:
        (n, 3) camera-frame points, metres, at pixel centres.

    Raises:
        RenderError: There is no contour pixel.
    """
    pixels = trace(mask)
    if len(pixels) == 0:
        raise RenderError("the silhouette has no contour inside the patch, so no contour points can be drawn")
    chosen = pixels[((np.arange(n) + rng.random()) * len(pixels) / n).astype(int)]
    row, column = chosen[:, 0], chosen[:, 1]
    points = back_project(K, chosen[:, ::-1] + 0.5, depth_m[row, column].astype(np.float64))
    return points.astype(np.float32)
