"""Tables to scores: means, medians, recalls and areas under curves, with missing estimates counted as failures."""

from typing import Any

import numpy as np
import pandas as pd

from evalkit.error_table import column
from evalkit.scores.per_pose import Values, score_values

Array = np.ndarray


def scores(table: pd.DataFrame) -> dict[str, Any]:
    """Scores of a table: counts, and the mean or median of every entry of `score_values`.

    Keys carry units. A value without rows behind it is NaN.
    """
    found = int((column(table, "found") > 0).sum())
    counts = {"expected": len(table), "found": found, "missing": len(table) - found}
    return counts | {name: summed_up(values) for name, values in score_values(table).items()}


def summed_up(values: Values) -> float:
    """Mean or median of the rows that have a part in a score; NaN where none has."""
    kept = values.per_row[~np.isnan(values.per_row)]
    if not len(kept):
        return float("nan")
    return float(np.mean(kept) if values.statistic == "mean" else np.median(kept))


def by_object(table: pd.DataFrame) -> dict[int, dict[str, Any]]:
    """Scores of each object."""
    return {int(obj_id): scores(group) for obj_id, group in table.groupby("obj_id")}
