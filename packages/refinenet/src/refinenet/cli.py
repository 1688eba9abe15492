"""The `refinenet` command: train a network on pair shards, refine BOP estimates with it."""

import json
import logging
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click
from posecore.errors import ConfigError, PoseError, exit_code

if TYPE_CHECKING:
    from rich.progress import Progress, TaskID

PRESETS = ("paper", "compact")
LOSSES = ("contour", "contour-forward", "mse", "point", "contour+point")
_CONTEXT = {"help_option_names": ["-h", "--help"], "show_default": True, "max_content_width": 110}
_FILE = click.Path(path_type=Path)
_NEW_FILE = click.Path(path_type=Path, dir_okay=False)

log = logging.getLogger(__name__)


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


@click.group(cls=CleanGroup, context_settings=_CONTEXT)
@click.version_option(package_name="refinenet")
def main() -> None:
    """Train pose refinement networks and refine poses with them.

    \b
    refinenet train shards/
    refinenet refine --checkpoint runs/compact/best.safetensors --dataset lmo --init start.csv --out refined.csv
    """


@main.command()
@click.argument("shards", type=str)
@click.option("--preset", type=click.Choice(PRESETS), default="compact", help="Which network and how it is trained.")
@click.option("--config", "file", type=_FILE, metavar="FILE", help="YAML laid over the preset.")
@click.option(
    "--set", "overrides", multiple=True, metavar="KEY=VALUE",
    help="Change one configuration key, e.g. --set optimiser.lr=1e-4. Repeatable; last wins.",
)  # fmt: skip
@click.option("--steps", type=click.IntRange(1), help="Optimiser steps. [preset]")
@click.option("--batch", type=click.IntRange(1), help="Pairs in a step. [preset]")
@click.option("--loss", type=click.Choice(LOSSES), help="Loss. [preset]")
@click.option("--seed", type=click.IntRange(0), help="Of weights, order, hypotheses, augmentation. [preset, 0]")
@click.option("--workers", type=click.IntRange(0), help="Loader processes; 0 loads in the training process. [preset]")
@click.option("--threads", type=click.IntRange(0), help="Torch threads; 0 leaves torch's choice. [preset, 0]")
@click.option("--device", type=click.Choice(["auto", "cpu", "cuda"]), help="Where the network runs. [preset, auto]")
@click.option(
    "--backbone-weights", type=_FILE, metavar="FILE", help="ImageNet weights of preset paper's stem (safetensors)."
)
@click.option("--out", type=_FILE, metavar="DIR", help="Checkpoints and logs. [runs/PRESET]")
@click.option("--resume", is_flag=True, help="Go on with the run in --out.")
@click.option("--quiet", is_flag=True, help="No progress line.")
@click.option("--verbose", is_flag=True, help="Log details to stderr.")
def train(
    shards: str,
    preset: str,
    file: Path | None,
    overrides: tuple[str, ...],
    backbone_weights: Path | None,
    out: Path | None,
    resume: bool,
    quiet: bool,
    verbose: bool,
    steps: int | None,
    batch: int | None,
    loss: str | None,
    seed: int | None,
    workers: int | None,
    threads: int | None,
    device: str | None,
) -> None:
    """Train on SHARDS, a dataset made by `synthgen render` (folder or fsspec URL).

    Writes best.safetensors, last.safetensors, metrics.jsonl, TensorBoard events and config.yaml.

    \b
    refinenet train shards/ --steps 4000
    refinenet train shards/ --preset paper --backbone-weights inception_v4.safetensors --out runs/benchvise
    refinenet train shards/ --set hypothesis.max_angle_deg=40 --set optimiser.lr=3e-4
    refinenet train shards/ --out runs/benchvise --resume
    torchrun --nproc-per-node 4 -m refinenet train s3://bucket/shards --preset paper
    """
    _start_logging(verbose)
    from refinenet.config import load_config
    from refinenet.train import train as run

    named = {
        "steps": steps, "batch": batch, "loss.name": loss, "seed": seed, "loader.workers": workers, "threads": threads,
        "device": device,
        # quoted: a path may hold what YAML reads as a comment
        "network.backbone.weights": None if backbone_weights is None else json.dumps(str(backbone_weights)),
    }  # fmt: skip
    assigned = [*overrides, *(f"{key}={value}" for key, value in named.items() if value is not None)]
    config = load_config(preset, assigned, file)
    folder = out or Path("runs") / preset
    with _stoppable(folder), _quiet_threads(), _training_bar(config.steps, quiet) as report:
        errors = run(config, shards, folder, resume=resume, report=report)
    for line in _comparison(errors):
        click.echo(line)
    click.echo(f"{folder / 'best.safetensors'}")


