"""Every score as one value for each row, for means, medians, bins and bootstrap intervals."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Literal

import numpy as np
import pandas as pd
from jaxtyping import Bool, Float

from evalkit.error_table import column
from evalkit.pose_errors.metrics import VSD_COLUMNS
from evalkit.scores.definitions import (
    AUC_LIMIT_DIAMETERS,
    AUC_LIMIT_M,
    DIVERGED_DIAMETERS,
    DIVERGED_RAD,
    MSPD_PX,
    MSPD_WIDTH_PX,
    MSSD_DIAMETERS,
    RECALL_DIAMETERS,
    ROUNDING_M,
    ROUNDING_RAD,
    VSD_LIMITS,
)

Statistic = Literal["mean", "median"]


@dataclass(frozen=True, kw_only=True, eq=False)
class Values:
    """A score before averaging.

    Attributes:
        per_row: one value for each row, NaN where the row is left out.
        statistic: of the values.
    """

    per_row: Float[np.ndarray, " n"]
    statistic: Statistic


def score_values(table: pd.DataFrame) -> dict[str, Values]:
    """All scores that are a mean or a median over rows, by key; keys carry units.

    A missing estimate is 0 in fractions, recalls, areas and VSS, 1 in `diverged`, and left out of errors.
    """
    is_found = column(table, "found") > 0
    vss = column(table, "vss")
    means = {"vss_mean": vss, "vss_mean_found": np.where(is_found, vss, np.nan)}
    means |= _recalls(table) | average_recalls(table)
    means["diverged"] = diverged(table).astype(np.float64)
    values = {name: Values(per_row=per_row, statistic="mean") for name, per_row in means.items()}
    for name, errors in found_errors(table).items():
        values[f"{name}_mean"] = Values(per_row=errors, statistic="mean")
        values[f"{name}_median"] = Values(per_row=errors, statistic="median")
    time_s = column(table, "time_s")
    time_s = np.where(is_found & (time_s >= 0), time_s, np.nan)
    values["time_s_mean"] = Values(per_row=time_s, statistic="mean")
    values["time_s_per_image"] = Values(per_row=_once_an_image(table, time_s), statistic="mean")
    return values


def _recalls(table: pd.DataFrame) -> dict[str, Float[np.ndarray, " n"]]:
    diameter = column(table, "diameter_m")
    add, adi, add_s = column(table, "add_m"), column(table, "adi_m"), add_s_m(table)
    re_sym_deg = np.rad2deg(column(table, "re_sym_rad"))
    fractions = {
        "add_recall_0.1d": in_diameters(add, diameter) < RECALL_DIAMETERS,
        "adi_recall_0.1d": in_diameters(adi, diameter) < RECALL_DIAMETERS,
        "add_s_recall_0.1d": in_diameters(add_s, diameter) < RECALL_DIAMETERS,
        "5cm5deg": (column(table, "te_m") < 0.05) & (re_sym_deg < 5.0),
        "proj_5px": column(table, "proj_sym_px") < 5.0,
    }
    areas = {}
    for name, error in (("add", add), ("adi", adi), ("add_s", add_s)):
        areas[f"{name}_auc_100mm"] = area_under_recall(error, AUC_LIMIT_M)
        areas[f"{name}_auc_0.1d"] = area_under_recall(error, AUC_LIMIT_DIAMETERS * diameter)
    return {name: np.asarray(fraction, np.float64) for name, fraction in fractions.items()} | areas


def in_diameters(error_m: Float[np.ndarray, " n"], diameter_m: Float[np.ndarray, " n"]) -> Float[np.ndarray, " n"]:
    """Errors in diameters, divided in millimetres as bop_toolkit does: 10 mm of 100 mm are 0.1, of metres not quite."""
    return np.asarray((error_m * 1e3) / (diameter_m * 1e3))


def area_under_recall(
    errors: Float[np.ndarray, " n"], limit: float | Float[np.ndarray, " n"]
) -> Float[np.ndarray, " n"]:
    """Contribution of each error to the area under the recall curve from 0 to `limit`: their mean is the exact area.

    Args:
        errors: NaN where an estimate is missing, with contribution 0.
        limit: largest threshold, in the errors' unit, one for all or one for each.
    """
    return np.nan_to_num(1.0 - errors / limit, nan=0.0).clip(0.0, 1.0)


def add_s_m(table: pd.DataFrame) -> Float[np.ndarray, " n"]:
    """ADD(-S): ADI of objects with symmetries, ADD of the others, metres, NaN where missing."""
    return np.where(column(table, "symmetric") > 0, column(table, "adi_m"), column(table, "add_m"))


def solved(table: pd.DataFrame, limit_diameters: float = RECALL_DIAMETERS) -> Bool[np.ndarray, " n"]:
    """Rows with an ADD(-S) under a fraction of the diameter; missing ones are not."""
    return np.asarray(in_diameters(add_s_m(table), column(table, "diameter_m")) < limit_diameters)


def average_recalls(table: pd.DataFrame) -> dict[str, Float[np.ndarray, " n"]]:
    """BOP19's average recalls: for each row the fraction of thresholds that it is under.

    Columns `bop19_mssd`, `bop19_mspd`, `bop19_vsd` (see `bop_matching.bop19_recalls`) are used where present: they hold
    BOP's matching of several instances. Otherwise the errors of the row's estimate count, which is the same for
    targets with a single instance.

    Returns:
        `ar_mssd`, `ar_mspd`, `ar_vsd`, `ar` and `ar_without_vsd`; `ar_vsd` and `ar` are NaN in every row where VSD was
        not computed, or not for all estimates (images without depth).
    """
    diameter, width = column(table, "diameter_m"), column(table, "image_width_px")
    mssd = _column_or(
        table, "bop19_mssd", lambda: under(in_diameters(column(table, "mssd_m"), diameter), MSSD_DIAMETERS)
    )
    mspd = _column_or(table, "bop19_mspd", lambda: under(column(table, "mspd_px") * (MSPD_WIDTH_PX / width), MSPD_PX))
    vsd = _column_or(table, "bop19_vsd", lambda: _vsd_recalls(table))
    return {
        "ar": (vsd + mssd + mspd) / 3.0,
        "ar_without_vsd": (mssd + mspd) / 2.0,
        "ar_vsd": vsd,
        "ar_mssd": mssd,
        "ar_mspd": mspd,
    }


def _column_or(table: pd.DataFrame, name: str, otherwise: Callable[[], np.ndarray]) -> Float[np.ndarray, " n"]:
    return column(table, name) if name in table else otherwise()


def under(errors: Float[np.ndarray, " n"], limits: Float[np.ndarray, " t"]) -> Float[np.ndarray, " n"]:
    """For each error the fraction of limits above; 0 for NaN."""
    below = len(limits) - np.searchsorted(limits, errors, side="right")
    return np.where(np.isfinite(errors), below, 0) / len(limits)


def _vsd_recalls(table: pd.DataFrame) -> Float[np.ndarray, " n"]:
    nothing = np.full(len(table), np.nan)
    if not all(name in table for name in VSD_COLUMNS):
        return nothing
    errors = np.stack([column(table, name) for name in VSD_COLUMNS])
    if np.isnan(errors[:, column(table, "found") > 0]).any():
        return nothing
    return np.asarray(np.mean([under(row, VSD_LIMITS) for row in errors], axis=0))


def found_errors(table: pd.DataFrame) -> dict[str, Float[np.ndarray, " n"]]:
    """Errors by name: degrees, millimetres and pixels, translations per camera axis without sign, NaN where missing."""
    return {
        "re_deg": np.rad2deg(column(table, "re_rad")),
        "re_sym_deg": np.rad2deg(column(table, "re_sym_rad")),
        "te_mm": column(table, "te_m") * 1e3,
        "tx_mm": np.abs(column(table, "dx_m")) * 1e3,
        "ty_mm": np.abs(column(table, "dy_m")) * 1e3,
        "tz_mm": np.abs(column(table, "dz_m")) * 1e3,
        "add_mm": column(table, "add_m") * 1e3,
        "adi_mm": column(table, "adi_m") * 1e3,
        "mssd_mm": column(table, "mssd_m") * 1e3,
        "mspd_px": column(table, "mspd_px"),
        "proj_px": column(table, "proj_px"),
    }


def diverged(table: pd.DataFrame) -> Bool[np.ndarray, " n"]:
    """Rows that are missing, rotated by over 45 degrees or translated by over half a diameter."""
    rotated = column(table, "re_sym_rad") > DIVERGED_RAD + ROUNDING_RAD
    translated = column(table, "te_m") > DIVERGED_DIAMETERS * column(table, "diameter_m") + ROUNDING_M
    return np.asarray(rotated | translated | (column(table, "found") == 0))


def _once_an_image(table: pd.DataFrame, values: Float[np.ndarray, " n"]) -> Float[np.ndarray, " n"]:
    """The first finite value of each image, NaN in its other rows: in BOP all estimates of an image have one time."""
    timed = np.flatnonzero(np.isfinite(values))
    first = ~table.iloc[timed].duplicated(["scene_id", "im_id"]).to_numpy()
    kept = np.full(len(values), np.nan)
    kept[timed[first]] = values[timed[first]]
    return kept
