"""The training loop."""

import time
from collections.abc import Callable
from contextlib import nullcontext
from pathlib import Path

from posecore import config as posecore_config
from posecore.errors import CheckpointError, ConfigError
from posecore.files import write_atomic

from refinenet.config import TrainConfig
from refinenet.metrics import MetricLog
from refinenet.trainer import Trainer

Report = Callable[[int, dict[str, float]], None]


def train(
    config: TrainConfig, url: str, out: Path, *, resume: bool = False, report: Report | None = None
) -> dict[str, float]:
    """Train a network; write `best.safetensors`, `last.safetensors`, `metrics.jsonl` and `config.yaml` to a folder.

    The same config, data and seed give the same weights on the same processor, also when the run was interrupted and
    resumed, as long as `threads` is the same. A GPU sums some gradients in no fixed order: there they are only close.

    Args:
        config: Everything but data and place.
        url: Shard dataset, a folder or fsspec URL.
        out: Folder.
        resume: Go on from the run in that folder.
        report: Called with step and metrics, after each logged step and each validation.

    Returns:
        The last validation's errors, before and after one update.

    Raises:
        ConfigError: The folder holds a run and `resume` is off; or settings and data do not fit.
        CheckpointError: There is nothing to resume, or it is of another run.
        ShardError: The dataset is damaged, of another schema, or empty.
        TrainingError: The loss is not finite.
    """
    if not resume and (out / "last.safetensors").exists():
        raise ConfigError(f"{out}: holds a run already; go on with --resume, or choose another --out")
    if resume and not (out / "last.safetensors").exists():
        raise CheckpointError(f"{out}: no run to resume, last.safetensors is missing; leave --resume out to start one")
    run = Trainer(config, url, out, resume=resume)
    main = run.rank == 0
    if main:
        write_atomic(out / "config.yaml", posecore_config.dump_yaml(config).encode())
    errors = run.validate()
    if report is not None and main:
        report(run.step, errors)
    with MetricLog(out, run.step) if main else nullcontext() as log:
        batches = run.stream() if run.step < config.steps else iter(())
        wait_s = compute_s = 0.0
        since = run.step
        while run.step < config.steps:
            asked = time.perf_counter()
            batch = next(batches)
            got = time.perf_counter()
            values = run.take_step(batch)
            wait_s, compute_s = wait_s + got - asked, compute_s + time.perf_counter() - got
            last = run.step == config.steps
            if log is not None and (last or run.step % config.log_every == 0):
                n = run.step - since
                values |= {"data_wait_ms": 1e3 * wait_s / n, "compute_ms": 1e3 * compute_s / n}
                wait_s, compute_s, since = 0.0, 0.0, run.step
                log.write(run.step, values)
                if report is not None:
                    report(run.step, values)
            due = last or run.step % config.validation.every == 0
            if log is not None and due:
                errors = run.validate()
                log.write(run.step, errors)
                if report is not None:
                    report(run.step, errors)
            if main and (due or run.step % config.checkpoint_every == 0):
                run.save(errors if due else None)
        del batches
    run.close()
    return errors
