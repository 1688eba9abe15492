"""Tables of the paper's refinement experiments: before and after, several methods side by side, loss ablation.

The experiments are section 4.3 ("Detection refinement") of the 2018 paper: table 1 (VSS of every object and a total),
table 2a (mean rotation error, mean translation error along each camera axis, ADD at 0.1 diameter) and table 2b (VSS of
every sequence for networks trained with different losses).

Totals of the paper's tables are means over the objects (or sequences), each counted once however many poses it has:
the columns of tables 1 and 2b average to their printed totals, and weighted with the lengths of the sequences they
would not. That is `mean_over="groups"` here; `mean_over="poses"` counts each pose once, as the report's totals do.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
import pandas as pd
from jaxtyping import Float, Int

from evalkit.error_table import column
from evalkit.evaluation.scored_file import Scored
from evalkit.inputs.result_files import method_names
from evalkit.scores.bootstrap import Resampling, resample, units_of
from evalkit.scores.per_pose import Values, score_values
from evalkit.tables.model import Cell, Interval, Row, Table, TableColumn

By = Literal["object", "scene"]
MeanOver = Literal["groups", "poses"]
KEY: Mapping[By, str] = {"object": "obj_id", "scene": "scene_id"}


@dataclass(frozen=True, kw_only=True, eq=False)
class Method:
    """The subject of a row or column: a result file under its name for readers.

    Attributes:
        name: for tables.
        table: errors.
        is_initial: whether these are the initial poses of the other methods.
    """

    name: str
    table: pd.DataFrame
    is_initial: bool = False


def methods_of(scored: Sequence[Scored]) -> list[Method]:
    """Result files as methods, named by their sidecars."""
    names = method_names([item.file for item in scored])
    return [
        Method(name=name, table=item.table, is_initial=item.file.is_initial)
        for name, item in zip(names, scored, strict=True)
    ]


ERROR_COLUMNS = (
    TableColumn(key="re_deg_mean", heading="rotation", unit="deg", digits=2, better="lower"),
    TableColumn(key="re_sym_deg_mean", heading="rotation sym.", unit="deg", digits=2, better="lower"),
    TableColumn(key="tx_mm_mean", heading="x", group="translation", unit="mm", digits=2, better="lower"),
    TableColumn(key="ty_mm_mean", heading="y", group="translation", unit="mm", digits=2, better="lower"),
    TableColumn(key="tz_mm_mean", heading="z", group="translation", unit="mm", digits=2, better="lower"),
    TableColumn(key="add_recall_0.1d", heading="ADD 0.1 d", unit="%", digits=1, better="higher"),
    TableColumn(key="add_s_recall_0.1d", heading="ADD(-S) 0.1 d", unit="%", digits=1, better="higher"),
    TableColumn(key="vss_mean", heading="VSS", digits=3, better="higher"),
)
SCORE: Mapping[str, TableColumn] = {shown.key: shown for shown in ERROR_COLUMNS}
METHOD_COLUMN = TableColumn(key="method", heading="method")
COUNT_COLUMNS = (
    TableColumn(key="expected", heading="poses", digits=0),
    TableColumn(key="missing", heading="missing", digits=0),
)
ERRORS_NOTE = (
    "Rotation and translation errors are means over found poses, along the camera's right, down and forward axes; "
    "recalls and VSS are over all expected poses, a missing one failing."
)
MEAN_NOTE: Mapping[MeanOver, str] = {
    "groups": "A total is the mean over {groups}, each counted once.",
    "poses": "A total is over all poses, each counted once.",
}


def before_after_table(methods: Sequence[Method], *, by: By = "object", resamples: int = 0, seed: int = 0) -> Table:
    """Every object (or scene) before and after, a row for each method, then both totals.

    Args:
        methods: initial poses first, see `methods_of`.
        by: group of a block of rows.
        resamples: for 95 % bootstrap intervals, 0 for none.
        seed: of the resampling.
    """
    rows = []
    for group in _group_ids(methods, by):
        for method in methods:
            cells = _cells(method.table[method.table[KEY[by]] == group], None, resamples, seed)
            rows.append(Row(cells=cells | {"group": str(group), "method": method.name}, group=str(group)))
    totals: tuple[tuple[str, MeanOver], ...] = ((f"mean of {by}s", "groups"), ("all poses", "poses"))
    for label, mean_over in totals:
        for method in methods:
            cells = _cells(method.table, _groups(method, by, mean_over), resamples, seed)
            rows.append(Row(cells=cells | {"group": label, "method": method.name}, group=label, total=True))
    first = TableColumn(key="group", heading=by)
    return Table(
        title=f"Before and after refinement, by {by}",
        name=f"refinement-{by}s",
        columns=[first, METHOD_COLUMN, *COUNT_COLUMNS, *ERROR_COLUMNS],
        rows=rows,
        note=_note(methods, resamples, ERRORS_NOTE),
    )


def error_table(
    methods: Sequence[Method], *, mean_over: MeanOver = "groups", by: By = "object", resamples: int = 0, seed: int = 0
) -> Table:
    """Table 2a of the paper: a row for each method, all objects together.

    Args:
        methods: initial poses first.
        mean_over: whether objects or poses are counted once, see the module.
        by: kind of the groups.
        resamples: for 95 % bootstrap intervals, 0 for none.
        seed: of the resampling.
    """
    rows = []
    for method in methods:
        cells = _cells(method.table, _groups(method, by, mean_over), resamples, seed)
        rows.append(Row(cells=cells | {"method": method.name}))
    return Table(
        title="Mean errors and recall",
        name="refinement",
        columns=[METHOD_COLUMN, *COUNT_COLUMNS, *ERROR_COLUMNS],
        rows=rows,
        note=_note(methods, resamples, ERRORS_NOTE, MEAN_NOTE[mean_over].format(groups=f"{by}s")),
    )


def score_by_group_table(
    methods: Sequence[Method],
    *,
    score: str = "vss_mean",
    mean_over: MeanOver = "groups",
    by: By = "object",
    resamples: int = 0,
    seed: int = 0,
) -> Table:
    """Table 1 of the paper: one score, a row for each method, a column for each object and the total.

    Args:
        methods: initial poses first.
        score: key of a score, one of `ERROR_COLUMNS`.
        mean_over: unit that the total counts once, see the module.
        by: group of a column.
        resamples: for 95 % bootstrap intervals, 0 for none.
        seed: of the resampling.
    """
    by_method = _by_method(methods, score, by, mean_over, resamples, seed)
    headings = {str(group): f"{by} {group}" for group in _group_ids(methods, by)} | {"total": "total"}
    return Table(
        title=f"{SCORE[score].heading} by {by}",
        name=f"refinement-{_slug(score)}-{by}s",
        columns=[METHOD_COLUMN, *_score_columns(score, headings)],
        rows=[
            Row(cells={"method": method.name} | {f"{score}_{key}": value for key, value in values.items()})
            for method, values in zip(methods, by_method, strict=True)
        ],
        note=_note(methods, resamples, MEAN_NOTE[mean_over].format(groups=f"{by}s")),
    )


def ablation_table(
    methods: Sequence[Method],
    *,
    score: str = "vss_mean",
    mean_over: MeanOver = "groups",
    by: By = "scene",
    resamples: int = 0,
    seed: int = 0,
) -> Table:
    """Table 2b of the paper: one score, a row for each sequence and the total, a column for each method or loss.

    See `score_by_group_table` for the arguments.
    """
    by_method = _by_method(methods, score, by, mean_over, resamples, seed)
    headings = {str(index): method.name for index, method in enumerate(methods)}
    return Table(
        title=f"{SCORE[score].heading} by {by}, methods side by side",
        name=f"ablation-{_slug(score)}",
        columns=[TableColumn(key="group", heading=by), *_score_columns(score, headings)],
        rows=[
            Row(
                cells={"group": group}
                | {f"{score}_{number}": values[group] for number, values in enumerate(by_method)},
                total=group == "total",
            )
            for group in [*map(str, _group_ids(methods, by)), "total"]
        ],
        note=_note(methods, resamples, MEAN_NOTE[mean_over].format(groups=f"{by}s")),
        best="row",
    )


def _note(methods: Sequence[Method], resamples: int, *parts: str) -> str:
    sentences = list(parts)
    if resamples:
        units = dict.fromkeys(units_of(method.table).text for method in methods if len(method.table))
        sentences.append(f"In brackets: 95 % bootstrap intervals, {' or '.join(units)} resampled.")
    return " ".join(sentences)


def _slug(score: str) -> str:
    return score.replace("_", "-").replace(".", "")


def _score_columns(score: str, headings: Mapping[str, str]) -> list[TableColumn]:
    """The score's column once for each heading, under keys that end in the headings' keys."""
    return [replace(SCORE[score], key=f"{score}_{key}", heading=heading, group="") for key, heading in headings.items()]


def _group_ids(methods: Sequence[Method], by: By) -> list[int]:
    """Objects or scenes of any method, in order."""
    return sorted({int(value) for method in methods for value in method.table[KEY[by]].unique()})


def _groups(method: Method, by: By, mean_over: MeanOver) -> Int[np.ndarray, " n"] | None:
    """The group of each row, for means over groups; None for means over poses."""
    return column(method.table, KEY[by]).astype(np.int64) if mean_over == "groups" else None


def _by_method(
    methods: Sequence[Method], score: str, by: By, mean_over: MeanOver, resamples: int, seed: int
) -> list[dict[str, Cell]]:
    """For each method one score of each group by its number, and "total"."""
    group_ids = _group_ids(methods, by)
    return [
        {
            str(group): _cells(method.table[method.table[KEY[by]] == group], None, resamples, seed, [score])[score]
            for group in group_ids
        }
        | {"total": _cells(method.table, _groups(method, by, mean_over), resamples, seed, [score])[score]}
        for method in methods
    ]


def _cells(
    table: pd.DataFrame,
    groups: Int[np.ndarray, " n"] | None,
    resamples: int,
    seed: int,
    keys: Sequence[str] = tuple(SCORE),
) -> dict[str, Cell]:
    """Counts and scores of a table; with `groups` scores are means over groups."""
    values = score_values(table)
    resampling = resample(units_of(table), resamples, seed) if resamples and len(table) else None
    missing = int((column(table, "found") == 0).sum())
    cells: dict[str, Cell] = {"expected": len(table), "missing": missing}
    return cells | {key: _cell(values[key], groups, resampling) for key in keys}


def _cell(values: Values, groups: Int[np.ndarray, " n"] | None, resampling: Resampling | None) -> Cell:
    assert values.statistic == "mean"
    parts = _parts(values.per_row, groups)
    value = _mean(np.array([_mean(part) for part in parts]))
    if resampling is None:
        return value
    sampled = resampling.means(parts)
    valid = ~np.isnan(sampled)
    with np.errstate(invalid="ignore"):
        means = np.where(valid, sampled, 0.0).sum(axis=0) / valid.sum(axis=0)
    ends = resampling.ends(means, resampling.units_with(values.per_row))
    return value if ends is None else Interval(value=value, low=ends[0], high=ends[1])


def _parts(per_row: Float[np.ndarray, " n"], groups: Int[np.ndarray, " n"] | None) -> Float[np.ndarray, "g n"]:
    """The values of each group, NaN elsewhere; without groups all values as one."""
    if groups is None or not len(groups):
        return per_row[None]
    return np.stack([np.where(groups == group, per_row, np.nan) for group in np.unique(groups)])


def _mean(values: Float[np.ndarray, " n"]) -> float:
    kept = values[~np.isnan(values)]
    return float(kept.mean()) if len(kept) else float("nan")
