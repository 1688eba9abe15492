"""Rigid transforms as 4 x 4 matrices.

`T_a_b` maps points of frame b into frame a: `p_a = T_a_b @ p_b`. Lengths are metres, angles radians.
A pose update (dR, dt) is in camera axes about the pose's origin: R' = dR R, t' = t + dt. Updates, rays and distances
are meant about an object's centre: `with_origin_at` gives the pose of the frame whose origin is there.
"""

import numpy as np
from jaxtyping import Bool, Float
from scipy.spatial.transform import Rotation


def make_T(R: Float[np.ndarray, "*b 3 3"], t: Float[np.ndarray, "*b 3"]) -> Float[np.ndarray, "*b 4 4"]:
    """Assemble a transform from rotation and translation (metres)."""
    R, t = np.asarray(R, np.float64), np.asarray(t, np.float64)
    T = np.zeros((*np.broadcast_shapes(R.shape[:-2], t.shape[:-1]), 4, 4))
    T[..., :3, :3] = R
    T[..., :3, 3] = t
    T[..., 3, 3] = 1.0
    return T


def inverse(T: Float[np.ndarray, "*b 4 4"]) -> Float[np.ndarray, "*b 4 4"]:
    """Invert a rigid transform: `inverse(T_a_b)` is `T_b_a`."""
    R_inv = np.swapaxes(T[..., :3, :3], -1, -2)
    return make_T(R_inv, -(R_inv @ T[..., :3, 3:])[..., 0])


def apply(T: Float[np.ndarray, "*b 4 4"], points: Float[np.ndarray, "*c n 3"]) -> Float[np.ndarray, "*d n 3"]:
    """Transform points (metres); batch axes of both broadcast."""
    return np.asarray(points @ np.swapaxes(T[..., :3, :3], -1, -2) + T[..., None, :3, 3])


def rotated(R: Float[np.ndarray, "*b 3 3"], vectors: Float[np.ndarray, "*c 3"]) -> Float[np.ndarray, "*d 3"]:
    """`R v` of each rotation and vector; batch axes of both broadcast.

    BLAS, behind `R @ v`, rounds by the matrix's address in memory, and so by its place in the batch; this does not.
    """
    return np.asarray((R * vectors[..., None, :]).sum(axis=-1))


def with_origin_at(
    T_cam_obj: Float[np.ndarray, "*b 4 4"], point_m: Float[np.ndarray, "*c 3"]
) -> Float[np.ndarray, "*b 4 4"]:
    """Poses of the frame with the object's axes and its origin at a point.

    The way back is `with_origin_at(T, -point_m)`. A pose's result does not depend on the others in the batch.

    Args:
        T_cam_obj: Poses, metres.
        point_m: In the object's frame, metres: one point, or a point of each pose.
    """
    R = T_cam_obj[..., :3, :3]
    return make_T(R, rotated(R, np.asarray(point_m, np.float64)) + T_cam_obj[..., :3, 3])


def rotation_angle_rad(R: Float[np.ndarray, "*b 3 3"]) -> Float[np.ndarray, "*b"]:
    """Angle of a rotation in [0, pi], exact also near 0 and pi (unlike the arc cosine of the trace)."""
    skew = np.stack([R[..., 2, 1] - R[..., 1, 2], R[..., 0, 2] - R[..., 2, 0], R[..., 1, 0] - R[..., 0, 1]], -1)
    sine = np.linalg.norm(skew, axis=-1) / 2.0
    cosine = (np.trace(R, axis1=-2, axis2=-1) - 1.0) / 2.0
    return np.asarray(np.arctan2(sine, cosine))


def rotation_from_rotvec(rotvec: Float[np.ndarray, "*b 3"]) -> Float[np.ndarray, "*b 3 3"]:
    """Rotation about `rotvec`'s direction by its length (radians)."""
    flat = Rotation.from_rotvec(np.asarray(rotvec, np.float64).reshape(-1, 3)).as_matrix()
    return np.asarray(flat.reshape(*rotvec.shape[:-1], 3, 3))


def rotvec_from_rotation(R: Float[np.ndarray, "*b 3 3"]) -> Float[np.ndarray, "*b 3"]:
    """Axis times angle (radians) of a rotation."""
    flat = Rotation.from_matrix(np.asarray(R, np.float64).reshape(-1, 3, 3)).as_rotvec()
    return np.asarray(flat.reshape(*R.shape[:-2], 3))


def rotation_from_quat_wxyz(quat_wxyz: Float[np.ndarray, "*b 4"]) -> Float[np.ndarray, "*b 3 3"]:
    """Rotation of a quaternion (w, x, y, z) of any non-zero length."""
    flat = np.asarray(quat_wxyz, np.float64).reshape(-1, 4)
    R = Rotation.from_quat(flat[:, [1, 2, 3, 0]]).as_matrix()
    return np.asarray(R.reshape(*quat_wxyz.shape[:-1], 3, 3))


