"""The paper's tables from result files: refinement, loss ablation, perturbation curves, according to the files."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

from posecore.bop import BopDataset

from evalkit.evaluation.evaluator import Evaluator, VssKind
from evalkit.evaluation.scored_file import Scored, score_file
from evalkit.inputs.perturbation import protocol_deviations
from evalkit.inputs.result_files import load_result_files, open_dataset
from evalkit.scores.convergence import by_level, by_level_and_object
from evalkit.tables.convergence import level_object_tables, level_tables
from evalkit.tables.model import Table
from evalkit.tables.paper_refinement import (
    By,
    Method,
    ablation_table,
    before_after_table,
    error_table,
    methods_of,
    score_by_group_table,
)
from evalkit.tables.writers import require_suffixes, write_tables


@dataclass(frozen=True, kw_only=True)
class PaperTablesJob:
    """Tables of the paper to make.

    Attributes:
        results: BOP result files; without any, those with a sidecar in the working folder and its `results/`.
        dataset: BOP folder with ground truth; by default the one that the sidecars name.
        split: of the dataset.
        by: group that totals count once, with a row or column for each.
        vss: VSS of whole silhouettes or of visible parts.
        workers: number of processes that score poses; the numbers do not depend on it.
        resamples: for 95 % bootstrap intervals, 0 for none.
        seed: of the resampling.
        out: files to write, .md, .tex, .csv or .json.
    """

    results: tuple[Path, ...] = ()
    dataset: Path | None = None
    split: str | None = None
    by: By = "object"
    vss: VssKind = "full"
    workers: int = 1
    resamples: int = 0
    seed: int = 0
    out: tuple[Path, ...] = ()

    def __post_init__(self) -> None:
        require_suffixes(self.out)


def make_paper_tables(job: PaperTablesJob) -> tuple[list[Table], list[Path]]:
    """The tables of a job, and the files written.

    Raises:
        PoseError: a file or the dataset is not usable; the message names it.
    """
    dataset, results = open_dataset(job.results, job.dataset, job.split)
    scored = score_files(dataset, results, job.vss, workers=job.workers)
    tables = paper_tables(scored, by=job.by, resamples=job.resamples, seed=job.seed)
    return tables, [written for path in job.out for written in write_tables(path, tables)]


def score_files(dataset: BopDataset, paths: Sequence[Path], vss: VssKind = "full", *, workers: int = 1) -> list[Scored]:
    """Evaluate result files, initial poses first, in so many processes.

    Raises:
        PoseError: a file or the dataset is not usable; the message names it.
    """
    with Evaluator(dataset, vss, workers=workers) as evaluator:
        return [score_file(evaluator, file) for file in load_result_files(paths, dataset)]


def paper_tables(scored: Sequence[Scored], *, by: By = "object", resamples: int = 0, seed: int = 0) -> list[Table]:
    """Tables of the paper's section 4 for these files.

    Files from initial poses perturbed by steps give curves (4.1), in total and by object. The others give mean errors
    and recalls (table 2a), VSS and ADD by object (table 1), each object before and after, and, for several refined
    files, VSS side by side (table 2b).

    Args:
        scored: initial poses first.
        by: group that totals count once, with a row or column for each.
        resamples: for 95 % bootstrap intervals, 0 for none.
        seed: of the resampling.
    """
    methods = methods_of(scored)
    stepped = [bool(by_level(method.table)) for method in methods]
    curves = [method for method, is_stepped in zip(methods, stepped, strict=True) if is_stepped]
    rest = [method for method, is_stepped in zip(methods, stepped, strict=True) if not is_stepped]
    deviations = [
        f"{method.name}: {text}."
        for method, item, is_stepped in zip(methods, scored, stepped, strict=True)
        for text in protocol_deviations(item.file.sidecar)
        if is_stepped
    ]
    tables = _refinement_tables(rest, by, resamples, seed) if rest else []
    return tables + _curve_tables(curves, deviations, resamples, seed)


def _refinement_tables(methods: Sequence[Method], by: By, resamples: int, seed: int) -> list[Table]:
    tables = [
        error_table(methods, by=by, resamples=resamples, seed=seed),
        score_by_group_table(methods, score="vss_mean", by=by, resamples=resamples, seed=seed),
        score_by_group_table(methods, score="add_recall_0.1d", by=by, resamples=resamples, seed=seed),
        before_after_table(methods, by=by, resamples=resamples, seed=seed),
    ]
    refined = [method for method in methods if not method.is_initial]
    if len(refined) > 1:
        tables.append(ablation_table(refined, by=by, resamples=resamples, seed=seed))
    return tables


def _curve_tables(methods: Sequence[Method], deviations: Sequence[str], resamples: int, seed: int) -> list[Table]:
    total = {method.name: by_level(method.table, resamples=resamples, seed=seed) for method in methods}
    objects = {method.name: by_level_and_object(method.table, resamples=resamples, seed=seed) for method in methods}
    several = len({obj_id for by_object in objects.values() for obj_id in by_object}) > 1
    tables = level_tables(total) + (level_object_tables(objects) if several else [])
    return [replace(table, note=" ".join([table.note, *deviations])) for table in tables]
