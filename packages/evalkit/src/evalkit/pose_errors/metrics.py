"""Pose errors, one function each. Metres, pixels and radians; definitions and names are those of bop_toolkit.

`T_est` and `T_gt` are poses `T_cam_obj`: one, (4, 4), or a batch, (b, 4, 4); results are of shape () or (b,).
`points_m` are the model's vertices in the object frame; `symmetries` are the object's transforms of
`posecore.symmetry.symmetry_transforms`, (s, 4, 4), the identity first, or (b, s, 4, 4) where each pose has its own.

Sources: Hodan et al., "On Evaluation of 6D Object Pose Estimation", ECCVW 2016, and "BOP Challenge 2020", ECCVW 2020.
"""

import numpy as np
from jaxtyping import Bool, Float
from posecore import se3

from evalkit.pose_errors import kernels
from evalkit.pose_errors.nearest_points import NearestPoints

Poses = Float[np.ndarray, "*b 4 4"]
Errors = Float[np.ndarray, "*b"]
Points = Float[np.ndarray, "n 3"]
Symmetries = Float[np.ndarray, "*g s 4 4"]
VSD_TAUS = np.arange(0.05, 0.51, 0.05)
"""Tolerances of BOP19's VSD, diameters."""
VSD_COLUMNS = tuple(f"vsd_{tau:.2f}" for tau in VSD_TAUS)
"""Columns of the error table with VSD at these tolerances."""
BOP_RAY_PX = 0.0
"""Offset within a pixel of bop_toolkit's rays from depth to distance: its corner."""


def add(T_est: Poses, T_gt: Poses, points_m: Points) -> Errors:
    """Average distance between corresponding model points (ADD), metres."""
    return _per_pose(kernels.mean_distance(_flat(T_est), _flat(T_gt), _packed(points_m)), T_est)


def adi(T_est: Poses, T_gt: Poses, points: Points | NearestPoints) -> Errors:
    """Average distance from each ground-truth model point to the nearest estimated one (ADI, also ADD-S), metres.

    `NearestPoints` instead of the vertices reuses its search structure.
    """
    nearest = points if isinstance(points, NearestPoints) else NearestPoints(points)
    return _per_pose(nearest.mean_distance_m(_flat(T_est), _flat(T_gt)), T_est)


def mssd(T_est: Poses, T_gt: Poses, points_m: Points, symmetries: Symmetries) -> Errors:
    """Maximum distance between corresponding points, at the best symmetry (MSSD), metres.

    The largest distance under an affine map is at a vertex of the convex hull: the hull's vertices give the same value.
    """
    transforms = _packed(symmetries).reshape(-1, *symmetries.shape[-3:])
    return _per_pose(kernels.max_distance(_flat(T_est), _flat(T_gt), _packed(points_m), transforms), T_est)


def mspd(T_est: Poses, T_gt: Poses, K: Float[np.ndarray, "*k 3 3"], points_m: Points, symmetries: Symmetries) -> Errors:
    """Maximum distance between projected points, at the best symmetry (MSPD), pixels."""
    return projection_errors(T_est, T_gt, K, points_m, symmetries)[0]


def proj(T_est: Poses, T_gt: Poses, K: Float[np.ndarray, "*k 3 3"], points_m: Points) -> Errors:
    """Average distance between projected points, without symmetries, pixels."""
    return projection_errors(T_est, T_gt, K, points_m, np.eye(4)[None])[1]


def projection_errors(
    T_est: Poses, T_gt: Poses, K: Float[np.ndarray, "*k 3 3"], points_m: Points, symmetries: Symmetries
) -> tuple[Errors, Errors, Errors]:
    """MSPD, `proj`, and `proj` at the best symmetry in one pass, pixels.

    They are infinite where a point lies in the camera's plane; points behind it are mirrored, as in bop_toolkit.
    """
    transforms = _packed(symmetries).reshape(-1, *symmetries.shape[-3:])
    K_of_each = np.ascontiguousarray(np.broadcast_to(_flat(K), (len(_flat(T_est)), 3, 3)))
    errors = kernels.projected_distances(_flat(T_est), _flat(T_gt), K_of_each, _packed(points_m), transforms)
    largest, average, average_best = (_per_pose(values, T_est) for values in errors.T)
    return largest, average, average_best


