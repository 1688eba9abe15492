"""Tables to scores: means, medians, recalls, areas under curves, BOP19's recalls and BOP24's precision."""

from evalkit.scores.bop import AllErrors, bop19_shares, bop24_precision, with_bop19
from evalkit.scores.definitions import DEFINITIONS
from evalkit.scores.totals import by_object, scores
from evalkit.scores.values import diverged, found_errors, score_values, solved

__all__ = [
    "DEFINITIONS",
    "AllErrors",
    "bop19_shares",
    "bop24_precision",
    "by_object",
    "diverged",
    "found_errors",
    "score_values",
    "scores",
    "solved",
    "with_bop19",
]
