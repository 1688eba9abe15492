"""Convergence from perturbed starts: shares and errors along the levels of perturbation.

The experiment is section 4.1 ("Pose perturbation", figure 4) of the 2018 paper: every true pose of a sequence is
rotated by an angle or moved by a share of the object's diameter, refined in 10 iterations and compared with the truth
again. The paper gives shares of rotation errors under 5 and 10 degrees in its text and says what has diverged: a
rotation error above 45 degrees, or a translation error larger than half of the object's diameter. The other thresholds
are ours. Where objects have symmetries, of which the paper says nothing here, rotation errors are at the best one.
"""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import pandas as pd

from evalkit.error_table import column
from evalkit.scores.bootstrap import resample, units_of
from evalkit.scores.definitions import ROUNDING_M, ROUNDING_RAD
from evalkit.scores.per_pose import Values, diverged
from evalkit.tables.model import Better, Cell, Column, Interval, Row, Table

Array = np.ndarray
Point = dict[str, Any]
Curves = dict[str, list[Point]]
"""By kind of perturbation, "angle" and "translation": one point for each level, rising."""
LIMITS_DEG = (5.0, 10.0, 15.0, 20.0, 30.0, 45.0)
LIMITS_DIAMETERS = (0.05, 0.1, 0.2, 0.5)
KINDS: Mapping[str, tuple[str, str]] = {
    "angle": ("start_angle_deg", "start_translation_diameter"),
    "translation": ("start_translation_diameter", "start_angle_deg"),
}
"""Column that a curve runs along, and the one that is 0 on it: poses are perturbed either way, never both ways."""
CURVE_DEFINITIONS: Mapping[str, str] = {
    "level": "angle that the true pose was rotated by, or length that it was moved by in diameters of the object",
    "under 5°, 10°, ...": "share of all starts of a level whose final rotation error (at the best symmetry) is below; "
    "an error of exactly the limit is not, nor is a missing estimate",
    "under 0.1 d, ...": "the same for the final distance of the origins, in diameters",
    "diverged": "share of all starts of a level whose final rotation error is over 45°, whose final distance of the "
    "origins is over half a diameter, or whose estimate is missing",
    "mean final error": "over the starts of a level whose estimate was found",
}


def by_level(table: pd.DataFrame, *, resamples: int = 0, seed: int = 0) -> Curves:
    """The curves of all rows together. Starts drawn at random belong to no level.

    Args:
        table: see `evalkit.error_table`.
        resamples: for 95 % bootstrap intervals (see `evalkit.scores.bootstrap`), 0 for none.
        seed: of the resampling.

    Returns:
        "angle" and "translation" where there are such starts. A point holds `level` (degrees or diameters),
        `expected`, `found`, `under_5deg` ... `under_45deg`, `te_under_0.05d` ... `te_under_0.5d`, `diverged` (shares
        of the expected), `re_deg_mean`, `re_sym_deg_mean`, `te_mm_mean`, `te_diameter_mean` (over the found, NaN where
        there is none) and, where asked for, `intervals`: both ends by key, or None.
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
    return {obj_id: found for obj_id, found in curves.items() if found}


def curve_values(table: pd.DataFrame) -> dict[str, Values]:
    """What the points of a curve are means of, one value for each row; NaN where a row has no part."""
    re_rad, te_m, diameter_m = (column(table, name) for name in ("re_sym_rad", "te_m", "diameter_m"))
    shares = {f"under_{limit:g}deg": re_rad < np.deg2rad(limit) - ROUNDING_RAD for limit in LIMITS_DEG}
    shares |= {f"te_under_{limit:g}d": te_m < limit * diameter_m - ROUNDING_M for limit in LIMITS_DIAMETERS}
    shares["diverged"] = diverged(table)
    errors = {
        "re_deg_mean": np.rad2deg(column(table, "re_rad")),
        "re_sym_deg_mean": np.rad2deg(re_rad),
        "te_mm_mean": 1e3 * te_m,
        "te_diameter_mean": te_m / diameter_m,
    }
    per_row = {name: np.asarray(share, np.float64) for name, share in shares.items()} | errors
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


def _share(key: str, heading: str, group: str, better: Better = "higher") -> Column:
    return Column(key=key, heading=heading, group=group, unit="%", digits=1, better=better)


SHARE_COLUMNS = (
    *(_share(f"under_{limit:g}deg", f"under {limit:g}°", "rotation") for limit in LIMITS_DEG),
    *(_share(f"te_under_{limit:g}d", f"under {limit:g} d", "translation") for limit in LIMITS_DIAMETERS),
    _share("diverged", "diverged", "", "lower"),
)
MEAN_COLUMNS = (
    Column(key="re_sym_deg_mean", heading="rotation", group="mean final error", unit="deg", digits=2, better="lower"),
    Column(key="te_mm_mean", heading="translation", group="mean final error", unit="mm", digits=2, better="lower"),
)
LEVEL_HEADINGS = {"angle": ("rotated by", "deg"), "translation": ("moved by", "diameters")}
TITLES = {"angle": "Starts rotated by steps", "translation": "Starts moved by steps"}


def level_tables(curves: Mapping[str, Curves]) -> list[Table]:
    """One table for each kind of perturbation: a row for each level of each method, the best of a level bold.

    Args:
        curves: of `by_level`, by the method's name.
    """
    return [
        _table(kind, [("", name, found[kind]) for name, found in curves.items() if kind in found])
        for kind in KINDS
        if any(kind in found for found in curves.values())
    ]


def level_object_tables(curves: Mapping[str, Mapping[int, Curves]]) -> list[Table]:
    """The same with a block for each object; `curves` are of `by_level_and_object`, by the method's name."""
    obj_ids = sorted({obj_id for found in curves.values() for obj_id in found})
    tables = []
    for kind in KINDS:
        blocks = [
            (str(obj_id), name, found[obj_id][kind])
            for obj_id in obj_ids
            for name, found in curves.items()
            if kind in found.get(obj_id, {})
        ]
        if blocks:
            tables.append(_table(kind, blocks))
    return tables


