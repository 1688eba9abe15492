"""A training run: data, network, loss and optimiser, and the step that joins them."""

import gc
import logging
import math
from collections.abc import Iterator
from contextlib import AbstractContextManager, nullcontext
from pathlib import Path

import torch
from posecore.errors import ConfigError
from torch import Tensor, nn
from torch.nn.parallel import DistributedDataParallel

from refinenet.batch import Batch, NetworkInput
from refinenet.config import TrainConfig
from refinenet.data.loader import make_loader, on_device
from refinenet.data.pair_stream import PairStream
from refinenet.geometry.poses import PoseUpdate
from refinenet.models import checkpoint
from refinenet.training import validation
from refinenet.training.finite_guard import FiniteGuard
from refinenet.training.losses import PIXEL_LOSSES, Loss
from refinenet.training.on_policy import OnPolicyHypotheses
from refinenet.training.optimiser import EmaWeights, learning_rate
from refinenet.training.ranks import Ranks
from refinenet.training.training_data import TrainingData

log = logging.getLogger(__name__)


def use_bfloat16(precision: str, device: torch.device) -> bool:
    """Whether convolutions run in bfloat16; on a processor without such instructions they would be slower."""
    if precision == "auto":
        if device.type == "cuda":
            return torch.cuda.is_bf16_supported(including_emulation=False)
        return torch.cpu._is_avx512_bf16_supported()
    return precision == "bfloat16"


