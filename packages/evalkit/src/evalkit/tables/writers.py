"""Tables as CSV and JSON, and files of the format that their suffix names."""

import csv
import io
import json
import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from posecore.errors import ConfigError
from posecore.files import write_atomic

from evalkit.tables.csv_cells import escaped
from evalkit.tables.latex import latex
from evalkit.tables.markdown import markdown
from evalkit.tables.model import Cell, Interval, Table

SUFFIXES = (".md", ".tex", ".csv", ".json")


def csv_text(table: Table) -> str:
    """The table as CSV: keys as header, nine significant digits, fractions from 0 to 1, empty where there is no value.

    A column with intervals is followed by `<key>_low` and `<key>_high`.
    """
    ends = {
        column.key
        for column in table.columns
        if any(isinstance(row.cells.get(column.key), Interval) for row in table.rows)
    }
    stream = io.StringIO()
    writer = csv.writer(stream, lineterminator="\n")
    writer.writerow(
        [
            name
            for column in table.columns
            for name in [column.key, *([f"{column.key}_low", f"{column.key}_high"] if column.key in ends else [])]
        ]
    )
    for row in table.rows:
        line: list[str] = []
        for column in table.columns:
            cell = row.cells.get(column.key)
            line.append(_plain(cell.value if isinstance(cell, Interval) else cell))
            if column.key in ends:
                line += [_plain(cell.low), _plain(cell.high)] if isinstance(cell, Interval) else ["", ""]
        writer.writerow(line)
    return stream.getvalue()


def _plain(value: float | int | str | None) -> str:
    if value is None or isinstance(value, str):
        return escaped(value or "")
    return "" if math.isnan(value) else f"{value:.9g}" if isinstance(value, float) else str(value)


def json_data(table: Table) -> dict[str, Any]:
    """The table as JSON-ready data: values at full precision, intervals as value, low and high, None for no value."""
    return {
        "name": table.name,
        "title": table.title,
        "note": table.note,
        "columns": [
            {"key": c.key, "heading": c.heading, "group": c.group, "unit": c.unit, "better": c.better, "about": c.about}
            for c in table.columns
        ],
        "rows": [
            {
                "group": row.group,
                "total": row.total,
                "cells": {column.key: _json_cell(row.cells.get(column.key)) for column in table.columns},
            }
            for row in table.rows
        ],
    }


def _json_cell(cell: Cell) -> Any:
    if isinstance(cell, Interval):
        return {"value": _json_cell(cell.value), "low": _json_cell(cell.low), "high": _json_cell(cell.high)}
    return None if isinstance(cell, float) and not math.isfinite(cell) else cell


def require_suffixes(paths: Sequence[str | Path]) -> None:
    """Check the suffixes of files to write, before the tables are computed.

    Raises:
        ConfigError: a suffix is none of `SUFFIXES`.
    """
    for file in map(Path, paths):
        if file.suffix not in SUFFIXES:
            raise ConfigError(f"{file}: found suffix '{file.suffix}', expected one of {', '.join(SUFFIXES)}")


def write_tables(path: str | Path, tables: Sequence[Table]) -> list[Path]:
    """Write tables into a file in the format of its suffix: .md, .tex, .csv or .json.

    Args:
        path: file; several tables as CSV go into one file each, `<stem>_<name>.csv`.
        tables: with names that differ.

    Returns:
        The files written.

    Raises:
        ConfigError: another suffix.
        StorageError: a file cannot be written.
    """
    file = Path(path)
    require_suffixes([file])
    if file.suffix == ".csv" and len(tables) > 1:
        parts = {file.with_name(f"{file.stem}_{table.name}.csv"): csv_text(table) for table in tables}
    else:
        parts = {file: text_of(tables, file.suffix)}
    for part, text in parts.items():
        write_atomic(part, text.encode())
    return list(parts)


def text_of(tables: Sequence[Table], suffix: str) -> str:
    """Tables one after the other as Markdown, LaTeX or CSV, or as a JSON list, by the suffix of a file name."""
    if suffix == ".json":
        return json.dumps([json_data(table) for table in tables], indent=2, allow_nan=False, ensure_ascii=False) + "\n"
    if suffix == ".tex":
        return "\n".join(latex(table, f"tab:{table.name}") for table in tables)
    return "\n".join((markdown if suffix == ".md" else csv_text)(table) for table in tables)
