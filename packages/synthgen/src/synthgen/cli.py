"""The `synthgen` command: render training pairs, render BOP frames, look at what was rendered."""

import logging
import os
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeVar

import click
from posecore.errors import ConfigError, PoseError, exit_code

if TYPE_CHECKING:
    from posecore.mesh import Mesh, Units
    from rich.progress import Progress

F = TypeVar("F", bound=Callable[..., Any])

ENGINES = ("cycles", "eevee", "raster")
_CONTEXT = {"help_option_names": ["-h", "--help"], "show_default": True, "max_content_width": 110}


class CleanGroup(click.Group):
    """Turns the project's errors into one line on stderr and an exit code, never a traceback."""

    def invoke(self, ctx: click.Context) -> Any:
        """Run the command."""
        try:
            return super().invoke(ctx)
        except PoseError as error:
            click.echo(f"Error: {error}", err=True)
            ctx.exit(exit_code(error))
        except OSError as error:
            from posecore.files import storage_error

            click.echo(f"Error: {storage_error(error.filename or 'storage', error)}", err=True)
            ctx.exit(1)


def _scene_options(command: F) -> F:
    """Options that decide what scenes look like, shared by `render` and `bop`."""
    options = [
        click.option(
            "--object",
            "objects",
            required=True,
            multiple=True,
            type=click.Path(path_type=Path),
            metavar="MESH",
            help="Mesh of the object (.ply, .obj, .gltf, .glb, .stl). Repeat it for several objects: each scene "
            "shows one of them. Files named obj_000005.ply keep their number.",
        ),
        click.option(
            "--out", required=True, type=str, metavar="DIR", help="Where to. The same command again continues it."
        ),
        click.option(
            "--units", type=click.Choice(["mm", "cm", "m"]), default="mm", help="Unit of the mesh's coordinates."
        ),
        click.option(
            "--engine", type=click.Choice(ENGINES), help="Renderer of the scenes; raster needs no Blender. [preset]"
        ),
        click.option(
            "--preset",
            default="default",
            metavar="NAME|FILE",
            help="Shipped preset (default, quickstart) or YAML file.",
        ),
        click.option(
            "--set",
            "overrides",
            multiple=True,
            metavar="KEY=VALUE",
            help="Change one configuration key, e.g. --set window.padding=0.5. Repeatable; last wins.",
        ),
        click.option("--seed", type=click.IntRange(0), help="Dataset seed. [preset, 0]"),
        click.option("--samples", type=click.IntRange(1), help="Light paths per pixel (Blender engines). [preset]"),
        click.option(
            "--backgrounds",
            type=click.Path(path_type=Path),
            metavar="DIR",
            help="Folder of photographs to put behind; without it backgrounds are drawn.",
        ),
        click.option(
            "--models-info",
            type=click.Path(path_type=Path),
            metavar="FILE",
            help="BOP models_info.json to take symmetries from; its keys are object ids or mesh names.",
        ),
        click.option("--quiet", is_flag=True, help="No progress bar."),
        click.option("--verbose", is_flag=True, help="Log details to stderr."),
    ]
    for option in reversed(options):
        command = option(command)
    return command


@click.group(cls=CleanGroup, context_settings=_CONTEXT)
@click.version_option(package_name="synthgen")
def main() -> None:
    """Render training pairs and test images of an object from its mesh.

    \b
    synthgen render --object mesh.ply --n 20000 --out shards
    synthgen preview shards --out sheet.png
    synthgen bop --object mesh.ply --frames 50 --out test_bop
    """


@main.command()
@_scene_options
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

    _start_logging(verbose)
    config = load_config(preset, overrides, values)
    meshes, photos = _load_meshes(objects, units), _photos(backgrounds)
    card = dataset.make_card(config, n, meshes, photos)
    writer = ShardWriter.create(out, card)
    for key, data in dataset.model_files(meshes, dataset.load_symmetries(_text(models_info), meshes)).items():
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
    with _stoppable(out), _bar(quiet) as bar:
        task = bar.add_task("pairs", total=total, completed=done)
        pipeline.run(
            job,
            writer,
            workers=workers,
            scheduler=scheduler,
            on_shard=lambda encoded: bar.advance(task, encoded.line["n"]),
        )
    click.echo(f"{out}: complete, {total} pairs", err=True)


