"""Training processes started by torchrun."""

import gc
import os
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from typing import TypeVar

import torch
from torch import Tensor, nn
from torch.nn.parallel import DistributedDataParallel

from refinenet.config import TrainConfig
from refinenet.device import choose_device

T = TypeVar("T")


@dataclass(frozen=True, kw_only=True)
class Ranks:
    """This process among all training processes.

    Attributes:
        rank: Index of this process; rank 0 validates, reports and writes.
        world: Number of processes.
    """

    rank: int = 0
    world: int = 1

    @classmethod
    def of_environment(cls) -> "Ranks":
        """As torchrun's environment variables give them; a single process without torchrun."""
        return cls(rank=int(os.environ.get("RANK", "0")), world=int(os.environ.get("WORLD_SIZE", "1")))

    def from_first(self, value: T) -> T:
        """Rank 0's value, on every rank."""
        values = [value]
        if self.world > 1:
            torch.distributed.broadcast_object_list(values, src=0)
        return values[0]

    def mean(self, value: float | Tensor, device: torch.device) -> float | Tensor:
        """Mean of a number over the ranks; call on every rank."""
        if self.world == 1:
            return value
        mean = torch.as_tensor(value, device=device) / self.world
        torch.distributed.all_reduce(mean)
        return mean

    def broadcast_buffers(self, network: nn.Module) -> None:
        """Copy rank 0's buffers, batch norm statistics among them, to every rank."""
        if self.world > 1:
            for buffer in network.buffers():
                torch.distributed.broadcast(buffer, src=0)

    def distributed(self, network: nn.Module, device: torch.device) -> nn.Module:
        """The network with gradients averaged over the ranks."""
        if self.world == 1:
            return network
        return DistributedDataParallel(network, device_ids=[device] if device.type == "cuda" else None)


@contextmanager
def process_group(config: TrainConfig) -> Iterator[None]:
    """Process group of torchrun's processes; nothing without torchrun."""
    if Ranks.of_environment().world == 1:
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
