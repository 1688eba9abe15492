"""Scores of a table: means, medians, recalls and areas under curves, with missing estimates as failures."""

from typing import Any

import numpy as np
import pandas as pd

from evalkit.error_table import column
from evalkit.scores.per_pose import Values, score_values


def scores(table: pd.DataFrame) -> dict[str, Any]:
    """Scores of a table: counts, and the mean or median of every entry of `score_values`.

    Keys end in units. A score without rows is NaN.
    """
    found_count = int((column(table, "found") > 0).sum())
    counts = {"expected": len(table), "found": found_count, "missing": len(table) - found_count}
    return counts | {name: statistic_of(values) for name, values in score_values(table).items()}


def statistic_of(values: Values) -> float:
    """Mean or median of a score over its rows; NaN without rows."""
    kept = values.per_row[~np.isnan(values.per_row)]
    if not len(kept):
        return float("nan")
    return float(np.mean(kept) if values.statistic == "mean" else np.median(kept))


def by_object(table: pd.DataFrame) -> dict[int, dict[str, Any]]:
    """Scores of each object."""
    return {int(obj_id): scores(group) for obj_id, group in table.groupby("obj_id")}
