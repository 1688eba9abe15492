"""What a step does to the weights: rate, optimiser, running average, and the guard against infinities."""

import copy
import math
from collections import deque
from typing import NamedTuple

import torch
from jaxtyping import Bool
from torch import Tensor, nn

from refinenet.batch import Batch
from refinenet.config import OptimiserConfig
from refinenet.errors import TrainingError


def learning_rate(step: int, steps: int, config: OptimiserConfig) -> float:
    """Rate of step `step` (from 0) of `steps`: linear warm-up, then constant or a cosine that ends at a hundredth."""
    if step < config.warmup_steps:
        return config.lr * (step + 1) / config.warmup_steps
    if config.schedule == "constant":
        return config.lr
    progress = (step - config.warmup_steps) / max(1, steps - 1 - config.warmup_steps)
    return config.lr * (0.01 + 0.99 * 0.5 * (1 + math.cos(math.pi * min(1.0, progress))))


def make_optimiser(network: nn.Module, config: OptimiserConfig) -> torch.optim.Optimizer:
    """Adam, or AdamW that decays matrices and kernels only; one fused kernel where the device has it."""
    parameters = [p for p in network.parameters() if p.requires_grad]
    fused = parameters[0].device.type in ("cpu", "cuda")
    if config.name == "adam":
        return torch.optim.Adam(parameters, lr=config.lr, fused=fused)
    decayed = [p for p in parameters if p.ndim > 1]
    plain = [p for p in parameters if p.ndim <= 1]
    groups = [{"params": decayed, "weight_decay": config.weight_decay}, {"params": plain, "weight_decay": 0.0}]
    return torch.optim.AdamW(groups, lr=config.lr, fused=fused)


class RunningAverage:
    """Exponential average of a network's weights, and of its batch norms' statistics; integers are copied.

    The decay of step n is at most (n + 1) / (n + 10), so that the first weights, which are random, are soon forgotten.

    Args:
        network: Whose weights; the average starts at them.
        decay: Share of the average that a step keeps.

    Attributes:
        network: Holds the average, in evaluation mode.
    """

    def __init__(self, network: nn.Module, decay: float) -> None:
        self.network = copy.deepcopy(network).eval().requires_grad_(False)
        self._decay = decay
        pairs = list(zip(self.network.state_dict().values(), network.state_dict().values(), strict=True))
        self._reals = [(mean, now) for mean, now in pairs if mean.is_floating_point()]
        self._others = [(mean, now) for mean, now in pairs if not mean.is_floating_point()]

    @torch.no_grad()
    def update(self, step: int) -> None:
        """Take in the weights after step `step` (from 0)."""
        keep = min(self._decay, (step + 1) / (step + 10))
        means, now = zip(*self._reals, strict=True)
        torch._foreach_lerp_(list(means), list(now), 1.0 - keep)
        for mean, value in self._others:
            mean.copy_(value)


class _Pending(NamedTuple):
    step: int
    batches: tuple[Batch, ...]
    finite: list[Bool[Tensor, " b"]]
    gradient: Bool[Tensor, ""]
    ready: torch.cuda.Event | None


class FiniteGuard:
    """Stops a run at a loss or gradient that is not finite, with the weights left alone.

    Asking a GPU for the answer at once would make it wait between steps. There, the optimiser's kernel itself skips
    this and every later step (`found_inf`, as gradient scalers use it), and the answer is read one step late.

    Args:
        optimiser: Whose steps are guarded.
        device: Where losses are.
        late: Read answers one step late; otherwise before the optimiser's step.
    """

    def __init__(self, optimiser: torch.optim.Optimizer, device: torch.device, *, late: bool) -> None:
        self._optimiser, self._late = optimiser, late
        self._cuda = device.type == "cuda"
        self._broken = torch.zeros((), device=device)
        self._pending: deque[_Pending] = deque()

    def check(self, step: int, batches: tuple[Batch, ...], losses: list[Tensor], norm: Tensor) -> None:
        """Look at one step, before the optimiser takes it.

        Args:
            step: Its number, from 0.
            batches: What it consumes.
            losses: Loss of every sample, by batch.
            norm: Of the gradient.

        Raises:
            TrainingError: A number of this step, or of the one before when late, is not finite; samples are named.
        """
        finite, gradient = [torch.isfinite(values) for values in losses], torch.isfinite(norm)
        if self._late:
            fine = gradient & torch.stack([values.all() for values in finite]).all()
            self._broken = torch.maximum(self._broken, (~fine).float())
            setattr(self._optimiser, "found_inf", self._broken)  # noqa: B010 (an attribute the class does not declare)
        ready = None
        if self._cuda:
            finite, gradient = [_to_host(values) for values in finite], _to_host(gradient)
            ready = torch.cuda.Event()
            ready.record()
        self._pending.append(_Pending(step, batches, finite, gradient, ready))
        while len(self._pending) > int(self._late):
            _require_finite(self._pending.popleft())

    def settle(self) -> None:
        """Wait for answers that are still open.

        Raises:
            TrainingError: As `check`.
        """
        while self._pending:
            _require_finite(self._pending.popleft())


def _to_host(values: Tensor) -> Tensor:
    host = torch.empty(values.shape, dtype=values.dtype, pin_memory=True)
    return host.copy_(values, non_blocking=True)


def _require_finite(pending: _Pending) -> None:
    if pending.ready is not None:
        pending.ready.synchronize()
    bad = [b.sample_ids[~f] for b, f in zip(pending.batches, pending.finite, strict=True)]
    if any(map(len, bad)):
        raise TrainingError(_not_finite("loss", pending.step, torch.cat(bad)))
    if not bool(pending.gradient):
        raise TrainingError(_not_finite("gradient", pending.step, torch.cat([b.sample_ids for b in pending.batches])))


def _not_finite(what: str, step: int, sample_ids: Tensor) -> str:
    names = ", ".join(f"shard {s} row {r}" for s, r in sample_ids[:8].tolist())
    more = f" and {len(sample_ids) - 8} more" if len(sample_ids) > 8 else ""
    return (
        f"the {what} of step {step} is not finite, samples: {names}{more}; the weights were left alone. "
        "Lower optimiser.lr, or set optimiser.gradient_clip"
    )