@main.command()
@click.option("--checkpoint", required=True, type=_FILE, metavar="FILE", help="Trained network (.safetensors).")
@click.option("--dataset", required=True, type=_FILE, metavar="DIR", help="BOP dataset with the images.")
@click.option("--split", metavar="NAME", help="Split folder. [test, val, train_pbr, train or the only one]")
@click.option("--init", required=True, type=_FILE, metavar="CSV", help="Start poses, a BOP result file.")
@click.option("--out", required=True, type=_NEW_FILE, metavar="CSV", help="Refined poses, a BOP result file.")
@click.option("--iterations", type=click.IntRange(1), default=5, help="Most updates of a pose.")
@click.option("--object", "objects", type=int, multiple=True, help="Refine only this object's poses. Repeatable. [all]")
@click.option("--name", help="Method's name in the report. [the preset and the checkpoint's step]")
@click.option("--overlay", type=_FILE, metavar="DIR", help="Draw start (red) and refined (green) contours here.")
@click.option("--device", type=click.Choice(["auto", "cpu", "cuda"]), default="auto", help="Where the network runs.")
@click.option("--batch", type=click.IntRange(1), default=64, help="Most poses in one forward pass.")
@click.option("--threads", type=click.IntRange(0), default=0, help="Torch threads; 0 leaves torch's choice.")
@click.option("--quiet", is_flag=True, help="No progress line.")
@click.option("--verbose", is_flag=True, help="Log details to stderr.")
def refine(
    checkpoint: Path,
    dataset: Path,
    split: str | None,
    init: Path,
    out: Path,
    iterations: int,
    objects: tuple[int, ...],
    name: str | None,
    overlay: Path | None,
    device: str,
    batch: int,
    threads: int,
    quiet: bool,
    verbose: bool,
) -> None:
    """Refine BOP estimates; the result file's sidecar says with what.

    Exit code 0 also when some poses fail: they keep their start pose, get score 0, and are counted on the last line.

    \b
    refinenet refine --checkpoint best.safetensors --dataset lmo --init start.csv --out results/refined.csv
    refinenet refine --checkpoint best.safetensors --dataset lmo --init start.csv --out ten.csv --iterations 10
    """
    _start_logging(verbose)
    import torch
    from posecore.bop import BopDataset, read_results, read_sidecar, write_results

    from refinenet import checkpoint as checkpoints
    from refinenet.estimates import make_sidecar, refine_estimates
    from refinenet.refine import Refiner

    if threads:
        torch.set_num_threads(threads)
    loaded = checkpoints.load(checkpoint)
    bop = BopDataset(dataset, split)
    starts = [s for s in read_results(init, bop) if not objects or s.obj_id in objects]
    if not starts:
        raise ConfigError(f"{init}: no pose of object {', '.join(map(str, objects))}; change --object")
    meshes = {i: bop.mesh(i) for i in sorted({s.obj_id for s in starts})}
    with Refiner(loaded, meshes, device=device, batch=batch) as refiner, _stoppable(out), _bar(quiet) as bar:
        task = bar.add_task("poses", total=len(starts))
        result = refine_estimates(
            bop, starts, refiner, iterations=iterations, overlay=overlay, on_image=lambda n: bar.advance(task, n)
        )
    method = name or f"refinenet {loaded.provenance.config.preset} step {loaded.provenance.step}"
    sidecar = make_sidecar(
        dataset=bop, loaded=loaded, start_path=init, start_sidecar=read_sidecar(init) or {},
        method=method, iterations=iterations, refined=result,
    )  # fmt: skip
    write_results(out, result.estimates, sidecar)
    click.echo(
        f"{out}: {len(starts)} poses refined, {result.converged} converged, {len(result.failed_lines)} failed"
        + (" (left out of the file: the object could not be seen)" if result.failed_lines else "")
    )


