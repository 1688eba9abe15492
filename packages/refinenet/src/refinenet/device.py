"""Choice of the device of a network."""

import os

import torch
from posecore.errors import ConfigError


def choose_device(name: str) -> torch.device:
    """Device by name: `auto` is a GPU where there is one; under torchrun each local rank takes the GPU of its number.

    Raises:
        ConfigError: The name is unknown, or a GPU is requested and there is none, or fewer than local ranks.
    """
    if name not in ("auto", "cpu", "cuda"):
        raise ConfigError(f"device: found {name!r}, expected auto, cpu or cuda")
    if name == "cuda" and not torch.cuda.is_available():
        raise ConfigError("device: cuda was requested and torch finds no GPU here; use --device cpu or auto")
    if name == "cpu" or (name == "auto" and not torch.cuda.is_available()):
        return torch.device("cpu")
    rank, count = int(os.environ.get("LOCAL_RANK", "0")), torch.cuda.device_count()
    if rank >= count:
        raise ConfigError(f"local rank {rank} has no GPU, there are {count} here; start --nproc-per-node {count}")
    return torch.device("cuda", rank)
