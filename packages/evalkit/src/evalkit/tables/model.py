"""One description of a table, and its texts: Markdown, LaTeX (booktabs), CSV and JSON."""

import csv
import io
import json
import math
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal

from posecore.errors import ConfigError
from posecore.files import write_atomic

Better = Literal["higher", "lower", ""]
BLANKS = re.compile(r"[ \t\r\n]+")
NOTHING = "–"
"""What stands in a cell without a value."""


@dataclass(frozen=True, kw_only=True)
class Interval:
    """A value with the ends of its confidence interval, all in the column's unit."""

    value: float
    low: float
    high: float


Cell = float | int | str | Interval | None


@dataclass(frozen=True, kw_only=True)
class Column:
    """A column.

    Attributes:
        key: its name in CSV and JSON and in `Row.cells`, unique in the table; a number's key ends in its unit.
        heading: what readers see above it, without the unit.
        group: heading that neighbouring columns share, empty for none.
        unit: written after the heading. "%": the values are shares from 0 to 1 and are shown times 100; CSV and JSON
            keep the shares.
        digits: shown after the decimal point; None for text, which is set flush left.
        better: which values are good. The best ones of a comparison are set bold; "" where nothing is compared.
        about: what is measured, in words, for a tooltip.
    """

    key: str
    heading: str
    group: str = ""
    unit: str = ""
    digits: int | None = None
    better: Better = ""
    about: str = ""

    @property
    def title(self) -> str:
        """Heading and unit: `rotation, deg`."""
        return ", ".join(part for part in (self.heading, self.unit) if part)


@dataclass(frozen=True, kw_only=True)
class Row:
    """A row.

    Attributes:
        cells: value by column key; a key that is absent is an empty cell, as are None and NaN.
        group: rows with the same one stand in a block, and the best of a column is sought within it.
        total: whether it sums up the rows above; totals are compared with totals only.
    """

    cells: Mapping[str, Cell]
    group: str = ""
    total: bool = False


@dataclass(frozen=True, kw_only=True)
class Table:
    """A table.

    Attributes:
        title: what it shows.
        name: short name for files and anchors, lower case with hyphens.
        columns: left to right.
        rows: top to bottom.
        note: what a reader must know: how values are defined, what was left out.
        best: where the best value is sought: down each "column" (methods are rows), along each "row" (methods are
            columns), or nowhere.
    """

    title: str
    columns: Sequence[Column]
    rows: Sequence[Row] = field(default_factory=tuple)
    note: str = ""
    best: Literal["column", "row", ""] = "column"
    name: str = "table"

    def __post_init__(self) -> None:
        keys = [column.key for column in self.columns]
        twice = sorted({key for key in keys if keys.count(key) > 1})
        unknown = sorted({key for row in self.rows for key in row.cells} - set(keys))
        if twice or unknown:
            raise ValueError(f"table '{self.title}': columns named twice {twice}, cells without a column {unknown}")


def cell_text(column: Column, cell: Cell) -> str:
    """A cell as readers see it: rounded, an interval as `12.3 [11.9, 12.8]`, `NOTHING` where there is no value."""
    if isinstance(cell, str):
        return cell
    if isinstance(cell, Interval):
        value, low, high = (_number(column, part) for part in (cell.value, cell.low, cell.high))
        bounded = not (math.isnan(cell.low) or math.isnan(cell.high))
        return f"{value} [{low}, {high}]" if bounded else value
    return NOTHING if cell is None else _number(column, cell)


def _number(column: Column, value: float) -> str:
    if math.isnan(value):
        return NOTHING
    text = f"{value * (100 if column.unit == '%' else 1):.{column.digits or 0}f}"
    return text[1:] if re.fullmatch(r"-0(\.0*)?", text) else text


def number_of(cell: Cell) -> float | None:
    """The number that a cell is sorted and compared by; None for text and empty cells."""
    value = cell.value if isinstance(cell, Interval) else cell
    if value is None or isinstance(value, str) or math.isnan(value):
        return None
    return float(value)


