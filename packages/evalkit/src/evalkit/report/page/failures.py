"""Causes of failures: one for every failed pose."""

from collections.abc import Mapping
from typing import Any

from evalkit.report import html, svg_plots
from evalkit.report.svg_plots import Part
from evalkit.tables.report_tables import cause_tables

NOTE = (
    "A pose has failed where it is missing or where its ADD(-S) is 0.1 diameter or more. The cause is the part of the "
    "error without which the pose would pass, estimated from the poses."
)
PARTS = (
    Part(name="solved", colour="#dfe5ec", is_light=True),
    Part(name="missed", colour="#1c2330"),
    Part(name="wrong instance", colour="#7b4fa3"),
    Part(name="flip", colour="#c25a00"),
    Part(name="near-symmetric flip", colour="#f2b705", is_light=True),
    Part(name="z only", colour="#1f5fd0"),
    Part(name="in plane only", colour="#6db6f0", is_light=True),
    Part(name="rotation only", colour="#0a7a5a"),
    Part(name="large", colour="#b3261e"),
)


def parts(summary: Mapping[str, Any]) -> list[str]:
    """A bar for each result file, and the numbers as tables."""
    files = [file for file in summary["files"] if file["total"]["expected"]]
    if not files:
        return []
    bars = [svg_plots.stacked_bar(file["name"], PARTS, _fractions(file["causes"]["total"])) for file in files]
    total, *by_object = map(html.table, cause_tables(summary))
    return [
        html.paragraph(NOTE, soft=True),
        svg_plots.part_legend(PARTS),
        *bars,
        total,
        html.fold("By object", *by_object),
    ]


def _fractions(counts: Mapping[str, int]) -> list[float]:
    solved = counts["expected"] - counts["failed"]
    values = [solved, *(counts[part.name] for part in PARTS[1:])]
    return [value / counts["expected"] for value in values]
