"""Failure analysis: exactly one cause for every failed estimate.

A pose has failed where it is missing, or where its ADD(-S) is not under a limit, 0.1 diameter by default. Its error is
decomposed in the camera's frame. The ground truth is the symmetry-equivalent pose with the smallest angle to the
estimate. The viewing ray runs from the camera's centre through the object's, the
middle of its bounding box, at the ground truth.

- z: the difference of the object's centres along the ray, metres.
- xy: the difference across the ray, metres.
- in plane: the angle of the rotation error's twist about the ray.
- out of plane: the angle of the rest of the rotation error (swing), about an axis across the ray.
- An angle a displaces model points by about 2 * 0.27 * sin(a / 2) diameters, so angles and lengths are comparable:
  0.27 diameters is the mean distance of points from an axis through the centre (0.24 to 0.30 for LM-O's objects).

The first of these that holds is the cause:

1. `missed`: there is no estimate.
2. `wrong instance`: MSSD to another instance of the object in the image is under 0.2 diameter, and smaller than to the
   expected one.
3. `flip`: the rotation error is 160 degrees or more, about 180 degrees about some axis, and the centres differ by less
   than the limit.
4. `near-symmetric flip`: the rotation error is 45 degrees or more, yet VSS is 0.8 or more, a similar silhouette;
   and the centres differ by less than the limit.
5. `z only`, `in plane only` (xy and in plane), `rotation only` (in plane and out of plane): without these parts, the
   displacement by the others (root of the sum of squares) is under the limit, so that the pose would pass. Of several
   such causes the one with the least remaining displacement counts, and of equal ones the first in this list.
6. `large`: the pose would fail without any one of these.

Causes are estimated from the poses, not from displaced model points; for ADD-S they overrate rotations.
"""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
import pandas as pd
from jaxtyping import Bool, Float
from posecore import se3
from posecore.symmetry import Symmetric, nearest_symmetric

from evalkit.error_table import column
from evalkit.scores.definitions import RECALL_DIAMETERS
from evalkit.scores.per_pose import solved

OTHER_DIAMETERS = 0.2
FLIP_RAD = np.deg2rad(160.0)
NEAR_FLIP_RAD = np.deg2rad(45.0)
NEAR_FLIP_VSS = 0.8
ARM_DIAMETERS = 0.27

CAUSES: Mapping[str, str] = {
    "missed": "no estimate",
    "wrong instance": "within 0.2 diameter (MSSD) of another instance of the object, closer than to the expected one",
    "flip": "rotation error of 160° or more, about 180° about some axis, with the centre in place",
    "near-symmetric flip": "rotation error of 45° or more but VSS of 0.8 or more, with the centre in place",
    "z only": "would pass without its error along the viewing ray",
    "in plane only": "would pass without its translation across the viewing ray and its rotation about the ray",
    "rotation only": "would pass without its rotation error",
    "large": "several errors; would still fail without any single part",
}
SOLVED = ""
"""In place of a cause where a pose has not failed."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Parts:
    """Parts of a pose error, see the module; NaN where there is no estimate.

    Attributes:
        z_m: along the viewing ray, signed, positive for too far.
        xy_m: across the ray.
        angle_rad: of the whole rotation error.
        in_plane_rad: twist about the ray, -pi to pi.
        out_of_plane_rad: the rest of the rotation, 0 to pi.
    """

    z_m: Float[np.ndarray, " n"]
    xy_m: Float[np.ndarray, " n"]
    angle_rad: Float[np.ndarray, " n"]
    in_plane_rad: Float[np.ndarray, " n"]
    out_of_plane_rad: Float[np.ndarray, " n"]


def parts_of(T_est: Float[np.ndarray, "n 4 4"], T_gt: Float[np.ndarray, "n 4 4"]) -> Parts:
    """Decompose errors about the viewing ray of each ground-truth pose; poses are those of the object's centre."""
    center = T_gt[:, :3, 3]
    length = np.linalg.norm(center, axis=1, keepdims=True)
    ray = np.divide(center, length, out=np.tile([0.0, 0.0, 1.0], (len(center), 1)), where=length > 0)
    shift = T_est[:, :3, 3] - center
    z_m = np.sum(shift * ray, axis=1)
    xy_m = np.linalg.norm(shift - z_m[:, None] * ray, axis=1)
    is_valid = np.isfinite(T_est).all(axis=(1, 2)) & np.isfinite(T_gt).all(axis=(1, 2))
    quat = np.full((len(center), 4), np.nan)
    if is_valid.any():
        R = T_est[is_valid, :3, :3] @ np.swapaxes(T_gt[is_valid, :3, :3], 1, 2)
        quat[is_valid] = se3.quat_wxyz_from_rotation(R)
    w, along = quat[:, 0], np.sum(quat[:, 1:] * ray, axis=1)
    twist = 2.0 * np.arctan2(along, w)
    across = np.linalg.norm(quat[:, 1:] - along[:, None] * ray, axis=1)
    return Parts(
        z_m=z_m,
        xy_m=xy_m,
        angle_rad=2.0 * np.arctan2(np.linalg.norm(quat[:, 1:], axis=1), w),
        in_plane_rad=np.asarray((twist + np.pi) % (2.0 * np.pi) - np.pi),
        out_of_plane_rad=2.0 * np.arctan2(across, np.hypot(w, along)),
    )


