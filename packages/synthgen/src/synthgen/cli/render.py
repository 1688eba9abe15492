"""`synthgen render`."""

import shlex
import sys
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click
from posecore.command_line import progress_bar

from synthgen.cli.options import ENGINE, cluster_options, echo_lines, resumable, scene_options, shards_out
from synthgen.names import DEVICES

if TYPE_CHECKING:
    from synthgen.inputs.sources import Sources
    from synthgen.run.cluster import Certificates
    from synthgen.run.render import RenderJob, RenderPlan


@click.command()
@scene_options
@shards_out
@click.option("--n", required=True, type=click.IntRange(1), help="Number of training pairs.")
@click.option(
    "--test-images",
    type=click.IntRange(0),
    metavar="N",
    help="Images of other scenes for a report, a BOP dataset in DIR/test_bop; `refinenet train` refines poses in them "
    "at its end. [a tenth of --n, at most 100; 0 for a URL or with --scheduler]",
)
@click.option(
    "--workers",
    type=click.IntRange(1),
    help="Local processes. [one per GPU that cycles uses; else one per core, at most 8]",
)
@cluster_options
@click.option(
    "--shard-timeout",
    type=click.FloatRange(min=0, min_open=True),
    metavar="SECONDS",
    help="Kill a worker that needs longer for a shard, and render the shard again. [20 x the median, at least 300]",
)
@click.option("--hypotheses-per-scene", type=click.IntRange(1), help="Pairs per rendered scene. [preset]")
@click.option(
    "--hypothesis-engine",
    type=ENGINE,
    help="Renderer of hypothesis patches; inference uses raster. [preset]",
)
@click.option(
    "--device",
    type=click.Choice(DEVICES),
    help="Device of cycles: auto is the first available one of optix, cuda and cpu. [preset, cpu]",
)
@click.option(
    "--only", type=click.IntRange(0), metavar="I", help="Render sample I alone, and compare it with the stored sample."
)
@click.option(
    "--save",
    type=click.Path(path_type=Path),
    metavar="FILE",
    help="File for that sample, .npz or a picture. [none]",
)
def render(
    sources: "Sources",
    out: str,
    n: int,
    preset: str,
    overrides: tuple[str, ...],
    quiet: bool,
    workers: int | None,
    scheduler: str | None,
    certificates: "Certificates | None",
    dashboard: int | None,
    shard_timeout: float | None,
    test_images: int | None,
    only: int | None,
    save: Path | None,
    **values: Any,
) -> None:
    """Render N training pairs as a sharded Zarr dataset, and some test images of other scenes as a BOP dataset.

    A stop at any moment, even kill -9, loses only the shards in progress; the same command again continues and ends
    with the same bytes. A scene that crashes the renderer twice is replaced by another draw, and reported.

    \b
    synthgen render --object mesh.ply --n 200000
    synthgen render --object mesh.ply --n 2000 --out draft --engine raster --preset quickstart
    synthgen render --object a.ply --object b.ply --n 50000 --out shards --backgrounds photos/ --workers 8
    synthgen render --object models/ --n 50000 --out many --preset tabletop --hdris hdris/ --occluders clutter/
    synthgen render --object mesh.ply --n 1000 --out near --set distance.min=3 --set distance.max=5
    synthgen render --object mesh.ply --n 200000 --out shards --device optix
    synthgen render --object mesh.ply --n 1000000 --out s3://bucket/shards --scheduler tcp://node0:8786
    synthgen render --object mesh.ply --n 900000 --out big --scheduler tls://node0:8786 --tls-ca ca.pem --tls-cert b.pem
    synthgen render --object mesh.ply --n 200000 --out shards --only 17 --save sample.png
    """
    from synthgen.config import load_config
    from synthgen.run.render import RenderJob, render_dataset
    from synthgen.run.test_set import default_count

    if save is not None and only is None:
        raise click.UsageError("--save writes the sample of --only: add --only")
    job = RenderJob(
        out=out,
        n=n,
        config=load_config(preset, overrides, values),
        sources=sources,
        workers=workers,
        scheduler=scheduler,
        certificates=certificates,
        dashboard=dashboard,
        shard_timeout_s=shard_timeout,
        test_images=default_count(n, out, scheduler) if test_images is None else test_images,
    )
    if only is not None:
        _reproduce(job, only, save)
        return
    with resumable(out), progress_bar(quiet) as bar:
        images = bar.add_task("test images", total=job.test_images, visible=False)
        task = bar.add_task("pairs", visible=False)

        def on_plan(plan: "RenderPlan") -> None:
            click.echo(plan.text, err=True)
            bar.reset(images, visible=plan.test_images > 0)
            bar.reset(task, total=plan.total, completed=plan.present, visible=not plan.test_images)

        def on_image(count: int) -> None:
            bar.advance(images, count)
            if bar.tasks[images].finished:  # the pairs' time begins
                bar.reset(task, completed=int(bar.tasks[task].completed), visible=True)

        summary = render_dataset(
            job,
            on_objects=echo_lines,
            on_plan=on_plan,
            on_image=on_image,
            on_shard=lambda encoded: bar.advance(task, encoded.line["n"]),
        )
    click.echo(summary.text, err=True)
    click.echo(f"next: refinenet train {shlex.quote(out)}", err=True)


def _reproduce(job: "RenderJob", index: int, save: Path | None) -> None:
    """Render a single sample again, report whether it equals the stored one, and exit with 1 when it does not."""
    from synthgen.inspect.reproduce import reproduce_sample

    reproduction = reproduce_sample(job, index, save)
    click.echo(reproduction.text)
    if reproduction.differences:
        sys.exit(1)
