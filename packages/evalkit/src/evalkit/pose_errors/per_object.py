"""Errors of many poses of an object at once, as columns."""

from dataclasses import dataclass, field

import numpy as np
from jaxtyping import Float
from posecore import se3
from posecore.bop import ModelInfo, symmetry_transforms
from posecore.mesh import Mesh
from posecore.symmetry import align_ball, is_ball
from scipy.spatial import ConvexHull, QhullError

from evalkit.pose_errors import metrics
from evalkit.pose_errors.nearest_points import NearestPoints

ERRORS = (
    *("add_m", "adi_m", "mssd_m", "mspd_px", "proj_px", "proj_sym_px"),
    *("re_rad", "re_sym_rad", "te_m", "dx_m", "dy_m", "dz_m"),
)
"""Columns that are NaN where an estimate is missing."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Model:
    """A mesh for pose errors, with its convex hull, symmetries and neighbour search, in the object's own frame.

    Attributes:
        mesh: its vertices are the model points.
        info: diameter and symmetries.
        center_m: the object's centre: that of the full model where `mesh` is a simplified one.
    """

    mesh: Mesh
    info: ModelInfo
    center_m: Float[np.ndarray, "3"]
    nearest: NearestPoints = field(init=False)
    hull_m: Float[np.ndarray, "h 3"] = field(init=False)
    symmetries: Float[np.ndarray, "s 4 4"] = field(init=False)

    def __post_init__(self) -> None:
        points_m = np.asarray(self.mesh.vertices_m, np.float64)
        object.__setattr__(self, "nearest", NearestPoints(points_m))
        object.__setattr__(self, "hull_m", hull(points_m))
        object.__setattr__(self, "symmetries", symmetry_transforms(self.info))

    def of_center(self, T_cam_obj: Float[np.ndarray, "*b 4 4"]) -> Float[np.ndarray, "*b 4 4"]:
        """Poses of the object's centre: the same axes, the origin at the centre."""
        return se3.with_origin_at(T_cam_obj, self.center_m)

    def symmetries_of(
        self, T_est: Float[np.ndarray, "b 4 4"], T_gt: Float[np.ndarray, "b 4 4"]
    ) -> Float[np.ndarray, "s 4 4"] | Float[np.ndarray, "b 2 4 4"]:
        """The object's symmetries; a ball's are the identity and each pair's exactly aligning rotation."""
        continuous = self.info.symmetries_continuous
        if not is_ball(continuous):
            return self.symmetries
        aligned = [align_ball(continuous, gt, estimate) for estimate, gt in zip(T_est, T_gt, strict=True)]
        return np.asarray(np.stack([np.broadcast_to(np.eye(4), T_est.shape), np.array(aligned)], axis=1))


def pose_errors(
    model: Model, T_est: Float[np.ndarray, "b 4 4"], T_gt: Float[np.ndarray, "b 4 4"], K: Float[np.ndarray, "b 3 3"]
) -> dict[str, Float[np.ndarray, " b"]]:
    """Every error in `ERRORS` for each pair of poses.

    Args:
        model: of the object.
        T_est: estimates `T_cam_obj`, metres.
        T_gt: ground-truth poses.
        K: intrinsics of their images, pixels.
    """
    points_m, symmetries = np.asarray(model.mesh.vertices_m, np.float64), model.symmetries_of(T_est, T_gt)
    mspd_px, proj_px, proj_sym_px = metrics.projection_errors(T_est, T_gt, K, points_m, symmetries)
    centers = (model.of_center(T_est), model.of_center(T_gt))
    dx_m, dy_m, dz_m = metrics.te_axes(*centers).T
    values = (
        metrics.add(T_est, T_gt, points_m),
        metrics.adi(T_est, T_gt, model.nearest),
        metrics.mssd(T_est, T_gt, model.hull_m, symmetries),
        *(mspd_px, proj_px, proj_sym_px),
        metrics.re(T_est, T_gt),
        metrics.re_symmetric(T_est, T_gt, symmetries),
        metrics.te(*centers),
        *(dx_m, dy_m, dz_m),
    )
    return dict(zip(ERRORS, values, strict=True))


def hull(points_m: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "h 3"]:
    """Vertices of the convex hull; all points where they are few or lie in a plane."""
    try:
        return np.asarray(points_m[ConvexHull(points_m).vertices])
    except (QhullError, ValueError):
        return points_m
