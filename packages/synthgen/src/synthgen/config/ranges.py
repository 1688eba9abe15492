"""Ranges, and the checks of single values."""

import math

from posecore.errors import ConfigError

Range = tuple[float, float]
IntRange = tuple[int, int]
MAX_PATCH_PX = 362  # shards hold distances up to 512 px, which is this patch's diagonal


def check_range(name: str, value: tuple[float, float], low: float = -math.inf, high: float = math.inf) -> None:
    """Raise ConfigError unless low <= a <= b <= high, all finite."""
    a, b = value
    if not (math.isfinite(a) and math.isfinite(b) and low <= a <= b <= high):
        raise ConfigError(f"{name} is [{a}, {b}], expected low <= high within [{low:g}, {high:g}]")


def check(name: str, value: float, low: float, high: float = math.inf) -> None:
    """Raise ConfigError unless the value is a number in [low, high]."""
    if not (math.isfinite(value) and low <= value <= high):
        raise ConfigError(f"{name} is {value}, expected a number in [{low:g}, {high:g}]")
