"""Whether the data keep up with the network: `python benchmarks/train_throughput.py shards/ --preset compact`.

Blocks of training steps that stream from the shards and blocks of the same steps on one batch that stays on the device
take turns in one process, so that a busy machine slows both alike. Medians of the blocks are printed, then one JSON
line; `ratio` is the streaming rate over the other, 1 where data never wait. FLOPs are those of forward and backward
passes as torch counts them (multiply and add are two), without optimiser and augmentation.

With `--against` the packages of another commit train too, each round in a process of its own, in turn with these; the
losses of the first steps are compared.
"""

import argparse
import json
import os
import platform
import resource
import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Mapping
from datetime import UTC, datetime
from pathlib import Path
from typing import Any, get_args

import torch
from other_commit import packages_of
from refinenet.batch import Batch
from refinenet.config import PresetName, load_config
from refinenet.training.run import Trainer
from refinenet.training.setup import open_run
from torch.utils.flop_counter import FlopCounterMode

PEAK_TFLOPS = {"H100": 989.0, "H200": 989.0, "A100": 312.0}
"""Dense bfloat16 of GPUs by a part of their names, from their data sheets."""


LOSSES = 5
"""Steps on one batch whose losses are compared."""


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("shards", help="dataset of `synthgen render`, folder or URL")
    parser.add_argument("--preset", choices=get_args(PresetName), default="compact")
    parser.add_argument("--set", dest="overrides", action="append", default=[], metavar="KEY=VALUE")
    parser.add_argument("--steps", type=int, default=20, help="steps of a block")
    parser.add_argument("--rounds", type=int, default=5, help="blocks of each kind")
    parser.add_argument("--peak-tflops", type=float, help="of the device, for the share of it; known for some GPUs")
    parser.add_argument(
        "--out", type=Path, metavar="FILE", help="also write the JSON line there, with date and machine"
    )
    parser.add_argument("--against", metavar="COMMIT", help="measure this commit too")
    arguments = parser.parse_args()
    if arguments.against is not None:
        compare(arguments)
        return
    total = (2 * arguments.rounds + 2) * arguments.steps
    config = load_config(arguments.preset, [*arguments.overrides, f"steps={total}", "validation.pairs=16"])
    with tempfile.TemporaryDirectory() as folder:
        run = open_run(config, arguments.shards, Path(folder))
        batches = run.stream()
        kept = next(batches).to(run.device)
        step_flops = flops(run, kept)
        losses = [loss_of(run.take_step(kept)) for _ in range(LOSSES)]

        def streamed() -> None:
            run.take_step(next(batches))  # noqa: F821 (it is deleted after the last call)

        def held() -> None:
            run.take_step(kept)

        for action in (streamed, held):  # compiles, fills the loaders' queues
            rate(run, action, arguments.steps)
        rates: dict[str, list[float]] = {"streamed": [], "kept": []}
        for _ in range(arguments.rounds):
            rates["streamed"].append(rate(run, streamed, arguments.steps))
            rates["kept"].append(rate(run, held, arguments.steps))
        report(arguments, run, rates, step_flops, losses)
        del batches
        run.close()


