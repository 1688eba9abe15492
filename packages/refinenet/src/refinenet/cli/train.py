"""`refinenet train`."""

import json
import logging
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any, get_args

import click
from posecore.command_line import end_early, progress_bar, stoppable

from refinenet.cli.options import FILE, quiet_option, verbose_option
from refinenet.config import DeviceName, LossName, PresetName, TrainConfig

log = logging.getLogger(__name__)


@click.command()
@click.argument("shards", type=str)
@click.option(
    "--preset", type=click.Choice(get_args(PresetName)), default="compact", help="Which network and how it is trained."
)
@click.option("--config", "file", type=FILE, metavar="FILE", help="YAML laid over the preset.")
@click.option(
    "--set", "overrides", multiple=True, metavar="KEY=VALUE",
    help="Change one configuration key, e.g. --set optimiser.lr=1e-4. Repeatable; last wins.",
)  # fmt: skip
@click.option(
    "--object", "objects", type=int, multiple=True, metavar="ID", help="Train on this object only. Repeatable. [all]"
)
@click.option("--steps", type=click.IntRange(1), help="Optimiser steps. [preset]")
@click.option("--batch", type=click.IntRange(1), help="Pairs in a batch, on each rank. [preset]")
@click.option("--loss", type=click.Choice(get_args(LossName)), help="Loss. [preset]")
@click.option(
    "--seed",
    type=click.IntRange(0),
    help="Random seed of initial weights, data order, hypotheses and augmentation. [preset, 0]",
)
@click.option("--workers", type=click.IntRange(0), help="Loader processes; 0 loads in the training process. [preset]")
@click.option("--threads", type=click.IntRange(0), help="Torch threads; 0 leaves torch's choice. [preset, 0]")
@click.option("--device", type=click.Choice(get_args(DeviceName)), help="Where the network runs. [preset, auto]")
@click.option(
    "--backbone-weights", type=FILE, metavar="FILE", help="ImageNet weights of preset paper's stem (safetensors)."
)
@click.option("--init", type=FILE, metavar="FILE", help="Checkpoint with the initial weights.")
@click.option("--out", type=FILE, metavar="DIR", help="Checkpoints and logs. [runs/PRESET]")
@click.option("--resume", is_flag=True, help="Continue the run in --out.")
@click.option("--follow", is_flag=True, help="SHARDS is being rendered, or will be: add new shards between epochs.")
@click.option("--skip-bad-shards", is_flag=True, help="Train without unreadable shards; each is reported.")
@quiet_option
@verbose_option
def train(
    shards: str,
    preset: str,
    file: Path | None,
    overrides: tuple[str, ...],
    objects: tuple[int, ...],
    backbone_weights: Path | None,
    init: Path | None,
    out: Path | None,
    resume: bool,
    follow: bool,
    skip_bad_shards: bool,
    quiet: bool,
    steps: int | None,
    batch: int | None,
    loss: str | None,
    seed: int | None,
    workers: int | None,
    threads: int | None,
    device: str | None,
) -> None:
    """Train on SHARDS, a dataset made by `synthgen render` (folder or fsspec URL).

    Writes best.safetensors, last.safetensors, metrics.jsonl, TensorBoard events and config.yaml to --out. At its end,
    poses in the test images of SHARDS, which it never trains on, are perturbed and refined into results/ of the working
    folder, for `evalkit report`.

    \b
    refinenet train shards/
    refinenet train shards/ --steps 4000
    refinenet train shards/ --preset paper --backbone-weights inception_v4.safetensors --out runs/benchvise
    refinenet train shards/ --set hypothesis.max_angle_deg=40 --set optimiser.lr=3e-4
    refinenet train shards/ --init examples/checkpoints/tug_compact.safetensors --out runs/benchvise
    refinenet train shards/ --out runs/benchvise --resume
    refinenet train shards/ --follow --set optimiser.ema_decay=0.999 --set optimiser.accumulate=4
    torchrun --nproc-per-node 4 -m refinenet train s3://bucket/shards --preset paper
    """
    from refinenet.config import load_config
    from refinenet.training.loop import train as run

    named = {
        "steps": steps, "batch": batch, "loss.name": loss, "seed": seed, "loader.workers": workers, "threads": threads,
        "device": device, "loader.follow": follow or None, "loader.skip_bad_shards": skip_bad_shards or None,
        # quoted: a path may contain what YAML reads as a comment
        "network.backbone.weights": None if backbone_weights is None else json.dumps(str(backbone_weights)),
        "objects": list(objects) or None,
        "init": None if init is None else json.dumps(str(init)),
    }  # fmt: skip
    assigned = [*overrides, *(f"{key}={value}" for key, value in named.items() if value is not None)]
    config = load_config(preset, assigned, file)
    folder = out or Path("runs") / preset
    with (
        stoppable(lambda: f"what was finished is in {folder}" if folder.exists() else None),
        _quiet_threads(),
        _training_bar(config.steps, quiet) as report,
    ):
        errors = run(config, shards, folder, resume=resume, report=report)
    if errors:  # under torchrun, rank 0 has them
        for line in (*_comparison(errors), *_checkpoints(folder, config.steps)):
            click.echo(line)
        click.echo(f"{folder / 'best.safetensors'}")
        _refine_test_set(shards, folder, config, quiet)


