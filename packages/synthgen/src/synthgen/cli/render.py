"""`synthgen render`."""

import os
import shutil
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click
from posecore.command_line import progress_bar

from synthgen.cli.options import ENGINES, resumable, scene_options

if TYPE_CHECKING:
    from posecore.shard import Encoded

    from synthgen.config import SynthConfig
    from synthgen.inputs.sources import Sources
    from synthgen.run.shard_job import ShardJob

MOST_WORKERS = 8
MEASURED_FROM = 1000  # pairs: for fewer the measurement would cost more than it is worth


@click.command()
@scene_options
@click.option("--n", required=True, type=click.IntRange(1), help="Number of training pairs.")
@click.option(
    "--workers",
    type=click.IntRange(1),
    help="Local processes. [one per GPU that cycles traces on; otherwise one per core, at most 8]",
)
@click.option("--scheduler", metavar="ADDRESS", help="Render on a running dask cluster instead, tcp://host:port.")
@click.option(
    "--shard-timeout",
    type=click.FloatRange(min=0, min_open=True),
    metavar="SECONDS",
    help="Kill a worker that holds a shard for longer, and do the shard again. [20 x the median, at least 300]",
)
@click.option("--hypotheses-per-scene", type=click.IntRange(1), help="Pairs that share one rendered scene. [preset]")
@click.option(
    "--hypothesis-engine",
    type=click.Choice(ENGINES),
    help="Renderer of hypothesis patches; inference uses raster. [preset]",
)
@click.option(
    "--device",
    type=click.Choice(["auto", "cpu", "cuda", "optix"]),
    help="Where cycles traces: auto is the first of optix, cuda and cpu that is there. [preset, cpu]",
)
@click.option(
    "--only", type=click.IntRange(0), metavar="I", help="Render sample I alone, and compare it with the stored one."
)
@click.option(
    "--save",
    type=click.Path(path_type=Path),
    metavar="FILE",
    help="Where to put that sample, .npz or a picture. [nowhere]",
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
    shard_timeout: float | None,
    only: int | None,
    save: Path | None,
    **values: Any,
) -> None:
    """Render N training pairs as a sharded Zarr dataset.

    Stopping it at any moment, also with kill -9, loses only the shards in flight; the same command again continues
    and ends with the same bytes. A scene that crashes the renderer twice is left out and drawn anew, and said.

    \b
    synthgen render --object mesh.ply --n 200000 --out shards
    synthgen render --object mesh.ply --n 2000 --out draft --engine raster --preset quickstart
    synthgen render --object a.ply --object b.ply --n 50000 --out shards --backgrounds photos/ --workers 8
    synthgen render --object models/ --n 50000 --out many --preset tabletop --hdris hdris/ --occluders clutter/
    synthgen render --object mesh.ply --n 1000 --out near --set distance.min=3 --set distance.max=5
    synthgen render --object mesh.ply --n 200000 --out shards --device optix
    synthgen render --object mesh.ply --n 1000000 --out s3://bucket/shards --scheduler tcp://node0:8786
    synthgen render --object mesh.ply --n 200000 --out shards --only 17 --save sample.png
    """
    from posecore.shard import ShardWriter

    from synthgen.config import load_config
    from synthgen.pairs import data_card
    from synthgen.run import dispatcher, lock
    from synthgen.run.shard_job import ShardJob

    if workers and scheduler:
        raise click.UsageError(
            "--workers starts local processes, --scheduler uses those of a cluster: give one of them"
        )
    if save is not None and only is None:
        raise click.UsageError("--save writes the sample of --only: give that too")
    config, gpus = _with_device(load_config(preset, overrides, values), scheduler)
    meshes, assets = sources.meshes(), sources.assets()
    card = data_card.make_card(config, n, meshes, assets)
    cores = len(os.sched_getaffinity(0))
    workers = workers or len(gpus) or min(MOST_WORKERS, cores)
    if only is not None:
        _one_sample(out, ShardJob(config=config, card=card, meshes=meshes, assets=assets, threads=cores), only, save)
        return
    new = "://" not in out and not Path(out).exists()
    with lock.held(out), resumable(out), _leaving_nothing_useless(Path(out) if new else None):
        writer = ShardWriter.create(out, card)
        for key, data in data_card.model_files(meshes, sources.infos(meshes)).items():
            writer.add_file(key, data)
        threads = 1 if scheduler else dispatcher.threads_per_worker(workers, cores)
        job = ShardJob(config=config, card=writer.card, meshes=meshes, assets=assets, threads=threads)
        damaged = writer.damaged()
        for shard_id, what in sorted(damaged.items())[:3]:
            click.echo(f"{out}: shard {shard_id} is damaged ({what}) and is rendered again", err=True)
        if len(damaged) > 3:
            click.echo(f"{out}: {len(damaged) - 3} further shards are damaged and are rendered again", err=True)
        done, total = dispatcher.progress(job, writer, damaged)
        click.echo(
            f"{out}: {done} of {total} pairs are there, rendering {total - done} with {config.engine}, "
            f"{_prospect(out, job, total - done, None if scheduler else workers)}",
            err=True,
        )
        with progress_bar(quiet) as bar:
            task = bar.add_task("pairs", total=total, completed=done)

            def on_shard(encoded: "Encoded") -> None:
                bar.advance(task, encoded.line["n"])

            dispatcher.run(
                job,
                writer,
                workers=workers,
                scheduler=scheduler,
                on_shard=on_shard,
                redo=set(damaged),
                shard_timeout_s=shard_timeout,
                gpus=gpus,
            )
        scenes = writer.quarantined()
        replaced = f", {len(scenes)} scenes quarantined and drawn anew" if scenes else ""
        click.echo(f"{out}: complete, {total} pairs{replaced}", err=True)


