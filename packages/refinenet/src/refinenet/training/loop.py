"""The training loop."""

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
from refinenet.data.loader import deaths_named
from refinenet.training.run import Trainer, process_group
from refinenet.training.validation import MetricLog

Report = Callable[[int, dict[str, float]], None]

log = logging.getLogger(__name__)


def train(
    config: TrainConfig, url: str, out: Path, *, resume: bool = False, report: Report | None = None
) -> dict[str, float]:
    """Train a network; write `best.safetensors`, `last.safetensors`, `metrics.jsonl` and `config.yaml` to a folder.

    The same config, data and seed give the same weights on the same processor, also when the run was interrupted and
    resumed, as long as `threads` is the same. A GPU sums some gradients in no fixed order: there they are only close.
    Under torchrun every process calls this; rank 0 measures, reports and writes.

    Args:
        config: Everything but data and place.
        url: Shard dataset, a folder or fsspec URL.
        out: Folder.
        resume: Go on from the run in that folder.
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
        raise ConfigError(f"{out}: holds a run already; go on with --resume, or choose another --out")
    if resume and not (out / "last.safetensors").exists():
        raise CheckpointError(f"{out}: no run to resume, last.safetensors is missing; leave --resume out to start one")
    with deaths_named(), process_group(config):
        run = Trainer(config, url, out, resume=resume)
        try:
            errors = _loop(run, config, out, report)
        finally:
            run.close()
    if run.skipped:
        log.warning("%d damaged shards were skipped", len(run.skipped))
    return errors


def _loop(run: Trainer, config: TrainConfig, out: Path, report: Report | None) -> dict[str, float]:
    main = run.rank == 0
    tell: Report = report if report is not None and main else lambda step, values: None
    errors: dict[str, float] = {}
    if main:
        write_atomic(out / "config.yaml", posecore_config.dump_yaml(config).encode())
        errors = run.validate()
    tell(run.step, errors)
    with MetricLog(out, run.step) if main else nullcontext() as metric_log:
        batches = run.stream() if run.step < config.steps else iter(())
        clock = _Clock()
        while run.step < config.steps:
            clock.start()
            taken = tuple(itertools.islice(batches, config.optimiser.accumulate))
            clock.lap("data_wait")
            values = run.take_step(*taken)
            last = run.step == config.steps
            due = last or run.step % config.validation.every == 0
            logged = last or run.step % config.log_every == 0
            numbers = run.over_ranks(values) if logged else {}
            clock.lap("compute")
            if metric_log is not None and logged:
                numbers |= clock.read(config.batch * config.optimiser.accumulate * run.world)
                numbers["skipped_shards"] = float(len(run.skipped))
                metric_log.write(run.step, numbers)
                tell(run.step, numbers)
            if metric_log is not None and due:
                errors = run.validate()
                metric_log.write(run.step, errors)
                tell(run.step, errors)
            if main and (due or run.step % config.checkpoint_every == 0):
                run.save(errors if due else None)
        del batches
    return errors


class _Clock:
    """Tells the time that steps wait for data from the time they compute; measuring and saving count as neither."""

    def __init__(self) -> None:
        self._steps, self._spent_s = 0, {"data_wait": 0.0, "compute": 0.0}
        self.start()

    def start(self) -> None:
        """A step begins."""
        self._mark = time.perf_counter()

    def lap(self, what: str) -> None:
        """The time since the last mark went into `what`; a step ends with its computing."""
        now = time.perf_counter()
        self._spent_s[what] += now - self._mark
        self._mark = now
        self._steps += what == "compute"

    def read(self, pairs: int) -> dict[str, float]:
        """Means since the last reading, for steps of so many pairs."""
        total_s = sum(self._spent_s.values())
        values = {f"{what}_ms": 1e3 * spent_s / self._steps for what, spent_s in self._spent_s.items()}
        values["data_wait_fraction"] = self._spent_s["data_wait"] / total_s
        values["pairs_per_s"] = self._steps * pairs / total_s
        self._steps, self._spent_s = 0, dict.fromkeys(self._spent_s, 0.0)
        return values
