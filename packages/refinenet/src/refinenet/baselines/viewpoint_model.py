"""Sparse viewpoint model: edge points of an object from viewpoints all around it, to score poses without rendering.

Edges of a render hardly change within a few degrees. So edge points are sampled once from each viewpoint, and a pose is
scored at the projections of the nearest viewpoint's points: microseconds instead of the milliseconds of a render.

Source: Stoiber et al., SRT3D, IJCV 2022.
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

VIEWPOINTS = 642
"""8 degrees between neighbours."""
POINTS = 160
VIEW_PX = 96
DISTANCE_DIAMETERS = 5.0
WINDOW_SCALE = 1.15
BATCH = 64


@dataclass(frozen=True, kw_only=True, eq=False)
class ViewpointModel:
    """Edge points of an object: n points from each of v viewpoints.

    Attributes:
        center_m: Centre of the object's box, object frame.
        viewpoints: Unit vectors from the centre to the viewpoints' cameras, object frame.
        points_m: (v, n, 3) object frame.
        normals: (v, n, 3) unit vectors across the edge in the image, object frame.
    """

    center_m: Float[np.ndarray, "3"]
    viewpoints: cKDTree
    points_m: Float[np.ndarray, "v n 3"]
    normals: Float[np.ndarray, "v n 3"]

    def similarity(
        self,
        T_cam_obj: Float[np.ndarray, "b 4 4"],
        K: Float[np.ndarray, "3 3"],
        occluder_depth_m: Float[np.ndarray, "p p"],
        responses: Float[np.ndarray, "o p p"],
    ) -> Float[np.ndarray, " b"]:
        """Mean response at the edge points of poses in front of the camera.

        Points outside the patch score 0. Points outside the image or behind a known occluder do not count, up to half
        of the points.

        Args:
            T_cam_obj: Poses, metres.
            K: Camera of the patch.
            occluder_depth_m: Camera z of the nearest known occluder; inf where none, 0 outside the image.
            responses: Response map of each orientation, evenly over half a turn.
        """
        R, centre_m = T_cam_obj[:, :3, :3], T_cam_obj[:, :3, :3] @ self.center_m + T_cam_obj[:, :3, 3]
        towards = -np.einsum("bji,bj->bi", R, centre_m) / np.linalg.norm(centre_m, axis=1, keepdims=True)
        nearest = self.viewpoints.query(towards)[1]
        T = np.ascontiguousarray(T_cam_obj, np.float64)
        return np.asarray(mean_response(T, K, nearest, self.points_m, self.normals, occluder_depth_m, responses))


def make_viewpoint_model(obj_id: int, mesh: Mesh, rasteriser: Rasteriser) -> ViewpointModel:
    """Viewpoint model of an object that the rasteriser holds."""
    z = se3.even_directions(VIEWPOINTS)
    R = se3.rotations_along(z)
    T = se3.make_T(R, np.array([0.0, 0.0, DISTANCE_DIAMETERS * mesh.diameter_m]) - se3.rotated(R, mesh.center_m))
    f_px = VIEW_PX * DISTANCE_DIAMETERS / WINDOW_SCALE
    K = np.array([[f_px, 0.0, VIEW_PX / 2], [0.0, f_px, VIEW_PX / 2], [0.0, 0.0, 1.0]])
    rng = np.random.default_rng(0)
    points, normals = [], []
    for first in range(0, VIEWPOINTS, BATCH):
        batch = T[first : first + BATCH]
        layers = rasteriser.render(obj_id, K, batch, VIEW_PX, VIEW_PX)
        assert layers.rgb is not None
        unit, strength = render_gradients(layers.rgb, layers.mask)
        for T_cam_obj, depth_m, mask, direction, edge in zip(
            batch, layers.depth_m, layers.mask, unit, strength, strict=True
        ):
            # beside the silhouette, the depth of the surface next to it
            near_m = np.where(mask, depth_m, cv2.dilate(depth_m, np.ones((3, 3), np.uint8)))
            pixels = np.argwhere(_ridge(direction, edge) & (near_m > 0))
            if len(pixels) == 0:  # no edge from this viewpoint, as of a sheet from its side: use the centre
                pixels, near_m = np.full((1, 2), VIEW_PX // 2), np.full_like(near_m, mesh.center_cam_m(T_cam_obj)[2])
            row, column = pixels[rng.choice(len(pixels), POINTS, replace=len(pixels) < POINTS)].T
            z_m = near_m[row, column].astype(np.float64)
            p_cam_m = back_project(K, np.stack([column, row], axis=1) + 0.5, z_m)
            points.append((p_cam_m - T_cam_obj[:3, 3]) @ T_cam_obj[:3, :3])
            normals.append(direction[row, column] @ T_cam_obj[:2, :3])
    return ViewpointModel(
        center_m=mesh.center_m,
        viewpoints=cKDTree(-z),
        points_m=np.stack(points).astype(np.float32),
        normals=np.stack(normals).astype(np.float32),
    )


def _ridge(direction: Float[np.ndarray, "p p 2"], strength: Float[np.ndarray, "p p"]) -> Bool[np.ndarray, "p p"]:
    """Edge pixels that are local maxima across the edge."""
    rows, columns = np.mgrid[: len(strength), : len(strength)].astype(np.float32)
    strength, x, y = (np.ascontiguousarray(v, np.float32) for v in (strength, direction[..., 0], direction[..., 1]))
    ahead = cv2.remap(strength, columns + x, rows + y, cv2.INTER_LINEAR)
    behind = cv2.remap(strength, columns - x, rows - y, cv2.INTER_LINEAR)
    return np.asarray((strength > RENDER_EDGE) & (strength >= ahead - 1e-3) & (strength >= behind - 1e-3))