def _packed(values: Float[np.ndarray, "*s"]) -> Float[np.ndarray, "*s"]:
    """Contiguous float64, as the compiled loops take it."""
    return np.ascontiguousarray(values, np.float64)


def _flat(matrices: Float[np.ndarray, "*b r c"]) -> Float[np.ndarray, "f r c"]:
    return _packed(matrices).reshape(-1, *matrices.shape[-2:])


def _per_pose(errors: Float[np.ndarray, " f"], T_est: Poses) -> Errors:
    return np.asarray(errors).reshape(T_est.shape[:-2])


def re(T_est: Poses, T_gt: Poses) -> Errors:
    """Angle of the rotation between two poses, without symmetries, radians in [0, pi]."""
    return _angle_rad(T_est[..., :3, :3], T_gt[..., :3, :3])


def _angle_rad(R_est: Float[np.ndarray, "*a 3 3"], R_gt: Float[np.ndarray, "*b 3 3"]) -> Float[np.ndarray, "*c"]:
    """Angle of R_est R_gt^-1, exactly 0 where both are equal: only the difference from the identity is computed."""
    D = (R_est - R_gt) @ _inverse(R_gt)
    skew = np.stack([D[..., 2, 1] - D[..., 1, 2], D[..., 0, 2] - D[..., 2, 0], D[..., 1, 0] - D[..., 0, 1]], -1)
    cosine = 1.0 + np.trace(D, axis1=-2, axis2=-1) / 2.0
    return np.asarray(np.arctan2(np.linalg.norm(skew, axis=-1) / 2.0, cosine))


def _inverse(R: Float[np.ndarray, "*b 3 3"]) -> Float[np.ndarray, "*b 3 3"]:
    """The exact inverse, by cross products of rows: annotations are not exactly orthonormal, so no transpose."""
    columns = [np.cross(R[..., (i + 1) % 3, :], R[..., (i + 2) % 3, :]) for i in range(3)]
    determinant = np.sum(R[..., 0, :] * columns[0], axis=-1)
    return np.asarray(np.stack(columns, axis=-1) / determinant[..., None, None])


def re_symmetric(T_est: Poses, T_gt: Poses, symmetries: Symmetries) -> Errors:
    """The same angle at the best symmetry, radians."""
    R_gt = T_gt[..., None, :3, :3] @ symmetries[..., :3, :3]
    return np.asarray(_angle_rad(T_est[..., None, :3, :3], R_gt).min(axis=-1))


def te(T_est: Poses, T_gt: Poses) -> Errors:
    """Distance between the poses' origins, metres; of the object's centres for poses of the centre.

    A rotation about the centre moves an origin off it: take poses of the centre (`posecore.se3.with_origin_at`).
    """
    return np.asarray(np.linalg.norm(te_axes(T_est, T_gt), axis=-1))


def te_axes(T_est: Poses, T_gt: Poses) -> Float[np.ndarray, "*b 3"]:
    """Estimated minus ground-truth origin along the camera's x (right), y (down) and z (forward), metres, signed.

    Of the object's centre for poses of the centre, see `te`.
    """
    return np.asarray(T_est[..., :3, 3] - T_gt[..., :3, 3])


def viewpoint_deg(T_cam_obj: Poses) -> tuple[Errors, Errors]:
    """Direction of the camera seen from the poses' origins, degrees: azimuth about z from x, elevation over xy."""
    camera = -se3.rotated(_inverse(T_cam_obj[..., :3, :3]), T_cam_obj[..., :3, 3])
    x, y, z = np.ascontiguousarray(np.moveaxis(camera, -1, 0))  # the arc tangent of strided arrays rounds by place
    return np.rad2deg(np.arctan2(y, x)), np.rad2deg(np.arctan2(z, np.hypot(x, y)))


