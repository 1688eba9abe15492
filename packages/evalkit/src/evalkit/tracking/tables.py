"""Tracking tables: a row for each sequence, or the paper's layout with a row for each axis."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from evalkit.inputs.result_files import ResultFile, method_names
from evalkit.scores.bootstrap import Units, resample
from evalkit.scores.per_pose import Values
from evalkit.tables.model import Cell, Interval, Row, Table, TableColumn
from evalkit.tracking.scores import ANGLES, AXES, track_scores
from evalkit.tracking.tracks import SequenceTrack


def _rms_column(key: str, heading: str, unit: str, about: str = "") -> TableColumn:
    return TableColumn(key=key, heading=heading, group="RMS", unit=unit, digits=2, better="lower", about=about)


RMS_COLUMNS = (
    *(_rms_column(f"{axis}_rms_mm", axis, "mm", about=f"camera {axis}") for axis in AXES),
    *(_rms_column(f"{name}_rms_deg", name, "deg") for name in ANGLES),
)
TRACK_COLUMNS = (
    TableColumn(key="frames", heading="frames", digits=0),
    TableColumn(key="lost", heading="lost", digits=0, better="lower", about="frames without an estimate"),
    *RMS_COLUMNS,
    TableColumn(key="success_5cm5deg", heading="5 cm 5°", unit="%", digits=1, better="higher"),
    TableColumn(key="failed", heading="failed", digits=0, about="frames outside of 5 cm or 5 degrees, lost ones too"),
    TableColumn(key="resets", heading="resets", digits=0, about="number of resets to the ground truth after a failure"),
    TableColumn(key="jitter_mm_median", heading="median", group="jitter", unit="mm", digits=2, better="lower"),
    TableColumn(key="jitter_mm_p95", heading="95 %", group="jitter", unit="mm", digits=2, better="lower"),
    TableColumn(key="jitter_deg_median", heading="median", group="jitter", unit="deg", digits=2, better="lower"),
    TableColumn(key="jitter_deg_p95", heading="95 %", group="jitter", unit="deg", digits=2, better="lower"),
    TableColumn(key="time_ms_mean", heading="time", unit="ms", digits=1, better="lower", about="mean of a frame"),
)
SUMMED = ("frames", "lost", "failed", "resets")
TOTAL = "mean of sequences"


@dataclass(frozen=True, kw_only=True, eq=False)
class TrackedFile:
    """A result file's tracks under its name for readers."""

    name: str
    tracks: list[SequenceTrack]


def named_tracks(files: Sequence[ResultFile], tracks: Sequence[list[SequenceTrack]]) -> list[TrackedFile]:
    """Tracks of result files, named by their sidecars."""
    names = method_names(files)
    return [TrackedFile(name=name, tracks=of_file) for name, of_file in zip(names, tracks, strict=True)]


def sequence_table(tracked: Sequence[TrackedFile], *, resamples: int = 0, seed: int = 0) -> Table:
    """Every sequence, a row for each method, then the mean over sequences (counts summed).

    Args:
        tracked: see `named_tracks`.
        resamples: for 95 % bootstrap intervals of the means, sequences resampled; 0 for none.
        seed: of the resampling.
    """
    scored = [[track_scores(track) for track in item.tracks] for item in tracked]
    rows: dict[str, list[Row]] = {}
    for item, scores in zip(tracked, scored, strict=True):
        for track, values in zip(item.tracks, scores, strict=True):
            cells = {"sequence": track.name, "method": item.name} | values
            rows.setdefault(track.name, []).append(Row(cells=cells, group=track.name))
    totals = [
        Row(
            cells={"sequence": TOTAL, "method": item.name} | _totals(scores, resamples, seed),
            group=TOTAL,
            total=True,
        )
        for item, scores in zip(tracked, scored, strict=True)
        if len(scores) > 1
    ]
    method = [TableColumn(key="method", heading="method")] if len(tracked) > 1 else []
    shown = {column.key for column in (*method, *TRACK_COLUMNS)} | {"sequence"}
    return Table(
        title="Tracking by sequence",
        name="tracking",
        columns=[TableColumn(key="sequence", heading="sequence"), *method, *TRACK_COLUMNS],
        rows=[
            Row(cells={key: cell for key, cell in row.cells.items() if key in shown}, group=row.group, total=row.total)
            for row in [*(row for part in rows.values() for row in part), *totals]
        ],
        note=_note(tracked),
        best="column" if method else "",
    )


def _totals(scores: Sequence[Mapping[str, float]], resamples: int, seed: int) -> dict[str, Cell]:
    units = Units(kind="scene", text=f"{len(scores)} sequences", of_row=np.arange(len(scores)), count=len(scores))
    resampling = resample(units, resamples, seed) if resamples else None
    totals: dict[str, Cell] = {}
    for key in (column.key for column in TRACK_COLUMNS):
        values = np.array([of_track[key] for of_track in scores])
        valid = values[~np.isnan(values)]
        if key in SUMMED:
            totals[key] = float(valid.sum()) if len(valid) else None
            continue
        ends = None if resampling is None else resampling.interval(Values(per_row=values, statistic="mean"))
        mean = float(valid.mean()) if len(valid) else float("nan")
        totals[key] = mean if ends is None else Interval(value=mean, low=ends[0], high=ends[1])
    return totals


def _note(tracked: Sequence[TrackedFile]) -> str:
    parts = ["RMS over frames with an estimate; lost frames fail 5 cm 5°."]
    free = [item.name for item in tracked if all(track.was_initialised is None for track in item.tracks)]
    if free:
        names = "" if len(tracked) == 1 else f" of {', '.join(free)}"
        parts.append(
            f"5 cm 5°{names}: without resets, frames as they are; a tracker that is lost stays lost, so this is not "
            "RBOT's number, for which a tracker is reset to the ground truth after a failure (`resets` in the sidecar)."
        )
    for item in tracked:
        unreset = sum(_failed_without_reset(track) for track in item.tracks)
        if unreset:
            parts.append(f"{item.name}: {unreset} failed frames without a reset, so RBOT's protocol was not kept.")
    return " ".join(parts)


def _failed_without_reset(track: SequenceTrack) -> int:
    scores = track_scores(track)
    return 0 if track.was_initialised is None else int(scores["failed"] - scores["resets"])


def axis_table(tracked: Sequence[TrackedFile]) -> Table:
    """The layout of the paper's figure 5a: six rows for each sequence, a column for each method, the best bold."""
    scores_by_track: dict[str, dict[int, dict[str, float]]] = {}
    for index, item in enumerate(tracked):
        for track in item.tracks:
            scores_by_track.setdefault(track.name, {})[index] = track_scores(track)
    rows = []
    for name, by_method in scores_by_track.items():
        for shown in RMS_COLUMNS:
            cells: dict[str, Cell] = {f"rms_{index}": values[shown.key] for index, values in by_method.items()}
            rows.append(Row(cells=cells | {"sequence": name, "axis": shown.title}, group=name))
    columns = [
        TableColumn(key=f"rms_{index}", heading=item.name, digits=2, better="lower")
        for index, item in enumerate(tracked)
    ]
    return Table(
        title="Tracking, RMS by axis",
        name="tracking-axes",
        columns=[TableColumn(key="sequence", heading="sequence"), TableColumn(key="axis", heading="RMS"), *columns],
        rows=rows,
        note=_note(tracked),
        best="row",
    )
