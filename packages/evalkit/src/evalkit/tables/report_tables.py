"""The tables of a report, defined once for the page, Markdown and LaTeX."""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any, Literal

from evalkit.scores.failure_causes import CAUSES
from evalkit.tables.convergence import level_tables
from evalkit.tables.model import Better, Cell, Interval, Row, Table, TableColumn

Values = Mapping[str, Any]
Best = Literal["column", "row", ""]
TOTAL = "total"


def _column(group: str, heading: str, key: str, unit: str, digits: int, better: Better = "") -> TableColumn:
    return TableColumn(key=key, heading=heading, group=group, unit=unit, digits=digits, better=better)


SCORE_COLUMNS = (
    _column("poses", "expected", "expected", "", 0),
    _column("poses", "missing", "missing", "", 0, "lower"),
    _column("VSS mean", "all", "vss_mean", "", 3, "higher"),
    _column("VSS mean", "found", "vss_mean_found", "", 3, "higher"),
    _column("recall at 0.1 diameter", "ADD", "add_recall_0.1d", "%", 1, "higher"),
    _column("recall at 0.1 diameter", "ADI", "adi_recall_0.1d", "%", 1, "higher"),
    _column("recall at 0.1 diameter", "ADD(-S)", "add_s_recall_0.1d", "%", 1, "higher"),
    _column("fraction", "5 cm 5°", "5cm5deg", "%", 1, "higher"),
    _column("fraction", "proj. 5 px", "proj_5px", "%", 1, "higher"),
    _column("fraction", "diverged", "diverged", "%", 1, "lower"),
)
AREA_COLUMNS = (
    _column("AUC to 100 mm", "ADD", "add_auc_100mm", "", 3, "higher"),
    _column("AUC to 100 mm", "ADI", "adi_auc_100mm", "", 3, "higher"),
    _column("AUC to 100 mm", "ADD(-S)", "add_s_auc_100mm", "", 3, "higher"),
    _column("BOP average recall", "AR", "ar", "", 3, "higher"),
    _column("BOP average recall", "without VSD", "ar_without_vsd", "", 3, "higher"),
    _column("BOP average recall", "VSD", "ar_vsd", "", 3, "higher"),
    _column("BOP average recall", "MSSD", "ar_mssd", "", 3, "higher"),
    _column("BOP average recall", "MSPD", "ar_mspd", "", 3, "higher"),
)
PRECISION_COLUMNS = (
    _column("BOP24 average precision", "AP", "ap", "", 3, "higher"),
    _column("BOP24 average precision", "MSSD", "ap_mssd", "", 3, "higher"),
    _column("BOP24 average precision", "MSPD", "ap_mspd", "", 3, "higher"),
    _column("BOP25", "AP MSSD mm", "ap_mssd_mm", "", 3, "higher"),
    _column("counted", "estimates", "estimates", "", 0),
    _column("counted", "instances", "instances", "", 0),
    _column("left out", "outscored", "outscored", "", 0),
    _column("left out", "absent object", "absent", "", 0),
)


def _mean_and_median(group: str, key: str, unit: str, digits: int = 2) -> tuple[TableColumn, TableColumn]:
    return (
        _column(group, "mean", f"{key}_mean", unit, digits, "lower"),
        _column(group, "median", f"{key}_median", unit, digits, "lower"),
    )


