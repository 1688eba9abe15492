"""Checks of decoded samples: values that training, pictures and exports cannot use, with the sample's row."""

from collections.abc import Callable, Collection, Mapping

import numpy as np
from jaxtyping import Bool

from posecore import se3
from posecore.camera import LARGEST_PX, SMALLEST_FOCAL_PX

ROTATION_TOLERANCE = 2e-2
"""Largest entry of R R^T - I that passes: annotations of real images are no better than 0.01."""
LARGEST_M = 1e6
_POSES, _CAMERAS = ("T_cam_obj", "T_cam_obj_hypothesis"), ("K", "K_crop")


def first_fault(values: Mapping[str, np.ndarray], obj_ids: Collection[int] | None) -> tuple[int, str] | None:
    """Row of the first sample that cannot be used, and the reason; None if all can.

    Args:
        values: Fields of a shard by name, in physical units, the sample axis in front; those that are absent pass.
        obj_ids: Objects of the data card; None accepts any.
    """
    faults = [fault for name, array in values.items() if (fault := _fault(name, array, obj_ids)) is not None]
    return min(faults, default=None)


def _fault(name: str, array: np.ndarray, obj_ids: Collection[int] | None) -> tuple[int, str] | None:
    def first(wrong: Bool[np.ndarray, " n"], reason: Callable[[int], str]) -> tuple[int, str] | None:
        rows = np.flatnonzero(wrong)
        return None if not len(rows) else (int(rows[0]), f"{name} {reason(int(rows[0]))}")

    if array.dtype.kind == "f":
        finite = np.isfinite(array).reshape(len(array), -1).all(axis=1)
        if not finite.all():
            return first(~finite, lambda row: "holds NaN or infinity")
    if name in _POSES:
        return first(~_are_poses(array), lambda row: _why_no_pose(array[row]))
    if name in _CAMERAS:
        return first(~_are_cameras(array), lambda row: f"is {array[row].tolist()}, expected a camera matrix")
    if name == "window_px":
        return first(array[:, 2] <= 0, lambda row: f"has the side {array[row, 2]:g}, expected a number above 0")
    if name == "visible_fraction":
        return first(np.abs(array - 0.5) > 0.5 + 1e-6, lambda row: f"is {array[row]:g}, expected 0 to 1")
    if name == "scene_index":
        return first(array < 0, lambda row: f"is {array[row]}, expected 0 or more")
    if name == "obj_id" and obj_ids is not None:
        listed = ", ".join(map(str, sorted(obj_ids)[:9]))
        unknown = ~np.isin(array, sorted(obj_ids))
        return first(unknown, lambda row: f"is {array[row]}, expected an object of the data card ({listed})")
    return None


def _are_poses(T: np.ndarray) -> Bool[np.ndarray, " n"]:
    small = np.abs(T).reshape(len(T), -1).max(axis=1) <= LARGEST_M
    is_rotation = se3.is_rotation(np.where(small[:, None, None], T[:, :3, :3], 0.0), ROTATION_TOLERANCE)
    return np.asarray(small & is_rotation & (T[:, 3] == [0, 0, 0, 1]).all(axis=1))


def _why_no_pose(T: np.ndarray) -> str:
    R = T[:3, :3]
    if np.abs(R).max() < 2 and np.linalg.det(R) < 0:
        return "is mirrored (determinant below 0), expected a rotation and a translation"
    return f"is {T.tolist()}, expected a rotation and a translation"


def _are_cameras(K: np.ndarray) -> Bool[np.ndarray, " n"]:
    focal = np.minimum(K[:, 0, 0], K[:, 1, 1])
    zeros = np.abs(K[:, [0, 1, 2, 2], [1, 0, 0, 1]]).max(axis=1) < 1e-9
    in_range = (focal >= SMALLEST_FOCAL_PX) & (np.abs(K).reshape(len(K), -1).max(axis=1) <= LARGEST_PX)
    return np.asarray(zeros & in_range & (np.abs(K[:, 2, 2] - 1) < 1e-9))