def best_cells(table: Table) -> set[tuple[int, str]]:
    """Row number and column key of the cells to set bold: the best ones, all that show the same rounded number.

    A comparison needs two values at least. Down a column, rows of one group are compared, totals apart; along a row,
    the columns that say what is better.
    """
    compared: dict[Any, list[tuple[int, Column]]] = {}
    for index, row in enumerate(table.rows):
        for column in table.columns:
            if table.best and column.better and number_of(row.cells.get(column.key)) is not None:
                place = index if table.best == "row" else (row.group, row.total, column.key)
                compared.setdefault(place, []).append((index, column))
    best: set[tuple[int, str]] = set()
    for members in compared.values():
        if len(members) > 1:
            best |= _best_of(table, members)
    return best


def _best_of(table: Table, members: Sequence[tuple[int, Column]]) -> set[tuple[int, str]]:
    def shown(member: tuple[int, Column]) -> float:
        index, column = member
        value = number_of(table.rows[index].cells.get(column.key)) or 0.0
        return float(_number(column, value))

    seek = max if members[0][1].better == "higher" else min
    winner = seek(shown(member) for member in members)
    return {(index, column.key) for index, column in members if shown((index, column)) == winner}


def markdown(table: Table) -> str:
    """The table in GitHub's Markdown, columns padded so that it also reads as plain text."""
    best = best_cells(table)
    titles = [_markdown_text(_full_title(column)) for column in table.columns]
    body = []
    for index, row in enumerate(table.rows):
        texts: list[str] = []
        for column in table.columns:
            text = _markdown_text(cell_text(column, row.cells.get(column.key)))
            texts.append(f"**{text}**" if (index, column.key) in best or (row.total and text and not texts) else text)
        body.append(texts)
    widths = [max(3, *(len(line[i]) for line in [titles, *body])) for i in range(len(titles))]
    right = [column.digits is not None for column in table.columns]
    rule = ["-" * (width - 1) + ":" if flush else "-" * width for width, flush in zip(widths, right, strict=True)]
    lines = [_padded(line, widths, right) for line in (titles, rule, *body)]
    head = [f"### {_markdown_text(table.title)}", ""] if table.title else []
    note = ["", _markdown_text(table.note)] if table.note else []
    return "\n".join([*head, *lines, *note]) + "\n"


def _full_title(column: Column) -> str:
    return " ".join(part for part in (column.group, column.title) if part)


def _padded(texts: Sequence[str], widths: Sequence[int], right: Sequence[bool]) -> str:
    cells = [
        text.rjust(width) if flush else text.ljust(width)
        for text, width, flush in zip(texts, widths, right, strict=True)
    ]
    return "| " + " | ".join(cells) + " |"


def _markdown_text(text: str) -> str:
    """Text that Markdown shows as it is; what needs no escape where it stands is left readable."""
    text = re.sub(r"([\\`*|<>~])", r"\\\1", BLANKS.sub(" ", text))
    text = re.sub(r"(?<![^\W_])_|_(?![^\W_])", r"\\_", text)
    return re.sub(r"&(?=#?\w+;)|\](?=[(\[:])", r"\\\g<0>", text)


SUFFIXES = (".md", ".tex", ".csv", ".json")
LATEX = {
    **{"\\": r"\textbackslash{}", "~": r"\textasciitilde{}", "^": r"\textasciicircum{}"},
    **{char: "\\" + char for char in "&%$#_{}"},
    **{"<": r"\textless{}", ">": r"\textgreater{}", "|": r"\textbar{}"},
    **{"°": r"\ensuremath{^\circ}", "×": r"\ensuremath{\times}", "±": r"\ensuremath{\pm}", "−": r"\ensuremath{-}"},
    **{"–": "--", "—": "---", "\N{NO-BREAK SPACE}": "~"},
    **{"α": r"\ensuremath{\alpha}", "β": r"\ensuremath{\beta}", "γ": r"\ensuremath{\gamma}"},
    **{"τ": r"\ensuremath{\tau}", "∞": r"\ensuremath{\infty}", "≤": r"\ensuremath{\le}", "≥": r"\ensuremath{\ge}"},
}
"""What LaTeX would not show as it is. Other letters are left to its UTF-8 input."""


