"""Object symmetries: transforms that map an object onto itself, sampled or solved for."""

from collections.abc import Sequence
from typing import Literal, NamedTuple, Protocol, runtime_checkable

import numpy as np
from jaxtyping import Float

from posecore import se3

BOP_STEP_RAD = 0.02
"""bop_toolkit's default: no surface point moves by more than 0.01 diameters between neighbouring samples."""

BALL_STEP_RAD = np.pi / 12
"""Sampling step of the full rotation group, which is three-dimensional: at BOP's step it would be 10 million poses."""

TIE = 1e-9
"""Difference in the trace of a rotation, or in metres, under which two symmetric poses are equally near."""


class ContinuousSymmetry(NamedTuple):
    """A rotation axis: every rotation about the line `offset_m + s * axis` maps the object onto itself.

    Attributes:
        axis: unit direction in the object frame.
        offset_m: a point on the axis, in the object frame, metres.
    """

    axis: tuple[float, float, float]
    offset_m: tuple[float, float, float]


@runtime_checkable
class Symmetric(Protocol):
    """An object with symmetries: `posecore.bop.ModelInfo`."""

    @property
    def symmetries_discrete(self) -> tuple[Float[np.ndarray, "4 4"], ...]:
        """Transforms in the object frame, metres, without the identity."""
        ...

    @property
    def symmetries_continuous(self) -> tuple[ContinuousSymmetry, ...]:
        """Rotation axes."""
        ...


def rotations_about_axis(
    axis: Float[np.ndarray, "3"], angles_rad: Float[np.ndarray, " n"], offset_m: Float[np.ndarray, "3"]
) -> Float[np.ndarray, "n 4 4"]:
    """Rotate about the line through `offset_m` along `axis` (any length but zero), by each angle."""
    unit = np.asarray(axis, dtype=np.float64) / np.linalg.norm(axis)
    cross = np.array([[0.0, -unit[2], unit[1]], [unit[2], 0.0, -unit[0]], [-unit[1], unit[0], 0.0]])
    sin, cos = np.sin(angles_rad)[:, None, None], np.cos(angles_rad)[:, None, None]
    rotations = np.eye(3) + sin * cross + (1.0 - cos) * (cross @ cross)
    transforms = np.tile(np.eye(4), (len(angles_rad), 1, 1))
    transforms[:, :3, :3] = rotations
    transforms[:, :3, 3] = offset_m - se3.rotated(rotations, offset_m)
    return transforms


def _angles_rad(step_rad: float) -> Float[np.ndarray, " n"]:
    count = max(1, int(np.ceil(2.0 * np.pi / step_rad - 1e-9)))
    return np.arange(count) * (2.0 * np.pi / count)


def is_ball(continuous: Sequence[ContinuousSymmetry]) -> bool:
    """Whether the axes generate every rotation: they are not all parallel."""
    first = np.array(continuous[0].axis) if continuous else np.zeros(3)
    return any(np.linalg.norm(np.cross(first, other.axis)) > 1e-3 for other in continuous[1:])


def ball_center_m(continuous: Sequence[ContinuousSymmetry]) -> Float[np.ndarray, "3"]:
    """The point all axes of a ball pass through (least squares, object frame, metres)."""
    normal, right = np.zeros((3, 3)), np.zeros(3)
    for symmetry in continuous:
        across = np.eye(3) - np.outer(symmetry.axis, symmetry.axis)
        normal += across
        right += across @ np.array(symmetry.offset_m)
    return np.asarray(np.linalg.lstsq(normal, right, rcond=None)[0], dtype=np.float64)


def _continuous_transforms(continuous: Sequence[ContinuousSymmetry], step_rad: float) -> Float[np.ndarray, "n 4 4"]:
    if not continuous:
        return np.eye(4)[None]
    first = np.array(continuous[0].axis)
    if not is_ball(continuous):
        return rotations_about_axis(first, _angles_rad(step_rad), np.array(continuous[0].offset_m))
    # Two axes composed once reach a surface in the rotation group; Euler angles z-y-z reach the whole group.
    center = ball_center_m(continuous)
    helper = np.eye(3)[int(np.argmin(np.abs(first)))]
    second = np.cross(first, helper)
    step = max(step_rad, BALL_STEP_RAD)
    spins = rotations_about_axis(first, _angles_rad(step), center)
    tilts = rotations_about_axis(second, np.linspace(0.0, np.pi, int(np.ceil(np.pi / step)) + 1), center)
    inner = np.einsum("aij,bjk->abik", tilts[1:-1], spins).reshape(-1, 4, 4)
    body = np.einsum("aij,bjk->abik", spins, inner).reshape(-1, 4, 4)
    return np.concatenate([spins, body, tilts[-1] @ spins])


