"""The last checkpoint of a run and the state to resume from."""

import logging
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from posecore.errors import CheckpointError, ConfigError

from refinenet.config import TrainConfig
from refinenet.models import checkpoint
from refinenet.models.checkpoint_schema import own_optimiser_state
from refinenet.training.optimiser import learning_rate
from refinenet.training.run import Trainer

log = logging.getLogger(__name__)


@dataclass(frozen=True, kw_only=True, eq=False)
class SavedRun:
    """A run on disk.

    Attributes:
        config: Configuration to continue with: the requested one, and the pivot of the run.
        last: Its newest checkpoint.
        state: Optimiser state of the same step.
        state_path: Its file.
    """

    config: TrainConfig
    last: checkpoint.Checkpoint
    state: dict[str, Any]
    state_path: Path

    @property
    def validation_shards(self) -> list[int]:
        """Shards of a growing dataset whose validation pairs had joined."""
        return list(self.state.get("validation_shards", []))


def load_run(config: TrainConfig, out: Path) -> SavedRun:
    """The run in a folder; one that an earlier version began keeps its pivot.

    Raises:
        ConfigError: A setting differs from the run's.
        CheckpointError: The checkpoint or its state is missing, damaged, or of another preset.
    """
    last = checkpoint.load(out / "last.safetensors", config.preset)
    before = last.provenance.config
    if before.pivot == "origin":
        config = replace(config, pivot=before.pivot)
    checkpoint.require_same(before, config, last.path)
    if config.optimiser.schedule == "cosine" and before.steps != config.steps:
        rates = [learning_rate(last.provenance.step, c.steps, c.optimiser) for c in (before, config)]
        log.warning(
            "%s: steps was %d and is now %d, so the cosine rate jumps from %.3g to %.3g",
            last.path, before.steps, config.steps, *rates,
        )  # fmt: skip
    state = checkpoint.load_state(out, last.provenance.step, ema=config.optimiser.ema_decay > 0)
    if config.loader.follow and "validation_shards" not in state:
        raise CheckpointError(f"{out}: a run with --follow of an earlier version, which held out less; start a new run")
    path = checkpoint.state_path(out, last.provenance.step)
    return SavedRun(config=config, last=last, state=state, state_path=path)


def restore(run: Trainer, saved: SavedRun) -> None:
    """Continue a run from its saved state.

    Raises:
        ConfigError: It was trained by another number of processes.
        CheckpointError: It was trained on other data.
    """
    last, state = saved.last, saved.state
    if last.provenance.dataset_sha256 != run.data.sha256:
        raise CheckpointError(
            f"{last.path}: was trained on other data than {run.data.url} holds now, which may have got more shards; "
            "start a new run, with --follow where shards are still being added"
        )
    if state["world"] != run.ranks.world:
        raise ConfigError(
            f"{last.path}: was trained by {state['world']} processes and now there are {run.ranks.world}; resume with "
            f"torchrun --nproc-per-node {state['world']}"
        )
    if run.ema is None:
        last.give_weights(run.network, run.config.network)
    else:
        trained = replace(last, tensors=state["weights"], path=saved.state_path)
        trained.give_weights(run.network, run.config.network)
        last.give_weights(run.ema.network, run.config.network)
    run.optimiser.load_state_dict(own_optimiser_state(run.optimiser, state["optimiser"], saved.state_path))
    run.step = last.provenance.step
    if last.provenance.config.validation.pairs == run.config.validation.pairs:  # other pairs have other errors
        run.best_mm = float(state["best_mm"])
    if run.ranks.rank == 0:
        checkpoint.drop_leftovers(run.out, run.step)
