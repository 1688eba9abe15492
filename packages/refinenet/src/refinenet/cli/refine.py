"""`refinenet refine`."""

from pathlib import Path
from typing import TYPE_CHECKING, get_args

import click
from posecore.command_line import end_early, progress_bar

from refinenet.cli.options import (
    FILE,
    NEW_FILE,
    checkpoint_option,
    device_option,
    iterations_option,
    method_option,
    other_mesh_option,
    quiet_option,
    refuse_unused_network_options,
    require_distinct_files,
    require_used,
    threads_option,
    verbose_option,
    workers_option,
)
from refinenet.refine.registry import NETWORK, MethodName, MethodSettings
from refinenet.refiner import HypothesisScorer

if TYPE_CHECKING:
    from refinenet.refine.bop_results import RefineJob, RefineSummary

SHOWN_FAILURES = 5


@click.command()
@method_option
@checkpoint_option
@click.option("--dataset", required=True, type=FILE, metavar="DIR", help="BOP dataset with the images.")
@click.option("--split", metavar="NAME", help="Split folder. [test, val, train_pbr, train or the only one]")
@click.option("--init", required=True, type=FILE, metavar="CSV", help="Initial poses, a BOP result file.")
@click.option("--out", required=True, type=NEW_FILE, metavar="CSV", help="Refined poses, a BOP result file.")
@iterations_option
@click.option(
    "--hypotheses",
    type=click.IntRange(1),
    default=1,
    help="Hypotheses for each initial pose: the pose itself, and poses drawn around it.",
)
@click.option(
    "--scorer", type=click.Choice(get_args(HypothesisScorer)), default="gradient",
    help="Ranking that selects the quarter of the hypotheses to refine: gradient similarity of render and image, or "
    "the network's confidence; none refines all.",
)  # fmt: skip
@click.option("--seed", type=click.IntRange(0), default=0, help="Seed of the hypotheses.")
@click.option("--object", "objects", type=int, multiple=True, help="Refine only this object's poses. Repeatable. [all]")
@click.option(
    "--min-confidence", type=click.FloatRange(0, 1),
    help="Minimum confidence; poses below it count as failed. [network: 0, search: 0.4, search with a network that "
    "predicts pose quality: 0.5]",
)  # fmt: skip
@click.option(
    "--keep-failed",
    is_flag=True,
    help="Where refinement fails, write the initial pose with score 0 instead of leaving it out. [left out]",
)
@click.option("--name", help="Method's name in the report. [the preset and the checkpoint's step]")
@click.option("--overlay", type=FILE, metavar="DIR", help="Draw initial (red) and refined (green) contours here.")
@click.option(
    "--candidates", type=NEW_FILE, metavar="CSV",
    help="Also write all poses that --method search scored: hypotheses for synthgen cut.",
)  # fmt: skip
@device_option
@click.option(
    "--batch",
    type=click.IntRange(1),
    default=64,
    help="Largest number of poses rendered together; on a GPU, in a forward pass.",
)
@threads_option
@workers_option
@other_mesh_option
@quiet_option
@verbose_option
def refine(
    method: MethodName,
    checkpoint: Path | None,
    dataset: Path,
    split: str | None,
    init: Path,
    out: Path,
    iterations: int,
    hypotheses: int,
    scorer: HypothesisScorer,
    seed: int,
    objects: tuple[int, ...],
    min_confidence: float | None,
    keep_failed: bool,
    name: str | None,
    overlay: Path | None,
    candidates: Path | None,
    device: str,
    batch: int,
    threads: int,
    workers: int,
    allow_other_mesh: bool,
    quiet: bool,
) -> None:
    """Refine BOP estimates; method and settings go into the result file's sidecar.

    A refined pose's score is its confidence, from 0 to 1, or the initial pose's score for a method without confidences.
    Exit code 0 also when some poses fail: these are left out of the file (or kept as they were, --keep-failed), listed
    on stderr with the reason, and counted on the last line.

    \b
    refinenet refine --checkpoint best.safetensors --dataset lmo --init start.csv --out results/refined.csv
    refinenet refine --checkpoint best.safetensors --dataset lmo --init start.csv --out ten.csv --iterations 10
    refinenet refine --checkpoint best.safetensors --dataset lmo --init start.csv --out pool.csv --hypotheses 16
    refinenet refine --method search --dataset lmo --init start.csv --out searched.csv
    refinenet refine --method search --checkpoint flow.safetensors --dataset lmo --init start.csv --out both.csv
    """
    settings = MethodSettings(
        method=method, checkpoint=checkpoint, iterations=iterations, device=device, batch=batch, hypotheses=hypotheses,
        allow_other_mesh=allow_other_mesh, min_confidence=min_confidence, scorer=scorer, seed=seed,
    )  # fmt: skip
    refuse_unused_network_options(settings)
    if method != NETWORK:
        require_used(f"for --method {method}", "scorer", "seed")
    if hypotheses == 1:
        require_used("with one hypothesis, see --hypotheses", "scorer", "seed")
    require_distinct_files({"--init": init, "--checkpoint": checkpoint}, {"--out": out, "--candidates": candidates})
    from refinenet.refine.bop_results import RefineJob, refine_result_file

    job = RefineJob(
        method=settings, dataset=dataset, split=split, init=init, out=out, objects=objects, keep_failed=keep_failed,
        name=name, overlay=overlay, candidates=candidates, workers=workers, threads=threads,
    )  # fmt: skip
    with progress_bar(quiet) as bar:
        task = bar.add_task("poses", total=None, visible=False)
        try:
            summary = refine_result_file(
                job, lambda done, total: bar.update(task, completed=done, total=total, visible=True)
            )
        except KeyboardInterrupt as error:
            end_early(error, None)
    _print(job, summary)
    if summary.stopped is not None:
        end_early(summary.stopped, f"{summary.not_reached} initial poses were not reached, {out} holds the others")


def _print(job: "RefineJob", summary: "RefineSummary") -> None:
    """Print failures to stderr, and counts."""
    refined, failed = summary.refined, summary.refined.failed
    for pose in failed[:SHOWN_FAILURES]:
        initial = pose.initial
        where = f"{job.init}:{initial.line}: scene {initial.scene_id}, image {initial.im_id}, object {initial.obj_id}"
        click.echo(f"Failed: {where}: {pose.result.failure}", err=True)
    if len(failed) > SHOWN_FAILURES:
        click.echo(f"Failed: {len(failed) - SHOWN_FAILURES} more, listed in {job.out}.json", err=True)
    count = len(refined.poses)
    click.echo(
        f"{job.out}: {count} initial poses, {count - len(failed)} refined ({refined.converged} converged), "
        f"{len(failed)} failed"
        + (f" ({'initial poses kept' if job.keep_failed else 'left out of the file'})" if failed else "")
    )