def compare(arguments: argparse.Namespace) -> None:
    """Measure both commits in turn and print medians, ratios and the largest relative difference of losses."""
    command = [
        sys.executable,
        __file__,
        arguments.shards,
        "--preset",
        arguments.preset,
        "--steps",
        str(arguments.steps),
    ]
    command += ["--rounds", "1", *(part for override in arguments.overrides for part in ("--set", override))]
    sides: dict[str, list[dict[str, Any]]] = {"this": [], arguments.against: []}
    with packages_of(arguments.against) as before:
        for _ in range(arguments.rounds):
            for name, environment in (("this", None), (arguments.against, before)):
                done = subprocess.run(command, env=environment, capture_output=True, text=True, check=False)
                if done.returncode:
                    sys.exit(done.stderr)
                sides[name].append(json.loads(done.stdout.splitlines()[-1]))
                print(f"{name}: {sides[name][-1]['streamed_steps_per_s']:.2f} steps/s", flush=True)
    ours, theirs = sides.values()
    result: dict[str, Any] = {"benchmark": "train_throughput", "against": arguments.against, "preset": arguments.preset}
    for key in ("streamed_steps_per_s", "kept_steps_per_s"):
        a, b = (statistics.median(side[key] for side in both) for both in (ours, theirs))
        result |= {key: a, f"{key}_{arguments.against}": b, f"{key}_ratio": round(a / b, 3)}
    pairs = zip(ours[0]["first_losses"], theirs[0]["first_losses"], strict=True)
    result["largest_relative_loss_difference"] = max(abs(a - b) / abs(b) for a, b in pairs)
    print(json.dumps(result))


def loss_of(values: Mapping[str, Any]) -> float:
    """The loss of a step, under whichever name it has."""
    return next(float(value) for name, value in values.items() if name.startswith("loss"))


def flops(run: Trainer, batch: Batch) -> int:
    """Floating-point operations of one step's passes; the step is taken."""
    counter = FlopCounterMode(display=False)
    with counter:
        run.take_step(batch)
    return int(counter.get_total_flops())


def rate(run: Trainer, action: Callable[[], None], steps: int) -> float:
    """Steps a second."""
    synchronise(run.device)
    began = time.perf_counter()
    for _ in range(steps):
        action()
    synchronise(run.device)
    return steps / (time.perf_counter() - began)


def synchronise(device: torch.device) -> None:
    """Wait for what was queued."""
    if device.type == "cuda":
        torch.cuda.synchronize(device)


def report(
    arguments: argparse.Namespace, run: Trainer, rates: dict[str, list[float]], step_flops: int, losses: list[float]
) -> None:
    """Print the figures in words and as one JSON line."""
    cuda = run.device.type == "cuda"
    device = torch.cuda.get_device_name(run.device) if cuda else platform.processor() or platform.machine()
    known = [value for name, value in PEAK_TFLOPS.items() if name in device]
    peak = arguments.peak_tflops or (known[0] if known else None)
    streamed, kept = (statistics.median(rates[name]) for name in ("streamed", "kept"))
    ratio = statistics.median(a / b for a, b in zip(rates["streamed"], rates["kept"], strict=True))
    tflops = step_flops * streamed / 1e12
    memory_mb = (
        torch.cuda.max_memory_allocated(run.device) / 1e6
        if cuda
        else resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1e3
    )
    result = {
        "benchmark": "train_throughput",
        "date": datetime.now(UTC).date().isoformat(),
        "device": device,
        "cpus": os.cpu_count(),
        "load_average_1min": round(os.getloadavg()[0], 2),
        "torch": torch.__version__,
        "torch_threads": torch.get_num_threads(),
        "preset": run.config.preset,
        "overrides": arguments.overrides,
        "batch": run.config.batch,
        "loader_workers": run.config.loader.workers,
        "streamed_steps_per_s": round(streamed, 3),
        "kept_steps_per_s": round(kept, 3),
        "ratio": round(ratio, 3),
        "streamed_pairs_per_s": round(streamed * run.config.batch, 1),
        "gflop_per_step": round(step_flops / 1e9, 3),
        "tflops": round(tflops, 4),
        "share_of_peak": None if peak is None else round(tflops / peak, 4),
        "peak_memory_mb": round(memory_mb, 1),
        "first_losses": losses,
    }
    print(f"streamed {streamed:.2f} steps/s, on one kept batch {kept:.2f} steps/s, ratio {ratio:.3f}")
    line = json.dumps(result)
    if arguments.out is not None:
        arguments.out.parent.mkdir(parents=True, exist_ok=True)
        arguments.out.write_text(line + "\n")
    print(line)


if __name__ == "__main__":
    main()
