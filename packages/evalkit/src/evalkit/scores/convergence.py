"""Convergence from perturbed initial poses: success fractions and errors by level of perturbation.

The experiment is section 4.1 ("Pose perturbation", figure 4) of the 2018 paper: every ground-truth pose of a
sequence is rotated by an angle or translated by a fraction of the object's diameter, refined in 10 iterations and
compared with the ground truth again. The paper's text gives fractions of rotation errors under 5 and 10 degrees and
defines divergence: a rotation error above 45 degrees, or a translation error larger than half of the object's diameter.
The other thresholds are ours. For objects with symmetries, which the paper does not discuss here, rotation errors are
at the best symmetry.
"""

from collections.abc import Mapping
from typing import Any

import numpy as np
import pandas as pd

from evalkit.error_table import column
from evalkit.scores.bootstrap import resample, units_of
from evalkit.scores.definitions import ROUNDING_M, ROUNDING_RAD
from evalkit.scores.per_pose import Values, diverged

Point = dict[str, Any]
Curves = dict[str, list[Point]]
"""By kind of perturbation, "angle" and "translation": one point for each level, rising."""
LIMITS_DEG = (5.0, 10.0, 15.0, 20.0, 30.0, 45.0)
LIMITS_DIAMETERS = (0.05, 0.1, 0.2, 0.5)
KINDS: Mapping[str, tuple[str, str]] = {
    "angle": ("initial_angle_deg", "initial_translation_diameter"),
    "translation": ("initial_translation_diameter", "initial_angle_deg"),
}
"""Column of a curve's levels, and the column that is 0 on the curve: poses are rotated or translated, not both."""
CURVE_DEFINITIONS: Mapping[str, str] = {
    "level": "rotation of the ground-truth pose, or its translation in diameters of the object",
    "under 5°, 10°, ...": "fraction of all initial poses of a level with a final rotation error (at the best symmetry) "
    "under the limit, which an error of exactly the limit and a missing estimate are not",
    "under 0.1 d, ...": "the same for the final distance of the centres, in diameters",
    "diverged": "fraction of all initial poses of a level with a final rotation error over 45°, a final distance of "
    "the centres over half a diameter, or no estimate",
    "mean final error": "over the initial poses of a level that have an estimate",
}


def by_level(table: pd.DataFrame, *, resamples: int = 0, seed: int = 0) -> Curves:
    """The curves of all rows together. Initial poses drawn at random belong to no level.

    Args:
        table: see `evalkit.error_table`.
        resamples: for 95 % bootstrap intervals (see `evalkit.scores.bootstrap`), 0 for none.
        seed: of the resampling.

    Returns:
        "angle" and "translation" where there are such initial poses. A point holds `level` (degrees or diameters),
        `expected`, `found`, `under_5deg` ... `under_45deg`, `te_under_0.05d` ... `te_under_0.5d`, `diverged`
        (fractions of the expected), `re_deg_mean`, `re_sym_deg_mean`, `te_mm_mean`, `te_diameter_mean` (over
        the found, NaN without any) and, with resamples, `intervals`: both ends by key, or None.
    """
    curves = {}
    for kind, (along, still) in KINDS.items():
        rows = table[column(table, still) == 0]
        points = [_point(float(level), group, resamples, seed) for level, group in rows.groupby(along)]
        if any(point["level"] > 0 for point in points):
            curves[kind] = points
    return curves


def by_level_and_object(table: pd.DataFrame, *, resamples: int = 0, seed: int = 0) -> dict[int, Curves]:
    """The curves of each object, as figure 4 of the paper draws them; see `by_level`."""
    curves = {int(obj_id): by_level(group, resamples=resamples, seed=seed) for obj_id, group in table.groupby("obj_id")}
    return {obj_id: by_kind for obj_id, by_kind in curves.items() if by_kind}


def curve_values(table: pd.DataFrame) -> dict[str, Values]:
    """Values of each row whose means are the points of a curve; NaN where a row is left out."""
    re_rad, te_m, diameter_m = (column(table, name) for name in ("re_sym_rad", "te_m", "diameter_m"))
    fractions = {f"under_{limit:g}deg": re_rad < np.deg2rad(limit) - ROUNDING_RAD for limit in LIMITS_DEG}
    fractions |= {f"te_under_{limit:g}d": te_m < limit * diameter_m - ROUNDING_M for limit in LIMITS_DIAMETERS}
    fractions["diverged"] = diverged(table)
    errors = {
        "re_deg_mean": np.rad2deg(column(table, "re_rad")),
        "re_sym_deg_mean": np.rad2deg(re_rad),
        "te_mm_mean": 1e3 * te_m,
        "te_diameter_mean": te_m / diameter_m,
    }
    per_row = {name: np.asarray(fraction, np.float64) for name, fraction in fractions.items()} | errors
    return {name: Values(per_row=values, statistic="mean") for name, values in per_row.items()}


def _point(level: float, group: pd.DataFrame, resamples: int, seed: int) -> Point:
    values = curve_values(group)
    point: Point = {"level": level, "expected": len(group), "found": int((column(group, "found") > 0).sum())}
    for name, item in values.items():
        kept = item.per_row[~np.isnan(item.per_row)]
        point[name] = float(kept.mean()) if len(kept) else float("nan")
    if resamples:
        point["intervals"] = resample(units_of(group), resamples, seed).intervals(values)
    return point
