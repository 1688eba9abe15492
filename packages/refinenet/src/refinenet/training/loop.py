"""Training loop: steps, metrics, validation, checkpoints."""

import itertools
import logging
import time
from collections.abc import Callable
from contextlib import nullcontext
from pathlib import Path

from posecore import config as posecore_config
from posecore.errors import CheckpointError, ConfigError
from posecore.files import write_atomic

from refinenet.config import TrainConfig
from refinenet.data.loader import worker_failures
from refinenet.training.metric_log import MetricLog
from refinenet.training.ranks import process_group
from refinenet.training.run import Trainer
from refinenet.training.setup import open_run

Report = Callable[[int, dict[str, float]], None]

log = logging.getLogger(__name__)


def train(
    config: TrainConfig, url: str, out: Path, *, resume: bool = False, report: Report | None = None
) -> dict[str, float]:
    """Train a network; write `best.safetensors`, `last.safetensors`, `metrics.jsonl` and `config.yaml` to a folder.

    The same config, data and seed give the same weights on the same processor, also when the run was interrupted and
    resumed, as long as `threads` is the same. A GPU sums some gradients in no fixed order: there they are only close.
    Under torchrun every process calls this; rank 0 validates, reports and writes.

    Args:
        config: Configuration of the run.
        url: Shard dataset, a folder or fsspec URL.
        out: Folder of the run.
        resume: Continue the run in that folder.
        report: Called with step and metrics, after each logged step and each validation.

    Returns:
        The last validation's errors, before and after one update; empty on ranks other than 0.

    Raises:
        ConfigError: The folder holds a run and `resume` is off; or settings and data do not fit.
        CheckpointError: There is nothing to resume, or it is of another run.
        ShardError: The dataset is damaged, of another schema, or empty.
        TrainingError: The loss is not finite.
        LoaderError: A loader process died, or shared memory is too small for its batches.
    """
    if not resume and (out / "last.safetensors").exists():
        raise ConfigError(f"{out}: already holds a run; continue it with --resume, or choose another --out")
    if resume and not (out / "last.safetensors").exists():
        raise CheckpointError(f"{out}: no run to resume, last.safetensors is missing; leave --resume out to start one")
    with worker_failures(), process_group(config):
        run = open_run(config, url, out, resume=resume)
        try:
            errors = _loop(run, report)
        finally:
            run.close()
    if skipped := run.data.skipped:
        log.warning("%d damaged shards were skipped", len(skipped))
    return errors


def _loop(run: Trainer, report: Report | None) -> dict[str, float]:
    config, is_first = run.config, run.ranks.rank == 0
    notify: Report = report if report is not None and is_first else lambda step, values: None
    errors: dict[str, float] = {}
    if is_first:
        write_atomic(run.out / "config.yaml", posecore_config.dump_yaml(config).encode())
        errors = run.validate()
    notify(run.step, errors)
    with MetricLog(run.out, run.step) if is_first else nullcontext() as metric_log:
        batches = run.stream() if run.step < config.steps else iter(())
        timer = _StepTimer()
        while run.step < config.steps:
            timer.start()
            taken = tuple(itertools.islice(batches, config.optimiser.accumulate))
            timer.lap("data_wait")
            values = run.take_step(*taken)
            last = run.step == config.steps
            due = last or run.step % config.validation.every == 0
            logged = last or run.step % config.log_every == 0
            numbers = run.over_ranks(values) if logged else {}
            timer.lap("compute")
            if metric_log is not None and logged:
                numbers |= timer.read(config.batch * config.optimiser.accumulate * run.ranks.world)
                numbers["skipped_shards"] = float(len(run.data.skipped))
                metric_log.write(run.step, numbers)
                notify(run.step, numbers)
            if metric_log is not None and due:
                errors = run.validate()
                metric_log.write(run.step, errors)
                notify(run.step, errors)
            if is_first and (due or run.step % config.checkpoint_every == 0):
                run.save(errors if due else None)
        del batches
    return errors


class _StepTimer:
    """Time that steps wait for data and time they compute; validation and saving count as neither."""

    def __init__(self) -> None:
        self._steps, self._spent_s = 0, {"data_wait": 0.0, "compute": 0.0}
        self.start()

    def start(self) -> None:
        """Begin a step."""
        self._mark = time.perf_counter()

    def lap(self, phase: str) -> None:
        """Add the time since the last mark to a phase; a step ends with `compute`."""
        now = time.perf_counter()
        self._spent_s[phase] += now - self._mark
        self._mark = now
        self._steps += phase == "compute"

    def read(self, pairs: int) -> dict[str, float]:
        """Means since the last reading, for steps of so many pairs."""
        total_s = sum(self._spent_s.values())
        values = {f"{phase}_ms": 1e3 * spent_s / self._steps for phase, spent_s in self._spent_s.items()}
        values["data_wait_fraction"] = self._spent_s["data_wait"] / total_s
        values["pairs_per_s"] = self._steps * pairs / total_s
        self._steps, self._spent_s = 0, dict.fromkeys(self._spent_s, 0.0)
        return values
