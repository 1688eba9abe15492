"""Configuration keys and values of earlier versions: refused in new configurations, migrated in old checkpoints."""

import copy
from collections.abc import Mapping
from typing import Any

from posecore.errors import ConfigError

KEYS = {
    "own_predictions.share": "on_policy.fraction",
    "own_predictions.begin": "on_policy.begin",
    "own_predictions.full": "on_policy.full",
    "own_predictions.updates": "on_policy.updates",
    "hypothesis.fresh": "hypothesis.online",
    "hypothesis.easy_share": "hypothesis.easy_fraction",
    "hypothesis.stored_share": "hypothesis.precomputed_fraction",
    "hypothesis.any_twin": "hypothesis.sample_symmetries",
    "augment.occlusion_leaves": "augment.min_visible_fraction",
    "loss.min_closeness": "loss.min_pose_quality",
    "validation.scene_share": "validation.scene_fraction",
}
"""Old key to new key."""
VALUES = {"loss.confidence_target": {"overlap": "visible_iou", "closeness": "pose_quality"}}
"""Old value to new value, by key."""


def require_current(mapping: Mapping[str, Any], where: str) -> None:
    """Refuse keys and values of earlier versions.

    Args:
        mapping: Configuration.
        where: File or option, for messages.

    Raises:
        ConfigError: There is such a key or value; the message names the new one.
    """
    for old, new in KEYS.items():
        group, key = old.split(".")
        if key in _group(mapping, group):
            raise ConfigError(f"{where}: {old} was renamed; write {new}")
    for name, values in VALUES.items():
        group, key = name.split(".")
        value = _group(mapping, group).get(key)
        if value in values:
            raise ConfigError(f"{where}: {name}={value} was renamed; write {name}={values[value]}")


def migrated(mapping: Mapping[str, Any]) -> dict[str, Any]:
    """The configuration of an earlier version under today's keys and values; a current one is returned unchanged."""
    result = copy.deepcopy(dict(mapping))
    for old, new in KEYS.items():
        group, key = old.split(".")
        if key in _group(result, group):
            new_group, new_key = new.split(".")
            result.setdefault(new_group, {})[new_key] = result[group].pop(key)
            if not result[group]:
                del result[group]
    for name, values in VALUES.items():
        group, key = name.split(".")
        if key in _group(result, group):
            result[group][key] = values.get(result[group][key], result[group][key])
    return result


def _group(mapping: Mapping[str, Any], name: str) -> Mapping[str, Any]:
    group = mapping.get(name)
    return group if isinstance(group, Mapping) else {}
