"""Checks of configuration fields that depend on each other."""

from posecore.errors import ConfigError


def require(ok: bool, message: str) -> None:
    """Raise `ConfigError` with a message unless a condition holds."""
    if not ok:
        raise ConfigError(message)
