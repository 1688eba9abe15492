"""An object's edges as points on its surface, seen from all around: poses are judged without being drawn.

Edges of a render hardly change within a few degrees. So they are taken once from each of many viewpoints, and a pose is
judged by where it puts those of the nearest: microseconds instead of the milliseconds of a render.

Source: the sparse viewpoint model of Stoiber et al., SRT3D, IJCV 2022.
"""

from dataclasses import dataclass

import cv2
import numpy as np
from jaxtyping import Bool, Float
from posecore import se3
from posecore.camera import back_project
from posecore.mesh import Mesh
from posecore.raster import Rasteriser
from scipy.spatial import cKDTree

from refinenet.baselines.kernels import mean_response
from refinenet.image.edge_gradients import RENDER_EDGE, render_gradients

Array = np.ndarray
VIEWPOINTS = 642
"""8 degrees from each to the next."""
POINTS = 160
VIEW_PX = 96
DISTANCE_DIAMETERS = 5.0
WINDOW_SCALE = 1.15
BATCH = 64


@dataclass(frozen=True, kw_only=True, eq=False)
class SparseViews:
    """Edges from v viewpoints, n points each.

    Attributes:
        center_m: The object's box centre, object frame.
        viewpoints: Finds the nearest of the unit vectors from the centre towards the cameras, object frame.
        points_m: (v, n, 3) object frame.
        normals: (v, n, 3) unit, object frame: across the edge in the image.
    """

    center_m: Float[Array, "3"]
    viewpoints: cKDTree
    points_m: Float[Array, "v n 3"]
    normals: Float[Array, "v n 3"]

    def agreement(
        self,
        T_cam_obj: Float[Array, "b 4 4"],
        K: Float[Array, "3 3"],
        seen_until_m: Float[Array, "p p"],
        responses: Float[Array, "o p p"],
    ) -> Float[Array, " b"]:
        """Mean response at the edges of poses, all in front of the camera.

        Points outside of the patch count 0. Those outside of the image, or behind what is known to be there, do not
        count, up to half of all.

        Args:
            T_cam_obj: Poses, metres.
            K: Camera of the patch.
            seen_until_m: Camera z up to which a patch pixel shows what is there: 0 outside of the image, else infinite
                where nothing is known to be.
            responses: For orientations evenly over half a turn, how well the image's edges agree.
        """
        R, centre_m = T_cam_obj[:, :3, :3], T_cam_obj[:, :3, :3] @ self.center_m + T_cam_obj[:, :3, 3]
        towards = -np.einsum("bji,bj->bi", R, centre_m) / np.linalg.norm(centre_m, axis=1, keepdims=True)
        nearest = self.viewpoints.query(towards)[1]
        T = np.ascontiguousarray(T_cam_obj, np.float64)
        return np.asarray(mean_response(T, K, nearest, self.points_m, self.normals, seen_until_m, responses))


def sparse_views(obj_id: int, mesh: Mesh, rasteriser: Rasteriser) -> SparseViews:
    """Edges of an object that a rasteriser draws."""
    z = se3.even_directions(VIEWPOINTS)
    R = se3.rotations_along(z)
    T = se3.make_T(R, np.array([0.0, 0.0, DISTANCE_DIAMETERS * mesh.diameter_m]) - R @ mesh.center_m)
    f_px = VIEW_PX * DISTANCE_DIAMETERS / WINDOW_SCALE
    K = np.array([[f_px, 0.0, VIEW_PX / 2], [0.0, f_px, VIEW_PX / 2], [0.0, 0.0, 1.0]])
    rng = np.random.default_rng(0)
    points, normals = [], []
    for start in range(0, VIEWPOINTS, BATCH):
        batch = T[start : start + BATCH]
        layers = rasteriser.render(obj_id, K, batch, VIEW_PX, VIEW_PX)
        assert layers.rgb is not None
        unit, strength = render_gradients(layers.rgb, layers.mask)
        for T_cam_obj, depth_m, mask, direction, edge in zip(
            batch, layers.depth_m, layers.mask, unit, strength, strict=True
        ):
            near_m = np.where(mask, depth_m, cv2.dilate(depth_m, np.ones((3, 3), np.uint8)))  # beside it, the surface's
            pixels = np.argwhere(_ridge(direction, edge) & (near_m > 0))
            if len(pixels) == 0:  # nothing is seen from there, as of a sheet from its side: the centre stands for it
                pixels, near_m = np.full((1, 2), VIEW_PX // 2), np.full_like(near_m, T_cam_obj[2, 3])
            row, column = pixels[rng.choice(len(pixels), POINTS, replace=len(pixels) < POINTS)].T
            seen = near_m[row, column].astype(np.float64)
            p_cam_m = back_project(K, np.stack([column, row], axis=1) + 0.5, seen)
            points.append((p_cam_m - T_cam_obj[:3, 3]) @ T_cam_obj[:3, :3])
            normals.append(direction[row, column] @ T_cam_obj[:2, :3])
    return SparseViews(
        center_m=mesh.center_m,
        viewpoints=cKDTree(-z),
        points_m=np.stack(points).astype(np.float32),
        normals=np.stack(normals).astype(np.float32),
    )


def _ridge(direction: Float[Array, "p p 2"], strength: Float[Array, "p p"]) -> Bool[Array, "p p"]:
    """Where an edge is strongest across itself."""
    rows, columns = np.mgrid[: len(strength), : len(strength)].astype(np.float32)
    strength, x, y = (np.ascontiguousarray(v, np.float32) for v in (strength, direction[..., 0], direction[..., 1]))
    ahead = cv2.remap(strength, columns + x, rows + y, cv2.INTER_LINEAR)
    behind = cv2.remap(strength, columns - x, rows - y, cv2.INTER_LINEAR)
    return np.asarray((strength > RENDER_EDGE) & (strength >= ahead - 1e-3) & (strength >= behind - 1e-3))
