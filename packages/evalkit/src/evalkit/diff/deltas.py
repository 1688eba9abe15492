"""Two error tables, pose by pose: deltas with intervals, newly failed and newly solved poses."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
import pandas as pd
from jaxtyping import Float, Int
from posecore.errors import ConfigError

from evalkit.diff.measures import MEASURES
from evalkit.diff.sides import Side, Sides
from evalkit.scores.bootstrap import RESAMPLES, Interval, Resampling, resample, units_of
from evalkit.scores.definitions import RECALL_DIAMETERS
from evalkit.scores.failure_causes import causes
from evalkit.scores.per_pose import solved

KEY = ["scene_id", "im_id", "obj_id", "gt_index"]
LEVEL = ["initial_angle_deg", "initial_translation_diameter"]
LEVEL_DECIMALS = 6
"""Decimals at which levels of perturbation are compared: an error table in CSV has nine digits."""
NEWLY_FAILED, NEWLY_SOLVED = "newly failed", "newly solved"
BOTH_FAILED, BOTH_SOLVED = "both failed", "both solved"


@dataclass(frozen=True, kw_only=True)
class Change:
    """Change of a measure between two files.

    Attributes:
        poses: number compared: all paired ones for fractions, those found in both files for errors.
        mean_a: mean over these poses in the first file.
        mean_b: in the second.
        mean_delta: mean of the second minus the first; NaN without poses.
        mean_interval: its 95 % interval, None with fewer than two units.
        median_a: median over these poses in the first file.
        median_b: in the second.
        median_delta: median of the per-pose deltas, which is not the difference of the medians.
        median_interval: its 95 % interval.
    """

    poses: int
    mean_a: float
    mean_b: float
    mean_delta: float
    mean_interval: Interval
    median_a: float
    median_b: float
    median_delta: float
    median_interval: Interval


@dataclass(frozen=True, kw_only=True, eq=False)
class Difference:
    """The second file against the first.

    Attributes:
        sides: both files.
        pairs: one row for each expected pose of both: ids, initial levels, `row_a` and `row_b` (in the sides' tables),
            `line_a`, `line_b`, `found_a`, `found_b`, for each measure `<name>_a`, `<name>_b` and `<name>_delta`
            (second minus first), `status` ("newly failed" and so on), and `cause_a`, `cause_b` (of failures)
            unless a side is an error table.
        only_a: ids of poses expected of the first file only.
        only_b: ids of poses expected of the second file only.
        changes: by measure.
        resampled: units of the intervals, in words.
        limit_diameters: an ADD(-S) of so many diameters or more is a failure.
    """

    sides: Sides
    pairs: pd.DataFrame
    only_a: pd.DataFrame
    only_b: pd.DataFrame
    changes: Mapping[str, Change]
    resampled: str
    limit_diameters: float

    def with_status(self, status: str) -> pd.DataFrame:
        """Pairs of a status, those lost or gained first, then by falling change of ADD(-S)."""
        rows = self.pairs[self.pairs.status == status]
        size = rows.add_s_delta.abs().fillna(np.inf)
        return rows.loc[size.sort_values(ascending=False, kind="stable").index]

    @property
    def newly_failed(self) -> pd.DataFrame:
        """Solved in the first file and failed in the second."""
        return self.with_status(NEWLY_FAILED)

    @property
    def newly_solved(self) -> pd.DataFrame:
        """Failed in the first file and solved in the second."""
        return self.with_status(NEWLY_SOLVED)

    @property
    def lost(self) -> pd.DataFrame:
        """Found in the first file only."""
        return self.pairs[self.pairs.found_a & ~self.pairs.found_b]

    @property
    def gained(self) -> pd.DataFrame:
        """Found in the second file only."""
        return self.pairs[~self.pairs.found_a & self.pairs.found_b]

    @property
    def counts(self) -> dict[str, int]:
        """Numbers of poses by their names in rules."""
        return {
            "newly_failed": len(self.newly_failed),
            "newly_solved": len(self.newly_solved),
            "lost": len(self.lost),
            "gained": len(self.gained),
            "unpaired": len(self.only_a) + len(self.only_b),
        }


def differences(
    sides: Sides, *, limit_diameters: float = RECALL_DIAMETERS, resamples: int = RESAMPLES, seed: int = 0
) -> Difference:
    """Compare two files.

    Args:
        sides: see `open_sides`.
        limit_diameters: an ADD(-S) of so many diameters or more is a failure.
        resamples: of the bootstrap; scenes (or images) are drawn with the poses of both files.
        seed: of the bootstrap.

    Raises:
        ConfigError: the files have no expected pose in common.
    """
    a, b = sides.a.table, sides.b.table
    rows_a, rows_b = paired_rows(a, b)
    if not len(rows_a):
        raise ConfigError(
            f"{sides.a.path} and {sides.b.path}: no expected pose is in both; "
            "compare results of the same dataset and split"
        )
    pairs, changes, resampled = _compared(
        a.iloc[rows_a].reset_index(drop=True), b.iloc[rows_b].reset_index(drop=True), limit_diameters, resamples, seed
    )
    pairs.insert(len(KEY) + len(LEVEL), "row_a", rows_a)
    pairs.insert(len(KEY) + len(LEVEL) + 1, "row_b", rows_b)
    for suffix, side, rows in (("a", sides.a, rows_a), ("b", sides.b, rows_b)):
        if side.scored is not None and sides.evaluator is not None:
            pairs[f"cause_{suffix}"] = _causes(side, sides, limit_diameters)[rows]
    return Difference(
        sides=sides,
        pairs=pairs,
        only_a=a.drop(index=a.index[rows_a])[[*KEY, *LEVEL]].reset_index(drop=True),
        only_b=b.drop(index=b.index[rows_b])[[*KEY, *LEVEL]].reset_index(drop=True),
        changes=changes,
        resampled=resampled,
        limit_diameters=limit_diameters,
    )


def paired_rows(a: pd.DataFrame, b: pd.DataFrame) -> tuple[Int[np.ndarray, " p"], Int[np.ndarray, " p"]]:
    """Positions of the same expected poses in two tables, in the first's order.

    Equal poses have the same scene, image, object, instance and initial level; of several (random initial poses), the
    first is paired with the first and so on.
    """
    keyed = []
    for table in (a, b):
        key = table[KEY].reset_index(drop=True).copy()
        for name in LEVEL:
            key[name] = table[name].fillna(-1.0).round(LEVEL_DECIMALS).to_numpy()
        key["nth"] = key.groupby([*KEY, *LEVEL], sort=False).cumcount()
        key["row"] = np.arange(len(key))
        keyed.append(key)
    merged = keyed[0].merge(keyed[1], on=[*KEY, *LEVEL, "nth"], suffixes=("_a", "_b")).sort_values("row_a")
    return merged.row_a.to_numpy(np.int64), merged.row_b.to_numpy(np.int64)


def _compared(
    a: pd.DataFrame, b: pd.DataFrame, limit_diameters: float, resamples: int, seed: int
) -> tuple[pd.DataFrame, dict[str, Change], str]:
    drawn = resample(units_of(a), resamples, seed)
    columns: dict[str, Any] = {name: a[name] for name in (*KEY, *LEVEL)}
    columns |= {"line_a": a.line, "line_b": b.line, "found_a": a.found, "found_b": b.found}
    changes = {}
    for name, measure in MEASURES.items():
        old, new = measure.values_of(a, limit_diameters), measure.values_of(b, limit_diameters)
        with np.errstate(invalid="ignore"):  # the delta of two infinite errors is 0
            delta = np.where(old == new, np.where(np.isnan(old), np.nan, 0.0), new - old)
        columns |= {f"{name}_a": old, f"{name}_b": new, f"{name}_delta": delta}
        changes[name] = _change(old, new, delta, drawn)
    before, after = solved(a, limit_diameters), solved(b, limit_diameters)
    columns["status"] = np.select(
        [before & after, before & ~after, ~before & after], [BOTH_SOLVED, NEWLY_FAILED, NEWLY_SOLVED], BOTH_FAILED
    )
    return pd.DataFrame(columns), changes, drawn.units.text


def _change(
    old: Float[np.ndarray, " p"], new: Float[np.ndarray, " p"], delta: Float[np.ndarray, " p"], drawn: Resampling
) -> Change:
    both = ~np.isnan(delta)
    if not both.any():
        nothing = float("nan")
        return Change(
            **dict.fromkeys(("mean_a", "mean_b", "mean_delta", "median_a", "median_b", "median_delta"), nothing),
            poses=0,
            mean_interval=None,
            median_interval=None,
        )
    units = drawn.units_with(delta)
    return Change(
        poses=int(both.sum()),
        mean_a=float(old[both].mean()),
        mean_b=float(new[both].mean()),
        mean_delta=float(delta[both].mean()),
        mean_interval=drawn.ends(drawn.means(delta[None])[0], units),
        median_a=float(np.median(old[both])),
        median_b=float(np.median(new[both])),
        median_delta=float(np.median(delta[both])),
        median_interval=drawn.ends(drawn.medians(delta), units),
    )


def _causes(side: Side, sides: Sides, limit_diameters: float) -> np.ndarray:
    assert side.scored is not None and sides.evaluator is not None
    infos, scored = sides.evaluator.dataset.models_info, side.scored
    chosen = causes(side.table, scored.T_est, scored.T_gt, scored.center_m, infos, limit_diameters=limit_diameters)
    return np.asarray(chosen.astype(str).to_numpy())
