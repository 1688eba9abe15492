"""Tables of the paper's refinement experiments: before and after, several methods side by side, loss ablation.

The experiments are section 4.3 ("Detection refinement") of the 2018 paper: table 1 (VSS of every object and a total),
table 2a (mean rotation error, mean translation error along each camera axis, ADD at 0.1 diameter) and table 2b (VSS of
every sequence for networks trained with different losses).

Totals of the paper's tables are means over the objects (or sequences), each counted once however many poses it has:
the columns of tables 1 and 2b average to their printed totals, and weighted with the lengths of the sequences they
would not. That is `of="groups"` here; `of="poses"` counts each pose once, as the report's totals do.
"""

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np
import pandas as pd
from jaxtyping import Float, Int

from evalkit.error_table import column
from evalkit.evaluation.scored_file import Scored
from evalkit.inputs.result_files import ResultFile
from evalkit.scores.bootstrap import Resampling, resample, units_of
from evalkit.scores.per_pose import Values, score_values
from evalkit.tables.model import Cell, Column, Interval, Row, Table

Array = np.ndarray
By = Literal["object", "scene"]
Of = Literal["groups", "poses"]
KEY: Mapping[By, str] = {"object": "obj_id", "scene": "scene_id"}
NO_REFINEMENT = "no refinement"


@dataclass(frozen=True, kw_only=True, eq=False)
class Method:
    """What a row (or a column) of the tables is about: a result file under the name that readers know it by.

    Attributes:
        name: for tables.
        table: errors.
        is_start: whether these are the poses that the other methods started from.
    """

    name: str
    table: pd.DataFrame
    is_start: bool = False


def methods_of(scored: Sequence[Scored]) -> list[Method]:
    """Result files as methods, named by what their sidecars say."""
    names = method_names([item.file for item in scored])
    return [
        Method(name=name, table=item.table, is_start=item.file.is_start)
        for name, item in zip(names, scored, strict=True)
    ]


def method_names(files: Sequence[ResultFile]) -> list[str]:
    """Names that differ: sidecar's `method` and `loss`, start poses "no refinement"; the file's name where these fail.

    A loss is looked for as `loss` in the sidecar and in its `settings`.
    """
    said = [_said(file) for file in files]
    count = Counter(said)
    return [
        (f"{name} ({file.name})" if name else file.name) if count[name] > 1 or not name else name
        for name, file in zip(said, files, strict=True)
    ]


def _said(file: ResultFile) -> str:
    if file.is_start:
        return NO_REFINEMENT
    settings = file.sidecar.get("settings")
    inner = settings.get("loss") if isinstance(settings, dict) else None
    method, loss = file.sidecar.get("method"), file.sidecar.get("loss", inner)
    parts = [method if isinstance(method, str) else "", f"{loss} loss" if isinstance(loss, str) and loss else ""]
    return ", ".join(part for part in parts if part)


ERROR_COLUMNS = (
    Column(key="re_deg_mean", heading="rotation", unit="deg", digits=2, better="lower"),
    Column(key="re_sym_deg_mean", heading="rotation sym.", unit="deg", digits=2, better="lower"),
    Column(key="tx_mm_mean", heading="x", group="translation", unit="mm", digits=2, better="lower"),
    Column(key="ty_mm_mean", heading="y", group="translation", unit="mm", digits=2, better="lower"),
    Column(key="tz_mm_mean", heading="z", group="translation", unit="mm", digits=2, better="lower"),
    Column(key="add_recall_0.1d", heading="ADD 0.1 d", unit="%", digits=1, better="higher"),
    Column(key="add_s_recall_0.1d", heading="ADD(-S) 0.1 d", unit="%", digits=1, better="higher"),
    Column(key="vss_mean", heading="VSS", digits=3, better="higher"),
)
COUNT_COLUMNS = (
    Column(key="expected", heading="poses", digits=0),
    Column(key="missing", heading="missing", digits=0),
)
ERRORS_NOTE = (
    "Rotation and translation errors are means over found poses, along the camera's right, down and forward axes; "
    "recalls and VSS are over all expected poses, a missing one failing."
)
OF_NOTE: Mapping[Of, str] = {
    "groups": "A total is the mean over {groups}, each counted once.",
    "poses": "A total is over all poses, each counted once.",
}


