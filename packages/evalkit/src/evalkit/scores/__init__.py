"""Scores of error tables: means, medians, recalls, areas under curves, BOP19's recalls and BOP24's precision."""

from evalkit.scores.bop_matching import AllErrors, bop19_recalls, bop24_precision, with_bop19
from evalkit.scores.definitions import DEFINITIONS
from evalkit.scores.per_pose import diverged, found_errors, score_values, solved
from evalkit.scores.totals import by_object, scores

__all__ = [
    "DEFINITIONS",
    "AllErrors",
    "bop19_recalls",
    "bop24_precision",
    "by_object",
    "diverged",
    "found_errors",
    "score_values",
    "scores",
    "solved",
    "with_bop19",
]
