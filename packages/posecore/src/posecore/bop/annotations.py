"""Annotations of a BOP image: camera, ground truth and targets, in metres, checked while reading."""

from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import Float

from posecore import se3
from posecore.bop.jsonfile import fraction, integer, numbers
from posecore.bop.models_info import MM, ROTATION_TOLERANCE
from posecore.errors import DatasetError
from posecore.schema import shown

NO_POSE_MM = -1.0
LARGEST_T_MM = 1e9
LARGEST_DEPTH_SCALE = 1e6


@dataclass(frozen=True, kw_only=True, eq=False)
class GroundTruth:
    """An annotated object in an image.

    Attributes:
        obj_id: object.
        T_cam_obj: (4, 4) pose, metres, as in the file (real annotations are orthonormal to about 0.01 only); all NaN
            where BOP marks the pose as unknown.
        visib_fract: visible fraction of the silhouette in [0, 1], or None where `scene_gt_info.json` is missing.
        gt_index: position in the image's list, the number in mask file names.
        has_pose: False where BOP marks the pose as unknown (t = -1, -1, -1).
    """

    obj_id: int
    T_cam_obj: Float[np.ndarray, "4 4"]
    visib_fract: float | None = None
    gt_index: int = 0
    has_pose: bool = True


@dataclass(frozen=True, kw_only=True, order=True)
class BopTarget:
    """An object of which `inst_count` instances are expected in an image (BOP's targets)."""

    scene_id: int
    im_id: int
    obj_id: int
    inst_count: int = 1


def camera_matrix(entry: Any, where: str) -> Float[np.ndarray, "3 3"]:
    """The camera matrix of an entry of `scene_camera.json`: `cam_K`, or a `cam_model` that is a pinhole.

    Raises:
        DatasetError: there is neither, the model has a distortion, or the matrix is not one.
    """
    if isinstance(entry, dict) and "cam_K" not in entry and "cam_model" in entry:
        model = entry["cam_model"]
        kind = model.get("projection_model_type") if isinstance(model, dict) else None
        if not isinstance(kind, str) or "pinhole" not in kind.lower():
            raise DatasetError(f"{where}: 'cam_model' is {shown(kind)}, expected a pinhole; undistort the images first")
        fx, fy, cx, cy = numbers(model, "projection_params", 4, f"{where}, 'cam_model'")
        return np.array([[fx, 0.0, cx], [0.0, fy, cy], [0.0, 0.0, 1.0]])
    K = numbers(entry, "cam_K", 9, where).reshape(3, 3)
    if K[1, 0] or K[2, 0] or K[2, 1]:
        hint = ", it is saved by columns" if K[2, 0] and K[2, 1] and not K[0, 2] and not K[1, 2] else ""
        raise DatasetError(f"{where}: 'cam_K' is {K.reshape(-1).tolist()}, expected fx 0 cx 0 fy cy 0 0 1{hint}")
    return K


def ground_truth(entry: Any, index: int, visib_fract: float | None, where: str) -> GroundTruth:
    """An annotated object from its entry in `scene_gt.json`.

    Raises:
        DatasetError: a number is missing, or the pose is not one; the message starts with `where`.
    """
    obj_id = integer(entry, "obj_id", where)
    t_mm = numbers(entry, "cam_t_m2c", 3, where)
    if np.all(t_mm == NO_POSE_MM):
        nowhere = np.full((4, 4), np.nan)
        return GroundTruth(obj_id=obj_id, T_cam_obj=nowhere, visib_fract=visib_fract, gt_index=index, has_pose=False)
    if np.abs(t_mm).max() > LARGEST_T_MM:
        raise DatasetError(f"{where}: 'cam_t_m2c' holds {np.abs(t_mm).max():.4g} mm, expected a distance in a scene")
    R = numbers(entry, "cam_R_m2c", 9, where).reshape(3, 3)
    if np.abs(R).max() > 2 or not bool(se3.is_rotation(R, ROTATION_TOLERANCE)):
        raise DatasetError(f"{where}: 'cam_R_m2c' is not a rotation (9 numbers by rows, determinant +1)")
    return GroundTruth(obj_id=obj_id, T_cam_obj=se3.make_T(R, t_mm * MM), visib_fract=visib_fract, gt_index=index)


def visib_fract(entry: Any, where: str) -> float | None:
    """Visible fraction of an object from its entry in `scene_gt_info.json`; None where it is not given.

    Raises:
        DatasetError: the entry is not one, or the fraction is not from 0 to 1; the message starts with `where`.
    """
    if not isinstance(entry, dict):
        raise DatasetError(f"{where}: found a {type(entry).__name__}, expected an object with numbers")
    return fraction(entry, "visib_fract", where) if "visib_fract" in entry else None


def depth_scale(entry: Any, where: str) -> float:
    """Millimetres for one step of a depth image from an entry of `scene_camera.json`; 1 where it is not given.

    Raises:
        DatasetError: it is not above 0; the message starts with `where`.
    """
    if not isinstance(entry, dict) or "depth_scale" not in entry:
        return 1.0
    scale = float(numbers(entry, "depth_scale", 1, where)[0])
    if not 0 < scale <= LARGEST_DEPTH_SCALE:
        raise DatasetError(f"{where}: 'depth_scale' is {scale:g}, expected millimetres for a step, above 0")
    return scale
