"""Tables as data: columns, rows, cells, and which cells are best."""

import math
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, Literal

Better = Literal["higher", "lower", ""]
BLANKS = re.compile(r"[ \t\r\n]+")
"""Runs of blanks, which every text format shows as one space."""
NOTHING = "–"
"""Text of a cell without a value."""


@dataclass(frozen=True, kw_only=True)
class Interval:
    """A value with the ends of its confidence interval, all in the column's unit."""

    value: float
    low: float
    high: float


Cell = float | int | str | Interval | None


@dataclass(frozen=True, kw_only=True)
class TableColumn:
    """A column.

    Attributes:
        key: name in CSV and JSON and in `Row.cells`, unique in the table; a number's key ends in its unit.
        heading: above the column, without the unit.
        group: heading that neighbouring columns share, empty for none.
        unit: written after the heading. "%": the values are fractions from 0 to 1 and are shown times 100; CSV and
            JSON keep the fractions.
        digits: shown after the decimal point; None for text, which is set flush left.
        better: order of the values. The best ones of a comparison are set bold; "" where nothing is compared.
        about: description for a tooltip.
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
        group: block of rows, within which the best value of a column is set bold.
        total: whether the row summarises the rows above; totals are compared with totals only.
    """

    cells: Mapping[str, Cell]
    group: str = ""
    total: bool = False


@dataclass(frozen=True, kw_only=True)
class Table:
    """A table.

    Attributes:
        title: caption.
        name: short name for files and anchors, lower case with hyphens.
        columns: left to right.
        rows: top to bottom.
        note: definitions and omissions, below the table.
        best: direction of the comparison: down each "column" (methods are rows), along each "row" (methods are
            columns), or none.
    """

    title: str
    columns: Sequence[TableColumn]
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


def cell_text(column: TableColumn, cell: Cell) -> str:
    """A cell as it is shown: rounded, an interval as `12.3 [11.9, 12.8]`, `NOTHING` where there is no value."""
    if isinstance(cell, str):
        return cell
    if isinstance(cell, Interval):
        value, low, high = (_number(column, part) for part in (cell.value, cell.low, cell.high))
        bounded = not (math.isnan(cell.low) or math.isnan(cell.high))
        return f"{value} [{low}, {high}]" if bounded else value
    return NOTHING if cell is None else _number(column, cell)


def _number(column: TableColumn, value: float) -> str:
    if math.isnan(value):
        return NOTHING
    text = f"{value * (100 if column.unit == '%' else 1):.{column.digits or 0}f}"
    return text[1:] if re.fullmatch(r"-0(\.0*)?", text) else text


def number_of(cell: Cell) -> float | None:
    """The number of a cell, for sorting and comparison; None for text and empty cells."""
    value = cell.value if isinstance(cell, Interval) else cell
    if value is None or isinstance(value, str) or math.isnan(value):
        return None
    return float(value)


def best_cells(table: Table) -> set[tuple[int, str]]:
    """Row number and column key of the cells to set bold: the best ones, all that show the same rounded number.

    A comparison needs two values at least. Down a column, rows of the same group are compared, totals separately; along
    a row, the columns with a `better` value.
    """
    compared: dict[Any, list[tuple[int, TableColumn]]] = {}
    for index, row in enumerate(table.rows):
        for column in table.columns:
            if table.best and column.better and number_of(row.cells.get(column.key)) is not None:
                compared_key = index if table.best == "row" else (row.group, row.total, column.key)
                compared.setdefault(compared_key, []).append((index, column))
    best: set[tuple[int, str]] = set()
    for members in compared.values():
        if len(members) > 1:
            best |= _best_of(table, members)
    return best


def _best_of(table: Table, members: Sequence[tuple[int, TableColumn]]) -> set[tuple[int, str]]:
    def shown(member: tuple[int, TableColumn]) -> float:
        index, column = member
        value = number_of(table.rows[index].cells.get(column.key)) or 0.0
        return float(_number(column, value))

    seek = max if members[0][1].better == "higher" else min
    winner = seek(shown(member) for member in members)
    return {(index, column.key) for index, column in members if shown((index, column)) == winner}


def column_groups(columns: Sequence[TableColumn]) -> list[tuple[str, int]]:
    """Neighbouring columns with the same group heading: the heading and their number."""
    groups: list[tuple[str, int]] = []
    for column in columns:
        if groups and groups[-1][0] == column.group:
            groups[-1] = (column.group, groups[-1][1] + 1)
        else:
            groups.append((column.group, 1))
    return groups
