"""Rendered silhouettes, stored as small patches of the image."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float
from posecore.camera import Camera
from posecore.raster import Rasteriser
from posecore.window import silhouette_box

from evalkit.pose_errors import metrics

TILE_SIDES_PX = (64, 128, 192, 256, 384, 512, 1024)
"""Tile sides: the renderer keeps buffers of a few sizes."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Patch:
    """The part of an image with a rendered object; depth is 0 outside.

    Attributes:
        depth_m: (h, w) camera z, 0 where not hit.
        x0_px: column of the patch's first pixel.
        y0_px: row of the patch's first pixel.
    """

    depth_m: Float[np.ndarray, "h w"]
    x0_px: int
    y0_px: int


def render_patch(
    rasteriser: Rasteriser,
    obj_id: int,
    outline_m: Float[np.ndarray, "n 3"],
    camera: Camera,
    T_cam_obj: Float[np.ndarray, "4 4"],
) -> Patch:
    """Render one pose, cropped to the image.

    Pixels are those of a full-frame render: the crop moves the principal point by whole pixels. Poses are rendered one
    at a time: side by side in one framebuffer, a pixel on an edge may depend on its position there.

    Args:
        rasteriser: has the object's mesh.
        obj_id: which mesh.
        outline_m: vertices of the mesh, or the fewer ones of its convex hull.
        camera: of the image.
        T_cam_obj: pose, metres.
    """
    x0_px, y0_px, side_px = _tile(outline_m, camera, T_cam_obj)
    if side_px == 0:
        return Patch(depth_m=np.zeros((0, 0), np.float32), x0_px=0, y0_px=0)
    K = camera.K.copy()
    K[:2, 2] -= (x0_px, y0_px)
    depth_m = rasteriser.render(obj_id, K, T_cam_obj[None], side_px, side_px, rgb=False).depth_m[0]
    return _trim(depth_m, x0_px, y0_px, camera)


def _tile(
    outline_m: Float[np.ndarray, "n 3"], camera: Camera, T_cam_obj: Float[np.ndarray, "4 4"]
) -> tuple[int, int, int]:
    """Left, top and side of a square over the object's part of the image; side 0 for an object outside."""
    width, height = camera.width_px, camera.height_px
    left, top, right, bottom = silhouette_box(outline_m, camera.K, T_cam_obj)
    x0, y0 = int(max(np.floor(left) - 1, 0)) if left > 0 else 0, int(max(np.floor(top) - 1, 0)) if top > 0 else 0
    x1 = int(min(np.ceil(right) + 1, width)) if right < width else width
    y1 = int(min(np.ceil(bottom) + 1, height)) if bottom < height else height
    need = max(x1 - x0, y1 - y0)
    if x1 <= x0 or y1 <= y0:
        return 0, 0, 0
    return x0, y0, next((side for side in TILE_SIDES_PX if side >= need), need)


def _trim(depth_m: Float[np.ndarray, "s s"], x0_px: int, y0_px: int, camera: Camera) -> Patch:
    inside = depth_m[: max(camera.height_px - y0_px, 0), : max(camera.width_px - x0_px, 0)]
    rows, columns = np.flatnonzero(inside.any(axis=1)), np.flatnonzero(inside.any(axis=0))
    if not len(rows):
        return Patch(depth_m=np.zeros((0, 0), np.float32), x0_px=0, y0_px=0)
    kept = inside[rows[0] : rows[-1] + 1, columns[0] : columns[-1] + 1].copy()
    return Patch(depth_m=kept, x0_px=x0_px + int(columns[0]), y0_px=y0_px + int(rows[0]))


def vss_full(estimated: Patch, gt: Patch) -> float:
    """VSS of the two whole silhouettes."""
    first, second, _, _ = _on_common_canvas(estimated, gt)
    return metrics.vss(first > 0, second > 0)


def vss_visible(
    estimated: Patch,
    gt: Patch,
    K: Float[np.ndarray, "3 3"],
    depth_scene_m: Float[np.ndarray, "h w"],
    delta_m: float = 0.015,
) -> float:
    """VSS of the visible parts, by measured depth: 1 - VSD with tau = infinity."""
    distances = _distances(estimated, gt, K, depth_scene_m)
    return metrics.vss(*metrics.visible_masks(distances[0], distances[1], distances[2], delta_m))


def vsd(
    estimated: Patch,
    gt: Patch,
    K: Float[np.ndarray, "3 3"],
    depth_scene_m: Float[np.ndarray, "h w"],
    taus_m: Float[np.ndarray, " t"],
    delta_m: float = 0.015,
) -> Float[np.ndarray, " t"]:
    """VSD for every tolerance from one pair of renders, see `metrics.vsd`."""
    distances = _distances(estimated, gt, K, depth_scene_m)
    return metrics.vsd(distances[0], distances[1], distances[2], taus_m, delta_m)


def _distances(
    estimated: Patch, gt: Patch, K: Float[np.ndarray, "3 3"], depth_scene_m: Float[np.ndarray, "h w"]
) -> list[Float[np.ndarray, "rows columns"]]:
    """Distances of estimate, ground truth and scene where either was rendered, along bop_toolkit's rays."""
    first, second, x0, y0 = _on_common_canvas(estimated, gt)
    rows, columns = first.shape
    scene = depth_scene_m[y0 : y0 + rows, x0 : x0 + columns]
    return [metrics.distance_from_depth(K, part, x0, y0, metrics.BOP_RAY_PX) for part in (first, second, scene)]


def _on_common_canvas(
    first: Patch, second: Patch
) -> tuple[Float[np.ndarray, "h w"], Float[np.ndarray, "h w"], int, int]:
    filled = [patch for patch in (first, second) if patch.depth_m.size]
    if not filled:
        return np.zeros((0, 0), np.float32), np.zeros((0, 0), np.float32), 0, 0
    x0, y0 = min(patch.x0_px for patch in filled), min(patch.y0_px for patch in filled)
    columns = max(patch.x0_px + patch.depth_m.shape[1] for patch in filled) - x0
    rows = max(patch.y0_px + patch.depth_m.shape[0] for patch in filled) - y0
    canvases = []
    for patch in (first, second):
        canvas = np.zeros((rows, columns), np.float32)
        height, width = patch.depth_m.shape
        top, left = patch.y0_px - y0, patch.x0_px - x0
        if patch.depth_m.size:
            canvas[top : top + height, left : left + width] = patch.depth_m
        canvases.append(canvas)
    return canvases[0], canvases[1], x0, y0
