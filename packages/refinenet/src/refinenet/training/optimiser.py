"""Optimiser, learning-rate schedule, and moving average of the weights."""

import copy
import math

import torch
from torch import nn

from refinenet.config import OptimiserConfig


def learning_rate(step: int, steps: int, config: OptimiserConfig) -> float:
    """Learning rate of a step (from 0) of `steps`: linear warm-up, then constant, or cosine down to a hundredth."""
    if step < config.warmup_steps:
        return config.lr * (step + 1) / config.warmup_steps
    if config.schedule == "constant":
        return config.lr
    progress = (step - config.warmup_steps) / max(1, steps - 1 - config.warmup_steps)
    return config.lr * (0.01 + 0.99 * 0.5 * (1 + math.cos(math.pi * min(1.0, progress))))


def make_optimiser(network: nn.Module, config: OptimiserConfig) -> torch.optim.Optimizer:
    """Adam, or AdamW with weight decay of matrices and convolutions only; fused where the device supports it."""
    parameters = [p for p in network.parameters() if p.requires_grad]
    fused = parameters[0].device.type in ("cpu", "cuda")
    if config.name == "adam":
        return torch.optim.Adam(parameters, lr=config.lr, fused=fused)
    decayed = [p for p in parameters if p.ndim > 1]
    plain = [p for p in parameters if p.ndim <= 1]
    groups = [{"params": decayed, "weight_decay": config.weight_decay}, {"params": plain, "weight_decay": 0.0}]
    return torch.optim.AdamW(groups, lr=config.lr, fused=fused)


class EmaWeights:
    """Exponential moving average (EMA) of a network's weights and of its batch norms' statistics; integers are copied.

    The decay of step n is at most (n + 1) / (n + 10): the random initial weights are forgotten soon.
    `torch.optim.swa_utils.AveragedModel` would copy the weights at the first step and average integers.

    Args:
        network: Network whose weights are averaged; the EMA starts at its present weights.
        decay: Weight of the EMA in each update.

    Attributes:
        network: Network with the averaged weights, in evaluation mode.
    """

    def __init__(self, network: nn.Module, decay: float) -> None:
        self.network = copy.deepcopy(network).eval().requires_grad_(False)
        self._decay = decay
        pairs = list(zip(self.network.state_dict().values(), network.state_dict().values(), strict=True))
        self._floats = [(mean, now) for mean, now in pairs if mean.is_floating_point()]
        self._integers = [(mean, now) for mean, now in pairs if not mean.is_floating_point()]

    @torch.no_grad()
    def update(self, step: int) -> None:
        """Average in the weights after step `step` (from 0)."""
        decay = min(self._decay, (step + 1) / (step + 10))
        means, now = zip(*self._floats, strict=True)
        torch._foreach_lerp_(list(means), list(now), 1.0 - decay)
        for mean, value in self._integers:
            mean.copy_(value)
