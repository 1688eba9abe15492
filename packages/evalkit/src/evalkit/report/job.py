"""A report folder: HTML page, tables as Markdown and LaTeX, CSV with a line for each pose, JSON summary."""

import json
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import pandas as pd
from posecore.files import write_atomic

from evalkit.evaluation.evaluator import Evaluator, VssKind
from evalkit.evaluation.scored_file import Scored, score_file
from evalkit.inputs.result_files import load_result_files, open_dataset
from evalkit.report.page import report_page
from evalkit.report.summary import summarise
from evalkit.tables.csv_cells import escaped
from evalkit.tables.report_tables import report_tables
from evalkit.tables.writers import write_tables

OnFile = Callable[[str, int], Callable[[int], None]]
"""Called with a result file's name and number of poses; returns what is called with each number of poses done."""


@dataclass(frozen=True, kw_only=True)
class ReportJob:
    """A report to make.

    Attributes:
        out: folder, made where it does not exist.
        results: BOP result files; without any, those with a sidecar in the working folder and its `results/`.
        dataset: BOP folder with ground truth; by default the one that the sidecars name.
        split: of the dataset.
        vss: VSS of whole silhouettes or of visible parts.
        worst: number of worst cases shown as pictures; 0 shows no case.
        workers: number of processes that score poses; the numbers do not depend on it.
    """

    out: Path = Path("report")
    results: tuple[Path, ...] = ()
    dataset: Path | None = None
    split: str | None = None
    vss: VssKind = "full"
    worst: int = 12
    workers: int = 1


@dataclass(frozen=True, kw_only=True)
class Report:
    """Paths of a report's files, and its summary."""

    page: Path
    table: Path
    summary_file: Path
    tables: tuple[Path, ...]
    summary: dict[str, Any]


def make_report(job: ReportJob, on_file: OnFile = lambda name, total: lambda done: None) -> Report:
    """Evaluate result files; write `index.html`, `tables.md`, `tables.tex`, `estimates.csv` and `summary.json`.

    Args:
        job: what is evaluated, and where it is written.
        on_file: progress, see `OnFile`.

    Raises:
        PoseError: a file or the dataset is not usable; the message names it.
    """
    dataset, results = open_dataset(job.results, job.dataset, job.split)
    files = load_result_files(results, dataset)
    with Evaluator(dataset, job.vss, workers=job.workers) as evaluator:
        scored = [score_file(evaluator, file, partial(on_file, file.name)) for file in files]
        summary = summarise(dataset, scored, job.vss)
        page = report_page(evaluator, scored, summary, job.worst)
    out = job.out
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
        part.insert(0, "results", escaped(item.file.name))
        parts.append(part)
    text: str = pd.concat(parts).to_csv(index=False, lineterminator="\n", float_format="%.9g")
    return text