def causes(
    table: pd.DataFrame,
    T_est: Float[np.ndarray, "n 4 4"],
    T_gt: Float[np.ndarray, "n 4 4"],
    center_m: Float[np.ndarray, "n 3"],
    infos: Mapping[int, Symmetric] | None = None,
    *,
    limit_diameters: float = RECALL_DIAMETERS,
) -> "pd.Series[str]":
    """The cause of each row's failure.

    Args:
        table: see `evalkit.error_table`.
        T_est: estimates `T_cam_obj` of its rows, metres, NaN where missing.
        T_gt: ground-truth poses.
        center_m: centre of each row's object, object frame, metres.
        infos: symmetries of the objects; objects without an entry have none.
        limit_diameters: an ADD(-S) of so many diameters or more is a failure.

    Returns:
        A categorical column, in the table's order, of keys of `CAUSES`, and `SOLVED` where a pose has not failed.
    """
    failed = ~solved(table, limit_diameters)
    diameter_m = column(table, "diameter_m")
    T_nearest = T_gt.astype(np.float64)
    for obj_id, info in (infos or {}).items():
        rows = np.flatnonzero(failed & (table.obj_id.to_numpy() == obj_id))
        if (info.symmetries_discrete or info.symmetries_continuous) and len(rows):
            T_nearest[rows] = nearest_symmetric(T_nearest[rows], T_est[rows], info)
    parts = parts_of(se3.with_origin_at(T_est, center_m), se3.with_origin_at(T_nearest, center_m))
    is_found = column(table, "found") > 0
    other = column(table, "other_mssd_m")
    chosen = np.full(len(table), SOLVED, dtype=object)
    chosen[failed] = "large"
    alone, cause = _alone(parts, diameter_m, limit_diameters)
    chosen[failed & alone] = cause[failed & alone]
    in_place = np.hypot(parts.z_m, parts.xy_m) < limit_diameters * diameter_m
    alike = (parts.angle_rad >= NEAR_FLIP_RAD) & (column(table, "vss") >= NEAR_FLIP_VSS)
    chosen[failed & in_place & alike] = "near-symmetric flip"
    chosen[failed & in_place & (parts.angle_rad >= FLIP_RAD)] = "flip"
    is_other = (other < OTHER_DIAMETERS * diameter_m) & (other < column(table, "mssd_m"))
    chosen[failed & is_other] = "wrong instance"
    chosen[failed & ~is_found] = "missed"
    return pd.Series(pd.Categorical(chosen, categories=[SOLVED, *CAUSES]), index=table.index, name="cause")


def _alone(
    parts: Parts, diameter_m: Float[np.ndarray, " n"], limit_diameters: float
) -> tuple[Bool[np.ndarray, " n"], np.ndarray]:
    """Whether a pose would pass without one kind of error, and which kind."""
    z, xy = parts.z_m / diameter_m, parts.xy_m / diameter_m
    left = {
        "z only": np.hypot(xy, _displacement(parts.angle_rad)),
        "in plane only": np.hypot(z, _displacement(parts.out_of_plane_rad)),
        "rotation only": np.hypot(z, xy),
    }
    rest = np.nan_to_num(np.stack(list(left.values())), nan=np.inf)
    best = np.argmin(np.round(rest, 9), axis=0)
    return np.min(rest, axis=0) < limit_diameters, np.array(list(left), dtype=object)[best]


def _displacement(angle_rad: Float[np.ndarray, " n"]) -> Float[np.ndarray, " n"]:
    """Displacement of model points by a rotation, diameters."""
    return np.asarray(2.0 * ARM_DIAMETERS * np.sin(angle_rad / 2.0))


def cause_counts(table: pd.DataFrame, cause: "pd.Series[str]") -> pd.DataFrame:
    """Number of failed poses by cause, by object and in total.

    Returns:
        Rows by object id as text, and "total" last; columns `expected`, `failed` and the keys of `CAUSES`.
    """
    rows = {str(obj_id): cause[table.obj_id == obj_id] for obj_id in sorted(table.obj_id.unique())} | {"total": cause}
    counts = {}
    for name, part in rows.items():
        by_cause = part.value_counts()
        each = {key: int(by_cause.get(key, 0)) for key in CAUSES}
        counts[name] = {"expected": len(part), "failed": sum(each.values()), **each}
    return pd.DataFrame.from_dict(counts, orient="index", columns=["expected", "failed", *CAUSES])