@contextmanager
def _leaving_nothing_useless(new: Path | None) -> Iterator[None]:
    """Remove a new folder when an error ends the command before the first shard is there.

    Its data card would refuse the same command with the mended setting.

    Args:
        new: A folder that was not there before the command; None when it was.
    """
    from posecore.errors import PoseError
    from posecore.shard.layout import MANIFEST

    try:
        yield
    except PoseError:
        if new is not None and not (new / MANIFEST).exists():
            shutil.rmtree(new, ignore_errors=True)
        raise


def _prospect(out: str, job: "ShardJob", missing: int, workers: int | None) -> str:
    """What is still to come, in words: measured before a long run, else the rough size alone.

    Args:
        out: Where to.
        job: What.
        missing: Pairs to render.
        workers: Local ones, None where others render: their speed is not known here.

    Raises:
        StorageError: The disk has no room for it.
    """
    from posecore.errors import RenderError

    from synthgen.machine import size_text
    from synthgen.pairs import data_card
    from synthgen.run.estimate import check_free_space, estimate

    if missing < MEASURED_FROM:
        size = data_card.estimated_bytes(job.config.patch_px, job.config.contour_points, missing)
        check_free_space(out, size)
        return f"about {size_text(size)} more"
    try:
        found = estimate(job)
    except RenderError as error:  # one scene may be to blame, or this machine only gives orders: the workers will see
        return f"size and time unknown ({error})"
    size = found.bytes(missing)
    check_free_space(out, size)
    time = "" if workers is None else f" and {_duration(found.seconds(missing, workers))}"
    return f"about {size_text(size)}{time} more, judged by {found.pairs} pairs"


def _duration(seconds: float) -> str:
    return f"{seconds / 3600:.1f} h" if seconds >= 7200 else f"{max(1.0, seconds / 60):.0f} min"


def _one_sample(out: str, job: "ShardJob", index: int, save: Path | None) -> None:
    """Make one sample again, say whether it is the stored one, and end with 1 when it is not."""
    from synthgen.inspect.reproduce import run_only

    made = run_only(out, job, index, save)
    click.echo(made.text)
    if made.differences:
        sys.exit(1)


def _with_device(config: "SynthConfig", scheduler: str | None) -> tuple["SynthConfig", tuple[str, ...]]:
    """The configuration with the device that 'auto' means here, since it goes into the card, and the GPUs it names."""
    from dataclasses import replace

    from synthgen.engines.devices import choose_device, list_gpus, visible_gpus

    if config.device == "cpu":
        return config, ()
    if "cycles" not in (config.engine, config.hypothesis_engine):  # the others draw with OpenGL
        return replace(config, device="cpu"), ()
    if scheduler is not None:
        if config.device == "auto":
            raise click.UsageError(
                "--device auto: this machine's GPUs say nothing about the workers'; name what they have: optix, cuda "
                "or cpu"
            )
        return config, ()
    found = list_gpus()
    device = choose_device(config.device, found)
    return replace(config, device=device), visible_gpus(found.get(device, 0))