def _comparison(errors: dict[str, float]) -> Iterator[str]:
    """Held-out errors, start beside refined."""
    rows = (
        ("rotation, mean", "rotation", "deg"), ("rotation, median", "rotation_median", "deg"),
        ("x", "x", "mm"), ("y", "y", "mm"), ("z", "z", "mm"), ("points (ADD)", "add", "mm"),
    )  # fmt: skip
    yield "held-out scenes, one update    start  refined"
    for label, key, unit in rows:
        before, after = errors[f"validation/{key}_before_{unit}"], errors[f"validation/{key}_after_{unit}"]
        yield f"{label + ', ' + unit:<26}{before:10.2f}{after:9.2f}"


def _bar(quiet: bool, *extra: str) -> "Progress":
    from rich.console import Console
    from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

    columns = (TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(), TimeRemainingColumn())
    return Progress(*columns, *map(TextColumn, extra), console=Console(stderr=True), disable=quiet)


@contextmanager
def _training_bar(steps: int, quiet: bool) -> Iterator[Any]:
    """A progress line with the loss and where a step's time goes, and one line for each validation."""
    bar = _bar(quiet, "{task.fields[state]}")
    task: TaskID = bar.add_task("steps", total=steps, state="first batches")

    def report(step: int, values: dict[str, float]) -> None:
        bar.start()  # at the first report, not before: an error in settings or data comes out on a line of its own
        if "validation/add_after_mm" in values:
            if not quiet:
                move = "  ".join(
                    f"{key} {values[f'validation/{key}_before_{unit}']:.2f} -> "
                    f"{values[f'validation/{key}_after_{unit}']:.2f} {unit}"
                    for key, unit in (("rotation", "deg"), ("x", "mm"), ("y", "mm"), ("z", "mm"), ("add", "mm"))
                )
                bar.console.print(f"step {step}  {move}", highlight=False, soft_wrap=True)
            return
        loss = next(f"{key} {value:.3f}" for key, value in values.items() if key.startswith("loss_"))
        timing = f"data wait {values['data_wait_ms']:.0f} ms, compute {values['compute_ms']:.0f} ms"
        bar.update(task, completed=step, state=f"{loss}  {timing}")

    try:
        yield report
    finally:
        if bar.live.is_started:  # stopping one that never started prints an empty line
            bar.stop()


@contextmanager
def _stoppable(where: Path) -> Iterator[None]:
    """Ctrl-C ends with one line."""
    try:
        yield
    except KeyboardInterrupt:
        click.echo(f"Stopped; what was finished is in {where}", err=True)
        raise SystemExit(130) from None


@contextmanager
def _quiet_threads() -> Iterator[None]:
    """TensorBoard's writing thread hands its error to the training thread, which reports it, and prints a traceback."""
    before = threading.excepthook
    threading.excepthook = lambda ended: log.info("%s: %s", ended.thread and ended.thread.name, ended.exc_value)
    try:
        yield
    finally:
        threading.excepthook = before


def _start_logging(verbose: bool) -> None:
    logging.basicConfig(
        level=logging.INFO if verbose else logging.WARNING, format="%(levelname)s %(name)s: %(message)s"
    )
