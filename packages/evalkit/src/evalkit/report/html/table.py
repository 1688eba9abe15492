"""A table as HTML that sorts by a click on its headings and scrolls sideways where it is too wide."""

from html import escape

from evalkit.tables.model import Row, Table, TableColumn, best_cells, cell_text, column_groups, number_of

ALARMS = ("missing",)
"""Columns whose values other than 0 are set in red."""


def table(described: Table) -> str:
    """The table with its title as caption and its note below; empty where it has no rows."""
    if not described.rows:
        return ""
    caption = f"<caption><span>{escape(described.title)}</span></caption>" if described.title else ""
    label = escape(described.title or "table")
    note = f'<p class="note">{escape(described.note)}</p>' if described.note else ""
    return (
        f'<div class="scroll" tabindex="0" role="region" aria-label="{label}"><table class="sortable">{caption}'
        f"<thead>{_heads(described)}</thead>{_bodies(described)}</table></div>{note}"
    )


def _heads(described: Table) -> str:
    columns = described.columns
    opens = _opens(described)
    top, first = [], 0
    titles: list[str] = []
    for group, span in column_groups(columns):
        members = columns[first : first + span]
        # A unit common to a whole group stands once, in the group's heading.
        common = members[0].unit if group and len({column.unit for column in members}) == 1 else ""
        titles += [column.heading if common else column.title for column in members]
        scope = f' scope="colgroup"{_classes("opens" if opens[first] else "")}' if group else ""
        tag = "th" if group else "td"
        top.append(
            f'<{tag} colspan="{span}"{scope}>{escape(", ".join(part for part in (group, common) if part))}</{tag}>'
        )
        first += span
    heads = "".join(
        f'<th scope="col"{_classes("text" if column.digits is None else "", "opens" if begins else "")}'
        f"{_tooltip(column)}>{escape(title)}</th>"
        for column, title, begins in zip(columns, titles, opens, strict=True)
    )
    groups = f'<tr class="groups">{"".join(top)}</tr>' if any(column.group for column in columns) else ""
    return f"{groups}<tr>{heads}</tr>"


def _bodies(described: Table) -> str:
    best = best_cells(described)
    blocks: list[tuple[tuple[str, bool], list[str]]] = []
    for index, row in enumerate(described.rows):
        if not blocks or blocks[-1][0] != (row.group, row.total):
            blocks.append(((row.group, row.total), []))
        blocks[-1][1].append(_row(described, row, {key for row_index, key in best if row_index == index}))
    return "".join(f"<tbody{_classes('total' if total else '')}>{''.join(rows)}</tbody>" for (_, total), rows in blocks)


def _row(described: Table, row: Row, best: set[str]) -> str:
    cells = []
    for index, (column, begins) in enumerate(zip(described.columns, _opens(described), strict=True)):
        cell = row.cells.get(column.key)
        text, _, ends = cell_text(column, cell).partition(" [")
        is_text = column.digits is None
        if index == 0 and is_text:
            cells.append(f'<th scope="row" class="text" title="{escape(text)}">{escape(text)}</th>')
            continue
        number = number_of(cell)
        # With an interval the cell's text is not a number, so sorting needs the value.
        value = f' data-value="{number:.9g}"' if ends and not is_text and number is not None else ""
        marks = _classes(
            "text" if is_text else "",
            "opens" if begins else "",
            "best" if column.key in best else "",
            "bad" if column.key in ALARMS and number else "",
        )
        interval = f"<small>[{escape(ends)}</small>" if ends and not is_text else ""
        shown = text if not is_text else cell_text(column, cell)
        cells.append(f"<td{marks}{value}>{escape(shown)}{interval}</td>")
    return f"<tr>{''.join(cells)}</tr>"


def _opens(described: Table) -> list[bool]:
    """Whether a column begins a new group and has a line before it."""
    columns = described.columns
    return [index > 0 and column.group != columns[index - 1].group for index, column in enumerate(columns)]


def _classes(*names: str) -> str:
    kept = " ".join(name for name in names if name)
    return f' class="{kept}"' if kept else ""


def _tooltip(column: TableColumn) -> str:
    return f' title="{escape(column.about)}"' if column.about else ""
