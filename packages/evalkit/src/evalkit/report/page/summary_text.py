"""What a reader should know first, in sentences."""

from collections.abc import Mapping, Sequence
from typing import Any

from evalkit.report import html
from evalkit.report.comparison import interval_words

FIRST = (
    ("vss_mean", "mean VSS", 1.0, "", ".3f"),
    ("add_s_recall_0.1d", "ADD(-S) recall at 0.1 diameter", 100.0, " %", ".1f"),
    ("re_sym_deg_median", "median rotation error", 1.0, "°", ".1f"),
    ("te_mm_median", "median distance of the origins", 1.0, " mm", ".1f"),
)
"""Scores that are said of every file: key, words, factor, unit, number format."""


def head(summary: Mapping[str, Any]) -> str:
    """What stands below the page's title."""
    dataset = summary["dataset"]
    files = summary["files"]
    count = f"{len(files)} result file{'s' * (len(files) != 1)}"
    return html.paragraph(
        f"Split {dataset['split']}, {dataset['targets']} targets, {count}. "
        f"VSS is {summary['definitions']['VSS variant']}.",
        soft=True,
    )


def summary(summary: Mapping[str, Any]) -> list[str]:
    """What changed against the start poses, and how good each file is."""
    changes = "".join(_change(item) for item in (*summary["against_start"], *summary["against_first"]))
    files = html.heading("Result files") + html.items([file_words(file) for file in summary["files"]])
    return [f'<div class="words">{changes}{files}</div>']


def _change(compared: Mapping[str, Any]) -> str:
    said = [text[0].upper() + text[1:] + "." for text in compared["changes"]]
    after = ""
    if said:
        missing = compared["missing"]
        are = "pose is" if missing == 1 else "poses are"
        lost = f"{missing} {are} missing in {compared['name']}: failures in the tables. " if missing else ""
        after = f'<p class="note">{html.text(lost + interval_words(compared))}</p>'
    verdict = html.paragraph(compared["verdict"]) if compared["verdict"] else ""
    return html.heading(compared["headline"]) + verdict + html.items(said) + after


def file_words(file: Mapping[str, Any]) -> str:
    """How good a file is, in one sentence."""
    total, intervals = file["total"], file["intervals"]["total"]["intervals"]
    said = [f"{total['found']} of {total['expected']} poses found"]
    for key, label, factor, unit, style in FIRST:
        if total[key] is not None:
            said.append(f"{label} {factor * total[key]:{style}}{unit}{_ends(intervals.get(key), factor, style)}")
    return f"{file['name']}: {', '.join(said)}."


def _ends(interval: Sequence[float] | None, factor: float, style: str) -> str:
    return "" if interval is None else f" [{factor * interval[0]:{style}}, {factor * interval[1]:{style}}]"
