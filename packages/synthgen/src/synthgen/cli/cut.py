"""`synthgen cut`."""

from pathlib import Path
from typing import TYPE_CHECKING

import click
from posecore.command_line import progress_bar, renamed_arguments

from synthgen.cli.options import QUIET, required_out, resumable

if TYPE_CHECKING:
    from synthgen.run.cut import CutWork


@click.command()
@click.option(
    "--dataset",
    required=True,
    type=click.Path(path_type=Path),
    metavar="DIR",
    help="BOP dataset with annotated images.",
)
@renamed_arguments("--dataset")
@required_out
@click.option(
    "--split",
    metavar="NAME",
    help="Split folder of the dataset. [the only one]",
)
@click.option("--sensor", metavar="NAME", help="Camera of several, as in scene_camera_NAME.json.")
@click.option(
    "--hypotheses",
    type=click.Path(path_type=Path),
    metavar="FILE",
    help="BOP result file: each line is a hypothesis of the nearest annotated instance of its object; images without "
    "a line give no pair. [drawn around the annotated poses]",
)
@click.option("--images", type=click.IntRange(0), help="Most images to cut, evenly spread over all; 0 cuts all. [0]")
@click.option("--patch-px", type=int, help="Side of the patches. [224]")
@click.option("--hypotheses-per-pose", type=int, help="Hypotheses drawn around each annotated pose. [8]")
@click.option("--seed", type=click.IntRange(0), help="Seed of drawn hypotheses. [0]")
@click.option(
    "--set",
    "overrides",
    multiple=True,
    metavar="KEY=VALUE",
    help="Change one configuration key: seed, patch_px, contour_points, hypotheses_per_pose, shard_size, min_visible, "
    "min_area_px, images, window, scale, padding, perturbation.max_angle_deg, ... Repeatable; last wins.",
)
@click.option("--workers", type=click.IntRange(1), default=1, help="Processes; the bytes do not depend on it.")
@QUIET
def cut(
    dataset: Path,
    out: str,
    split: str | None,
    sensor: str | None,
    hypotheses: Path | None,
    overrides: tuple[str, ...],
    workers: int,
    quiet: bool,
    **values: int | None,
) -> None:
    """Cut training pairs from the annotated images of a BOP dataset.

    For training on real images, or on the errors of a detector or of a refinement, whose result file --hypotheses
    takes. Hidden poses and hypotheses that do not fit into their windows are left out, and counted. Never train on
    images that you report results on.

    \b
    synthgen cut --dataset ycbv --split train_real --images 5000 --out shards
    synthgen cut --dataset my_images --out shards --hypotheses detections.csv
    synthgen cut --dataset my_images --out shards --set perturbation.max_angle_deg=20 --patch-px 160
    """
    from synthgen.config import load_cut_config
    from synthgen.run.cut import CutJob, cut_dataset

    job = CutJob(
        dataset=dataset,
        out=out,
        config=load_cut_config(overrides, values),
        split=split,
        sensor=sensor,
        hypotheses=hypotheses,
        workers=workers,
    )
    with resumable(out), progress_bar(quiet) as bar:
        task = bar.add_task("pairs", visible=False)

        def on_plan(plan: "CutWork") -> None:
            click.echo(plan.text, err=True)
            bar.reset(task, total=plan.pairs, visible=True)

        summary = cut_dataset(job, on_plan=on_plan, on_shard=lambda count: bar.advance(task, count))
    click.echo(summary.text, err=True)