def quat_wxyz_from_rotation(R: Float[np.ndarray, "*b 3 3"]) -> Float[np.ndarray, "*b 4"]:
    """Unit quaternion (w, x, y, z) with w >= 0."""
    xyzw = Rotation.from_matrix(np.asarray(R, np.float64).reshape(-1, 3, 3)).as_quat(canonical=True)
    return np.asarray(xyzw[:, [3, 0, 1, 2]].reshape(*R.shape[:-2], 4))


def random_rotation(rng: np.random.Generator) -> Float[np.ndarray, "3 3"]:
    """Rotation drawn uniformly from SO(3) (normalised Gaussian quaternion)."""
    return rotation_from_quat_wxyz(rng.normal(size=4))


def random_direction(rng: np.random.Generator) -> Float[np.ndarray, "3"]:
    """Unit vector drawn uniformly from the sphere."""
    v = rng.normal(size=3)
    return np.asarray(v / np.linalg.norm(v))


def is_rotation(R: Float[np.ndarray, "*b 3 3"], tol: float = 1e-3) -> Bool[np.ndarray, "*b"]:
    """Whether R is orthonormal with determinant +1, every entry of R R^T within `tol` of the identity."""
    with np.errstate(invalid="ignore", over="ignore"):  # NaN is none
        residual = np.abs(R @ np.swapaxes(R, -1, -2) - np.eye(3)).max(axis=(-2, -1))
        return np.asarray((residual <= tol) & (np.linalg.det(R) > 0))


def nearest_rotation(R: Float[np.ndarray, "*b 3 3"]) -> Float[np.ndarray, "*b 3 3"]:
    """Closest rotation in the Frobenius norm (orthogonal Procrustes, by SVD)."""
    U, _, Vt = np.linalg.svd(R)
    U = U.copy()
    U[..., :, 2] *= np.sign(np.linalg.det(U @ Vt))[..., None]
    return np.asarray(U @ Vt)


def apply_update(
    T_cam_obj: Float[np.ndarray, "*b 4 4"], dR: Float[np.ndarray, "*b 3 3"], dt_m: Float[np.ndarray, "*b 3"]
) -> Float[np.ndarray, "*b 4 4"]:
    """Update a pose in camera axes about its origin: R' = dR R, t' = t + dt."""
    return make_T(dR @ T_cam_obj[..., :3, :3], T_cam_obj[..., :3, 3] + dt_m)


def update_between(
    T_from: Float[np.ndarray, "*b 4 4"], T_to: Float[np.ndarray, "*b 4 4"]
) -> tuple[Float[np.ndarray, "*b 3 3"], Float[np.ndarray, "*b 3"]]:
    """The update (dR, dt in metres) with `apply_update(T_from, dR, dt) == T_to`."""
    dR = T_to[..., :3, :3] @ np.swapaxes(T_from[..., :3, :3], -1, -2)
    return dR, T_to[..., :3, 3] - T_from[..., :3, 3]


def perturb(
    T_cam_obj: Float[np.ndarray, "4 4"], angle_rad: float, distance_m: float, rng: np.random.Generator
) -> Float[np.ndarray, "4 4"]:
    """Rotate a pose by `angle_rad` about a random axis and move its origin by `distance_m` in a random direction."""
    dR = rotation_from_rotvec(random_direction(rng) * angle_rad)
    return apply_update(T_cam_obj, dR, random_direction(rng) * distance_m)


def stretched_along_ray(
    T_cam_obj: Float[np.ndarray, "4 4"], moved: Float[np.ndarray, "4 4"], factor: float
) -> Float[np.ndarray, "4 4"]:
    """`moved` with its translation along the ray from the camera to `T_cam_obj`'s origin multiplied by a factor."""
    ray = T_cam_obj[:3, 3] / np.linalg.norm(T_cam_obj[:3, 3])
    along_m = (moved[:3, 3] - T_cam_obj[:3, 3]) @ ray
    return make_T(moved[:3, :3], moved[:3, 3] + (factor - 1) * along_m * ray)


def even_directions(count: int) -> Float[np.ndarray, "n 3"]:
    """Unit vectors evenly over the sphere, those of a Fibonacci lattice."""
    i = np.arange(count) + 0.5
    polar, azimuth = np.arccos(1 - 2 * i / count), np.pi * (1 + 5**0.5) * i
    return np.stack([np.cos(azimuth) * np.sin(polar), np.sin(azimuth) * np.sin(polar), np.cos(polar)], -1)


def rotations_along(z: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "n 3 3"]:
    """`R_cam_obj` of cameras with optical axes along unit vectors of the object frame and any roll."""
    helper = np.where(np.abs(z[:, :1]) < 0.9, np.array([[1.0, 0, 0]]), np.array([[0, 1.0, 0]]))
    x = np.cross(helper, z)
    x /= np.linalg.norm(x, axis=-1, keepdims=True)
    return np.stack([x, np.cross(z, x), z], axis=-2)
