"""Configuration keys that have a new name: refused in what a user writes, migrated in what earlier versions stored."""

from collections.abc import Mapping
from typing import Any

from posecore.errors import ConfigError

RENAMED_KEYS: dict[str, str] = {
    "perturbation.easy_share": "perturbation.easy_fraction",
    "scene.tabletop_share": "scene.tabletop_fraction",
    "tabletop.near_share": "tabletop.near_fraction",
    "lights.hdri_share": "lights.hdri_fraction",
    "lights.ambient_share": "lights.ambient_fraction",
    "material.textureless_share": "material.textureless_fraction",
    "material.random_colour_share": "material.random_colour_fraction",
    "background.hdri_share": "background.hdri_fraction",
    "background.photo_share": "background.photo_fraction",
    "sensor.motion_share": "sensor.motion_fraction",
    "sensor.jpeg_share": "sensor.jpeg_fraction",
    "sequence.max_turn_deg_s": "sequence.max_angular_speed_deg_s",
    "sequence.smoothness_s": "sequence.min_period_s",
    "sequence.pass_every_s": "sequence.occluder_period_s",
    "sequence.light_swing": "sequence.light_variation",
}
"""New key by old key, of `SynthConfig` and `CutConfig`, group and name with a dot between."""


def refuse_renamed(mapping: Mapping[str, Any], where: str) -> None:
    """Check a user's configuration for old keys.

    Args:
        mapping: Groups of keys.
        where: File or option, for the message.

    Raises:
        ConfigError: A key has a new name; the message has both.
    """
    for group, values in mapping.items():
        for key in values if isinstance(values, Mapping) else ():
            if (old := f"{group}.{key}") in RENAMED_KEYS:
                raise ConfigError(f"{where}: the key {old} was renamed; write {RENAMED_KEYS[old]}")


def migrate(mapping: Mapping[str, Any]) -> dict[str, Any]:
    """A copy of a stored configuration, e.g. of a data card, with today's keys in the stored order."""
    return {
        group: {RENAMED_KEYS.get(f"{group}.{key}", f".{key}").partition(".")[2]: value for key, value in values.items()}
        if isinstance(values, Mapping)
        else values
        for group, values in mapping.items()
    }
