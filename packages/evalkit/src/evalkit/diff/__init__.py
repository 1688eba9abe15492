"""One result file against another: paired deltas with intervals, newly failed and newly solved poses, rules for CI."""

from evalkit.diff.deltas import Change, Difference, differences
from evalkit.diff.job import DiffJob, DiffResult, compare_files
from evalkit.diff.measures import MEASURES
from evalkit.diff.rules import COUNTS, Rule, Verdict, judge, parse_rule
from evalkit.diff.sides import Side, Sides, open_sides

__all__ = [
    "COUNTS",
    "MEASURES",
    "Change",
    "DiffJob",
    "DiffResult",
    "Difference",
    "Rule",
    "Side",
    "Sides",
    "Verdict",
    "compare_files",
    "differences",
    "judge",
    "open_sides",
    "parse_rule",
]
