"""Tables to scores: means, medians, recalls and areas under curves, with missing estimates counted as failures."""

from typing import Any

import numpy as np
import pandas as pd
from jaxtyping import Bool, Float

from evalkit.table import column

Array = np.ndarray
AUC_LIMIT_M = 0.1
DIVERGED_RAD = np.deg2rad(45.0)
DIVERGED_DIAMETERS = 0.5
MSSD_DIAMETERS = np.arange(0.05, 0.501, 0.05)
MSPD_PX = np.arange(5.0, 50.1, 5.0)
LEVEL_LIMITS_DEG = (5.0, 10.0, 20.0)
ROUNDING_RAD, ROUNDING_M = 1e-7, 1e-8
"""A start moved by exactly a limit is neither under nor over it, whatever the decimals of its file made of it."""

DEFINITIONS = {
    "VSS": "intersection over union of the rendered silhouettes of truth and estimate; a missing estimate counts 0",
    "ADD": "average distance of corresponding model points; recall: share under 0.1 diameter",
    "ADI": "average distance to the nearest model point (ADD-S); recall: share under 0.1 diameter",
    "ADD(-S)": "ADI for objects with symmetries, ADD for the others; recall: share under 0.1 diameter",
    "AUC": "area under the recall curve for thresholds from 0 to 100 mm, 1 at best",
    "rotation": "angle between estimated and true rotation, over found estimates; 'sym.' is at the best symmetry",
    "x, y, z": "absolute difference of the object's origin along the camera's right, down and forward axes, mm",
    "5 cm 5°": "share with a distance of origins under 5 cm and a rotation error (at the best symmetry) under 5°",
    "proj. 5 px": "share with an average distance of projected model points (at the best symmetry) under 5 pixels",
    "AR MSSD": "BOP: mean recall of the maximum surface distance at 0.05, 0.10, ... 0.50 diameter",
    "AR MSPD": "BOP: mean recall of the maximum projected distance at 5, 10, ... 50 px times image width / 640",
    "diverged": "share with a rotation error (at the best symmetry) over 45 degrees or a distance of origins over half "
    "a diameter; missing ones included",
    "diameter": "the largest distance between two model points, as models_info.json gives it",
}


def scores(table: pd.DataFrame) -> dict[str, Any]:
    """Scores of a table; shares and recalls are over all rows, means and medians over the found ones.

    Keys carry units. A value without rows behind it is NaN.
    """
    found = table[table.found]
    diameter = column(table, "diameter_m")
    symmetric = column(table, "symmetric") > 0
    add, adi = column(table, "add_m"), column(table, "adi_m")
    re_sym_deg = np.rad2deg(column(table, "re_sym_rad"))
    result: dict[str, Any] = {
        "expected": len(table),
        "found": len(found),
        "missing": len(table) - len(found),
        "vss_mean": _mean(column(table, "vss")),
        "vss_mean_found": _mean(column(found, "vss")),
        "add_recall_0.1d": _mean(add < 0.1 * diameter),
        "adi_recall_0.1d": _mean(adi < 0.1 * diameter),
        "add_s_recall_0.1d": _mean(np.where(symmetric, adi, add) < 0.1 * diameter),
        "add_auc_100mm": _auc(add),
        "adi_auc_100mm": _auc(adi),
        "5cm5deg": _mean((column(table, "te_m") < 0.05) & (re_sym_deg < 5.0)),
        "proj_5px": _mean(column(table, "proj_sym_px") < 5.0),
        "ar_mssd": _mean(column(table, "mssd_m")[:, None] < MSSD_DIAMETERS * diameter[:, None]),
        "ar_mspd": _mean(column(table, "mspd_px")[:, None] < MSPD_PX * column(table, "image_width_px")[:, None] / 640),
        "diverged": _mean(diverged(table)),
    }
    for name, values in found_errors(found).items():
        result[f"{name}_mean"], result[f"{name}_median"] = _mean(values), _median(values)
    times = column(found, "time_s")
    result["time_s_mean"] = _mean(times[times >= 0])
    return result


def found_errors(found: pd.DataFrame) -> dict[str, Float[Array, " n"]]:
    """Errors of found rows by name: degrees and millimetres, translations per camera axis without sign."""
    return {
        "re_deg": np.rad2deg(column(found, "re_rad")),
        "re_sym_deg": np.rad2deg(column(found, "re_sym_rad")),
        "te_mm": column(found, "te_m") * 1e3,
        "tx_mm": np.abs(column(found, "dx_m")) * 1e3,
        "ty_mm": np.abs(column(found, "dy_m")) * 1e3,
        "tz_mm": np.abs(column(found, "dz_m")) * 1e3,
        "add_mm": column(found, "add_m") * 1e3,
        "adi_mm": column(found, "adi_m") * 1e3,
    }


def diverged(table: pd.DataFrame) -> Bool[Array, " n"]:
    """Rows that are missing, rotated by over 45 degrees or moved by over half a diameter."""
    rotated = column(table, "re_sym_rad") > DIVERGED_RAD + ROUNDING_RAD
    moved = column(table, "te_m") > DIVERGED_DIAMETERS * column(table, "diameter_m") + ROUNDING_M
    return np.asarray(rotated | moved | (column(table, "found") == 0))


def by_object(table: pd.DataFrame) -> dict[int, dict[str, Any]]:
    """Scores of each object."""
    return {int(obj_id): scores(group) for obj_id, group in table.groupby("obj_id")}


def by_level(table: pd.DataFrame) -> dict[str, list[dict[str, Any]]]:
    """Scores along the levels of perturbation.

    Returns:
        "angle" and "translation" where there are such starts, each a list in rising level: `level`
        (degrees or diameters), `expected`, `under_5deg` and so on (share of rotation errors), `diverged`, means of the
        final errors.
    """
    curves = {
        "angle": _curve(table[table.start_translation_diameter == 0], "start_angle_deg"),
        "translation": _curve(table[table.start_angle_deg == 0], "start_translation_diameter"),
    }
    return {name: curve for name, curve in curves.items() if any(point["level"] > 0 for point in curve)}


def _curve(table: pd.DataFrame, level_column: str) -> list[dict[str, Any]]:
    curve = []
    for level, group in table.groupby(level_column):
        re_deg = np.rad2deg(column(group, "re_sym_rad"))
        te = column(group, "te_m")
        point = {"level": float(level), "expected": len(group), "found": int(np.isfinite(te).sum())}
        point |= {f"under_{limit:g}deg": _mean(re_deg < limit - np.rad2deg(ROUNDING_RAD)) for limit in LEVEL_LIMITS_DEG}
        point["te_under_0.1d"] = _mean(te < 0.1 * column(group, "diameter_m") - ROUNDING_M)
        point["diverged"] = _mean(diverged(group))
        point["re_sym_deg_mean"] = _mean(re_deg[np.isfinite(re_deg)])
        point["te_mm_mean"] = _mean(te[np.isfinite(te)] * 1e3)
        curve.append(point)
    return curve


def _mean(values: Array) -> float:
    return float(np.mean(values)) if np.size(values) else float("nan")


def _median(values: Array) -> float:
    return float(np.median(values)) if np.size(values) else float("nan")


def _auc(errors_m: Float[Array, " n"]) -> float:
    """Exact integral of the recall curve over thresholds from 0 to AUC_LIMIT_M, over AUC_LIMIT_M."""
    if not len(errors_m):
        return float("nan")
    return float(np.nan_to_num(1.0 - errors_m / AUC_LIMIT_M, nan=0.0).clip(0.0, 1.0).mean())
