"""Names shared by the command line, the configuration and the engines; imports nothing heavy."""

from typing import Literal, get_args

EngineName = Literal["cycles", "eevee", "raster"]
Device = Literal["auto", "cpu", "cuda", "optix"]

ENGINE_NAMES: tuple[EngineName, ...] = get_args(EngineName)
DEVICES: tuple[Device, ...] = get_args(Device)
GPU_DEVICES: tuple[Device, ...] = ("optix", "cuda")
"""GPU back ends of Cycles in the order in which 'auto' tries them; without any it takes the CPU."""
