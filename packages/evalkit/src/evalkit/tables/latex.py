"""A table as a LaTeX float (booktabs)."""

from collections.abc import Sequence

from evalkit.tables.model import BLANKS, Table, TableColumn, best_cells, cell_text, column_groups

LATEX = {
    **{"\\": r"\textbackslash{}", "~": r"\textasciitilde{}", "^": r"\textasciicircum{}"},
    **{char: "\\" + char for char in "&%$#_{}"},
    **{"<": r"\textless{}", ">": r"\textgreater{}", "|": r"\textbar{}"},
    **{"°": r"\ensuremath{^\circ}", "×": r"\ensuremath{\times}", "±": r"\ensuremath{\pm}", "−": r"\ensuremath{-}"},
    **{"–": "--", "—": "---", "\N{NO-BREAK SPACE}": "~"},
    **{"α": r"\ensuremath{\alpha}", "β": r"\ensuremath{\beta}", "γ": r"\ensuremath{\gamma}"},
    **{"τ": r"\ensuremath{\tau}", "∞": r"\ensuremath{\infty}", "≤": r"\ensuremath{\le}", "≥": r"\ensuremath{\ge}"},
}
"""Escapes of characters that LaTeX would not show. Other letters are left to its UTF-8 input."""


def latex_text(text: str) -> str:
    """Text with all special characters of LaTeX escaped."""
    return "".join(LATEX.get(char, char) for char in BLANKS.sub(" ", text))


def latex(table: Table, label: str = "") -> str:
    """The table as a LaTeX float. It needs `\\usepackage{booktabs}`, as its first line notes.

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


def _latex_heads(columns: Sequence[TableColumn]) -> list[str]:
    titles = _latex_line([latex_text(column.title) for column in columns])
    if not any(column.group for column in columns):
        return [titles]
    heads, rules, first = [], [], 1
    for group, span in column_groups(columns):
        heads.append(rf"\multicolumn{{{span}}}{{c}}{{{latex_text(group)}}}" if group else " & ".join([""] * span))
        rules += [rf"\cmidrule(lr){{{first}-{first + span - 1}}}"] if group else []
        first += span
    return [_latex_line(heads), "".join(rules), titles]


def _latex_line(texts: Sequence[str]) -> str:
    # A bracket or a star at the start of a line would be read as an argument of the command that ended the one before.
    guard = "{}" if texts[0].startswith(("[", "*")) else ""
    return guard + " & ".join(texts) + r" \\"