class Trainer:
    """A run, ready to step; under torchrun, within `process_group`. `setup.open_run` makes one.

    Args:
        config: Configuration.
        out: Folder of checkpoints and logs.
        data: Split, validation pairs and objects.
        network: Network with its initial weights, on the device.
        loss: Loss on the same device.
        optimiser: Optimiser of the network's weights.
        ema: Moving average of the weights; None validates and saves the weights themselves.
        ranks: This process.
        device: Device of network and loss.

    Attributes:
        step: Optimiser steps taken.
        best_mm: Smallest mean point distance in a validation so far.
        loss_key: Name of the loss among the metrics, with its unit where it has one.
    """

    def __init__(
        self,
        config: TrainConfig,
        out: Path,
        *,
        data: TrainingData,
        network: nn.Module,
        loss: Loss,
        optimiser: torch.optim.Optimizer,
        ema: EmaWeights | None,
        ranks: Ranks,
        device: torch.device,
    ) -> None:
        self.config, self.out, self.data = config, out, data
        self.network, self.loss, self.optimiser, self.ema = network, loss, optimiser, ema
        self.ranks, self.device = ranks, device
        self.step, self.best_mm = 0, math.inf
        in_pixels = config.loss.name in PIXEL_LOSSES and not config.network.confidence
        self.loss_key = "loss_px" if in_pixels else "loss"
        self._bfloat16 = use_bfloat16(config.precision, device)
        self._guard = FiniteGuard(optimiser, device, late=device.type == "cuda")
        self._on_policy = OnPolicyHypotheses(config, data.meshes, ranks.rank, bfloat16=self._bfloat16)
        self._parallel: nn.Module | None = None
        self._forward: nn.Module | None = None

    @property
    def eval_network(self) -> nn.Module:
        """The network that is validated and saved: the EMA where there is one."""
        return self.network if self.ema is None else self.ema.network

    def stream(self) -> Iterator[Batch]:
        """Training batches on the device, from the present step on."""
        settings, training = self.config.loader, self.data.training
        workers = max(1, min(settings.workers, len(training.rows) // self.ranks.world))
        stream = PairStream(
            url=self.data.url, config=self.config, split=training, rank=self.ranks.rank, world=self.ranks.world,
            workers=workers, start=self.step * self.config.optimiser.accumulate, growing=self.data.growing,
        )  # fmt: skip
        return on_device(iter(make_loader(stream, pin=self.device.type == "cuda")), self.device)

    def take_step(self, *batches: Batch) -> dict[str, float | Tensor]:
        """One optimiser step on the mean gradient of its batches.

        Returns:
            The mean loss and the gradient's norm, both still on the device, the step's learning rate, and the mean
            visible fraction of the objects.

        Raises:
            TrainingError: A loss or the gradient is not finite; the weights are unchanged. Samples are named. On a GPU
                this is raised one step late, or by `settle`.
        """
        parallel = self._distributed()
        parallel.train()
        self.optimiser.zero_grad(set_to_none=True)
        losses = []
        for i, batch in enumerate(batches):
            self.data.report_skipped(*batch.skipped)
            if self.config.on_policy.fraction:  # a resumed run begins with rank 0's statistics on every rank
                self.ranks.broadcast_buffers(self.network)
            batch = self._on_policy(self.network, batch.to(self.device), self.step, i)
            with _no_sync(parallel) if i < len(batches) - 1 else nullcontext():
                with torch.autocast(self.device.type, torch.bfloat16, enabled=self._bfloat16):
                    update = self._predict(batch.inputs)
                losses.append(self.loss(update, batch.target))
                (losses[-1].mean() / len(batches)).backward()
        weights = [p for p in self.network.parameters() if p.grad is not None]
        norm = torch.nn.utils.get_total_norm([p.grad for p in weights if p.grad is not None])
        self._guard.check(self.step, batches, [values.detach() for values in losses], norm)
        if limit := self.config.optimiser.gradient_clip:
            torch.nn.utils.clip_grads_with_norm_(weights, limit, norm)
        rate = learning_rate(self.step, self.config.steps, self.config.optimiser)
        for group in self.optimiser.param_groups:
            group["lr"] = rate
        self.optimiser.step()
        if self.ema is not None:
            self.ema.update(self.step)
        self.step += 1
        loss = torch.stack([values.detach().mean() for values in losses]).mean()
        visible = [batch.visible_fraction.mean() for batch in batches if batch.visible_fraction is not None]
        more = {"visible_fraction": torch.stack(visible).mean()} if visible else {}
        return {self.loss_key: loss, "learning_rate": rate, "gradient_norm": norm, **more}

    def _distributed(self) -> nn.Module:
        """The network as it is trained, made at the first step: after weights have been restored."""
        if self._parallel is None or self._forward is None:
            self._parallel = self.ranks.distributed(self.network, self.device)
            self._forward = torch.compile(self._parallel) if self.config.compile else self._parallel  # type: ignore[assignment]
        return self._parallel

    def _predict(self, inputs: NetworkInput) -> PoseUpdate:
        assert self._forward is not None
        if not self.config.compile:
            return self._forward(inputs)
        try:
            return self._forward(inputs)
        except torch._dynamo.exc.TorchDynamoException as error:
            detail = (str(error).strip().splitlines() or [type(error).__name__])[0]
            raise ConfigError(
                f"compile: torch.compile failed here ({detail}); train with --set compile=false"
            ) from error

    def settle(self) -> None:
        """Wait until the device has checked the last step's numbers.

        Raises:
            TrainingError: As `take_step`.
        """
        self._guard.settle()

    def over_ranks(self, values: dict[str, float | Tensor]) -> dict[str, float]:
        """A step's values as numbers, averaged over the ranks where they differ; call on every rank.

        Raises:
            TrainingError: As `take_step`.
        """
        self.settle()
        for key in (self.loss_key, "visible_fraction"):
            if key in values:
                values = {**values, key: self.ranks.mean(values[key], self.device)}
        return {key: float(value) for key, value in values.items()}

    def validate(self) -> dict[str, float]:
        """Errors on the validation pairs, before and after one update; on rank 0.

        When more pairs have joined, errors are not comparable with earlier ones, and `best_mm` is reset.
        """
        pairs = self.data.validation
        assert pairs is not None
        if pairs.grow():
            self.data.report_skipped(*pairs.skipped)
            self.best_mm = math.inf
        return validation.measure(self.eval_network, pairs.batches, self.loss.objects, self.device, self.config.loss)

    def save(self, errors: dict[str, float] | None) -> None:
        """Write `last`, and `best` when the errors are the best so far.

        The state beside `last` is written first, and that of the previous step is removed last: a whole checkpoint
        remains whenever a signal or a full disk interrupts this.

        Raises:
            StorageError: No space or no rights.
            TrainingError: As `take_step`.
        """
        self.settle()
        provenance = checkpoint.Provenance(
            config=self.config, step=self.step, dataset_sha256=self.data.sha256, objects=self.data.objects_card,
            camera_fx_px=self.data.camera_fx_px,
        )  # fmt: skip
        if errors is not None and errors["validation/add_after_mm"] < self.best_mm:
            checkpoint.save(self.out / "best.safetensors", self.eval_network, provenance)
            self.best_mm = errors["validation/add_after_mm"]
        assert self.data.validation is not None
        state = {
            "optimiser": self.optimiser.state_dict(), "best_mm": self.best_mm, "world": self.ranks.world,
            "validation_shards": sorted(self.data.validation.joined),
        }  # fmt: skip
        if self.ema is not None:
            state["weights"] = self.network.state_dict()
        checkpoint.save_state(self.out, self.step, state)
        checkpoint.save(self.out / "last.safetensors", self.eval_network, provenance)
        checkpoint.drop_leftovers(self.out, self.step)

    def close(self) -> None:
        """Free the rasteriser and the reducer of the process group.

        The reducer goes before the group: as the group's last owner, its destructor would wait, with Python's lock
        held, for a thread that needs that lock.
        """
        self._on_policy.close()
        self._parallel = self._forward = None
        gc.collect()


def _no_sync(parallel: nn.Module) -> AbstractContextManager[None]:
    """Gradients stay on this rank until the last batch of a step."""
    return parallel.no_sync() if isinstance(parallel, DistributedDataParallel) else nullcontext()