def before_after_table(methods: Sequence[Method], *, by: By = "object", resamples: int = 0, seed: int = 0) -> Table:
    """Every object (or scene) before and after, a row for each method, then both totals.

    Args:
        methods: starts first, see `methods_of`.
        by: what a block of rows is about.
        resamples: for 95 % bootstrap intervals, 0 for none.
        seed: of the resampling.
    """
    groups = sorted({int(value) for method in methods for value in method.table[KEY[by]].unique()})
    rows = []
    for group in groups:
        for method in methods:
            cells = _cells(method.table[method.table[KEY[by]] == group], None, resamples, seed)
            rows.append(Row(cells=cells | {"group": str(group), "method": method.name}, group=str(group)))
    for label, of in ((f"mean of {by}s", "groups"), ("all poses", "poses")):
        for method in methods:
            groups_of_row = column(method.table, KEY[by]).astype(np.int64) if of == "groups" else None
            cells = _cells(method.table, groups_of_row, resamples, seed)
            rows.append(Row(cells=cells | {"group": label, "method": method.name}, group=label, total=True))
    return Table(
        title=f"Before and after refinement, by {by}",
        name=f"refinement-{by}s",
        columns=[
            Column(key="group", heading=by),
            Column(key="method", heading="method"),
            *COUNT_COLUMNS,
            *ERROR_COLUMNS,
        ],
        rows=rows,
        note=_note(methods, resamples, ERRORS_NOTE),
    )


def error_table(
    methods: Sequence[Method], *, of: Of = "groups", by: By = "object", resamples: int = 0, seed: int = 0
) -> Table:
    """Table 2a of the paper: a row for each method, all objects together.

    Args:
        methods: starts first.
        of: whether objects or poses are counted once, see the module.
        by: what a group is.
        resamples: for 95 % bootstrap intervals, 0 for none.
        seed: of the resampling.
    """
    rows = []
    for method in methods:
        groups_of_row = column(method.table, KEY[by]).astype(np.int64) if of == "groups" else None
        rows.append(Row(cells=_cells(method.table, groups_of_row, resamples, seed) | {"method": method.name}))
    return Table(
        title="Mean errors and recall",
        name="refinement",
        columns=[Column(key="method", heading="method"), *COUNT_COLUMNS, *ERROR_COLUMNS],
        rows=rows,
        note=_note(methods, resamples, ERRORS_NOTE, OF_NOTE[of].format(groups=f"{by}s")),
    )


def score_by_group_table(
    methods: Sequence[Method],
    *,
    score: str = "vss_mean",
    of: Of = "groups",
    by: By = "object",
    resamples: int = 0,
    seed: int = 0,
) -> Table:
    """Table 1 of the paper: one score, a row for each method, a column for each object and the total.

    Args:
        methods: starts first.
        score: key of a score, one of `ERROR_COLUMNS`.
        of: what the total counts once, see the module.
        by: what a column is about.
        resamples: for 95 % bootstrap intervals, 0 for none.
        seed: of the resampling.
    """
    shown = _column_of(score)
    groups = sorted({int(value) for method in methods for value in method.table[KEY[by]].unique()})
    named = {str(group): f"{by} {group}" for group in groups} | {"total": "total"}
    columns = [
        Column(key=f"{score}_{key}", heading=heading, unit=shown.unit, digits=shown.digits, better=shown.better)
        for key, heading in named.items()
    ]
    rows = []
    for method in methods:
        cells: dict[str, Cell] = {"method": method.name}
        values = _by_group(method, groups, score, by, of, resamples, seed)
        cells |= {f"{score}_{key}": value for key, value in values.items()}
        rows.append(Row(cells=cells))
    return Table(
        title=f"{shown.heading} by {by}",
        name=f"refinement-{score.replace('_', '-').replace('.', '')}-{by}s",
        columns=[Column(key="method", heading="method"), *columns],
        rows=rows,
        note=_note(methods, resamples, OF_NOTE[of].format(groups=f"{by}s")),
    )