def vss(mask_est: Bool[np.ndarray, "h w"], mask_gt: Bool[np.ndarray, "h w"]) -> float:
    """Visual surface similarity: intersection over union of two silhouettes, 0 where both are empty.

    On full renders this is 1 - cus of bop_toolkit; on visibility masks it is 1 - VSD with tau = infinity.
    """
    union = int(np.count_nonzero(mask_est | mask_gt))
    return int(np.count_nonzero(mask_est & mask_gt)) / union if union else 0.0


def visible_masks(
    distance_est_m: Float[np.ndarray, "*b h w"],
    distance_gt_m: Float[np.ndarray, "*b h w"],
    distance_scene_m: Float[np.ndarray, "*b h w"],
    delta_m: float = 0.015,
) -> tuple[Bool[np.ndarray, "*b h w"], Bool[np.ndarray, "*b h w"]]:
    """Visible parts of an estimated and a ground-truth render in a measured scene (BOP19's rules).

    A rendered pixel is visible where depth is unknown, or the scene is not nearer by more than `delta_m`. The estimate
    is also visible where the ground truth is and both are rendered.

    Args:
        distance_est_m: distance from the camera's centre (not z), 0 where not hit.
        distance_gt_m: the same for the ground-truth pose.
        distance_scene_m: the same as measured, 0 where unknown.
        delta_m: tolerance, metres.
    """
    unknown = distance_scene_m == 0
    visible_gt = (distance_gt_m > 0) & (unknown | (distance_gt_m - distance_scene_m <= delta_m))
    visible_est = (distance_est_m > 0) & (unknown | (distance_est_m - distance_scene_m <= delta_m) | visible_gt)
    return visible_est, visible_gt


def vsd(
    distance_est_m: Float[np.ndarray, "*b h w"],
    distance_gt_m: Float[np.ndarray, "*b h w"],
    distance_scene_m: Float[np.ndarray, "*b h w"],
    taus_m: Float[np.ndarray, " t"],
    delta_m: float = 0.015,
) -> Float[np.ndarray, "*b t"]:
    """Visible surface discrepancy (VSD), 0 to 1, for every tolerance; 1 where neither pose is visible.

    The fraction, among pixels where either render is visible, where only one is visible, or where both are and their
    distances differ by a tolerance or more ("step" cost). Hodan et al., "BOP: Benchmark for 6D Object Pose Estimation",
    ECCV 2018, with the visibility of BOP19 (`visible_masks`).

    Args:
        distance_est_m: distance from the camera's centre (not z), 0 where not hit.
        distance_gt_m: the same for the ground-truth pose.
        distance_scene_m: the same as measured, 0 where unknown.
        taus_m: tolerances, metres; BOP19 takes 0.05, 0.10, ... 0.50 diameters.
        delta_m: tolerance of visibility, metres.
    """
    visible_est, visible_gt = visible_masks(distance_est_m, distance_gt_m, distance_scene_m, delta_m)
    both = visible_est & visible_gt
    differences_m = np.abs(distance_gt_m - distance_est_m)
    union = np.count_nonzero(visible_est | visible_gt, axis=(-2, -1))
    agree = np.stack([np.count_nonzero(both & (differences_m < tau), axis=(-2, -1)) for tau in taus_m], axis=-1)
    return np.where(union[..., None] > 0, 1.0 - agree / np.maximum(union, 1)[..., None], 1.0)


def distance_from_depth(
    K: Float[np.ndarray, "3 3"], depth_m: Float[np.ndarray, "h w"], x0_px: int = 0, y0_px: int = 0, ray_px: float = 0.5
) -> Float[np.ndarray, "h w"]:
    """Distance from the camera's centre for a depth image that starts at pixel (x0, y0), metres.

    Rays go through pixel centres (+0.5), where renderers sample. bop_toolkit sends them through the pixels' corners,
    half a pixel off: `ray_px=0` (`BOP_RAY_PX`), which VSD takes so that its numbers are BOP's.
    """
    rows, columns = depth_m.shape
    x = (np.arange(columns) + x0_px + ray_px - K[0, 2]) / K[0, 0]
    y = (np.arange(rows) + y0_px + ray_px - K[1, 2]) / K[1, 1]
    return np.asarray(depth_m * np.sqrt(1.0 + x[None, :] ** 2 + y[:, None] ** 2))
