"""Tables as Markdown, LaTeX, CSV and JSON: numbers, bold best values, escaping."""

import csv
import io
import json

import pytest
from evalkit.tables import csv_cells
from evalkit.tables.latex import latex, latex_text
from evalkit.tables.markdown import markdown
from evalkit.tables.model import Interval, Row, Table, TableColumn, best_cells, cell_text
from evalkit.tables.writers import csv_text, json_data, text_of, write_tables
from posecore.errors import ConfigError

VSS = TableColumn(key="vss", heading="VSS", digits=3, better="higher")
ROTATION = TableColumn(key="re_deg", heading="rotation", unit="deg", digits=1, better="lower")
ADD = TableColumn(key="add", heading="ADD", group="recall", unit="%", digits=1, better="higher")
METHOD = TableColumn(key="method", heading="method")


def table_of(*rows, columns=(METHOD, VSS, ROTATION, ADD), **rest):
    return Table(title=rest.pop("title", "t"), columns=columns, rows=rows, **rest)


def row(method, vss=None, re_deg=None, add=None, **rest):
    return Row(cells={"method": method, "vss": vss, "re_deg": re_deg, "add": add}, **rest)


@pytest.mark.parametrize(
    ("column", "cell", "text"),
    [
        (VSS, 0.12349, "0.123"),
        (ROTATION, 12.34, "12.3"),
        (ROTATION, Interval(value=12.34, low=11.9, high=12.81), "12.3 [11.9, 12.8]"),
        (ROTATION, Interval(value=12.34, low=float("nan"), high=float("nan")), "12.3"),
        (ADD, 0.2749, "27.5"),
        (ADD, 1, "100.0"),
        (ADD, Interval(value=0.275, low=0.25, high=0.3), "27.5 [25.0, 30.0]"),
        (ROTATION, -0.04, "0.0"),
        (ROTATION, -0.06, "-0.1"),
        (ROTATION, float("inf"), "inf"),
        (ROTATION, float("nan"), "–"),
        (ROTATION, None, "–"),
        (METHOD, "a b", "a b"),
        (TableColumn(key="n", heading="poses", digits=0), 349, "349"),
    ],
)
def test_cells_are_rounded_and_shares_are_shown_in_percent(column, cell, text):
    assert cell_text(column, cell) == text


def test_the_best_of_a_column_is_the_highest_or_the_lowest_as_the_column_says():
    table = table_of(row("a", 0.8, 10.0, 0.3), row("b", 0.7, 5.0, 0.3), row("c", None, float("nan"), 0.1))
    assert best_cells(table) == {(0, "vss"), (1, "re_deg"), (0, "add"), (1, "add")}


def test_values_that_round_alike_are_equally_good():
    # 0.24 and 0.24 are both bold in the paper's tracking table.
    table = table_of(row("a", 0.8001, 1.0), row("b", 0.8004, 2.0))
    assert best_cells(table) == {(0, "vss"), (1, "vss"), (0, "re_deg")}


def test_a_single_value_is_not_called_the_best():
    assert best_cells(table_of(row("a", 0.8, 1.0), row("b"))) == set()


def test_groups_and_totals_are_compared_among_themselves():
    table = table_of(
        row("a", 0.8, group="1"),
        row("b", 0.7, group="1"),
        row("a", 0.2, group="2"),
        row("b", 0.3, group="2"),
        row("a", 0.55, total=True),
        row("b", 0.5, total=True),
    )
    assert best_cells(table) == {(0, "vss"), (3, "vss"), (4, "vss")}


def test_a_total_is_not_better_than_the_rows_it_sums_up():
    table = table_of(row("a", 0.8), row("b", 0.7), row("sum", 0.9, total=True))
    assert best_cells(table) == {(0, "vss")}


def test_along_a_row_methods_are_columns():
    ours, theirs = (TableColumn(key=key, heading=key, digits=2, better="lower") for key in ("ours", "theirs"))
    table = Table(
        title="RMS",
        columns=[METHOD, ours, theirs],
        rows=[
            Row(cells={"method": "x", "ours": 0.65, "theirs": 0.69}),
            Row(cells={"method": "y", "ours": 6.49, "theirs": Interval(value=1.17, low=1.1, high=1.2)}),
        ],
        best="row",
    )
    assert best_cells(table) == {(0, "ours"), (1, "theirs")}


def test_markdown_is_a_table_that_lines_up():
    table = table_of(row("start", 0.66, 27.96, 0.074), row("refined", 0.83, 16.17, 0.341), title="LM", note="All.")
    assert markdown(table) == (
        "### LM\n"
        "\n"
        "| method  |       VSS | rotation, deg | recall ADD, % |\n"
        "| ------- | --------: | ------------: | ------------: |\n"
        "| start   |     0.660 |          28.0 |           7.4 |\n"
        "| refined | **0.830** |      **16.2** |      **34.1** |\n"
        "\n"
        "All.\n"
    )


def test_markdown_escapes_what_would_break_a_table_or_turn_into_markup():
    table = table_of(row("a|b *c* `d` <b> _e_ f_g &lt; [h](i)\nj"))
    line = markdown(table).splitlines()[4]
    assert r"a\|b \*c\* \`d\` \<b\> \_e\_ f_g \&lt; [h\](i) j" in line