@main.command()
@_scene_options
@click.option("--frames", required=True, type=click.IntRange(1), help="Number of images.")
def bop(
    objects: tuple[Path, ...],
    out: str,
    frames: int,
    units: "Units",
    preset: str,
    overrides: tuple[str, ...],
    backgrounds: Path | None,
    models_info: Path | None,
    quiet: bool,
    verbose: bool,
    **values: Any,
) -> None:
    """Render whole camera images with ground truth as a BOP dataset (split `test`, scene 1).

    The images follow the same preset as training pairs, but are other scenes.

    \b
    synthgen bop --object mesh.ply --frames 50 --out test_bop
    synthgen bop --object mesh.ply --frames 20 --out test_bop --preset quickstart --engine raster --seed 7
    """
    from synthgen import bopset, dataset
    from synthgen.config import load_config

    _start_logging(verbose)
    config = load_config(preset, overrides, values)
    meshes, photos = _load_meshes(objects, units), _photos(backgrounds)
    infos = dataset.load_symmetries(_text(models_info), meshes)
    with _stoppable(out), _bar(quiet) as bar:
        task = bar.add_task("frames", total=frames)
        bopset.write_dataset(
            out, config, meshes, frames, photos=photos, infos=infos, on_frame=lambda _: bar.advance(task)
        )
    click.echo(f"{out}: complete, {frames} frames", err=True)


@main.command()
@click.argument("dataset", type=str)
@click.option("--out", required=True, type=click.Path(path_type=Path), metavar="FILE", help="Picture to write, .png.")
@click.option("--count", type=click.IntRange(1, 200), default=8, help="Samples to show, one a row.")
@click.option("--first", type=click.IntRange(0), default=0, help="Index of the first sample.")
def preview(dataset: str, out: Path, count: int, first: int) -> None:
    """Draw a contact sheet of a shard DATASET: patches with contours, distance transforms, masks and depth.

    \b
    synthgen preview shards --out sheet.png
    synthgen preview shards --out sheet.png --count 20 --first 1000
    """
    import cv2
    from posecore.files import write_atomic

    from synthgen.preview import contact_sheet

    if out.suffix.lower() not in (".png", ".jpg", ".jpeg"):
        raise ConfigError(f"--out {out}: expected a .png or .jpg file")
    sheet = contact_sheet(dataset, count, first=first)
    ok, data = cv2.imencode(out.suffix, sheet[..., ::-1])
    assert ok
    write_atomic(out, data.tobytes())
    click.echo(f"{out}: {sheet.shape[1]} x {sheet.shape[0]} px", err=True)


def _load_meshes(objects: tuple[Path, ...], units: "Units") -> "dict[int, Mesh]":
    from posecore.mesh import load_mesh

    from synthgen.target import object_ids

    ids = object_ids([str(p) for p in objects])
    return {obj_id: load_mesh(path, units=units) for obj_id, path in zip(ids, objects, strict=True)}


def _photos(folder: Path | None) -> tuple[str, ...]:
    from synthgen.background import list_photos

    return list_photos(folder.resolve()) if folder is not None else ()


def _text(path: Path | None) -> str | None:
    return None if path is None else str(path)


def _start_logging(verbose: bool) -> None:
    logging.basicConfig(format="%(levelname)s %(name)s: %(message)s", stream=sys.stderr)
    logging.getLogger("synthgen").setLevel(logging.INFO if verbose else logging.WARNING)


@contextmanager
def _stoppable(out: str) -> Iterator[None]:
    """Ctrl-C ends with one line; what is rendered stays."""
    try:
        yield
    except KeyboardInterrupt:
        click.echo(f"\nStopped. What is rendered stays in {out}; the same command again continues.", err=True)
        sys.exit(130)


def _bar(quiet: bool) -> "Progress":
    from rich.console import Console
    from rich.progress import (
        BarColumn,
        MofNCompleteColumn,
        Progress,
        ProgressColumn,
        Task,
        TextColumn,
        TimeElapsedColumn,
        TimeRemainingColumn,
    )
    from rich.text import Text

    class Rate(ProgressColumn):
        """Items a second."""

        def render(self, task: Task) -> Text:
            return Text(f"{task.speed:.2f}/s" if task.speed else "-/s")

    return Progress(
        TextColumn("{task.description}"),
        BarColumn(),
        MofNCompleteColumn(),
        Rate(),
        TimeElapsedColumn(),
        TextColumn("left"),
        TimeRemainingColumn(),
        console=Console(stderr=True),
        disable=quiet,
        speed_estimate_period=120,
    )


if __name__ == "__main__":
    main()
