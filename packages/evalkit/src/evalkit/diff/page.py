"""A difference as one HTML page, with pictures of newly failed and newly solved poses."""

from collections.abc import Mapping, Sequence

import pandas as pd

from evalkit.diff.deltas import Difference
from evalkit.diff.measures import MEASURES, Measure
from evalkit.diff.rules import Verdict
from evalkit.diff.sides import Side
from evalkit.diff.text import IDS, line_of
from evalkit.evaluation.scored_file import CaseKey
from evalkit.report import html
from evalkit.report.html import Section
from evalkit.report.page import cases
from evalkit.scores import DEFINITIONS
from evalkit.tables.model import Cell, Interval, Row, Table, TableColumn

NAN = float("nan")


def difference_page(difference: Difference, verdicts: Sequence[Verdict], pictures: int) -> str:
    """The HTML document.

    Args:
        difference: of the two files.
        verdicts: of the rules.
        pictures: largest number of pictures of newly failed poses, and of newly solved ones.
    """
    sides, counts = difference.sides, difference.counts
    title = f"{sides.b.name} against {sides.a.name}"
    sentences = [
        f"{len(difference.pairs)} expected poses are in both files. {counts['newly_failed']} newly fail, "
        f"{counts['newly_solved']} are newly solved; {counts['lost']} are found in {sides.a.name} only, "
        f"{counts['gained']} in {sides.b.name} only.",
        *[verdict.words for verdict in verdicts],
    ]
    if counts["unpaired"]:
        sentences.append(
            f"Left out: {len(difference.only_a)} poses expected of {sides.a.name} only, "
            f"{len(difference.only_b)} of {sides.b.name} only."
        )
    sections = [
        Section(heading="Changes", parts=[html.table(table) for table in tables_of(difference)]),
        Section(heading="Newly failed", parts=_changed(difference, difference.newly_failed, pictures)),
        Section(heading="Newly solved", parts=_changed(difference, difference.newly_solved, pictures)),
        Section(heading=f"Found in {sides.a.name} only", parts=_listed(difference.lost)),
        Section(heading=f"Found in {sides.b.name} only", parts=_listed(difference.gained)),
        Section(heading="Definitions", parts=[html.definitions(dict(DEFINITIONS))]),
        Section(heading="Inputs", parts=[html.definitions(dict((_input(sides.a), _input(sides.b))))]),
    ]
    return html.page(title, "".join(html.paragraph(line) for line in sentences), sections)


def tables_of(difference: Difference) -> list[Table]:
    """Means and medians of every measure in both files, and their deltas: fractions first, then errors."""
    a, b = difference.sides.a.name, difference.sides.b.name
    fractions = {name: measure for name, measure in MEASURES.items() if not measure.unit}
    errors = {name: measure for name, measure in MEASURES.items() if measure.unit}
    delta = (
        f"A delta is {b} minus {a} of a pose; the last column is the median of the deltas, not the difference of the "
        f"medians. 95 % intervals by resampling {difference.resampled}."
    )
    fails = f"A pose fails with an ADD(-S) of {difference.limit_diameters:g} diameter or more."
    return [
        _table(difference, "Fractions", fractions, f"{delta} A missing estimate counts as 0. {fails}"),
        _table(difference, "Errors", errors, f"{delta} Over the poses found in both files."),
    ]


def _table(difference: Difference, kind: str, measures: Mapping[str, Measure], note: str) -> Table:
    a, b = difference.sides.a.name, difference.sides.b.name
    digits = max(measure.digits for measure in measures.values())
    columns = [
        TableColumn(key="measure", heading="measure"),
        TableColumn(key="about", heading="meaning"),
        TableColumn(key="poses", heading="poses", digits=0),
        *[
            TableColumn(key=f"{statistic}_{side}", heading=heading, group=statistic, digits=digits)
            for statistic in ("mean", "median")
            for side, heading in (("a", a), ("b", b), ("delta", "delta"))
        ],
    ]
    rows = []
    for name, measure in measures.items():
        change = difference.changes[name]
        label = f"{name}, {measure.unit}" if measure.unit else name
        cells: dict[str, Cell] = {"measure": label, "about": measure.text, "poses": change.poses}
        cells |= {"mean_a": change.mean_a, "mean_b": change.mean_b}
        cells["mean_delta"] = _with_ends(change.mean_delta, change.mean_interval)
        if not measure.is_binary:
            cells |= {"median_a": change.median_a, "median_b": change.median_b}
            cells["median_delta"] = _with_ends(change.median_delta, change.median_interval)
        rows.append(Row(cells=cells))
    return Table(title=f"{kind}: {b} against {a}", name=kind.lower(), columns=columns, rows=rows, note=note, best="")


def _with_ends(value: float, interval: tuple[float, float] | None) -> Interval:
    low, high = interval or (NAN, NAN)
    return Interval(value=value, low=low, high=high)


def _changed(difference: Difference, rows: pd.DataFrame, pictures: int) -> list[str]:
    if rows.empty:
        return []
    shown = _pictures(difference, rows.head(pictures))
    parts = [html.paragraph(f"{len(rows)} poses, the largest changes of ADD(-S) first.", soft=True), *shown]
    if difference.sides.evaluator is None:
        parts.append(html.paragraph("No pictures: an error table has no poses.", soft=True))
    return [*parts, html.fold(f"All {len(rows)} ({IDS})", *_listed(rows))]


def _listed(rows: pd.DataFrame) -> list[str]:
    return [html.items([line_of(row) for row in rows.to_dict("records")])]


def _pictures(difference: Difference, rows: pd.DataFrame) -> list[str]:
    sides = difference.sides
    scored = [side.scored for side in (sides.a, sides.b) if side.scored is not None]
    if sides.evaluator is None or len(scored) < 2:
        return []
    articles: list[str] = []
    for row in rows.to_dict("records"):
        key: CaseKey = (row["scene_id"], row["im_id"], row["gt_index"], -1.0, -1.0, 1)
        article = cases.case(sides.evaluator, scored, [{key: row["row_a"]}, {key: row["row_b"]}], key)
        if sum(map(len, articles)) + len(article) > cases.PICTURES_BYTES:
            break
        articles += [article] if article else []
    if not articles:
        return (
            [html.paragraph("No pictures: the dataset has no images of these poses.", soft=True)] if len(rows) else []
        )
    return [cases.legend(), html.cases(articles, len(scored))]


def _input(side: Side) -> tuple[str, str]:
    return side.name, f"{side.path}, sha256 {side.sha256}"
