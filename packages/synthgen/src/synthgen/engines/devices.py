"""Where Cycles traces: what this machine has, what is meant by 'auto', and which worker gets which GPU."""

import json
import os
import subprocess
import sys
from collections.abc import Mapping

from posecore.errors import RenderError

from synthgen.names import GPU_DEVICES, Device

_LISTING_TIMEOUT_S = 180  # the first start on a machine with GPUs may load their drivers


def list_gpus() -> dict[Device, int]:
    """Number of GPUs by kind that Cycles finds on this machine.

    Another process looks, because one that imports Blender must not fork afterwards.

    Raises:
        RenderError: Blender does not start.
    """
    command = [sys.executable, "-m", "synthgen.engines.blender.devices"]
    try:
        run = subprocess.run(command, capture_output=True, text=True, timeout=_LISTING_TIMEOUT_S, check=True)
        found: dict[Device, int] = json.loads(run.stdout.splitlines()[-1])
    except (OSError, subprocess.SubprocessError, ValueError, IndexError) as error:
        said = (getattr(error, "stderr", None) or str(error)).strip().splitlines()
        raise RenderError(
            f"--device: Blender cannot be asked for its GPUs ({said[-1] if said else type(error).__name__}); "
            "use --device cpu or --engine raster"
        ) from error
    return found


def choose_device(device: Device, gpus: Mapping[Device, int]) -> Device:
    """The device that is meant.

    Args:
        device: Wish; 'auto' takes the first of OptiX, CUDA and the CPU that is there.
        gpus: What is there.

    Raises:
        RenderError: The wished kind is not there.
    """
    if device == "auto":
        return next((kind for kind in GPU_DEVICES if gpus.get(kind)), "cpu")
    if device != "cpu" and not gpus.get(device):
        there = ", ".join(f"{count} {kind}" for kind, count in sorted(gpus.items())) or "none"
        raise RenderError(
            f"device {device}: Cycles finds no such GPU here (it finds {there}); install NVIDIA's driver and look at "
            "CUDA_VISIBLE_DEVICES, or use --device cpu"
        )
    return device


def visible_gpus(count: int) -> tuple[str, ...]:
    """What CUDA_VISIBLE_DEVICES calls each of the GPUs that this process sees."""
    named = [name.strip() for name in os.environ.get("CUDA_VISIBLE_DEVICES", "").split(",") if name.strip()]
    return tuple(named[:count]) if named else tuple(str(i) for i in range(count))
