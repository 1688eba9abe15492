"""Object symmetries: the transforms that map an object onto itself, sampled finely enough to take a minimum over."""

from collections.abc import Sequence
from typing import NamedTuple, Protocol, runtime_checkable

import numpy as np
from jaxtyping import Float

Array = np.ndarray

BOP_STEP_RAD = 0.02
"""bop_toolkit's default: no surface point moves by more than 0.01 diameters between neighbouring samples."""

BALL_STEP_RAD = np.pi / 12
"""Sampling step of the full rotation group, which is three-dimensional: at BOP's step it would be 10 million poses."""


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
    """What has symmetries: `posecore.bop.ModelInfo`."""

    @property
    def symmetries_discrete(self) -> tuple[Float[Array, "4 4"], ...]:
        """Transforms in the object frame, metres, without the identity."""
        ...

    @property
    def symmetries_continuous(self) -> tuple[ContinuousSymmetry, ...]:
        """Rotation axes."""
        ...


def rotations_about_axis(
    axis: Float[Array, "3"], angles_rad: Float[Array, " n"], offset_m: Float[Array, "3"]
) -> Float[Array, "n 4 4"]:
    """Rotate about the line through `offset_m` along `axis` (any length but zero), by each angle."""
    unit = np.asarray(axis, dtype=np.float64) / np.linalg.norm(axis)
    cross = np.array([[0.0, -unit[2], unit[1]], [unit[2], 0.0, -unit[0]], [-unit[1], unit[0], 0.0]])
    sin, cos = np.sin(angles_rad)[:, None, None], np.cos(angles_rad)[:, None, None]
    rotations = np.eye(3) + sin * cross + (1.0 - cos) * (cross @ cross)
    transforms = np.tile(np.eye(4), (len(angles_rad), 1, 1))
    transforms[:, :3, :3] = rotations
    transforms[:, :3, 3] = offset_m - rotations @ offset_m
    return transforms


def _turns(step_rad: float) -> Float[Array, " n"]:
    count = max(1, int(np.ceil(2.0 * np.pi / step_rad - 1e-9)))
    return np.arange(count) * (2.0 * np.pi / count)


def is_ball(continuous: Sequence[ContinuousSymmetry]) -> bool:
    """Whether the axes generate every rotation: two of them are not parallel."""
    first = np.array(continuous[0].axis) if continuous else np.zeros(3)
    return any(np.linalg.norm(np.cross(first, other.axis)) > 1e-3 for other in continuous[1:])


def ball_center_m(continuous: Sequence[ContinuousSymmetry]) -> Float[Array, "3"]:
    """The point all axes of a ball pass through (least squares, object frame, metres)."""
    normal, right = np.zeros((3, 3)), np.zeros(3)
    for symmetry in continuous:
        across = np.eye(3) - np.outer(symmetry.axis, symmetry.axis)
        normal += across
        right += across @ np.array(symmetry.offset_m)
    return np.asarray(np.linalg.lstsq(normal, right, rcond=None)[0], dtype=np.float64)


def _continuous_transforms(continuous: Sequence[ContinuousSymmetry], step_rad: float) -> Float[Array, "n 4 4"]:
    if not continuous:
        return np.eye(4)[None]
    first = np.array(continuous[0].axis)
    if not is_ball(continuous):
        return rotations_about_axis(first, _turns(step_rad), np.array(continuous[0].offset_m))
    # Two axes composed once reach a surface in the rotation group, not all of it: Euler angles z-y-z reach all.
    center = ball_center_m(continuous)
    helper = np.eye(3)[int(np.argmin(np.abs(first)))]
    second = np.cross(first, helper)
    step = max(step_rad, BALL_STEP_RAD)
    spins = rotations_about_axis(first, _turns(step), center)
    tilts = rotations_about_axis(second, np.linspace(0.0, np.pi, int(np.ceil(np.pi / step)) + 1), center)
    inner = np.einsum("aij,bjk->abik", tilts[1:-1], spins).reshape(-1, 4, 4)
    body = np.einsum("aij,bjk->abik", spins, inner).reshape(-1, 4, 4)
    return np.concatenate([spins, body, tilts[-1] @ spins])


def symmetry_transforms(info: Symmetric, max_step_rad: float = BOP_STEP_RAD) -> Float[Array, "s 4 4"]:
    """All symmetries of an object: every sampled continuous one after the identity and every discrete one.

    The identity comes first. As in BOP, the discrete symmetries are taken as listed and not completed to a group.
    Unlike bop_toolkit, the identity stays in the set beside continuous symmetries, and two axes that are not parallel
    give all rotations about their common point (at a coarser step, see `BALL_STEP_RAD`; `align_ball` is exact).

    Args:
        info: discrete and continuous symmetries of the object.
        max_step_rad: largest angle between neighbouring samples of one axis.

    Returns:
        Transforms S with `T_cam_obj @ S` looking the same as `T_cam_obj`.
    """
    fixed = np.stack([np.eye(4), *info.symmetries_discrete])
    turning = _continuous_transforms(info.symmetries_continuous, max_step_rad)
    return np.asarray(np.einsum("cij,djk->cdik", turning, fixed).reshape(-1, 4, 4))


def align_ball(
    continuous: Sequence[ContinuousSymmetry],
    T_cam_obj: Float[Array, "4 4"],
    T_cam_obj_other: Float[Array, "4 4"],
) -> Float[Array, "4 4"]:
    """The ball's symmetry S that gives `T_cam_obj @ S` the rotation of `T_cam_obj_other`: exact, no sampling."""
    center = ball_center_m(continuous)
    S = np.eye(4)
    S[:3, :3] = T_cam_obj[:3, :3].T @ T_cam_obj_other[:3, :3]
    S[:3, 3] = center - S[:3, :3] @ center
    return S