def _refine_test_set(shards: str, folder: Path, config: TrainConfig, quiet: bool) -> None:
    """Refine perturbed poses in the dataset's test images, or print in one line the reason for none."""
    from refinenet.refine.test_set import TestSetJob, find_test_set, refine_test_set

    images = find_test_set(shards)
    if isinstance(images, str):
        click.echo(
            f"{shards}: {images}, so nothing is refined for a report; on your own images: refinenet refine "
            f"--checkpoint {folder / 'best.safetensors'} --dataset DIR --init POSES.csv --out results/NAME.csv"
        )
        return
    job = TestSetJob(dataset=images, run=folder, device=config.device, threads=config.threads)
    again = "the run is complete; with --resume the same command refines its test images"
    with stoppable(lambda: again), progress_bar(quiet) as bar:
        task = bar.add_task("test poses", total=None, visible=False)
        done = refine_test_set(job, lambda count, total: bar.update(task, completed=count, total=total, visible=True))
    if done is None:
        click.echo(f"{images}: no image of a trained object, so nothing is refined for a report")
        return
    click.echo(done.text)
    if done.summary.stopped is not None:
        end_early(done.summary.stopped, again)


def _comparison(errors: dict[str, float]) -> Iterator[str]:
    """Validation errors before and after one update."""
    rows = (
        ("rotation, mean", "rotation", "deg"), ("rotation, median", "rotation_median", "deg"),
        ("x", "x", "mm"), ("y", "y", "mm"), ("z", "z", "mm"), ("points (ADD)", "add", "mm"),
    )  # fmt: skip
    yield "validation, one update       initial  refined"
    for label, key, unit in rows:
        before, after = errors[f"validation/{key}_before_{unit}"], errors[f"validation/{key}_after_{unit}"]
        yield f"{label + ', ' + unit:<26}{before:10.2f}{after:9.2f}"


def _checkpoints(folder: Path, steps: int) -> Iterator[str]:
    """Which of the run's two checkpoints the table belongs to."""
    from refinenet.models import checkpoint

    best = checkpoint.load(folder / "best.safetensors").provenance.step
    if best == steps:
        yield f"of step {steps}: last.safetensors, and best.safetensors too"
        return
    yield f"of step {steps}: last.safetensors"
    lines = (json.loads(line) for line in (folder / "metrics.jsonl").read_text().splitlines())
    key = "validation/add_after_mm"
    add_mm = [line[key] for line in lines if line["step"] == best and key in line]
    yield f"best.safetensors is of step {best}" + "".join(f", points (ADD) {value:.2f} mm" for value in add_mm[-1:])


@contextmanager
def _training_bar(steps: int, quiet: bool) -> Iterator[Any]:
    """A progress line with the loss and where a step's time goes, and one line for each validation."""
    with progress_bar(quiet, "{task.fields[state]}") as bar:
        task = bar.add_task("steps", total=steps, state="first batches", visible=False)

        def report(step: int, values: dict[str, float]) -> None:
            if "validation/add_after_mm" in values:
                bar.update(task, visible=True)
                if not quiet:
                    change = "  ".join(
                        f"{key} {values[f'validation/{key}_before_{unit}']:.2f} -> "
                        f"{values[f'validation/{key}_after_{unit}']:.2f} {unit}"
                        for key, unit in (("rotation", "deg"), ("x", "mm"), ("y", "mm"), ("z", "mm"), ("add", "mm"))
                    )
                    bar.console.print(f"step {step}  {change}", highlight=False, soft_wrap=True)
                return
            loss = next(f"{key} {value:.3f}" for key, value in values.items() if key.startswith("loss"))
            wait = f"data wait {values['data_wait_ms']:.0f} ms ({100 * values['data_wait_fraction']:.0f} %)"
            timing = f"{wait}, compute {values['compute_ms']:.0f} ms, {values['pairs_per_s']:.0f} pairs/s"
            bad = f"  {values['skipped_shards']:.0f} bad shards" if values["skipped_shards"] else ""
            bar.update(task, completed=step, state=f"{loss}  {timing}{bad}", visible=True)

        yield report


@contextmanager
def _quiet_threads() -> Iterator[None]:
    """Log errors of TensorBoard's writing thread without a traceback: the training thread reports them."""
    before = threading.excepthook
    threading.excepthook = lambda ended: log.info("%s: %s", ended.thread and ended.thread.name, ended.exc_value)
    try:
        yield
    finally:
        threading.excepthook = before
