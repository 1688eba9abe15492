"""A report folder: one HTML page, its tables as Markdown and LaTeX, one CSV line for each pose, one JSON summary."""

import json
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import pandas as pd
from posecore.bop import BopDataset
from posecore.errors import ConfigError
from posecore.files import write_atomic

from evalkit.evaluation.evaluator import Evaluator, VssKind
from evalkit.evaluation.scored_file import Scored, score_file
from evalkit.inputs.result_files import load_result_files
from evalkit.report.page import report_page
from evalkit.report.summary import summarise
from evalkit.tables.report_tables import report_tables
from evalkit.tables.writers import write_tables

Start = Callable[[str, int], Callable[[int], None]]
"""Announces a result file and its number of poses; returns what is called as they are done."""


@dataclass(frozen=True, kw_only=True)
class Report:
    """Where a report was written, and its summary."""

    page: Path
    table: Path
    summary_file: Path
    tables: tuple[Path, ...]
    summary: dict[str, Any]


def write_report(
    dataset: BopDataset,
    results: Sequence[Path],
    out: Path,
    *,
    vss: VssKind = "full",
    worst: int = 12,
    workers: int = 1,
    start: Start = lambda name, total: lambda done: None,
) -> Report:
    """Evaluate result files; write `index.html`, `tables.md`, `tables.tex`, `estimates.csv`, `summary.json` into `out`.

    Args:
        dataset: with ground truth.
        results: BOP result files; start poses are known by `method: start` in their sidecar.
        out: folder, made where it does not exist.
        vss: whole silhouettes or visible parts.
        worst: number of worst cases to show as pictures.
        workers: number of processes that score poses.
        start: progress, see `Start`.

    Raises:
        PoseError: a file or the dataset is not usable; the message names it.
    """
    if not results:
        raise ConfigError("no result files: name them with --results FILE.csv")
    files = load_result_files(results, dataset)
    with Evaluator(dataset, vss, workers=workers) as evaluator:
        scored = [score_file(evaluator, file, partial(start, file.name)) for file in files]
        summary = summarise(dataset, scored, vss)
        page = report_page(evaluator, scored, summary, worst)
    written = Report(
        page=out / "index.html",
        table=out / "estimates.csv",
        summary_file=out / "summary.json",
        tables=(out / "tables.md", out / "tables.tex"),
        summary=summary,
    )
    write_atomic(written.table, estimates_csv(scored).encode())
    write_atomic(written.summary_file, (json.dumps(summary, indent=2, allow_nan=False) + "\n").encode())
    for file in written.tables:
        write_tables(file, report_tables(summary))
    write_atomic(written.page, page.encode())
    return written


def estimates_csv(scored: Sequence[Scored]) -> str:
    """One line for each expected pose of each result file; NaN is left empty, units are in the column names."""
    parts = []
    for item in scored:
        part = item.table.copy()
        part[["found", "symmetric"]] = part[["found", "symmetric"]].astype("int64")
        part.insert(0, "results", item.file.name)
        parts.append(part)
    text: str = pd.concat(parts).to_csv(index=False, lineterminator="\n", float_format="%.9g")
    return text