POSE_COLUMNS = (
    _column("poses", "found", "found", "", 0),
    *_mean_and_median("rotation", "re_deg", "deg"),
    *_mean_and_median("rotation sym.", "re_sym_deg", "deg"),
    *_mean_and_median("camera x", "tx_mm", "mm"),
    *_mean_and_median("camera y", "ty_mm", "mm"),
    *_mean_and_median("camera z", "tz_mm", "mm"),
)
SURFACE_COLUMNS = (
    *_mean_and_median("centre", "te_mm", "mm"),
    *_mean_and_median("ADD", "add_mm", "mm"),
    *_mean_and_median("ADI", "adi_mm", "mm"),
    *_mean_and_median("MSSD", "mssd_mm", "mm"),
    *_mean_and_median("MSPD", "mspd_px", "px"),
    _column("run time", "an image", "time_s_per_image", "s", 3, "lower"),
)
ERRORS_NOTE = "Errors are over the estimates found."
PRECISION_NOTE = "Over all lines of the file with their scores, and all instances; a total is the mean over objects."
SCORE_TABLES = (
    ("Scores", "scores", SCORE_COLUMNS, ""),
    ("Areas under recall curves", "areas", AREA_COLUMNS, ""),
    ("6D detection", "precision", PRECISION_COLUMNS, PRECISION_NOTE),
    ("Rotation and translation errors", "pose-errors", POSE_COLUMNS, ERRORS_NOTE),
    ("Distances of centres, surfaces and projections", "surface-errors", SURFACE_COLUMNS, ERRORS_NOTE),
)
"""Title, name, columns and note of the tables of every file, in total and by object."""
COMPARED = (
    _column("", "VSS mean", "vss_mean", "", 3, "higher"),
    _column("", "ADD(-S) recall at 0.1 diameter", "add_s_recall_0.1d", "%", 1, "higher"),
    _column("", "Median rotation error (best symmetry)", "re_sym_deg_median", "deg", 1, "lower"),
    _column("", "Median distance of the centres", "te_mm_median", "mm", 1, "lower"),
)
"""Scores compared between files, object by object."""


BIN_AXES: Mapping[str, tuple[str, str, float]] = {
    "visibility": ("visible fraction of the ground-truth silhouette", "visib_fract", 1.0),
    "distance": ("camera z of the object's centre, m", "distance_m", 1.0),
    "azimuth": ("camera's azimuth seen from the object, degrees", "view_azimuth_deg", 1.0),
    "elevation": ("camera's elevation seen from the object, degrees", "view_elevation_deg", 1.0),
}
"""Axes of the bins: label with unit, column of the error table, factor to that unit."""
BIN_COLUMNS = (
    _column("", "mean VSS", "vss_mean", "", 3, "higher"),
    _column("", "ADD(-S) 0.1 d", "add_s_recall_0.1d", "%", 1, "higher"),
    _column("median error", "rotation sym.", "re_sym_deg_median", "deg", 2, "lower"),
    _column("median error", "z", "tz_mm_median", "mm", 2, "lower"),
    _column("median error", "ADD", "add_mm_median", "mm", 2, "lower"),
)


CAUSE_COLUMNS = (
    _column("poses", "expected", "expected", "", 0),
    _column("poses", "failed", "failed", "%", 1),
    *(
        TableColumn(key=cause, heading=cause, group="failed because of", unit="%", digits=1, about=text)
        for cause, text in CAUSES.items()
    ),
)


def report_tables(summary: Mapping[str, Any]) -> list[Table]:
    """All tables of a report, in the page's order.

    Args:
        summary: of `evalkit.report.summary.summarise`.
    """
    by_file = [table for tables in object_tables(summary).values() for table in tables]
    return [
        *total_tables(summary),
        *comparison_tables(summary),
        *by_file,
        *bin_tables(summary),
        *cause_tables(summary),
        *curve_tables(summary),
    ]


def total_tables(summary: Mapping[str, Any]) -> list[Table]:
    """Scores and errors in total, a row for each result file."""
    rows = [(file["name"], *_scores(file, TOTAL)) for file in summary["files"]]
    first = TableColumn(key="name", heading="result file")
    resampled = ", ".join(dict.fromkeys(_resampled(file["intervals"]["total"]) for file in summary["files"]))
    interval_note = _interval_note(resampled)
    tables = [
        _table(title, name, first, rows, columns, note=note if index else interval_note)
        for index, (title, name, columns, note) in enumerate(SCORE_TABLES)
    ]
    return [table for table in tables if len(table.columns) > 1]


