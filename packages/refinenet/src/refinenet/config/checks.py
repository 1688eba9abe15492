"""Range checks of configuration fields."""

import math

from posecore.errors import ConfigError


def require(ok: bool, message: str) -> None:
    """Raise `ConfigError` with a message unless a condition holds."""
    if not ok:
        raise ConfigError(message)


def require_finite(config: object, *names: str) -> None:
    """Require finite numbers of 0 or more in these fields."""
    for name in names:
        value = getattr(config, name)
        require(0 <= value < math.inf, f"{name} is {value}, expected a number of 0 or more")


def require_positive(config: object, *names: str) -> None:
    """Require 1 or more in these fields."""
    for name in names:
        value = getattr(config, name)
        require(value >= 1, f"{name} is {value}, expected 1 or more")


def require_fraction(config: object, *names: str) -> None:
    """Require 0 to 1 in these fields."""
    for name in names:
        value = getattr(config, name)
        require(0 <= value <= 1, f"{name} is {value}, expected 0 to 1")
