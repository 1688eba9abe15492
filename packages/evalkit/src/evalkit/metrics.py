"""Pose errors, one function each. Metres, pixels and radians; definitions and names are those of bop_toolkit.

`T_est` and `T_gt` are (4, 4) poses `T_cam_obj`; `points_m` are the model's vertices in the object frame; `symmetries`
are the object's transforms of `posecore.symmetry.symmetry_transforms`, the identity among them.

Sources: Hodan et al., "On Evaluation of 6D Object Pose Estimation", ECCVW 2016, and "BOP Challenge 2020", ECCVW 2020.
"""

import numpy as np
from jaxtyping import Bool, Float
from posecore import camera, se3
from scipy.spatial import cKDTree

Array = np.ndarray
Pose = Float[Array, "4 4"]
BOP_RAY_PX = 0.0
"""Where in a pixel bop_toolkit's rays go through when it turns depth into distance."""
CHUNK_VALUES = 3_000_000
"""Largest number of floats held at once when a model is moved by every symmetry."""


def add(T_est: Pose, T_gt: Pose, points_m: Float[Array, "n 3"]) -> float:
    """Average distance between corresponding model points (ADD), metres."""
    return float(np.linalg.norm(se3.apply(T_est, points_m) - se3.apply(T_gt, points_m), axis=1).mean())


def adi(T_est: Pose, T_gt: Pose, points_m: Float[Array, "n 3"]) -> float:
    """Average distance from each true model point to the nearest estimated one (ADI, also ADD-S), metres."""
    # The tree is built in the camera frame, not once in the object frame: annotations are not exactly orthonormal.
    tree = cKDTree(se3.apply(T_est, points_m), leafsize=64, balanced_tree=False, compact_nodes=False)
    distances, _ = tree.query(se3.apply(T_gt, points_m))
    return float(np.mean(distances))


def mssd(T_est: Pose, T_gt: Pose, points_m: Float[Array, "n 3"], symmetries: Float[Array, "s 4 4"]) -> float:
    """Maximum distance between corresponding points, at the best symmetry (MSSD), metres.

    The largest distance under an affine map is at a vertex of the convex hull: the hull's vertices give the same value.
    """
    estimated = se3.apply(T_est, points_m)
    worst = [
        np.linalg.norm(se3.apply(T_gt @ part, points_m) - estimated, axis=2).max(axis=1)
        for part in _chunks(symmetries, len(points_m))
    ]
    return float(np.concatenate(worst).min())


def mspd(
    T_est: Pose,
    T_gt: Pose,
    K: Float[Array, "3 3"],
    points_m: Float[Array, "n 3"],
    symmetries: Float[Array, "s 4 4"],
) -> float:
    """Maximum distance between projected points, at the best symmetry (MSPD), pixels."""
    return float(_projected_distances(T_est, T_gt, K, points_m, symmetries)[0].min())


def proj(T_est: Pose, T_gt: Pose, K: Float[Array, "3 3"], points_m: Float[Array, "n 3"]) -> float:
    """Average distance between projected points, without symmetries, pixels."""
    return float(_projected_distances(T_est, T_gt, K, points_m, np.eye(4)[None])[1][0])


def projection_errors(
    T_est: Pose,
    T_gt: Pose,
    K: Float[Array, "3 3"],
    points_m: Float[Array, "n 3"],
    symmetries: Float[Array, "s 4 4"],
) -> tuple[float, float, float]:
    """MSPD, `proj`, and `proj` at the best symmetry in one pass, pixels. The identity comes first in `symmetries`."""
    largest, average = _projected_distances(T_est, T_gt, K, points_m, symmetries)
    return float(largest.min()), float(average[0]), float(average.min())


def _projected_distances(
    T_est: Pose,
    T_gt: Pose,
    K: Float[Array, "3 3"],
    points_m: Float[Array, "n 3"],
    symmetries: Float[Array, "s 4 4"],
) -> tuple[Float[Array, " s"], Float[Array, " s"]]:
    """Largest and average projected distance for each symmetry; infinite where a point lies in the camera's plane."""
    estimated = camera.project(K, se3.apply(T_est, points_m))
    largest, average = [], []
    for part in _chunks(symmetries, len(points_m)):
        true = camera.project(K, se3.apply(T_gt @ part, points_m))
        distances = np.nan_to_num(np.linalg.norm(true - estimated, axis=2), nan=np.inf)
        largest.append(distances.max(axis=1))
        average.append(distances.mean(axis=1))
    return np.concatenate(largest), np.concatenate(average)


