"""Renamed configuration keys: refused in a user's configuration, migrated in a stored one."""

from collections.abc import Mapping
from typing import Any

from posecore.renamed import migrated_keys

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
"""New key of `SynthConfig` and `CutConfig` by old key, see `posecore.renamed`."""


def migrate(mapping: Mapping[str, Any]) -> dict[str, Any]:
    """A copy of a stored configuration, e.g. of a data card, with the new keys."""
    return migrated_keys(mapping, RENAMED_KEYS)
