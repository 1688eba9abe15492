"""A difference as text for a terminal, as JSON, and as CSV with a line for each pose."""

import json
import math
from collections.abc import Sequence
from dataclasses import asdict
from typing import Any

import numpy as np
import pandas as pd

from evalkit import __version__
from evalkit.diff.deltas import KEY, Change, Difference
from evalkit.diff.measures import MEASURES, Measure
from evalkit.diff.rules import Verdict
from evalkit.diff.sides import Side
from evalkit.scores.bootstrap import Interval
from evalkit.tables.model import NOTHING

IDS = "scene/image/object/instance"


def text(difference: Difference, listed: int) -> str:
    """Both files, a table of all measures, and the poses with another verdict, the largest changes first."""
    sides, counts = difference.sides, difference.counts
    lines = [f"A  {_about(sides.a)}", f"B  {_about(sides.b)}", ""]
    lines += _table(difference)
    lines += [
        "",
        f"delta is B minus A of each pose; 95 % intervals by resampling {difference.resampled}.",
        "Fractions (no unit) and VSS count a missing estimate as 0; errors are over the poses found in both.",
    ]
    if counts["unpaired"]:
        lines.append(
            f"Left out: {len(difference.only_a)} poses expected of A only, {len(difference.only_b)} of B only."
        )
    for title, rows in (
        (f"Newly failed (ADD(-S) of {difference.limit_diameters:g} diameter or more)", difference.newly_failed),
        ("Newly solved", difference.newly_solved),
        ("Found in A only", difference.lost),
        ("Found in B only", difference.gained),
    ):
        lines += ["", f"{title}: {len(rows)}"]
        lines += [f"  {line_of(row)}" for row in rows.head(listed).to_dict("records")]
        if len(rows) > listed > 0:
            lines.append(f"  ... and {len(rows) - listed} more")
    return "\n".join(lines)


def _about(side: Side) -> str:
    missing = int((~side.table.found).sum())
    return f"{side.name}: {len(side.table)} expected poses, {missing} missing ({side.path})"


def _table(difference: Difference) -> list[str]:
    heads = ("", "poses", "A mean", "B mean", "mean delta", "95 %", "A median", "B median", "median delta", "95 %")
    rows: list[tuple[str, ...]] = [heads]
    for name, measure in MEASURES.items():
        label = f"{name}, {measure.unit}" if measure.unit else name
        rows.append((label, *_cells(difference.changes[name], measure)))
    widths = [max(len(row[index]) for row in rows) for index in range(len(heads))]
    return [
        "  ".join(
            [row[0].ljust(widths[0]), *(cell.rjust(width) for cell, width in zip(row[1:], widths[1:], strict=True))]
        )
        for row in rows
    ]


def _cells(change: Change, measure: Measure) -> tuple[str, ...]:
    digits = measure.digits
    means = (
        _number(change.mean_a, digits),
        _number(change.mean_b, digits),
        _number(change.mean_delta, digits, sign="+"),
    )
    cells = (str(change.poses), *means, _ends(change.mean_interval, digits))
    if measure.is_binary:
        return (*cells, *[NOTHING] * 4)
    medians = (change.median_a, change.median_b)
    return (
        *cells,
        *(_number(median, digits) for median in medians),
        _number(change.median_delta, digits, sign="+"),
        _ends(change.median_interval, digits),
    )


def _number(value: float, digits: int, sign: str = "") -> str:
    if math.isnan(value):
        return NOTHING
    return f"{round(value, digits) + 0.0:{sign}.{digits}f}" if value else f"{0:.{digits}f}"


def _ends(interval: Interval, digits: int) -> str:
    return NOTHING if interval is None else f"[{', '.join(_number(end, digits, sign='+') for end in interval)}]"


def line_of(row: dict[str, Any]) -> str:
    """A pose with another verdict, in one line."""
    ids = "/".join(str(row[name]) for name in KEY)
    level = ""
    if row["initial_angle_deg"] == row["initial_angle_deg"]:
        level = f" initial pose {row['initial_angle_deg']:g} deg {row['initial_translation_diameter']:g} d"
    add = f"ADD(-S) {_millimetres(row['add_s_a'])} to {_millimetres(row['add_s_b'])}"
    vss = f"VSS {row['vss_a']:.3f} to {row['vss_b']:.3f}"
    why = [f"{side}: {cause}" for side, cause in (("A", row.get("cause_a")), ("B", row.get("cause_b"))) if cause]
    lines = f"lines {row['line_a'] or NOTHING} and {row['line_b'] or NOTHING}"
    return f"{ids}{level}, {lines}: {add}, {vss}" + (f" ({', '.join(why)})" if why else "")


def _millimetres(value: float) -> str:
    return "missing" if math.isnan(value) else f"{value:.2f} mm"


def json_text(difference: Difference, verdicts: Sequence[Verdict] = ()) -> str:
    """A difference as JSON; values without data are null."""
    pairs = difference.pairs
    content = {
        "a": _side(difference.sides.a),
        "b": _side(difference.sides.b),
        "evalkit": __version__,
        "limit_diameters": difference.limit_diameters,
        "resampled": difference.resampled,
        "paired": len(pairs),
        "counts": difference.counts,
        "measures": {
            name: {"unit": measure.unit, "better": measure.better, "text": measure.text}
            | asdict(difference.changes[name])
            for name, measure in MEASURES.items()
        },
        "newly_failed": _rows(difference.newly_failed),
        "newly_solved": _rows(difference.newly_solved),
        "found_in_a_only": _rows(difference.lost),
        "found_in_b_only": _rows(difference.gained),
        "expected_in_a_only": _rows(difference.only_a),
        "expected_in_b_only": _rows(difference.only_b),
        "rules": [{"rule": verdict.rule.text, "value": verdict.value, "fired": verdict.fired} for verdict in verdicts],
    }
    return json.dumps(_finite(content), indent=2, allow_nan=False, ensure_ascii=False) + "\n"


def _side(side: Side) -> dict[str, Any]:
    missing = int((~side.table.found).sum())
    return {
        "name": side.name,
        "path": str(side.path),
        "sha256": side.sha256,
        "expected": len(side.table),
        "missing": missing,
    }


def _rows(rows: pd.DataFrame) -> list[dict[str, Any]]:
    return [{str(name): value for name, value in row.items()} for row in _with_units(rows).to_dict("records")]


def _with_units(pairs: pd.DataFrame) -> pd.DataFrame:
    """Columns whose names end in their unit, without positions in tables."""
    renamed = {
        f"{name}_{part}": f"{name}_{part}_{measure.unit}"
        for name, measure in MEASURES.items()
        for part in ("a", "b", "delta")
        if measure.unit
    }
    return pairs.drop(columns=["row_a", "row_b"], errors="ignore").rename(columns=renamed)


def csv_text(difference: Difference) -> str:
    """A line for each pair; NaN is left empty, units are in the column names."""
    pairs = _with_units(difference.pairs)
    pairs[["found_a", "found_b"]] = pairs[["found_a", "found_b"]].astype("int64")
    written: str = pairs.to_csv(index=False, lineterminator="\n", float_format="%.9g")
    return written


def _finite(value: Any) -> Any:
    if isinstance(value, dict):
        return {key: _finite(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [_finite(item) for item in value]
    if isinstance(value, np.generic):
        return _finite(value.item())
    if isinstance(value, float) and not math.isfinite(value):
        return None
    return value
