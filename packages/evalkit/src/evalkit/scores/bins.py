"""Scores by visibility, distance and viewpoint: tidy tables, one row for each bin and score.

A bin holds values from its lower edge up to its upper edge, which belongs to it only in the last bin of an axis. Rows
without a value (visibility where the dataset has none) and rows beyond the edges are in no bin. Bins without rows are
left out. Intervals are bootstrap intervals with the same resamples for all bins.
"""

from collections.abc import Mapping, Sequence
from itertools import pairwise, product
from typing import Any

import numpy as np
import pandas as pd
from jaxtyping import Bool, Float
from posecore.errors import ConfigError

from evalkit.error_table import column
from evalkit.scores.bootstrap import RESAMPLES, Resampling, resample, units_of
from evalkit.scores.per_pose import Values, score_values
from evalkit.scores.totals import statistic_of

SCORES = ("vss_mean", "add_s_recall_0.1d", "re_sym_deg_median", "tz_mm_median", "add_mm_median")
VISIBILITY_EDGES = tuple(step / 10 for step in range(11))
AZIMUTH_EDGES_DEG = tuple(float(edge) for edge in range(-180, 181, 45))
ELEVATION_EDGES_DEG = (-90.0, -45.0, -15.0, 15.0, 45.0, 90.0)
DISTANCE_BINS = 8


def binned(
    table: pd.DataFrame,
    by: Mapping[str, Sequence[float]],
    *,
    scores: Sequence[str] = SCORES,
    resamples: int = RESAMPLES,
    seed: int = 0,
) -> pd.DataFrame:
    """Scores in bins of columns.

    Args:
        table: see `evalkit.error_table`.
        by: edges of the bins by column, rising; several columns give a grid.
        scores: keys of `scores.per_pose.score_values`.
        resamples: of the bootstrap; 0 for no intervals.
        seed: of the draws.

    Returns:
        For each column `<column>_low` and `<column>_high`; `score`, `value` (NaN where no row has one), `low` and
        `high` (95 % interval, NaN where there are fewer than two units), `expected`, `found`, `rows` (with a value of
        the score) and `units` (their scenes or images).

    Raises:
        ConfigError: edges are not rising, or a score or column is unknown.
    """
    values = score_values(table)
    unknown = [name for name in scores if name not in values]
    if unknown:
        raise ConfigError(f"bins: no score {unknown[0]}; there are {', '.join(values)}")
    for name, edges in by.items():
        if name not in table:
            raise ConfigError(f"bins: the table has no column {name}; it has {', '.join(table.columns)}")
        if len(edges) < 2 or any(not low < high for low, high in pairwise(edges)):
            raise ConfigError(f"bins: found edges {list(edges)} of {name}, expected two or more rising numbers")
    resampling = resample(units_of(table), resamples, seed) if resamples and len(table) else None
    is_found = column(table, "found") > 0
    rows: list[dict[str, Any]] = []
    for ends in product(*(list(pairwise(edges)) for edges in by.values())):
        inside = np.ones(len(table), bool)
        edges_of_bin: dict[str, float] = {}
        for (name, edges), (low, high) in zip(by.items(), ends, strict=True):
            inside &= _between(column(table, name), low, high, last=high == edges[-1])
            edges_of_bin |= {f"{name}_low": low, f"{name}_high": high}
        if inside.any():
            counts = {"expected": int(inside.sum()), "found": int((inside & is_found).sum())}
            rows += [edges_of_bin | _summed_up(name, values[name], inside, resampling) | counts for name in scores]
    names = [f"{name}_{end}" for name in by for end in ("low", "high")]
    names += ["score", "value", "low", "high", "expected", "found", "rows", "units"]
    return pd.DataFrame(rows, columns=names)


def _between(values: Float[np.ndarray, " n"], low: float, high: float, *, last: bool) -> Bool[np.ndarray, " n"]:
    return np.asarray((values >= low) & ((values <= high) if last else (values < high)))


def _summed_up(
    name: str, values: Values, inside: Bool[np.ndarray, " n"], resampling: Resampling | None
) -> dict[str, float | int | str]:
    part = Values(per_row=np.where(inside, values.per_row, np.nan), statistic=values.statistic)
    interval = None if resampling is None else resampling.interval(part)
    low, high = interval or (np.nan, np.nan)
    units = 0 if resampling is None else resampling.units_with(part.per_row)
    count = int((~np.isnan(part.per_row)).sum())
    return {"score": name, "value": statistic_of(part), "low": low, "high": high, "rows": count, "units": units}


def by_visibility(table: pd.DataFrame, edges: Sequence[float] = VISIBILITY_EDGES, **options: Any) -> pd.DataFrame:
    """Scores by the visible fraction of the ground-truth silhouette; `options` are those of `binned`."""
    return binned(table, {"visib_fract": edges}, **options)


def by_distance(table: pd.DataFrame, edges_m: Sequence[float] | None = None, **options: Any) -> pd.DataFrame:
    """Scores by camera z of the object's centre at the ground truth, metres.

    By default the edges are round numbers from the smallest to the largest distance.
    """
    return binned(table, {"distance_m": edges_m or round_edges(column(table, "distance_m"))}, **options)


def by_azimuth(table: pd.DataFrame, edges_deg: Sequence[float] = AZIMUTH_EDGES_DEG, **options: Any) -> pd.DataFrame:
    """Scores by the camera's direction about the object's z axis, from its x axis, degrees."""
    return binned(table, {"view_azimuth_deg": edges_deg}, **options)


def by_elevation(table: pd.DataFrame, edges_deg: Sequence[float] = ELEVATION_EDGES_DEG, **options: Any) -> pd.DataFrame:
    """Scores by the camera's direction over the object's xy plane, degrees."""
    return binned(table, {"view_elevation_deg": edges_deg}, **options)


def by_viewpoint(
    table: pd.DataFrame,
    azimuth_edges_deg: Sequence[float] = AZIMUTH_EDGES_DEG,
    elevation_edges_deg: Sequence[float] = ELEVATION_EDGES_DEG,
    **options: Any,
) -> pd.DataFrame:
    """Scores on a grid of the camera's direction as seen from the object: azimuth times elevation, degrees."""
    return binned(table, {"view_azimuth_deg": azimuth_edges_deg, "view_elevation_deg": elevation_edges_deg}, **options)


def round_edges(values: Float[np.ndarray, " n"], bins: int = DISTANCE_BINS) -> tuple[float, ...]:
    """Edges at multiples of 1, 2, 2.5 or 5 times a power of ten that hold all finite values in at most `bins` bins."""
    finite = values[np.isfinite(values)]
    if not len(finite):
        return (0.0, 1.0)
    low, high = float(finite.min()), float(finite.max())
    least = max((high - low) / bins, 1e-9 * max(abs(high), 1.0))
    power = 10.0 ** np.floor(np.log10(least))
    for step in (factor * power for factor in (1.0, 2.0, 2.5, 5.0, 10.0, 20.0)):
        first, last = int(np.floor(low / step + 1e-9)), int(np.ceil(high / step - 1e-9))
        last = max(last, first + 1)
        if last - first <= bins:
            break
    return tuple(float(f"{index * step:.12g}") for index in range(first, last + 1))
