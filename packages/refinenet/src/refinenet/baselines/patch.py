"""Patch of a baseline: the object's render and the image in a window around the pose, and the render's edges."""

from dataclasses import dataclass

import cv2
import numpy as np
from jaxtyping import Bool, Float, Int, Shaped, UInt8
from posecore.camera import back_project, crop_K
from posecore.contour import trace
from posecore.mesh import Mesh
from posecore.raster import Rasteriser
from posecore.window import Window, cut_rgb, diameter_window, pixels_inside
from scipy.special import ndtri

from refinenet.refiner import render_obstacle

WINDOW_SCALE = 1.6
"""Window side over the projected diameter: room for a search of 0.3 diameters on each side."""
MIN_SIDE_PX = 12.0
"""Least window side in image pixels; a smaller window has too little detail to estimate a pose."""
EDGE_BLUR_PX = 1.0


@dataclass(frozen=True, kw_only=True, eq=False)
class TrackedObject:
    """An object and its renderer.

    Attributes:
        obj_id: Id of the mesh in the rasteriser.
        mesh: Mesh, its origin at the centre.
        rasteriser: Holds the mesh.
        known_depth_m: Camera z of other objects with known poses, 0 elsewhere; None without any.
    """

    obj_id: int
    mesh: Mesh
    rasteriser: Rasteriser
    known_depth_m: Float[np.ndarray, "h w"] | None = None


@dataclass(frozen=True, kw_only=True, eq=False)
class ObjectPatch:
    """A square patch of p x p pixels at a pose.

    Attributes:
        K: Camera of the patch.
        window: Window of the patch in the image.
        depth_m: Camera z of the object's render, 0 beside the object.
        rgb: Colours of the object's render on black.
        scene_rgb: Image, its border replicated outside.
        occluder_depth_m: Camera z of the nearest known occluder; inf where none, 0 outside the image.
        visible: Patch pixels in the image without a known occluder in front of the object.
    """

    K: Float[np.ndarray, "3 3"]
    window: Window
    depth_m: Float[np.ndarray, "p p"]
    rgb: UInt8[np.ndarray, "p p 3"]
    scene_rgb: UInt8[np.ndarray, "p p 3"]
    occluder_depth_m: Float[np.ndarray, "p p"]
    visible: Bool[np.ndarray, "p p"]

    @property
    def mask(self) -> Bool[np.ndarray, "p p"]:
        """Silhouette of the render."""
        return self.depth_m > 0


@dataclass(frozen=True, kw_only=True, eq=False)
class Edges:
    """Points of a render at which an image edge is expected.

    Attributes:
        p_cam_m: (n, 3) surface points, camera frame, metres.
        uv_px: (n, 2) positions in the patch, subpixel.
        normal: (n, 2) unit vectors across the edge.
    """

    p_cam_m: Float[np.ndarray, "n 3"]
    uv_px: Float[np.ndarray, "n 2"]
    normal: Float[np.ndarray, "n 2"]


def finest_px(K: Float[np.ndarray, "3 3"], T_cam_obj: Float[np.ndarray, "4 4"], mesh: Mesh, at_most_px: int) -> int:
    """Side of the finest useful patch: the image's resolution, at most `at_most_px`; 0 where the object is not visible.

    A pose that cannot be rendered (`render_obstacle`) or is too far away is not visible.
    """
    if render_obstacle(T_cam_obj, mesh):
        return 0
    side_px = diameter_window(K, T_cam_obj, mesh.center_m, mesh.diameter_m, WINDOW_SCALE).side_px
    return 0 if side_px < MIN_SIDE_PX else int(np.clip(np.ceil(side_px), 48, at_most_px))


def render_and_crop(
    image: UInt8[np.ndarray, "h w 3"],
    K: Float[np.ndarray, "3 3"],
    T_cam_obj: Float[np.ndarray, "4 4"],
    target: TrackedObject,
    patch_px: int,
    scale: float = WINDOW_SCALE,
) -> ObjectPatch | None:
    """The patch around a pose, `scale` projected diameters wide; None where no pixel of the object is visible."""
    if not finest_px(K, T_cam_obj, target.mesh, patch_px):
        return None
    window = diameter_window(K, T_cam_obj, target.mesh.center_m, target.mesh.diameter_m, scale)
    K_patch = crop_K(K, window, patch_px)
    height_px, width_px = image.shape[:2]
    in_image = pixels_inside(window, patch_px, width_px, height_px)
    if not in_image.any():
        return None
    layers = target.rasteriser.render(target.obj_id, K_patch, T_cam_obj[None], patch_px, patch_px)
    assert layers.rgb is not None
    mask, depth_m, occluder_depth_m = layers.mask[0], layers.depth_m[0], np.where(in_image, np.inf, 0.0)
    if target.known_depth_m is not None:
        known_depth_m = nearest_pixels(target.known_depth_m, window, patch_px)
        occluder_depth_m = np.where(in_image & (known_depth_m > 0), known_depth_m, occluder_depth_m)
    centre_z_m = target.mesh.center_cam_m(T_cam_obj)[2]
    visible = occluder_depth_m > np.where(mask, depth_m, centre_z_m)
    if not (mask & visible).any():
        return None
    return ObjectPatch(
        K=K_patch,
        window=window,
        depth_m=depth_m,
        rgb=layers.rgb[0],
        scene_rgb=cut_rgb(image, window, patch_px, border="replicate"),
        occluder_depth_m=occluder_depth_m,
        visible=visible,
    )