def test_latex_is_a_booktabs_table():
    table = table_of(
        row("start", 0.66, 27.96, 0.074),
        row("refined", 0.83, None, Interval(value=0.341, low=0.3, high=0.38)),
        row("all", 0.75, total=True),
        title="Mean errors",
        note="n = 3",
    )
    assert latex(table, "tab:lm") == (
        "% \\usepackage{booktabs}\n"
        "\\begin{table}\n"
        "  \\centering\n"
        "  \\begin{tabular}{@{}lrrr@{}}\n"
        "    \\toprule\n"
        "     &  &  & \\multicolumn{1}{c}{recall} \\\\\n"
        "    \\cmidrule(lr){4-4}\n"
        "    method & VSS & rotation, deg & ADD, \\% \\\\\n"
        "    \\midrule\n"
        "    start & 0.660 & 28.0 & 7.4 \\\\\n"
        "    refined & \\textbf{0.830} & -- & \\textbf{34.1 [30.0, 38.0]} \\\\\n"
        "    \\midrule\n"
        "    all & 0.750 & -- & -- \\\\\n"
        "    \\bottomrule\n"
        "  \\end{tabular}\n"
        "  \\caption{Mean errors. n = 3.}\n"
        "  \\label{tab:lm}\n"
        "\\end{table}\n"
    )


def test_a_line_that_begins_with_a_bracket_is_no_argument_of_the_line_before():
    assert "    {}[1] & 0.500" in latex(table_of(row("x", 0.4), row("[1]", 0.5), row("*", 0.5))).replace(
        r"\textbf{", ""
    )


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("100 % & #1 $x$ a_b {c}", r"100 \% \& \#1 \$x\$ a\_b \{c\}"),
        ("a\\b^c~d", r"a\textbackslash{}b\textasciicircum{}c\textasciitilde{}d"),
        ("under 5° <b> a|b", r"under 5\ensuremath{^\circ} \textless{}b\textgreater{} a\textbar{}b"),
        ("two\nlines", "two lines"),
    ],
)
def test_latex_escapes_every_character_with_a_meaning(text, expected):
    assert latex_text(text) == expected


def test_csv_keeps_full_values_and_gives_intervals_their_own_columns():
    table = table_of(row('a,"b"', Interval(value=0.123456789, low=0.1, high=0.2), float("nan"), 0.5), row("c", 0.25))
    lines = list(csv.reader(io.StringIO(csv_text(table))))
    assert lines == [
        ["method", "vss", "vss_low", "vss_high", "re_deg", "add"],
        ['a,"b"', "0.123456789", "0.1", "0.2", "", "0.5"],
        ["c", "0.25", "", "", "", ""],
    ]


def test_json_has_no_nan_and_no_infinity():
    table = table_of(row("a", Interval(value=0.5, low=0.4, high=0.6), float("inf"), float("nan"), total=True))
    data = json.loads(json.dumps(json_data(table), allow_nan=False))
    (line,) = data["rows"]
    expected = {"method": "a", "vss": {"value": 0.5, "low": 0.4, "high": 0.6}, "re_deg": None, "add": None}
    assert line == {"group": "", "total": True, "cells": expected}
    assert data["columns"][3]["unit"] == "%"


def test_cells_without_a_column_and_columns_named_twice_are_refused():
    with pytest.raises(ValueError, match=r"cells without a column \['te'\]"):
        Table(title="t", columns=[VSS], rows=[Row(cells={"te": 1.0})])
    with pytest.raises(ValueError, match=r"columns named twice \['vss'\]"):
        Table(title="t", columns=[VSS, VSS])


@pytest.mark.parametrize(("suffix", "start"), [(".md", "### one"), (".tex", "% \\use"), (".json", "["), (".csv", "me")])
def test_a_file_is_written_in_the_format_of_its_suffix(tmp_path, suffix, start):
    table = table_of(row("a", 0.5), title="one", name="one")
    (written,) = write_tables(tmp_path / f"out{suffix}", [table])
    assert written.read_text().startswith(start)
    assert written.read_text() == text_of([table], suffix)


def test_several_tables_are_one_document_but_several_csv_files(tmp_path):
    tables = [table_of(row("a", 0.5), title=name, name=name) for name in ("one", "two")]
    (document,) = write_tables(tmp_path / "out.md", tables)
    assert document.read_text().count("### ") == 2
    assert [file.name for file in write_tables(tmp_path / "out.csv", tables)] == ["out_one.csv", "out_two.csv"]
    assert (tmp_path / "out_two.csv").read_text() == csv_text(tables[1])


def test_an_unknown_suffix_is_refused(tmp_path):
    with pytest.raises(ConfigError, match=r"out\.docx: found suffix '\.docx', expected one of \.md, \.tex"):
        write_tables(tmp_path / "out.docx", [table_of()])


FORMULAS = [
    "=HYPERLINK(1)",
    "+1+1",
    "-cmd|x",
    "@SUM(1)",
    "\t=1",
    "'=1",
    "'",
    "-1 (A1)",
    "-1 [1, 2]+A1",
    "-1-1",
    "--",
    "-1(2)",
]


@pytest.mark.parametrize("name", FORMULAS)
def test_a_name_in_a_csv_is_no_formula(name):
    cell = csv_cells.escaped(name)
    assert cell == "'" + name
    assert csv_cells.unescaped(cell) == name
    (line,) = list(csv.reader(io.StringIO(csv_text(table_of(row(name))))))[1:]
    assert line[0] == cell


@pytest.mark.parametrize(
    "text", ["lmo", "a=b", "-0.5", "+1e3", "", "it's", "-", "-0.01 (-0.02 to 0.01)", "-1.5 [-2, -1.0]", "-3 % (4)"]
)
def test_other_cells_of_a_csv_stay(text):
    assert csv_cells.escaped(text) == text
    assert csv_cells.unescaped(text) == text
