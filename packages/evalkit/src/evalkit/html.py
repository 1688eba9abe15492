"""The report's page: one file, light, readable from 360 px to wide screens, nothing loaded from elsewhere."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from html import escape
from typing import Any

STYLE = """
:root { color-scheme: light; --ink: #1c2330; --soft: #5b6472; --line: #dfe3ea; --wash: #f5f7fa; }
* { box-sizing: border-box; }
body { margin: 0 auto; padding: 20px 16px 60px; max-width: 1320px; color: var(--ink); background: #fff;
  font: 15px/1.5 system-ui, -apple-system, "Segoe UI", Roboto, "Helvetica Neue", Arial, sans-serif; }
h1 { font-size: 1.6rem; line-height: 1.2; margin: 0 0 4px; }
h2 { font-size: 1.15rem; margin: 34px 0 8px; padding-top: 14px; border-top: 1px solid var(--line); }
h3 { font-size: 1rem; margin: 18px 0 6px; }
p { margin: 6px 0; max-width: 92ch; }
.soft, figcaption small { color: var(--soft); }
.words { background: var(--wash); border-left: 4px solid #1f5fd0; padding: 10px 14px; margin: 10px 0;
  max-width: 100ch; }
.words p { margin: 4px 0; }
.scroll { overflow-x: auto; border: 1px solid var(--line); border-radius: 6px; margin: 8px 0 14px; max-width: 100%; }
table { border-collapse: collapse; font-size: 13px; font-variant-numeric: tabular-nums; width: 100%; }
th, td { padding: 4px 9px; text-align: right; white-space: nowrap; border-bottom: 1px solid var(--line); }
thead th { background: var(--wash); font-weight: 600; }
thead tr:first-child th { border-bottom: 0; color: var(--soft); font-weight: 500; padding-bottom: 0;
  text-align: center; }
th.start { border-left: 1px solid var(--line); }
td.start { border-left: 1px solid var(--line); }
th:first-child, td:first-child { text-align: left; position: sticky; left: 0; background: #fff; font-weight: 600; }
thead th:first-child { background: var(--wash); }
tr.total td { border-top: 2px solid #b9c0cc; font-weight: 600; }
tbody tr:last-child td { border-bottom: 0; }
.bad { color: #b3261e; font-weight: 600; }
.plots, .case { display: grid; gap: 14px; }
.plots { grid-template-columns: repeat(auto-fill, minmax(min(100%, 340px), 1fr)); }
figure { margin: 0; min-width: 0; }
figcaption { font-weight: 600; font-size: 13.5px; margin-bottom: 4px; }
figure svg { width: 100%; height: auto; display: block; border: 1px solid var(--line); border-radius: 6px; }
svg text { font: 12px system-ui, Arial, sans-serif; fill: #4a5261; }
.grid { stroke: #e8ebf0; } .axis, .tick { stroke: #9aa3b2; } path { fill: none; }
.legend { display: flex; flex-wrap: wrap; gap: 4px 18px; font-size: 13.5px; }
.legend span { display: inline-flex; align-items: center; gap: 6px; }
.legend svg { width: 30px; height: 12px; }
.cases { display: grid; grid-template-columns: repeat(auto-fill, minmax(min(100%, var(--case)), 1fr)); gap: 16px; }
.case { border: 1px solid var(--line); border-radius: 6px; padding: 10px; align-content: start; }
.case h3 { margin: 0; font-size: 13.5px; }
.shots { display: grid; grid-template-columns: repeat(auto-fit, minmax(min(100%, 150px), 1fr)); gap: 8px; }
.shots img { width: 100%; height: auto; display: block; border-radius: 4px; }
.shots figcaption { font-weight: 400; font-size: 12px; line-height: 1.35; margin: 4px 0 0; }
.swatch { display: inline-block; width: 22px; height: 4px; vertical-align: middle; border-radius: 2px; }
dl { display: grid; grid-template-columns: minmax(90px, max-content) 1fr; gap: 3px 14px; font-size: 13.5px; }
dt { font-weight: 600; } dd { margin: 0; overflow-wrap: anywhere; }
@media (max-width: 560px) { body { padding: 14px 10px 40px; font-size: 14px; } th, td { padding: 4px 6px; }
  svg text { font-size: 14px; }
  dl { grid-template-columns: 1fr; } dd { margin-bottom: 6px; } }
"""


@dataclass(frozen=True, kw_only=True)
class Column:
    """A table column: its group's heading, its own, the key in the scores, and how the value is written."""

    group: str
    heading: str
    key: str
    style: str


def _columns(*rows: tuple[str, str, str, str]) -> tuple[Column, ...]:
    return tuple(Column(group=group, heading=heading, key=key, style=style) for group, heading, key, style in rows)


SCORE_COLUMNS = _columns(
    ("poses", "expected", "expected", "d"),
    ("poses", "missing", "missing", "missing"),
    ("VSS mean", "all", "vss_mean", ".3f"),
    ("VSS mean", "found", "vss_mean_found", ".3f"),
    ("recall at 0.1 diameter", "ADD", "add_recall_0.1d", "%"),
    ("recall at 0.1 diameter", "ADI", "adi_recall_0.1d", "%"),
    ("recall at 0.1 diameter", "ADD(-S)", "add_s_recall_0.1d", "%"),
    ("AUC to 100 mm", "ADD", "add_auc_100mm", ".3f"),
    ("AUC to 100 mm", "ADI", "adi_auc_100mm", ".3f"),
    ("share", "5 cm 5°", "5cm5deg", "%"),
    ("share", "proj. 5 px", "proj_5px", "%"),
    ("share", "diverged", "diverged", "%"),
    ("BOP average recall", "MSSD", "ar_mssd", ".3f"),
    ("BOP average recall", "MSPD", "ar_mspd", ".3f"),
)

ERROR_COLUMNS = _columns(
    ("poses", "found", "found", "d"),
    ("rotation, deg", "mean", "re_deg_mean", ".2f"),
    ("rotation, deg", "median", "re_deg_median", ".2f"),
    ("rotation sym., deg", "mean", "re_sym_deg_mean", ".2f"),
    ("rotation sym., deg", "median", "re_sym_deg_median", ".2f"),
    ("camera x, mm", "mean", "tx_mm_mean", ".2f"),
    ("camera x, mm", "median", "tx_mm_median", ".2f"),
    ("camera y, mm", "mean", "ty_mm_mean", ".2f"),
    ("camera y, mm", "median", "ty_mm_median", ".2f"),
    ("camera z, mm", "mean", "tz_mm_mean", ".2f"),
    ("camera z, mm", "median", "tz_mm_median", ".2f"),
    ("ADD, mm", "mean", "add_mm_mean", ".2f"),
    ("ADD, mm", "median", "add_mm_median", ".2f"),
)

LEVEL_COLUMNS = _columns(
    ("poses", "expected", "expected", "d"),
    ("poses", "found", "found", "d"),
    ("rotation error", "under 5°", "under_5deg", "%"),
    ("rotation error", "under 10°", "under_10deg", "%"),
    ("rotation error", "under 20°", "under_20deg", "%"),
    ("translation", "under 0.1 d", "te_under_0.1d", "%"),
    ("share", "diverged", "diverged", "%"),
    ("mean final error", "deg", "re_sym_deg_mean", ".2f"),
    ("mean final error", "mm", "te_mm_mean", ".2f"),
)


def _cell(value: Any, style: str) -> str:
    if value is None or value != value:
        return "–"
    if style == "%":
        return f"{100 * value:.1f}%"
    if style == "missing":
        return f'<span class="bad">{value}</span>' if value else "0"
    return format(value, style)


def table(
    first: str, rows: Sequence[tuple[str, Mapping[str, Any]]], columns: Sequence[Column], *, total_last: bool = False
) -> str:
    """A table of scores that scrolls sideways on narrow screens; the first column stays in place."""
    groups: list[tuple[str, int]] = []
    for column in columns:
        if groups and groups[-1][0] == column.group:
            groups[-1] = (column.group, groups[-1][1] + 1)
        else:
            groups.append((column.group, 1))
    opens = [index == 0 or columns[index - 1].group != column.group for index, column in enumerate(columns)]
    classes = [' class="start"' if is_open else "" for is_open in opens]
    top = "".join(f'<th class="start" colspan="{span}" scope="colgroup">{escape(name)}</th>' for name, span in groups)
    heads = "".join(
        f'<th{mark} scope="col">{escape(column.heading)}</th>' for column, mark in zip(columns, classes, strict=True)
    )
    body = []
    for index, (name, values) in enumerate(rows):
        cells = "".join(
            f"<td{mark}>{_cell(values.get(column.key), column.style)}</td>"
            for column, mark in zip(columns, classes, strict=True)
        )
        mark = ' class="total"' if total_last and index == len(rows) - 1 else ""
        body.append(f"<tr{mark}><td>{escape(name)}</td>{cells}</tr>")
    return (
        f'<div class="scroll" tabindex="0"><table><thead><tr><th></th>{top}</tr>'
        f'<tr><th scope="col">{escape(first)}</th>{heads}</tr></thead><tbody>{"".join(body)}</tbody></table></div>'
    )


@dataclass(frozen=True, kw_only=True)
class Shot:
    """One picture of a case: which result file, the image as a data URL, and a line below it."""

    name: str
    url: str
    caption: str


def case(title: str, shots: Sequence[Shot]) -> str:
    """The same pose as several result files have it, side by side."""
    figures = "".join(
        f'<figure><img src="{shot.url}" alt="{escape(title)}: {escape(shot.name)}" width="300" height="300">'
        f"<figcaption><b>{escape(shot.name)}</b><br>{escape(shot.caption)}</figcaption></figure>"
        for shot in shots
    )
    return f'<article class="case"><h3>{escape(title)}</h3><div class="shots">{figures}</div></article>'


def cases(articles: Sequence[str], shots_each: int) -> str:
    """A grid of cases, each wide enough for its pictures."""
    width = 20 + 190 * max(1, min(shots_each, 4))
    return f'<div class="cases" style="--case: {width}px">{"".join(articles)}</div>'


def definitions(entries: Mapping[str, str]) -> str:
    """Terms and what they mean."""
    items = "".join(f"<dt>{escape(term)}</dt><dd>{escape(text)}</dd>" for term, text in entries.items())
    return f"<dl>{items}</dl>"


def section(heading: str, *parts: str) -> str:
    """A headed part of the page; empty where it has nothing to show."""
    content = "".join(part for part in parts if part)
    return f"<section><h2>{escape(heading)}</h2>{content}</section>" if content else ""


def paragraph(text: str, soft: bool = False) -> str:
    """Plain text."""
    return f"<p{' class=' + chr(34) + 'soft' + chr(34) if soft else ''}>{escape(text)}</p>"


def page(title: str, body: str) -> str:
    """A whole document."""
    return (
        '<!doctype html><html lang="en"><head><meta charset="utf-8">'
        '<meta name="viewport" content="width=device-width, initial-scale=1">'
        f"<title>{escape(title)}</title><style>{STYLE}</style></head><body>{body}</body></html>\n"
    )