def nearest_pixels(values: Shaped[np.ndarray, "h w"], window: Window, patch_px: int) -> Shaped[np.ndarray, "p p"]:
    """Image values at the pixel nearest to each patch pixel of a window; outside the image, those of its border."""
    centre = (np.arange(patch_px) + 0.5) * window.side_px / patch_px
    rows = np.floor(window.y0_px + centre).astype(int).clip(0, values.shape[0] - 1)
    columns = np.floor(window.x0_px + centre).astype(int).clip(0, values.shape[1] - 1)
    return np.asarray(values[rows[:, None], columns])


def silhouette_edges(patch: ObjectPatch, n: int) -> Edges:
    """At most `n` points evenly along the visible silhouette, normals outwards.

    Contour pixels lie on the object, the edge at most half a pixel outside their centres. The blurred silhouette gives
    the distance, as it falls off by the normal distribution across a straight edge.
    """
    pixels = trace(patch.mask)
    pixels = pixels[patch.visible[pixels[:, 0], pixels[:, 1]]]
    pixels = pixels[_even(len(pixels), n)]
    row, column = pixels[:, 0], pixels[:, 1]
    soft = cv2.GaussianBlur(patch.mask.astype(np.float32), (0, 0), EDGE_BLUR_PX)
    normal = _unit(-channel_gradients_at(soft[..., None], pixels)[:, 0])
    outwards_px = EDGE_BLUR_PX * ndtri(soft[row, column].astype(np.float64).clip(0.05, 0.95))
    centre_px = pixels[:, ::-1] + 0.5
    return Edges(
        p_cam_m=back_project(patch.K, centre_px, patch.depth_m[row, column].astype(np.float64)),
        uv_px=centre_px + outwards_px[:, None] * normal,
        normal=normal,
    )


def _even(length: int, n: int) -> Int[np.ndarray, " m"]:
    """At most `n` indices, evenly spread over `length`."""
    return np.arange(length) if length <= n else (np.arange(n) * (length / n)).astype(int)


def _unit(vectors: Float[np.ndarray, "n 2"]) -> Float[np.ndarray, "n 2"]:
    length = np.linalg.norm(vectors, axis=1, keepdims=True)
    return np.divide(vectors, length, out=np.zeros_like(vectors), where=length > 1e-9)


def channel_gradients_at(
    channels: Float[np.ndarray, "h w c"], pixels: Int[np.ndarray, "n 2"]
) -> Float[np.ndarray, "n c 2"]:
    """(d/dx, d/dy) of every channel at pixels (row, column), by central differences."""
    padded = cv2.copyMakeBorder(channels, 1, 1, 1, 1, cv2.BORDER_REPLICATE).reshape(
        channels.shape[0] + 2, channels.shape[1] + 2, -1
    )
    row, column = pixels[:, 0] + 1, pixels[:, 1] + 1
    dx = padded[row, column + 1] - padded[row, column - 1]
    dy = padded[row + 1, column] - padded[row - 1, column]
    return np.stack([dx, dy], -1).astype(np.float64) / 2


def inner_edges(patch: ObjectPatch, n: int, min_gradient: float) -> tuple[Edges, Float[np.ndarray, "n c"]]:
    """At most `n` points evenly over the render's edges inside the silhouette: creases, colours, steps in depth.

    Args:
        patch: Render.
        n: Largest number of points.
        min_gradient: Least gradient across an edge, grey levels a pixel after blurring.

    Returns:
        The edges, normals up the gradient, and (n, 3) the unit colour step across the edge.
    """
    inside = cv2.erode(patch.mask.astype(np.uint8), np.ones((5, 5), np.uint8)).astype(bool) & patch.visible
    smooth = cv2.GaussianBlur(patch.rgb.astype(np.float32), (0, 0), EDGE_BLUR_PX)
    dx = cv2.Sobel(smooth, cv2.CV_32F, 1, 0, ksize=3, scale=1 / 8)
    dy = cv2.Sobel(smooth, cv2.CV_32F, 0, 1, ksize=3, scale=1 / 8)
    # the strongest direction of change over all channels: the larger eigenvector of the summed structure tensor
    xx, yy, xy = (dx * dx).sum(-1), (dy * dy).sum(-1), (dx * dy).sum(-1)
    half = np.hypot((xx - yy) / 2, xy)
    strength = np.sqrt((xx + yy) / 2 + half)
    angle = 0.5 * np.arctan2(2 * xy, xx - yy)
    nx, ny = np.cos(angle), np.sin(angle)
    columns, rows = np.meshgrid(
        np.arange(strength.shape[1], dtype=np.float32), np.arange(strength.shape[0], dtype=np.float32)
    )
    ahead = cv2.remap(strength, columns + nx, rows + ny, cv2.INTER_LINEAR)
    behind = cv2.remap(strength, columns - nx, rows - ny, cv2.INTER_LINEAR)
    peak = inside & (strength >= ahead) & (strength > behind) & (strength > min_gradient)
    pixels = np.argwhere(peak)
    pixels = pixels[_even(len(pixels), n)]
    row, column = pixels[:, 0], pixels[:, 1]
    bend = np.minimum(behind - 2 * strength + ahead, -1e-6)
    finer = ((behind - ahead) / (2 * bend)).clip(-0.5, 0.5)[row, column]
    normal = np.stack([nx, ny], -1)[row, column].astype(np.float64)
    change = dx[row, column] * normal[:, :1] + dy[row, column] * normal[:, 1:]
    expected = change / np.maximum(np.linalg.norm(change, axis=1, keepdims=True), 1e-6)
    centre_px = pixels[:, ::-1] + 0.5
    edges = Edges(
        p_cam_m=back_project(patch.K, centre_px, patch.depth_m[row, column].astype(np.float64)),
        uv_px=centre_px + finer[:, None] * normal,
        normal=normal,
    )
    return edges, expected