def _table(kind: str, blocks: Sequence[tuple[str, str, list[Point]]]) -> Table:
    """A table from curves, each of an object (empty for all together) and a method."""
    objects = any(obj_id for obj_id, _, _ in blocks)
    methods = len({method for _, method, _ in blocks}) > 1
    heading, unit = LEVEL_HEADINGS[kind]
    levels = [point["level"] for _, _, points in blocks for point in points]
    columns = [Column(key="object", heading="object")] if objects else []
    columns += [Column(key="level", heading=heading, unit=unit, digits=_digits(levels))]
    columns += [Column(key="method", heading="method")] if methods else []
    columns += [Column(key="expected", heading="starts", digits=0), Column(key="found", heading="found", digits=0)]
    rows = []
    for obj_id, method, points in blocks:
        for point in points:
            cells = {name: _cell(point, name) for name in (c.key for c in (*SHARE_COLUMNS, *MEAN_COLUMNS))}
            cells |= {"level": point["level"], "expected": point["expected"], "found": point["found"]}
            cells |= ({"object": obj_id} if objects else {}) | ({"method": method} if methods else {})
            group = f"{obj_id} {point['level']:g}" if methods else obj_id
            rows.append((obj_id, point["level"], Row(cells=cells, group=group)))
    if methods:  # a level's methods one below the other; Python's sort keeps them in order
        order = {obj_id: place for place, obj_id in enumerate(dict.fromkeys(obj_id for obj_id, _, _ in blocks))}
        rows.sort(key=lambda row: (order[row[0]], row[1]))
    return Table(
        title=TITLES[kind] + (", by object" if objects else ""),
        name=f"curve-{kind}" + ("-objects" if objects else ""),
        columns=[*columns, *SHARE_COLUMNS, *MEAN_COLUMNS],
        rows=[row for _, _, row in rows],
        best="column" if methods else "",
        note="Shares are of all starts of a level, a missing estimate failing; errors are over the found ones. "
        "Diverged: rotation error over 45° or translation error over half a diameter.",
    )


def _cell(point: Point, name: str) -> Cell:
    value: float = point[name]
    ends = point.get("intervals", {}).get(name)
    return value if ends is None else Interval(value=value, low=ends[0], high=ends[1])


def _digits(levels: Sequence[float]) -> int:
    """Decimals that show every level as it is, three at most."""
    return next((digits for digits in range(3) if all(round(level, digits) == level for level in levels)), 3)
