"""What a training run is made of: data, network, loss, optimiser, and the step that joins them."""

import gc
import hashlib
import json
import logging
import math
import os
from collections.abc import Iterator
from contextlib import AbstractContextManager, contextmanager, nullcontext
from pathlib import Path
from typing import Any

import torch
from posecore.errors import CheckpointError, ConfigError
from posecore.mesh import mesh_digest
from posecore.shard import ShardReader, load_meshes, n_shards
from torch import Tensor, nn
from torch.nn.parallel import DistributedDataParallel

from refinenet.batch import Batch, NetworkInput
from refinenet.config import TrainConfig
from refinenet.data.growing_split import GrowingSplit, wait_for_dataset, wait_for_start
from refinenet.data.loader import make_loader, on_device
from refinenet.data.objects import load_models, object_ids, object_points
from refinenet.data.pair_stream import PairStream
from refinenet.data.split import DataRecord, Split, divide, read_scenes, validation_scenes
from refinenet.data.validation_set import ValidationSet
from refinenet.device import choose_device
from refinenet.geometry.poses import PoseUpdate
from refinenet.models import checkpoint, inception
from refinenet.models.networks import PaperNet, make_network
from refinenet.training import validation
from refinenet.training.losses import PIXEL_LOSSES, make_loss
from refinenet.training.on_policy import OnPolicyHypotheses
from refinenet.training.optimiser import FiniteGuard, RunningAverage, learning_rate, make_optimiser

log = logging.getLogger(__name__)


def use_bfloat16(precision: str, device: torch.device) -> bool:
    """Whether convolutions run in bfloat16; on a processor without such instructions they would run slower in it."""
    if precision == "auto":
        if device.type == "cuda":
            return torch.cuda.is_bf16_supported(including_emulation=False)
        return torch.cpu._is_avx512_bf16_supported()
    return precision == "bfloat16"


@contextmanager
def process_group(config: TrainConfig) -> Iterator[None]:
    """The processes that torchrun started, joined; without torchrun, nothing."""
    if int(os.environ.get("WORLD_SIZE", "1")) == 1:
        yield
        return
    device = choose_device(config.device)
    if device.type == "cuda":
        torch.cuda.set_device(device)
    torch.distributed.init_process_group("nccl" if device.type == "cuda" else "gloo")
    try:
        yield
    finally:
        gc.collect()
        torch.distributed.destroy_process_group()