def _chunks(symmetries: Float[Array, "s 4 4"], points: int) -> list[Float[Array, "c 4 4"]]:
    count = max(1, CHUNK_VALUES // (3 * points))
    return [symmetries[start : start + count] for start in range(0, len(symmetries), count)]


def re(T_est: Pose, T_gt: Pose) -> float:
    """Angle of the rotation between two poses, without symmetries, radians in [0, pi]."""
    return float(_angle_rad(T_est[:3, :3], T_gt[:3, :3]))


def _angle_rad(R_est: Float[Array, "3 3"], R_gt: Float[Array, "*b 3 3"]) -> Float[Array, "*b"]:
    """Angle of R_est R_gt^-1, exactly 0 where both are the same: only what differs from the identity is computed."""
    D = (R_est - R_gt) @ _inverse(R_gt)
    skew = np.stack([D[..., 2, 1] - D[..., 1, 2], D[..., 0, 2] - D[..., 2, 0], D[..., 1, 0] - D[..., 0, 1]], -1)
    cosine = 1.0 + np.trace(D, axis1=-2, axis2=-1) / 2.0
    return np.asarray(np.arctan2(np.linalg.norm(skew, axis=-1) / 2.0, cosine))


def _inverse(R: Float[Array, "*b 3 3"]) -> Float[Array, "*b 3 3"]:
    """The true inverse, by cross products of rows: annotations are not exactly orthonormal, so no transpose."""
    columns = [np.cross(R[..., (i + 1) % 3, :], R[..., (i + 2) % 3, :]) for i in range(3)]
    determinant = np.sum(R[..., 0, :] * columns[0], axis=-1)
    return np.asarray(np.stack(columns, axis=-1) / determinant[..., None, None])


def re_symmetric(T_est: Pose, T_gt: Pose, symmetries: Float[Array, "s 4 4"]) -> float:
    """The same angle at the best symmetry, radians."""
    true = T_gt[:3, :3] @ symmetries[:, :3, :3]
    return float(_angle_rad(T_est[:3, :3], true).min())


def te(T_est: Pose, T_gt: Pose) -> float:
    """Distance between the object's origins, metres."""
    return float(np.linalg.norm(te_axes(T_est, T_gt)))


def te_axes(T_est: Pose, T_gt: Pose) -> Float[Array, "3"]:
    """Estimated minus true origin along the camera's x (right), y (down) and z (forward), metres, signed."""
    return np.asarray(T_est[:3, 3] - T_gt[:3, 3])


def viewpoint_deg(T_cam_obj: Pose) -> tuple[float, float]:
    """Direction of the camera seen from the object, degrees: azimuth about z from x, elevation over the xy plane."""
    x, y, z = -_inverse(T_cam_obj[:3, :3]) @ T_cam_obj[:3, 3]
    return float(np.rad2deg(np.arctan2(y, x))), float(np.rad2deg(np.arctan2(z, np.hypot(x, y))))


def vss(mask_est: Bool[Array, "h w"], mask_gt: Bool[Array, "h w"]) -> float:
    """Visual surface similarity: intersection over union of two silhouettes, 0 where both are empty.

    On full renders this is 1 - cus of bop_toolkit; on visibility masks it is 1 - VSD with tau = infinity.
    """
    union = int(np.count_nonzero(mask_est | mask_gt))
    return int(np.count_nonzero(mask_est & mask_gt)) / union if union else 0.0


def visible_masks(
    distance_est_m: Float[Array, "*b h w"],
    distance_gt_m: Float[Array, "*b h w"],
    distance_scene_m: Float[Array, "*b h w"],
    delta_m: float = 0.015,
) -> tuple[Bool[Array, "*b h w"], Bool[Array, "*b h w"]]:
    """Visible parts of an estimated and a true render before a measured scene (BOP19's rules).

    A rendered pixel is visible where nothing was measured, or what was measured is not nearer by more than `delta_m`.
    The estimate is also visible where the truth is and both are rendered.

    Args:
        distance_est_m: distance from the camera's centre (not z), 0 where not hit.
        distance_gt_m: the same for the true pose.
        distance_scene_m: the same as measured, 0 where unknown.
        delta_m: tolerance, metres.
    """
    unknown = distance_scene_m == 0
    visible_gt = (distance_gt_m > 0) & (unknown | (distance_gt_m - distance_scene_m <= delta_m))
    visible_est = (distance_est_m > 0) & (unknown | (distance_est_m - distance_scene_m <= delta_m) | visible_gt)
    return visible_est, visible_gt


def vsd(
    distance_est_m: Float[Array, "*b h w"],
    distance_gt_m: Float[Array, "*b h w"],
    distance_scene_m: Float[Array, "*b h w"],
    taus_m: Float[Array, " t"],
    delta_m: float = 0.015,
) -> Float[Array, "*b t"]:
    """Visible surface discrepancy (VSD), 0 to 1, for every tolerance; 1 where neither pose is visible.

    Of the pixels where either render is visible, the share where only one is, or where both are and their distances
    differ by a tolerance or more ("step" cost). Hodan et al., "BOP: Benchmark for 6D Object Pose Estimation", ECCV
    2018, with the visibility of BOP19 (`visible_masks`).

    Args:
        distance_est_m: distance from the camera's centre (not z), 0 where not hit.
        distance_gt_m: the same for the true pose.
        distance_scene_m: the same as measured, 0 where unknown.
        taus_m: tolerances, metres; BOP19 takes 0.05, 0.10, ... 0.50 diameters.
        delta_m: tolerance of visibility, metres.
    """
    visible_est, visible_gt = visible_masks(distance_est_m, distance_gt_m, distance_scene_m, delta_m)
    both = visible_est & visible_gt
    apart = np.abs(distance_gt_m - distance_est_m)
    union = np.count_nonzero(visible_est | visible_gt, axis=(-2, -1))
    agree = np.stack([np.count_nonzero(both & (apart < tau), axis=(-2, -1)) for tau in taus_m], axis=-1)
    return np.where(union[..., None] > 0, 1.0 - agree / np.maximum(union, 1)[..., None], 1.0)


def distance_from_depth(
    K: Float[Array, "3 3"], depth_m: Float[Array, "h w"], x0_px: int = 0, y0_px: int = 0, ray_px: float = 0.5
) -> Float[Array, "h w"]:
    """Distance from the camera's centre for a depth image that starts at pixel (x0, y0), metres.

    Rays go through pixel centres (+0.5), where renderers sample. bop_toolkit sends them through the pixels' corners,
    half a pixel off: `ray_px=0` (`BOP_RAY_PX`), which VSD takes so that its numbers are BOP's.
    """
    rows, columns = depth_m.shape
    x = (np.arange(columns) + x0_px + ray_px - K[0, 2]) / K[0, 0]
    y = (np.arange(rows) + y0_px + ray_px - K[1, 2]) / K[1, 1]
    return np.asarray(depth_m * np.sqrt(1.0 + x[None, :] ** 2 + y[:, None] ** 2))
