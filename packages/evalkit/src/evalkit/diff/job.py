"""Comparison of two files: text, JSON, CSV, page, and verdicts on rules."""

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from posecore.files import write_atomic

from evalkit.diff.deltas import differences
from evalkit.diff.page import difference_page
from evalkit.diff.rules import Rule, Verdict, judge
from evalkit.diff.sides import open_sides
from evalkit.diff.text import csv_text, json_text, text
from evalkit.evaluation.evaluator import VssKind
from evalkit.scores.bootstrap import RESAMPLES
from evalkit.scores.definitions import RECALL_DIAMETERS


@dataclass(frozen=True, kw_only=True)
class DiffJob:
    """A comparison to make, the second file against the first.

    Attributes:
        paths: the two files, each a BOP result file or an `estimates.csv` of a report.
        results: names of the result files within an `estimates.csv` that holds several.
        dataset: BOP folder with ground truth; by default the one that the sidecars name.
        split: of the dataset.
        vss: VSS of whole silhouettes or of visible parts.
        workers: number of processes that score poses; the numbers do not depend on it.
        limit_diameters: an ADD(-S) of so many diameters or more is a failure.
        resamples: of the bootstrap.
        seed: of the bootstrap.
        rules: for continuous integration, see `parse_rule`.
        listed: number of poses that the text lists of each kind.
        pictures: number of pictures of each kind on the page.
        json_file: output as JSON, None for no file.
        csv_file: output with a line for each pose, None for no file.
        html_file: output as a page with pictures, None for no file.
    """

    paths: tuple[Path, Path]
    results: tuple[str | None, str | None] = (None, None)
    dataset: Path | None = None
    split: str | None = None
    vss: VssKind = "full"
    workers: int = 1
    limit_diameters: float = RECALL_DIAMETERS
    resamples: int = RESAMPLES
    seed: int = 0
    rules: tuple[Rule, ...] = ()
    listed: int = 10
    pictures: int = 12
    json_file: Path | None = None
    csv_file: Path | None = None
    html_file: Path | None = None


@dataclass(frozen=True, kw_only=True)
class DiffResult:
    """Result of a comparison: text, verdicts on the rules, and files written."""

    text: str
    verdicts: list[Verdict]
    written: list[Path]


def compare_files(job: DiffJob) -> DiffResult:
    """Compare the two files of a job and write its output files.

    Raises:
        PoseError: a file or the dataset is not usable, or no expected pose is in both files; the message names it.
    """
    with open_sides(
        job.paths, results=job.results, dataset=job.dataset, split=job.split, vss=job.vss, workers=job.workers
    ) as sides:
        difference = differences(sides, limit_diameters=job.limit_diameters, resamples=job.resamples, seed=job.seed)
        verdicts = judge(job.rules, difference)
        written = []
        contents: tuple[tuple[Path | None, Callable[[], str]], ...] = (
            (job.json_file, lambda: json_text(difference, verdicts)),
            (job.csv_file, lambda: csv_text(difference)),
            (job.html_file, lambda: difference_page(difference, verdicts, job.pictures)),
        )
        for file, content in contents:
            if file is not None:
                write_atomic(file, content().encode())
                written.append(file)
        return DiffResult(text=text(difference, job.listed), verdicts=verdicts, written=written)
