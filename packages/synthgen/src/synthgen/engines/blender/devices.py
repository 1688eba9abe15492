"""GPUs available to Cycles. As a program it writes their numbers as JSON: see `synthgen.engines.devices`."""

import json
import sys
from typing import Any

import bpy

from synthgen.engines.blender.quiet import blender_output_caught
from synthgen.names import GPU_DEVICES, Device


def gpu_counts() -> dict[Device, int]:
    """Number of GPUs by kind, kinds without any left out."""
    counts: dict[Device, int] = {kind: len(_devices(kind)) for kind in GPU_DEVICES}
    return {kind: count for kind, count in counts.items() if count}


def use_gpus(kind: Device) -> None:
    """Make Cycles use exactly the GPUs of a kind that are visible to this process (CUDA_VISIBLE_DEVICES)."""
    preferences = _preferences()
    preferences.compute_device_type = kind.upper()
    chosen = _devices(kind)
    for device in preferences.devices:
        device.use = device in chosen


def _devices(kind: Device) -> list[Any]:
    name = kind.upper()
    try:
        return [device for device in _preferences().get_devices_for_type(name) if device.type == name]
    except (TypeError, ValueError):  # a kind that this build of Blender does not support
        return []


def _preferences() -> Any:
    return bpy.context.preferences.addons["cycles"].preferences


if __name__ == "__main__":
    with blender_output_caught("looking for GPUs"):
        counts_by_kind = gpu_counts()
    sys.stdout.write(json.dumps(counts_by_kind) + "\n")
