"""Devices of Cycles: the GPUs of this machine, the choice of 'auto', and the names of GPUs for workers."""

import json
import os
import subprocess
import sys
from collections.abc import Mapping

from posecore.errors import RenderError

from synthgen.names import GPU_DEVICES, Device

_LISTING_TIMEOUT_S = 600  # the first start on a machine with GPUs may load their drivers


def list_gpus() -> dict[Device, int]:
    """Number of GPUs by kind that Cycles finds on this machine.

    Blender is imported in a process of its own, because a process with Blender must not fork.

    Raises:
        RenderError: Blender does not start.
    """
    command = [sys.executable, "-m", "synthgen.engines.blender.devices"]
    try:
        run = subprocess.run(command, capture_output=True, text=True, timeout=_LISTING_TIMEOUT_S, check=True)
        gpus: dict[Device, int] = json.loads(run.stdout.splitlines()[-1])
    except (OSError, subprocess.SubprocessError, ValueError, IndexError) as error:
        lines = (getattr(error, "stderr", None) or str(error)).strip().splitlines()
        raise RenderError(
            f"--device: Blender cannot list its GPUs ({lines[-1] if lines else type(error).__name__}); "
            "use --device cpu or --engine raster"
        ) from error
    return gpus


def choose_device(device: Device, gpus: Mapping[Device, int]) -> Device:
    """The device to use.

    Args:
        device: Requested device; 'auto' takes the first available one of OptiX, CUDA and the CPU.
        gpus: Number of GPUs by kind.

    Raises:
        RenderError: The requested kind is not available.
    """
    if device == "auto":
        return next((kind for kind in GPU_DEVICES if gpus.get(kind)), "cpu")
    if device != "cpu" and not gpus.get(device):
        available = ", ".join(f"{count} {kind}" for kind, count in sorted(gpus.items())) or "none"
        raise RenderError(
            f"device {device}: Cycles finds no such GPU here (it finds {available}); install NVIDIA's driver and check "
            "CUDA_VISIBLE_DEVICES, or use --device cpu"
        )
    return device


def visible_gpus(count: int) -> tuple[str, ...]:
    """Names of this process' GPUs for CUDA_VISIBLE_DEVICES."""
    named = [name.strip() for name in os.environ.get("CUDA_VISIBLE_DEVICES", "").split(",") if name.strip()]
    return tuple(named[:count]) if named else tuple(str(i) for i in range(count))
