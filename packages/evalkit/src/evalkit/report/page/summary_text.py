"""The main results in sentences."""

from collections.abc import Mapping, Sequence
from typing import Any

from evalkit.report import html
from evalkit.report.comparison import interval_words

FIRST = (
    ("vss_mean", "mean VSS", 1.0, "", ".3f"),
    ("add_s_recall_0.1d", "ADD(-S) recall at 0.1 diameter", 100.0, " %", ".1f"),
    ("re_sym_deg_median", "median rotation error", 1.0, "°", ".1f"),
    ("te_mm_median", "median distance of the centres", 1.0, " mm", ".1f"),
)
"""Scores in every file's sentence: key, words, factor, unit, number format."""


def head(summary: Mapping[str, Any]) -> str:
    """Text below the page's title."""
    dataset = summary["dataset"]
    files = summary["files"]
    count = f"{len(files)} result file{'s' * (len(files) != 1)}"
    return html.paragraph(
        f"Split {dataset['split']}, {dataset['targets']} targets, {count}. "
        f"VSS is {summary['definitions']['VSS variant']}.",
        soft=True,
    )


def summary(summary: Mapping[str, Any]) -> list[str]:
    """Changes from the initial poses, and the scores of each file."""
    changes = "".join(_change(item) for item in (*summary["against_initial"], *summary["against_first"]))
    files = html.heading("Result files") + html.items([file_words(file) for file in summary["files"]])
    return [f'<div class="words">{changes}{files}</div>']


def _change(compared: Mapping[str, Any]) -> str:
    sentences = [text[0].upper() + text[1:] + "." for text in compared["changes"]]
    after = ""
    if sentences:
        missing = compared["missing"]
        are = "pose is" if missing == 1 else "poses are"
        lost = f"{missing} {are} missing in {compared['name']}: failures in the tables. " if missing else ""
        after = f'<p class="note">{html.text(lost + interval_words(compared))}</p>'
    verdict = html.paragraph(compared["verdict"]) if compared["verdict"] else ""
    return html.heading(compared["headline"]) + verdict + html.items(sentences) + after


def file_words(file: Mapping[str, Any]) -> str:
    """The scores of a file in one sentence."""
    total, intervals = file["total"], file["intervals"]["total"]["intervals"]
    sentences = [f"{total['found']} of {total['expected']} poses found"]
    for key, label, factor, unit, style in FIRST:
        if total[key] is not None:
            sentences.append(f"{label} {factor * total[key]:{style}}{unit}{_ends(intervals.get(key), factor, style)}")
    return f"{file['name']}: {', '.join(sentences)}."


def _ends(interval: Sequence[float] | None, factor: float, style: str) -> str:
    return "" if interval is None else f" [{factor * interval[0]:{style}}, {factor * interval[1]:{style}}]"
