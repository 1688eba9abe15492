"""What a training run is made of: data, network, loss, optimiser, and the step that joins them."""

import gc
import math
import os
from pathlib import Path
from typing import Any

import torch
from posecore.errors import CheckpointError, ConfigError
from torch import nn
from torch.nn.parallel import DistributedDataParallel

from refinenet import backbone, checkpoint, metrics
from refinenet.config import OptimiserConfig, TrainConfig
from refinenet.data import Batch, PairSource, PairStream, make_loader, split_by_scene, spread_rows, validation_batches
from refinenet.errors import TrainingError
from refinenet.loss import make_loss
from refinenet.network import PaperNet, make_network
from refinenet.objects import load_meshes, load_models, object_points


def learning_rate(step: int, steps: int, config: OptimiserConfig) -> float:
    """Rate of step `step` (from 0) of `steps`: linear warm-up, then constant or a cosine down to a hundredth."""
    if step < config.warmup_steps:
        return config.lr * (step + 1) / config.warmup_steps
    if config.schedule == "constant":
        return config.lr
    progress = (step - config.warmup_steps) / max(1, steps - config.warmup_steps)
    return config.lr * (0.01 + 0.99 * 0.5 * (1 + math.cos(math.pi * min(1.0, progress))))


def choose_device(name: str) -> torch.device:
    """`auto` is a GPU where there is one; under torchrun each local rank takes its own.

    Raises:
        ConfigError: A GPU is asked for and there is none.
    """
    if name == "cuda" and not torch.cuda.is_available():
        raise ConfigError("device: cuda was asked for and torch finds no GPU here; use --device cpu or auto")
    if name == "cpu" or (name == "auto" and not torch.cuda.is_available()):
        return torch.device("cpu")
    return torch.device("cuda", int(os.environ.get("LOCAL_RANK", "0")))


def use_bfloat16(precision: str, device: torch.device) -> bool:
    """Whether convolutions run in bfloat16; on a processor without such instructions they would run slower in it."""
    if precision == "auto":
        return device.type == "cuda" or torch.cpu._is_avx512_bf16_supported()
    return precision == "bfloat16"


