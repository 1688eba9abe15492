"""A report's page from scores and pictures: cases and curves, words, tables, definitions, inputs."""

from collections.abc import Mapping, Sequence
from typing import Any

from evalkit.evaluation.evaluator import Evaluator
from evalkit.evaluation.scored_file import Scored
from evalkit.report import html, svg_plots
from evalkit.report.html import Section
from evalkit.report.page import about, bins, cases, convergence, failures, recall_curves, summary_text
from evalkit.tables.report_tables import comparison_tables, curve_tables, object_tables, total_tables

UNFOLDED_FILES = 1
"""With more files than this, the many tables by object are folded below the comparison."""


def report_page(evaluator: Evaluator, scored: Sequence[Scored], summary: Mapping[str, Any], worst: int) -> str:
    """The HTML document.

    Args:
        evaluator: of the files; it renders the contours.
        scored: result files in the summary's order.
        summary: of `evalkit.report.summary.summarise`.
        worst: number of worst cases shown as pictures; 0 shows no case.
    """
    styles = svg_plots.line_styles([item.file.is_initial for item in scored])
    key = svg_plots.legend([item.file.name for item in scored], styles)
    sections = [
        Section(heading="Typical and worst cases", parts=cases.first(evaluator, scored, worst)),
        Section(heading="Recall curves", parts=[key, recall_curves.figures(scored, styles)]),
        Section(heading="From perturbed initial poses", parts=_keyed(key, convergence.plots(summary, styles))),
        Section(heading="Summary", parts=summary_text.summary(summary)),
        Section(heading="Totals", parts=[*map(html.table, total_tables(summary)), *_ignored(summary)]),
        Section(heading="By object", parts=_objects(summary)),
        Section(heading="By level of perturbation", parts=[*map(html.table, curve_tables(summary))]),
        Section(heading="By visibility, distance and viewpoint", parts=_keyed(key, bins.parts(summary, styles))),
        Section(heading="Failures", parts=failures.parts(summary)),
        Section(heading="Further worst cases", parts=cases.further_worst(evaluator, scored, worst)),
        Section(heading="Missing estimates", parts=cases.missing(scored)),
        Section(heading="Definitions", parts=[html.definitions(summary["definitions"])]),
        Section(heading="Conventions", parts=[html.definitions(about.CONVENTIONS)]),
        Section(heading="Inputs and versions", parts=[html.definitions(about.inputs(summary))]),
    ]
    return html.page(f"Pose report: {summary['dataset']['name']}", summary_text.head(summary), sections)


def _keyed(key: str, parts: Sequence[str]) -> list[str]:
    """Parts below the legend of their plots."""
    return [key, *parts] if any(parts) else []


def _ignored(summary: Mapping[str, Any]) -> list[str]:
    return [
        html.paragraph(
            f"{file['name']}: {file['ignored_lines']} lines belong to no target or are outscored, and were left out.",
            soft=True,
        )
        for file in summary["files"]
        if file["ignored_lines"]
    ]


def _objects(summary: Mapping[str, Any]) -> list[str]:
    compared = html.beside(*map(html.table, comparison_tables(summary)))
    by_file = object_tables(summary)
    if len(by_file) <= UNFOLDED_FILES:
        return [html.table(table) for tables in by_file.values() for table in tables]
    folded = [
        html.fold(f"All scores and errors of {name} by object", *map(html.table, tables))
        for name, tables in by_file.items()
    ]
    return [compared, *folded]
