"""Guard against non-finite losses and gradients."""

from collections import deque
from typing import NamedTuple

import torch
from jaxtyping import Bool
from torch import Tensor

from refinenet.batch import Batch
from refinenet.errors import TrainingError


class _Pending(NamedTuple):
    step: int
    batches: tuple[Batch, ...]
    finite: list[Bool[Tensor, " b"]]
    gradient: Bool[Tensor, ""]
    ready: torch.cuda.Event | None


class FiniteGuard:
    """Stops a run at a non-finite loss or gradient, with the weights unchanged.

    Reading the result from a GPU at once would stall it between steps. There, the optimiser's kernel itself skips this
    and every later step (`found_inf`, as for gradient scalers), and the result is read one step late.

    Args:
        optimiser: Optimiser whose steps are guarded.
        device: Device of the losses.
        late: Read results one step late; otherwise before the optimiser's step.
    """

    def __init__(self, optimiser: torch.optim.Optimizer, device: torch.device, *, late: bool) -> None:
        self._optimiser, self._late = optimiser, late
        self._cuda = device.type == "cuda"
        self._broken = torch.zeros((), device=device)
        self._pending: deque[_Pending] = deque()

    def check(self, step: int, batches: tuple[Batch, ...], losses: list[Tensor], norm: Tensor) -> None:
        """Check one step, before the optimiser takes it.

        Args:
            step: Number of the step, from 0.
            batches: Batches of the step.
            losses: Loss of every sample, by batch.
            norm: Gradient norm.

        Raises:
            TrainingError: A number of this step, or of the previous step when late, is not finite; samples are named.
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
        """Wait for pending results.

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
        f"the {what} of step {step} is not finite, samples: {names}{more}; the weights are unchanged. "
        "Lower optimiser.lr, or set optimiser.gradient_clip"
    )