class Trainer:
    """A run, ready to step.

    Args:
        config: Everything but data and place.
        url: Shard dataset.
        out: Folder of checkpoints and logs.
        resume: Go on from `out/last.safetensors`.

    Attributes:
        step: Optimiser steps taken.
        best_mm: Smallest held-out point distance so far.
    """

    def __init__(self, config: TrainConfig, url: str, out: Path, *, resume: bool = False) -> None:
        if config.threads:
            torch.set_num_threads(config.threads)
        torch.manual_seed(config.seed)
        torch.backends.cudnn.deterministic, torch.backends.cudnn.benchmark = True, False
        self.config, self.out = config, out
        self.rank, self.world = int(os.environ.get("RANK", "0")), int(os.environ.get("WORLD_SIZE", "1"))
        self.device = choose_device(config.device)
        self._reduced = use_bfloat16(config.precision, self.device)
        self._url = url
        held_out = PairSource(url, config, training=False)
        reader = held_out.reader
        try:
            self.training, self.validation = split_by_scene(reader, config.validation.scene_share, config.seed)
            measured = spread_rows(self.validation, config.validation.pairs)
            # Rendered once and kept: the same pairs are measured every time, without a context in this process.
            self._held_out = list(validation_batches(held_out, measured, config.batch))
        finally:
            held_out.close()
        points = object_points(
            load_meshes(reader), load_models(reader), config.loss.model_points, config.loss.symmetry_step_deg
        )
        self.objects = points.to(self.device)
        self._dataset_sha256, self._objects_card = reader.digest, reader.card["objects"]
        self._fx_px = float(reader.card.get("camera", {}).get("fx", 0.0))
        self.network = make_network(config.network).to(self.device)
        self._loss = make_loss(
            config.loss.name, gamma=config.loss.gamma, point_weight=config.loss.point_weight,
            rotation_weight=config.loss.rotation_weight, objects=self.objects,
        )  # fmt: skip
        self.loss_key = "loss_mse" if config.loss.name == "mse" else "loss_px"
        self._optimiser = _optimiser(self.network, config.optimiser)
        self.step, self.best_mm = 0, math.inf
        if resume:
            self._resume()
        elif isinstance(self.network, PaperNet) and config.network.backbone.pretrained:
            stem = config.network.backbone
            backbone.load_pretrained(self.network.stem, stem.name, stem.weights)
        self._parallel = self._distribute()

    def _resume(self) -> None:
        last = checkpoint.load(self.out / "last.safetensors", self.config.preset)
        checkpoint.require_same(last.provenance.config, self.config, last.path)
        if last.provenance.dataset_sha256 != self._dataset_sha256:
            raise CheckpointError(f"{last.path}: was trained on other data than {self._url}; start a new run")
        self.network.load_state_dict(last.tensors)
        state = checkpoint.load_state(self.out, last.provenance.step)
        self._optimiser.load_state_dict(state["optimiser"])
        self.step, self.best_mm = last.provenance.step, float(state["best_mm"])

    def _distribute(self) -> nn.Module:
        if self.world == 1:
            return self.network
        torch.distributed.init_process_group("nccl" if self.device.type == "cuda" else "gloo")
        return DistributedDataParallel(self.network, device_ids=[self.device] if self.device.type == "cuda" else None)

    def stream(self) -> Any:
        """Iterator of training batches from the present step on."""
        workers = max(1, min(self.config.loader.workers, len(self.training.rows) // self.world))
        stream = PairStream(
            url=self._url, config=self.config, split=self.training, rank=self.rank, world=self.world, workers=workers,
            start=self.step,
        )  # fmt: skip
        return iter(make_loader(stream))

    def take_step(self, batch: Batch) -> dict[str, float]:
        """One optimiser step.

        Returns:
            The batch's mean loss and the step's learning rate.

        Raises:
            TrainingError: A loss or the gradient is not finite; nothing was changed. Samples are named.
        """
        self._parallel.train()
        batch = batch.to(self.device)
        with torch.autocast(self.device.type, torch.bfloat16, enabled=self._reduced):
            update = self._parallel(batch.pair)
        losses = self._loss(update, batch.target)
        finite = torch.isfinite(losses)
        if not bool(finite.all()):
            raise TrainingError(_not_finite("loss", self.step, batch.sample_ids[~finite.cpu()]))
        loss = losses.mean()
        self._optimiser.zero_grad(set_to_none=True)
        loss.backward()
        limit = self.config.optimiser.gradient_clip or math.inf
        norm = torch.nn.utils.clip_grad_norm_(self.network.parameters(), limit)
        if not bool(torch.isfinite(norm)):
            raise TrainingError(_not_finite("gradient", self.step, batch.sample_ids))
        rate = learning_rate(self.step, self.config.steps, self.config.optimiser)
        for group in self._optimiser.param_groups:
            group["lr"] = rate
        self._optimiser.step()
        self.step += 1
        return {self.loss_key: float(loss.detach()), "learning_rate": rate, "gradient_norm": float(norm)}

    def validate(self) -> dict[str, float]:
        """Errors on held-out pairs, before and after one update."""
        return metrics.measure(self.network, self._held_out, self.objects, self.device)

    def save(self, errors: dict[str, float] | None) -> None:
        """Write `last`, and `best` when the errors are the best so far."""
        provenance = checkpoint.Provenance(
            config=self.config, step=self.step, dataset_sha256=self._dataset_sha256, objects=self._objects_card,
            camera_fx_px=self._fx_px,
        )  # fmt: skip
        if errors is not None and errors["validation/add_after_mm"] < self.best_mm:
            self.best_mm = errors["validation/add_after_mm"]
            checkpoint.save(self.out / "best.safetensors", self.network, provenance)
        state = {"optimiser": self._optimiser.state_dict(), "best_mm": self.best_mm}
        checkpoint.save_state(self.out, self.step, state)
        checkpoint.save(self.out / "last.safetensors", self.network, provenance)
        checkpoint.drop_states(self.out, self.step)

    def close(self) -> None:
        """Leave the process group.

        The reducer goes first: were it the last owner of the group, its destructor would wait, with Python's lock
        held, for a thread that needs that lock.
        """
        if self.world > 1:
            self._parallel = self.network
            gc.collect()
            torch.distributed.destroy_process_group()


def _optimiser(network: nn.Module, config: OptimiserConfig) -> torch.optim.Optimizer:
    parameters = [p for p in network.parameters() if p.requires_grad]
    if config.name == "adam":
        return torch.optim.Adam(parameters, lr=config.lr, fused=True)
    decayed = [p for p in parameters if p.ndim > 1]
    plain = [p for p in parameters if p.ndim <= 1]
    groups = [{"params": decayed, "weight_decay": config.weight_decay}, {"params": plain, "weight_decay": 0.0}]
    return torch.optim.AdamW(groups, lr=config.lr, fused=True)


def _not_finite(what: str, step: int, sample_ids: torch.Tensor) -> str:
    names = ", ".join(f"shard {s} row {r}" for s, r in sample_ids[:8].tolist())
    more = f" and {len(sample_ids) - 8} more" if len(sample_ids) > 8 else ""
    return (
        f"the {what} of step {step} is not finite, samples: {names}{more}; the weights were left alone. "
        "Lower optimiser.lr, or set optimiser.gradient_clip"
    )