def object_tables(summary: Mapping[str, Any]) -> dict[str, list[Table]]:
    """For each result file, by name: scores and errors of its objects and in total."""
    tables = {}
    for index, file in enumerate(summary["files"]):
        rows = [(_group_name(group), *_scores(file, group)) for group in (*file["by_object"], TOTAL)]
        first = TableColumn(key="name", heading="object")
        described = [
            _table(f"{title} of {file['name']} by object", f"{slug}-objects-{index}", first, rows, columns, True, note)
            for title, slug, columns, note in SCORE_TABLES
        ]
        tables[file["name"]] = [table for table in described if len(table.columns) > 1]
    return tables


def comparison_tables(summary: Mapping[str, Any]) -> list[Table]:
    """One table for each of `COMPARED`, objects down and result files across; none for a single file."""
    files = summary["files"]
    if len(files) < 2:
        return []
    obj_ids = sorted({obj_id for file in files for obj_id in file["by_object"]}, key=int)
    tables = []
    for shown in COMPARED:
        columns = [replace(shown, key=f"{shown.key}_{index}", heading=file["name"]) for index, file in enumerate(files)]
        rows = []
        for group in (*obj_ids, TOTAL):
            cells: dict[str, Cell] = {"object": _group_name(group)}
            for column, file in zip(columns, files, strict=True):
                cells[column.key] = _cell(*_scores(file, group), shown.key)
            rows.append(Row(cells=cells, total=group == TOTAL))
        tables.append(
            Table(
                title=shown.heading,
                name=f"compare-{shown.key.replace('_', '-').replace('.', '')}",
                columns=[TableColumn(key="object", heading="object"), *columns],
                rows=rows,
                best="row",
            )
        )
    return tables


def _scores(file: Values, group: str) -> tuple[Values, Values]:
    """Scores and intervals of an object of a file, or of all objects under `TOTAL`; empty without that object."""
    if group == TOTAL:
        return file["total"], file["intervals"]["total"]["intervals"]
    return file["by_object"].get(group, {}), file["intervals"]["by_object"].get(group, {}).get("intervals", {})


def _group_name(group: str) -> str:
    return group if group == TOTAL else f"object {group}"


def bin_tables(summary: Mapping[str, Any]) -> list[Table]:
    """One table for each axis of `BIN_AXES`: a row for each bin of each result file, the best of a bin bold."""
    several = len(summary["files"]) > 1
    tables = []
    for axis, (label, name, factor) in BIN_AXES.items():
        rows: dict[tuple[float, int], dict[str, Cell]] = {}
        for index, file in enumerate(summary["files"]):
            for record in file["bins"][axis]:
                low, high = factor * record[f"{name}_low"], factor * record[f"{name}_high"]
                cells = rows.setdefault((low, index), {"low": low, "high": high, "expected": record["expected"]})
                cells[record["score"]] = _cell(record, {"value": (record["low"], record["high"])}, "value")
                cells |= {"found": record["found"]} | ({"file": file["name"]} if several else {})
        if rows:
            digits = 0 if all(low == round(low) for low, _ in rows) else 2
            first = [_column(axis, heading, key, "", digits) for heading, key in (("from", "low"), ("to", "high"))]
            first += [TableColumn(key="file", heading="result file")] if several else []
            counts = [_column("poses", key, key, "", 0) for key in ("expected", "found")]
            described = [Row(cells=cells, group=f"{low:g}") for (low, _), cells in sorted(rows.items())]
            tables.append(
                Table(
                    title=f"By {axis}: {label}",
                    name=f"bins-{axis}",
                    columns=[*first, *counts, *BIN_COLUMNS],
                    rows=described,
                    best="column" if several else "",
                )
            )
    return tables