def ablation_table(
    methods: Sequence[Method],
    *,
    score: str = "vss_mean",
    of: Of = "groups",
    by: By = "scene",
    resamples: int = 0,
    seed: int = 0,
) -> Table:
    """Table 2b of the paper: one score, a row for each sequence and the total, a column for each method or loss.

    See `score_by_group_table` for the arguments.
    """
    shown = _column_of(score)
    groups = sorted({int(value) for method in methods for value in method.table[KEY[by]].unique()})
    found = [_by_group(method, groups, score, by, of, resamples, seed) for method in methods]
    rows = [
        Row(
            cells={"group": name} | {f"{score}_{place}": values[name] for place, values in enumerate(found)},
            total=name == "total",
        )
        for name in [*map(str, groups), "total"]
    ]
    columns = [
        Column(key=f"{score}_{place}", heading=method.name, unit=shown.unit, digits=shown.digits, better=shown.better)
        for place, method in enumerate(methods)
    ]
    return Table(
        title=f"{shown.heading} by {by}, methods side by side",
        name=f"ablation-{score.replace('_', '-').replace('.', '')}",
        columns=[Column(key="group", heading=by), *columns],
        rows=rows,
        note=_note(methods, resamples, OF_NOTE[of].format(groups=f"{by}s")),
        best="row",
    )


def _note(methods: Sequence[Method], resamples: int, *parts: str) -> str:
    said = list(parts)
    if resamples:
        units = dict.fromkeys(units_of(method.table).text for method in methods if len(method.table))
        said.append(f"In brackets: 95 % bootstrap intervals, {' or '.join(units)} resampled.")
    return " ".join(said)


def _column_of(score: str) -> Column:
    return {item.key: item for item in ERROR_COLUMNS}[score]


def _by_group(
    method: Method, groups: Sequence[int], score: str, by: By, of: Of, resamples: int, seed: int
) -> dict[str, Cell]:
    """One score of each group by its number, and "total"."""
    key = column(method.table, KEY[by]).astype(np.int64)
    cells: dict[str, Cell] = {}
    for group in groups:
        part = method.table[key == group]
        cells[str(group)] = _cells(part, None, resamples, seed, [score])[score]
    cells["total"] = _cells(method.table, key if of == "groups" else None, resamples, seed, [score])[score]
    return cells


def _cells(
    table: pd.DataFrame,
    groups: Int[Array, " n"] | None,
    resamples: int,
    seed: int,
    keys: Sequence[str] = tuple(shown.key for shown in ERROR_COLUMNS),
) -> dict[str, Cell]:
    """Counts and scores of a table; with `groups` scores are means over groups."""
    values = score_values(table)
    resampling = resample(units_of(table), resamples, seed) if resamples and len(table) else None
    missing = int((column(table, "found") == 0).sum())
    cells: dict[str, Cell] = {"expected": len(table), "missing": missing}
    return cells | {key: _cell(values[key], groups, resampling) for key in keys}


def _cell(values: Values, groups: Int[Array, " n"] | None, resampling: Resampling | None) -> Cell:
    assert values.statistic == "mean"
    parts = _parts(values.per_row, groups)
    value = _mean(np.array([_mean(part) for part in parts]))
    if resampling is None:
        return value
    sampled = resampling.means(parts)
    known = ~np.isnan(sampled)
    with np.errstate(invalid="ignore"):
        means = np.where(known, sampled, 0.0).sum(axis=0) / known.sum(axis=0)
    ends = resampling.ends(means, resampling.units_with(values.per_row))
    return value if ends is None else Interval(value=value, low=ends[0], high=ends[1])


def _parts(per_row: Float[Array, " n"], groups: Int[Array, " n"] | None) -> Float[Array, "g n"]:
    """The values of each group, NaN elsewhere; without groups all values as one."""
    if groups is None or not len(groups):
        return per_row[None]
    return np.stack([np.where(groups == group, per_row, np.nan) for group in np.unique(groups)])


def _mean(values: Float[Array, " n"]) -> float:
    kept = values[~np.isnan(values)]
    return float(kept.mean()) if len(kept) else float("nan")