def latex_text(text: str) -> str:
    """Text with everything escaped that LaTeX gives a meaning."""
    return "".join(LATEX.get(char, char) for char in BLANKS.sub(" ", text))


def latex(table: Table, label: str = "") -> str:
    """The table as a LaTeX float. It needs `\\usepackage{booktabs}`, which the first line says.

    Args:
        table: with title as caption; the note follows in the caption.
        label: for `\\ref`, empty for none.
    """
    best = best_cells(table)
    flush = "".join("l" if column.digits is None else "r" for column in table.columns)
    lines = [
        r"% \usepackage{booktabs}",
        r"\begin{table}",
        r"  \centering",
        rf"  \begin{{tabular}}{{@{{}}{flush}@{{}}}}",
    ]
    lines += [f"    {line}" for line in [r"\toprule", *_latex_heads(table.columns), r"\midrule"]]
    for index, row in enumerate(table.rows):
        before = table.rows[index - 1] if index else row
        if (row.group, row.total) != (before.group, before.total):
            lines.append(r"    \midrule")
        texts = [latex_text(cell_text(column, row.cells.get(column.key))) for column in table.columns]
        bold = [(index, column.key) in best for column in table.columns]
        lines.append("    " + _latex_line([rf"\textbf{{{t}}}" if b else t for t, b in zip(texts, bold, strict=True)]))
    caption = " ".join(part.rstrip(".") + "." for part in (table.title, table.note) if part)
    lines += [r"    \bottomrule", r"  \end{tabular}", rf"  \caption{{{latex_text(caption)}}}"]
    lines += [rf"  \label{{{label}}}"] if label else []
    return "\n".join([*lines, r"\end{table}"]) + "\n"


def _latex_heads(columns: Sequence[Column]) -> list[str]:
    titles = _latex_line([latex_text(column.title) for column in columns])
    if not any(column.group for column in columns):
        return [titles]
    heads, rules, first = [], [], 1
    for group, span in column_groups(columns):
        heads.append(rf"\multicolumn{{{span}}}{{c}}{{{latex_text(group)}}}" if group else " & ".join([""] * span))
        rules += [rf"\cmidrule(lr){{{first}-{first + span - 1}}}"] if group else []
        first += span
    return [_latex_line(heads), "".join(rules), titles]


def column_groups(columns: Sequence[Column]) -> list[tuple[str, int]]:
    """Neighbouring columns with the same group heading: the heading and how many they are."""
    groups: list[tuple[str, int]] = []
    for column in columns:
        if groups and groups[-1][0] == column.group:
            groups[-1] = (column.group, groups[-1][1] + 1)
        else:
            groups.append((column.group, 1))
    return groups


def _latex_line(texts: Sequence[str]) -> str:
    # A bracket or a star at the start of a line would be read as an argument of the command that ended the one before.
    guard = "{}" if texts[0].startswith(("[", "*")) else ""
    return guard + " & ".join(texts) + r" \\"


def csv_text(table: Table) -> str:
    """The table as CSV: keys as header, nine significant digits, shares as shares, empty where there is no value.

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
        return value or ""
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


def require_suffixes(paths: Sequence[str | Path]) -> None:
    """Check the suffixes of files to write, before the work whose tables they are to hold.

    Raises:
        ConfigError: `write_tables` knows no such suffix.
    """
    for file in map(Path, paths):
        if file.suffix not in SUFFIXES:
            raise ConfigError(f"{file}: found suffix '{file.suffix}', expected one of {', '.join(SUFFIXES)}")


def write_tables(path: str | Path, tables: Sequence[Table]) -> list[Path]:
    """Write tables into a file of the kind that its suffix names: .md, .tex, .csv or .json.

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


def _json_cell(cell: Cell) -> Any:
    if isinstance(cell, Interval):
        return {"value": _json_cell(cell.value), "low": _json_cell(cell.low), "high": _json_cell(cell.high)}
    return None if isinstance(cell, float) and not math.isfinite(cell) else cell