def cause_tables(summary: Mapping[str, Any]) -> list[Table]:
    """Causes of failures (`evalkit.scores.failure_causes`): causes down, files across; then a table for each file."""
    files = summary["files"]
    columns = [TableColumn(key="cause", heading="cause")]
    rows: dict[str, dict[str, Cell]] = {
        cause: {"cause": cause, "meaning": CAUSES.get(cause, "")} for cause in (*CAUSES, "all failures")
    }
    for index, file in enumerate(files):
        poses, fraction = f"poses_{index}", f"fraction_{index}"
        columns += [_column(file["name"], "poses", poses, "", 0), _column(file["name"], "fraction", fraction, "%", 1)]
        counts = file["causes"]["total"]
        for cause, cells in rows.items():
            count = counts["failed" if cause == "all failures" else cause]
            cells |= {poses: count, fraction: count / counts["expected"] if counts["expected"] else None}
    columns.append(TableColumn(key="meaning", heading="meaning"))
    return [
        Table(
            title="Failures by cause",
            name="causes",
            columns=columns,
            rows=[Row(cells=cells, total=cause == "all failures") for cause, cells in rows.items()],
            note="Fractions are of all expected poses; every failed pose has one cause.",
            best="",
        ),
        *[_object_causes(file, index) for index, file in enumerate(files)],
    ]


def _object_causes(file: Mapping[str, Any], index: int) -> Table:
    return Table(
        title=f"Failures of {file['name']} by cause and object",
        name=f"causes-objects-{index}",
        columns=[TableColumn(key="name", heading="object"), *CAUSE_COLUMNS],
        rows=[
            Row(cells={"name": _group_name(group)} | _cause_cells(counts), total=group == TOTAL)
            for group, counts in file["causes"].items()
        ],
        best="",
    )


def _cause_cells(counts: Mapping[str, int]) -> dict[str, Cell]:
    expected = counts["expected"]
    fractions = {key: counts[key] / expected if expected else None for key in ("failed", *CAUSES)}
    return {"expected": expected, **fractions}


def curve_tables(summary: Mapping[str, Any]) -> list[Table]:
    """Fractions and errors by level of perturbation, for files with perturbed initial poses."""
    curves = {
        file["name"]: {
            kind: [{key: float("nan") if value is None else value for key, value in point.items()} for point in points]
            for kind, points in file["by_level"].items()
        }
        for file in summary["files"]
        if file["by_level"]
    }
    return level_tables(curves)


def _table(
    title: str,
    slug: str,
    first: TableColumn,
    rows: Sequence[tuple[str, Values, Values]],
    columns: Sequence[TableColumn],
    total_last: bool = False,
    note: str = "",
) -> Table:
    """A table with a row for each name, its scores and their intervals; columns without any value are left out."""
    kept = [column for column in columns if any(values.get(column.key) is not None for _, values, _ in rows)]
    described = [
        Row(
            cells={first.key: name} | {column.key: _cell(values, intervals, column.key) for column in kept},
            total=total_last and index == len(rows) - 1,
        )
        for index, (name, values, intervals) in enumerate(rows)
    ]
    columns = [first, *kept]
    best: Best = "" if total_last else "column"  # objects are not compared
    return Table(title=title, name=slug, columns=columns, rows=described, note=note, best=best)


def _cell(values: Values, intervals: Values, key: str) -> Cell:
    value, ends = values.get(key), intervals.get(key)
    if value is None or ends is None or None in ends:
        cell: Cell = value
        return cell
    return Interval(value=float(value), low=float(ends[0]), high=float(ends[1]))


def _resampled(intervals: Values) -> str:
    return str(intervals["resampled"]) if intervals["units"] > 1 else ""


def _interval_note(resampled: str) -> str:
    if not resampled:
        return "No intervals: they need two scenes or two images."
    return f"In brackets: 95 % bootstrap intervals, resampled by {resampled.replace(', ', ' or ')}."