def symmetry_transforms(info: Symmetric, max_step_rad: float = BOP_STEP_RAD) -> Float[np.ndarray, "s 4 4"]:
    """All symmetries of an object: every sampled continuous one after the identity and every discrete one.

    The identity comes first. As in BOP, the discrete symmetries are taken as listed and not completed to a group.
    Unlike bop_toolkit, the identity stays in the set beside continuous symmetries, and two axes that are not parallel
    give all rotations about their common point (at a coarser step, see `BALL_STEP_RAD`; `align_ball` is exact).

    Args:
        info: discrete and continuous symmetries of the object.
        max_step_rad: largest angle between neighbouring samples about an axis.

    Returns:
        Transforms S with which `T_cam_obj @ S` has the same appearance as `T_cam_obj`.
    """
    fixed = np.stack([np.eye(4), *info.symmetries_discrete])
    continuous = _continuous_transforms(info.symmetries_continuous, max_step_rad)
    return np.asarray(np.einsum("cij,djk->cdik", continuous, fixed).reshape(-1, 4, 4))


def align_ball(
    continuous: Sequence[ContinuousSymmetry],
    T_cam_obj: Float[np.ndarray, "4 4"],
    T_cam_obj_other: Float[np.ndarray, "4 4"],
) -> Float[np.ndarray, "4 4"]:
    """The ball's symmetry S that gives `T_cam_obj @ S` the rotation of `T_cam_obj_other`: exact, no sampling."""
    center = ball_center_m(continuous)
    S = np.eye(4)
    S[:3, :3] = T_cam_obj[:3, :3].T @ T_cam_obj_other[:3, :3]
    S[:3, 3] = center - S[:3, :3] @ center
    return S


def nearest_symmetric(
    T_cam_obj: Float[np.ndarray, "*b 4 4"],
    T_reference: Float[np.ndarray, "*b 4 4"],
    info: Symmetric,
    *,
    by: Literal["rotation", "points"] = "rotation",
    points_m: Float[np.ndarray, "p 3"] | None = None,
) -> Float[np.ndarray, "*b 4 4"]:
    """The pose symmetry-equivalent to `T_cam_obj` that is nearest to `T_reference`.

    Of the discrete symmetries each is tried, as listed, after the identity; of equally near poses the first is taken.
    The angle about a continuous axis is solved for, not sampled; all rotations of a ball likewise.

    Args:
        T_cam_obj: Poses, metres, for example the ground truth.
        T_reference: Poses to come near to, for example the estimates; NaN leaves the angle about an axis at 0.
        info: Symmetries of the object.
        by: `rotation` minimises the angle between both rotations. `points` minimises the mean distance of model points
            over discrete symmetries and the mean squared distance over continuous ones, translations included.
        points_m: Model points, object frame; only for `points`.

    Raises:
        ValueError: `points` without points.
    """
    copies = symmetric_copies(T_cam_obj, T_reference, info, by=by, points_m=points_m)
    if by == "rotation":
        trace = np.einsum("...ij,...sij->...s", T_reference[..., :3, :3], copies[..., :3, :3])
        nearness = np.nan_to_num(trace)
    else:
        there, here = se3.apply(T_reference, _required(points_m)), se3.apply(copies, _required(points_m))
        nearness = -np.nan_to_num(np.linalg.norm(here - there[..., None, :, :], axis=-1).mean(axis=-1))
    best = np.argmax(nearness > nearness.max(axis=-1, keepdims=True) - TIE, axis=-1)
    return np.asarray(np.take_along_axis(copies, best[..., None, None, None], axis=-3)[..., 0, :, :])


