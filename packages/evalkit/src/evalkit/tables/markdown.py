"""A table as GitHub's Markdown."""

import re
from collections.abc import Sequence

from evalkit.tables.model import BLANKS, Table, TableColumn, best_cells, cell_text


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


def _full_title(column: TableColumn) -> str:
    return " ".join(part for part in (column.group, column.title) if part)


def _padded(texts: Sequence[str], widths: Sequence[int], right: Sequence[bool]) -> str:
    cells = [
        text.rjust(width) if flush else text.ljust(width)
        for text, width, flush in zip(texts, widths, right, strict=True)
    ]
    return "| " + " | ".join(cells) + " |"


def _markdown_text(text: str) -> str:
    """Text with Markdown's special characters escaped, but only where they have an effect."""
    text = re.sub(r"([\\`*|<>~])", r"\\\1", BLANKS.sub(" ", text))
    text = re.sub(r"(?<![^\W_])_|_(?![^\W_])", r"\\_", text)
    return re.sub(r"&(?=#?\w+;)|\](?=[(\[:])", r"\\\g<0>", text)