class Trainer:
    """A run, ready to step; under torchrun, within `process_group`.

    Args:
        config: Everything but data and place.
        url: Shard dataset.
        out: Folder of checkpoints and logs.
        resume: Go on from `out/last.safetensors`.

    Attributes:
        step: Optimiser steps taken.
        best_mm: Smallest held-out point distance so far.
        skipped: What is wrong with each shard that was skipped.
    """

    def __init__(self, config: TrainConfig, url: str, out: Path, *, resume: bool = False) -> None:
        if config.threads:
            torch.set_num_threads(config.threads)
        torch.manual_seed(config.seed)
        torch.backends.cudnn.deterministic, torch.backends.cudnn.benchmark = True, False
        self.config, self.out, self._url = config, out, url
        self.rank, self.world = int(os.environ.get("RANK", "0")), int(os.environ.get("WORLD_SIZE", "1"))
        self.device = choose_device(config.device)
        self._reduced = use_bfloat16(config.precision, self.device)
        self.skipped: dict[str, None] = {}
        last = self._last() if resume else None
        if config.loader.follow and not resume:
            wait_for_dataset(url)
        reader = ShardReader(url)
        if unknown := set(config.objects) - {*object_ids(reader)}:
            known = ", ".join(map(str, object_ids(reader)))
            raise ConfigError(f"{url}: there is no object {min(unknown)} in it, only {known}; choose among those")
        if config.loader.follow and not resume:
            # every rank for itself: one that waited for another's word would give up after some minutes
            wait_for_start(reader, config, self.world * max(1, config.loader.workers))
        state = None if last is None else checkpoint.load_state(out, last.provenance.step)
        if state is not None and config.loader.follow and "validation_shards" not in state:
            raise CheckpointError(
                f"{out}: a run with --follow of an earlier version, which held out less; start a new run"
            )
        self.training, held_out, record = self._split(reader, resume=resume)
        self._growth = GrowingSplit(out=out, record=record, config=config) if config.loader.follow else None
        joined = [] if state is None else state.get("validation_shards", [])
        self._validation_set = ValidationSet(url, config, held_out, self._growth, joined) if self.rank == 0 else None
        self._tell_skipped(*(self._validation_set.skipped if self._validation_set else ()))
        meshes = load_meshes(reader)
        points = object_points(meshes, load_models(reader), config.loss.model_points, config.loss.symmetry_step_deg)
        self._on_policy = OnPolicyHypotheses(config, meshes, self.rank, reduced=self._reduced)
        self.objects = points.to(self.device)
        self._dataset_sha256 = _dataset_sha256(reader, config)
        self._objects_card = {
            key: {**card, "mesh_digest": mesh_digest(meshes[int(key)])}
            for key, card in reader.card["objects"].items()
            if not config.objects or int(key) in config.objects
        }
        self._fx_px = float(reader.card.get("camera", {}).get("fx", 0.0))
        self.network = make_network(config.network).to(self.device, memory_format=torch.channels_last)  # type: ignore[call-overload]
        self._loss = make_loss(
            config.loss.name, gamma=config.loss.gamma, point_weight=config.loss.point_weight,
            rotation_weight=config.loss.rotation_weight, confidence_weight=config.loss.confidence_weight,
            confidence_target=config.loss.confidence_target, min_pose_quality=config.loss.min_pose_quality,
            objects=self.objects,
        )  # fmt: skip
        pixels = config.loss.name in PIXEL_LOSSES and not config.network.confidence
        self.loss_key = "loss_px" if pixels else "loss"
        self._optimiser = make_optimiser(self.network, config.optimiser)
        self._guard = FiniteGuard(self._optimiser, self.device, late=self.device.type == "cuda")
        self.step, self.best_mm = 0, math.inf
        if (
            last is None
            and not config.init
            and isinstance(self.network, PaperNet)
            and config.network.backbone.pretrained
        ):
            stem = config.network.backbone
            inception.load_pretrained(self.network.stem, stem.name, stem.weights)
        if last is None and config.init:
            checkpoint.load(Path(config.init)).give_weights(self.network, config.network)
        decay = config.optimiser.ema_decay
        self._average = RunningAverage(self.network, decay) if decay else None
        if last is not None and state is not None:
            self._resume(last, state)
        self._parallel = self._distribute()
        self._forward = torch.compile(self._parallel) if config.compile else self._parallel

    @property
    def kept(self) -> nn.Module:
        """The network that is measured and saved: the running average where there is one."""
        return self.network if self._average is None else self._average.network

    def _share_buffers(self) -> None:
        """Rank 0's batch norm statistics on every rank, before own predictions: a resumed run begins with those."""
        if self.world > 1 and self.config.on_policy.fraction:
            for buffer in self.network.buffers():
                torch.distributed.broadcast(buffer, src=0)

    def _last(self) -> checkpoint.Checkpoint:
        last = checkpoint.load(self.out / "last.safetensors", self.config.preset)
        before = last.provenance.config
        checkpoint.require_same(before, self.config, last.path)
        if self.config.optimiser.schedule == "cosine" and before.steps != self.config.steps:
            rates = [learning_rate(last.provenance.step, c.steps, c.optimiser) for c in (before, self.config)]
            log.warning(
                "%s: steps was %d and is now %d, so the cosine rate jumps from %.3g to %.3g",
                last.path, before.steps, self.config.steps, *rates,
            )  # fmt: skip
        return last

    def _split(self, reader: ShardReader, *, resume: bool) -> tuple[Split, Split, DataRecord]:
        """Both sides of the split, the same on every rank: rank 0 decides, or reads what the run began with."""
        shared: list[Any] = [None]
        if self.rank == 0:
            settings, validation = self.config.loader, self.config.validation
            record = DataRecord.load(self.out) if resume else None
            begun = record.shards if record is not None else reader.committed
            scene_of, bad = read_scenes(reader, begun, skip=settings.skip_bad_shards, objects=self.config.objects)
            self._tell_skipped(*bad.values())
            if not (settings.follow or reader.complete):
                log.warning(
                    "%s: %d of %d shards are there, and only these are trained on; --follow takes those that come",
                    reader.url, len(reader.committed), n_shards(reader.card),
                )  # fmt: skip
            if record is None:
                held = validation_scenes(
                    reader.url, scene_of, validation.scene_fraction, self.config.seed, growing=settings.follow
                )
                record = DataRecord(shards=tuple(scene_of), validation_scenes=tuple(int(scene) for scene in held))
                record.save(self.out)
            shared = [(record, scene_of)]
        if self.world > 1:
            torch.distributed.broadcast_object_list(shared, src=0)
        record, scene_of = shared[0]
        return (*divide(scene_of, record.validation_scenes), record)

    def _tell_skipped(self, *messages: str) -> None:
        for message in messages:
            if message not in self.skipped:
                self.skipped[message] = None
                log.warning("skipped: %s", message)

    def _resume(self, last: checkpoint.Checkpoint, state: dict[str, Any]) -> None:
        if last.provenance.dataset_sha256 != self._dataset_sha256:
            raise CheckpointError(
                f"{last.path}: was trained on other data than {self._url} holds now, which may have got more shards; "
                "start a new run, with --follow where shards are still being added"
            )
        if state["world"] != self.world:
            raise ConfigError(
                f"{last.path}: was trained by {state['world']} processes and now there are {self.world}; resume with "
                f"torchrun --nproc-per-node {state['world']}"
            )
        self.network.load_state_dict(last.tensors if self._average is None else state["weights"])
        if self._average is not None:
            self._average.network.load_state_dict(last.tensors)
        self._optimiser.load_state_dict(state["optimiser"])
        self.step = last.provenance.step
        if last.provenance.config.validation.pairs == self.config.validation.pairs:  # else it was measured on others
            self.best_mm = float(state["best_mm"])
        if self.rank == 0:
            checkpoint.drop_leftovers(self.out, self.step)

    def _distribute(self) -> nn.Module:
        if self.world == 1:
            return self.network
        return DistributedDataParallel(self.network, device_ids=[self.device] if self.device.type == "cuda" else None)

    def stream(self) -> Iterator[Batch]:
        """Training batches on the device, from the present step on."""
        settings = self.config.loader
        workers = max(1, min(settings.workers, len(self.training.rows) // self.world))
        stream = PairStream(
            url=self._url, config=self.config, split=self.training, rank=self.rank, world=self.world, workers=workers,
            start=self.step * self.config.optimiser.accumulate, growth=self._growth,
        )  # fmt: skip
        return on_device(iter(make_loader(stream, pin=self.device.type == "cuda")), self.device)

    def take_step(self, *batches: Batch) -> dict[str, float | Tensor]:
        """One optimiser step on the mean gradient of one or more batches.

        Returns:
            The mean loss, the gradient's norm (both still on the device) and the step's learning rate.

        Raises:
            TrainingError: A loss or the gradient is not finite; the weights were left alone. Samples are named. On a
                GPU this is found one step late, or by `settle`.
        """
        self._parallel.train()
        self._optimiser.zero_grad(set_to_none=True)
        losses = []
        for i, batch in enumerate(batches):
            self._tell_skipped(*batch.skipped)
            self._share_buffers()
            batch = self._on_policy(self.network, batch.to(self.device), self.step, i)
            with self._apart() if i < len(batches) - 1 else nullcontext():
                with torch.autocast(self.device.type, torch.bfloat16, enabled=self._reduced):
                    update = self._predict(batch.inputs)
                losses.append(self._loss(update, batch.target))
                (losses[-1].mean() / len(batches)).backward()
        weights = [p for p in self.network.parameters() if p.grad is not None]
        norm = torch.nn.utils.get_total_norm([p.grad for p in weights if p.grad is not None])
        self._guard.check(self.step, batches, [values.detach() for values in losses], norm)
        if limit := self.config.optimiser.gradient_clip:
            torch.nn.utils.clip_grads_with_norm_(weights, limit, norm)
        rate = learning_rate(self.step, self.config.steps, self.config.optimiser)
        for group in self._optimiser.param_groups:
            group["lr"] = rate
        self._optimiser.step()
        if self._average is not None:
            self._average.update(self.step)
        self.step += 1
        loss = torch.stack([values.detach().mean() for values in losses]).mean()
        shares = [batch.visible_fraction for batch in batches if batch.visible_fraction is not None]
        told = {"visible_fraction": torch.stack([share.mean() for share in shares]).mean()} if shares else {}
        return {self.loss_key: loss, "learning_rate": rate, "gradient_norm": norm, **told}

    def _predict(self, pair: NetworkInput) -> PoseUpdate:
        if not self.config.compile:
            return self._forward(pair)
        try:
            return self._forward(pair)
        except torch._dynamo.exc.TorchDynamoException as error:
            detail = (str(error).strip().splitlines() or [type(error).__name__])[0]
            raise ConfigError(
                f"compile: torch.compile failed here ({detail}); train with --set compile=false"
            ) from error

    def _apart(self) -> AbstractContextManager[None]:
        """Gradients stay on this rank until the last batch of a step."""
        parallel = self._parallel
        return parallel.no_sync() if isinstance(parallel, DistributedDataParallel) else nullcontext()

    def settle(self) -> None:
        """Wait for the device to tell whether the last step's numbers were finite.

        Raises:
            TrainingError: As `take_step`.
        """
        self._guard.settle()

    def over_ranks(self, values: dict[str, float | Tensor]) -> dict[str, float]:
        """A step's values as numbers, those that are each rank's own averaged over all; call on every rank.

        Raises:
            TrainingError: As `take_step`.
        """
        self.settle()
        for key in (self.loss_key, "visible_fraction"):
            value = values.get(key)
            if self.world > 1 and value is not None:
                mean = torch.as_tensor(value, device=self.device) / self.world
                torch.distributed.all_reduce(mean)
                values = {**values, key: mean}
        return {key: float(value) for key, value in values.items()}

    def validate(self) -> dict[str, float]:
        """Errors on held-out pairs, before and after one update; on rank 0.

        Where more pairs have joined, errors do not compare with those before, and the best so far is forgotten.
        """
        assert self._validation_set is not None
        if self._validation_set.grow():
            self._tell_skipped(*self._validation_set.skipped)
            self.best_mm = math.inf
        loss = self.config.loss
        return validation.measure(
            self.kept,
            self._validation_set.batches,
            self.objects,
            self.device,
            loss.confidence_target,
            loss.min_pose_quality,
        )

    def save(self, errors: dict[str, float] | None) -> None:
        """Write `last`, and `best` when the errors are the best so far.

        What `last` needs beside it is written first and what the one before needed is dropped last: whenever this is
        stopped, by a signal or a full disk, a whole checkpoint remains.

        Raises:
            StorageError: No space or no rights.
            TrainingError: As `take_step`.
        """
        self.settle()
        provenance = checkpoint.Provenance(
            config=self.config, step=self.step, dataset_sha256=self._dataset_sha256, objects=self._objects_card,
            camera_fx_px=self._fx_px,
        )  # fmt: skip
        if errors is not None and errors["validation/add_after_mm"] < self.best_mm:
            checkpoint.save(self.out / "best.safetensors", self.kept, provenance)
            self.best_mm = errors["validation/add_after_mm"]
        assert self._validation_set is not None
        state = {
            "optimiser": self._optimiser.state_dict(), "best_mm": self.best_mm, "world": self.world,
            "validation_shards": sorted(self._validation_set.joined),
        }  # fmt: skip
        if self._average is not None:
            state["weights"] = self.network.state_dict()
        checkpoint.save_state(self.out, self.step, state)
        checkpoint.save(self.out / "last.safetensors", self.kept, provenance)
        checkpoint.drop_leftovers(self.out, self.step)

    def close(self) -> None:
        """Let go of what the process group holds.

        The reducer goes first: were it the last owner of the group, its destructor would wait, with Python's lock
        held, for a thread that needs that lock.
        """
        self._on_policy.close()
        self._parallel = self._forward = self.network
        gc.collect()


def _dataset_sha256(reader: ShardReader, config: TrainConfig) -> str:
    """Hash of the data card and the manifest; of the card alone where shards are still being added."""
    if config.loader.follow:
        return hashlib.sha256(json.dumps(reader.card, sort_keys=True).encode()).hexdigest()
    return reader.digest