def symmetric_copies(
    T_cam_obj: Float[np.ndarray, "*b 4 4"],
    T_reference: Float[np.ndarray, "*b 4 4"],
    info: Symmetric | None,
    *,
    by: Literal["rotation", "points"] = "rotation",
    points_m: Float[np.ndarray, "p 3"] | None = None,
) -> Float[np.ndarray, "*b s 4 4"]:
    """Poses symmetry-equivalent to `T_cam_obj`, one for each discrete symmetry, the identity first; one for a ball.

    With an axis of revolution, each is rotated about it to come nearest to `T_reference`; see `nearest_symmetric`.
    """
    fixed = np.stack([np.eye(4), *(info.symmetries_discrete if info is not None else ())])
    axes = info.symmetries_continuous if info is not None else ()
    if not axes:
        return np.asarray(T_cam_obj[..., None, :, :] @ fixed)
    if is_ball(axes):
        center_m = ball_center_m(axes)
        R = _ball_rotation(T_cam_obj, T_reference, center_m, None if by == "rotation" else _required(points_m))
        return np.asarray(T_cam_obj @ se3.make_T(R, center_m - se3.rotated(R, center_m)))[..., None, :, :]
    axis, offset_m = np.asarray(axes[0].axis, np.float64), np.asarray(axes[0].offset_m, np.float64)
    axis = axis / np.linalg.norm(axis)
    if by == "rotation":
        M = np.linalg.inv(T_cam_obj[..., :3, :3]) @ T_reference[..., :3, :3]
        M = M[..., None, :, :] @ np.swapaxes(fixed[:, :3, :3], -1, -2)
    else:
        # M = sum of target and source vectors' outer products, both about the axis' point, in the object frame
        source = se3.apply(fixed, _required(points_m)) - offset_m
        target = se3.apply(se3.inverse(T_cam_obj) @ T_reference, _required(points_m)) - offset_m
        M = np.einsum("...pi,spj->...sij", target, source)
    return np.asarray(T_cam_obj[..., None, :, :] @ (_rotation_nearest(M, axis, offset_m) @ fixed))


def _required(points_m: Float[np.ndarray, "p 3"] | None) -> Float[np.ndarray, "p 3"]:
    if points_m is None:
        raise ValueError("nearest_symmetric by points needs points_m")
    return points_m


def _rotation_nearest(
    M: Float[np.ndarray, "*b 3 3"], axis: Float[np.ndarray, "3"], offset_m: Float[np.ndarray, "3"]
) -> Float[np.ndarray, "*b 4 4"]:
    """The rotation C about a line with the largest trace of `M C^T`: the nearest to M.

    That trace is a constant plus `cos * (trace M - a M a) + sin * (a . w)`, with w the vector of the skew part of M:
    the angle of its largest value is an arc tangent.
    """
    skew = np.stack([M[..., 2, 1] - M[..., 1, 2], M[..., 0, 2] - M[..., 2, 0], M[..., 1, 0] - M[..., 0, 1]], axis=-1)
    along = np.einsum("i,...ij,j->...", axis, M, axis)
    angle_rad = np.arctan2((skew * axis).sum(axis=-1), np.trace(M, axis1=-2, axis2=-1) - along)
    R = se3.rotation_from_rotvec(np.nan_to_num(angle_rad)[..., None] * axis)
    return se3.make_T(R, offset_m - se3.rotated(R, offset_m))


def _ball_rotation(
    T_cam_obj: Float[np.ndarray, "*b 4 4"],
    T_reference: Float[np.ndarray, "*b 4 4"],
    center_m: Float[np.ndarray, "3"],
    points_m: Float[np.ndarray, "p 3"] | None,
) -> Float[np.ndarray, "*b 3 3"]:
    """The rotation about a ball's centre that brings its pose nearest: exact, by points with orthogonal Procrustes."""
    if points_m is None:
        return np.asarray(np.swapaxes(T_cam_obj[..., :3, :3], -1, -2) @ T_reference[..., :3, :3])
    target = se3.apply(se3.inverse(T_cam_obj) @ T_reference, points_m) - center_m
    return se3.nearest_rotation(np.nan_to_num(np.einsum("...pi,pj->...ij", target, points_m - center_m)))
