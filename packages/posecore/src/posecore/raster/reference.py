"""Reference implementation of the rasteriser in numpy: slow and obvious; tests compare the GL one with it."""

import numpy as np
from jaxtyping import Bool, Float

from posecore.mesh import Mesh


def render(
    mesh: Mesh, K: Float[np.ndarray, "3 3"], T_cam_obj: Float[np.ndarray, "4 4"], width_px: int, height_px: int
) -> tuple[Float[np.ndarray, "h w"], Bool[np.ndarray, "h w"]]:
    """Camera z (metres, 0 = nothing) and silhouette, sampled at pixel centres (+0.5).

    Every vertex must lie in front of the camera. An edge that passes exactly through a pixel centre counts as inside.
    """
    p = mesh.vertices_m @ T_cam_obj[:3, :3].T + T_cam_obj[:3, 3]
    assert p[:, 2].min() > 0, "the reference does not clip"
    uv = p[:, :2] / p[:, 2:] * np.array([K[0, 0], K[1, 1]]) + K[:2, 2]
    nearest = np.full((height_px, width_px), np.inf)
    for face in mesh.faces:
        (x0, y0), (x1, y1), (x2, y2) = a, b, c = uv[face]
        area = (x1 - x0) * (y2 - y0) - (x2 - x0) * (y1 - y0)
        if area == 0.0:
            continue
        low = np.floor(np.minimum(np.minimum(a, b), c) - 0.5).astype(int)
        high = np.ceil(np.maximum(np.maximum(a, b), c) + 0.5).astype(int)
        left, top = max(low[0], 0), max(low[1], 0)
        right, bottom = min(high[0], width_px), min(high[1], height_px)
        if left >= right or top >= bottom:
            continue
        u, v = np.meshgrid(np.arange(left, right) + 0.5, np.arange(top, bottom) + 0.5)
        w0 = ((x1 - u) * (y2 - v) - (x2 - u) * (y1 - v)) / area
        w1 = ((x2 - u) * (y0 - v) - (x0 - u) * (y2 - v)) / area
        w2 = 1.0 - w0 - w1
        inside = (w0 >= 0) & (w1 >= 0) & (w2 >= 0)
        # 1/z is linear in the image, z is not
        z = 1.0 / np.where(inside, w0 / p[face[0], 2] + w1 / p[face[1], 2] + w2 / p[face[2], 2], 1.0)
        block = nearest[top:bottom, left:right]
        np.copyto(block, z, where=inside & (z < block))
    mask = np.isfinite(nearest)
    return np.where(mask, nearest, 0.0), mask
