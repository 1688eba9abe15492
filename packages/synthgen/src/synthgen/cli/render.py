"""`synthgen render`."""

import os
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from synthgen.cli.console import progress_bar, start_logging, stoppable
from synthgen.cli.options import ENGINES, load_meshes, load_photos, scene_options, text

if TYPE_CHECKING:
    from posecore.mesh import Units


@click.command()
@scene_options
@click.option("--n", required=True, type=click.IntRange(1), help="Number of training pairs.")
@click.option("--workers", type=click.IntRange(1), help="Local processes. [one per core, at most 8]")
@click.option("--scheduler", metavar="ADDRESS", help="Render on a running dask cluster instead, tcp://host:port.")
@click.option("--hypotheses-per-scene", type=click.IntRange(1), help="Pairs that share one rendered scene. [preset]")
@click.option(
    "--hypothesis-engine",
    type=click.Choice(ENGINES),
    help="Renderer of hypothesis patches; inference uses raster. [preset]",
)
@click.option("--device", type=click.Choice(["cpu", "gpu"]), help="Where cycles traces. [preset, cpu]")
def render(
    objects: tuple[Path, ...],
    out: str,
    n: int,
    units: "Units",
    preset: str,
    overrides: tuple[str, ...],
    backgrounds: Path | None,
    models_info: Path | None,
    quiet: bool,
    verbose: bool,
    workers: int | None,
    scheduler: str | None,
    **values: Any,
) -> None:
    """Render N training pairs as a sharded Zarr dataset.

    Stopping it at any moment, also with kill -9, loses only the shards in flight; the same command again continues
    and ends with the same bytes.

    \b
    synthgen render --object mesh.ply --n 200000 --out shards
    synthgen render --object mesh.ply --n 2000 --out draft --engine raster --preset quickstart
    synthgen render --object a.ply --object b.ply --n 50000 --out shards --backgrounds photos/ --workers 8
    synthgen render --object mesh.ply --n 1000 --out near --set distance.min=3 --set distance.max=5
    synthgen render --object mesh.ply --n 1000000 --out s3://bucket/shards --scheduler tcp://node0:8786
    """
    from posecore.shard import ShardWriter

    from synthgen import dataset, pipeline
    from synthgen.config import load_config
    from synthgen.shardrun import ShardJob

    start_logging(verbose)
    config = load_config(preset, overrides, values)
    meshes, photos = load_meshes(objects, units), load_photos(backgrounds)
    card = dataset.make_card(config, n, meshes, photos)
    writer = ShardWriter.create(out, card)
    for key, data in dataset.model_files(meshes, dataset.load_symmetries(text(models_info), meshes)).items():
        writer.add_file(key, data)
    cores = len(os.sched_getaffinity(0))
    workers = workers or min(8, cores)
    threads = 0 if scheduler else pipeline.threads_per_worker(workers, cores)
    job = ShardJob(config=config, card=writer.card, meshes=meshes, photos=photos, threads=threads)
    done, total = pipeline.progress(job, writer)
    size = dataset.estimated_bytes(config, n - done)
    click.echo(
        f"{out}: {done} of {total} pairs are there, rendering {total - done} with {config.engine}, "
        f"about {size / 1e9:.2g} GB more",
        err=True,
    )
    with stoppable(out), progress_bar(quiet) as bar:
        task = bar.add_task("pairs", total=total, completed=done)
        pipeline.run(
            job,
            writer,
            workers=workers,
            scheduler=scheduler,
            on_shard=lambda encoded: bar.advance(task, encoded.line["n"]),
        )
    click.echo(f"{out}: complete, {total} pairs", err=True)
