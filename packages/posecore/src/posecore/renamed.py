"""Names of earlier versions: modules and keys are refused with the new name; stored mappings are read as before.

Keys have dots between groups. A table has an entry for each key or whole group, and for each value with an equals sign:

    {"loss.min_closeness": "loss.min_pose_quality", "own_predictions": "on_policy",
     "own_predictions.share": "on_policy.fraction", "method=start": "method=initial"}

Old names are in such tables only, so that a later version can drop them.
"""

import sys
from collections.abc import Mapping, Sequence
from importlib.abc import MetaPathFinder
from typing import Any

from posecore.errors import ConfigError


def refuse_renamed_modules(renamed: Mapping[str, str]) -> None:
    """Have `import` name the new place of modules that moved: "refinenet.methods is now refinenet.refiner".

    Args:
        renamed: New full name, of a module or of an object in it, by old full name.
    """
    finder = next((item for item in sys.meta_path if isinstance(item, _RenamedModules)), None)
    if finder is None:
        finder = _RenamedModules()
        sys.meta_path.append(finder)  # last: only modules that are not there come to it
    finder.renamed |= renamed


class _RenamedModules(MetaPathFinder):
    """Finder that finds nothing and refuses the old names."""

    def __init__(self) -> None:
        self.renamed: dict[str, str] = {}

    def find_spec(self, fullname: str, path: object, target: object = None) -> None:
        if fullname in self.renamed:
            raise ImportError(f"{fullname} is now {self.renamed[fullname]}", name=fullname)


def refuse_renamed_keys(mapping: Mapping[str, Any], renamed: Mapping[str, str], where: str) -> None:
    """Refuse keys and values of earlier versions.

    Args:
        mapping: Nested groups of keys.
        renamed: See the module.
        where: File or option, for messages.

    Raises:
        ConfigError: There is one; the message has its new name.
    """
    for old in _deepest_first(renamed):
        if _holds(mapping, old):
            raise ConfigError(f"{where}: {old} is now {renamed[old]}")


def migrated_keys(mapping: Mapping[str, Any], renamed: Mapping[str, str]) -> dict[str, Any]:
    """A copy of a stored mapping with its old keys and values replaced; what has the new name already stays.

    Args:
        mapping: Nested groups of keys.
        renamed: See the module.
    """
    result = dict(mapping)
    for old in _deepest_first(renamed):
        if _holds(result, old):
            key, new_key = old.partition("=")[0].split("."), renamed[old].partition("=")[0].split(".")
            value = renamed[old].partition("=")[2] if "=" in old else _get(result, key)
            result = _moved(result, key, new_key, value)
    return result


def _deepest_first(renamed: Mapping[str, str]) -> list[str]:
    """Old names: keys before their groups, values before their keys."""
    return sorted(renamed, key=lambda old: (-old.partition("=")[0].count("."), "=" not in old))


def _holds(mapping: Mapping[str, Any], old: str) -> bool:
    key, is_value, value = old.partition("=")
    *groups, name = key.split(".")
    group = _get(mapping, groups)
    return isinstance(group, Mapping) and name in group and (not is_value or group[name] == value)


def _get(mapping: Any, key: Sequence[str]) -> Any:
    for name in key:
        mapping = mapping.get(name) if isinstance(mapping, Mapping) else None
    return mapping


def _moved(mapping: Mapping[str, Any], old: Sequence[str], new: Sequence[str], value: Any) -> dict[str, Any]:
    """A copy with a value under another key, at its position where both keys are in the same group."""
    if len(old) > 1 and len(new) > 1 and old[0] == new[0]:
        return {k: _moved(v, old[1:], new[1:], value) if k == old[0] else v for k, v in mapping.items()}
    if len(old) == len(new) == 1 and (old == new or new[0] not in mapping):
        return {(new[0] if k == old[0] else k): (value if k == old[0] else v) for k, v in mapping.items()}
    return _with(_without(mapping, old), new, value)


def _without(mapping: Mapping[str, Any], key: Sequence[str]) -> dict[str, Any]:
    name, *rest = key
    inner = _without(mapping[name], rest) if rest else {}
    return {k: inner if k == name else v for k, v in mapping.items() if k != name or inner}


def _with(mapping: Mapping[str, Any], key: Sequence[str], value: Any) -> dict[str, Any]:
    name, *rest = key
    present = mapping.get(name)
    if rest:
        return {**mapping, name: _with(present if isinstance(present, Mapping) else {}, rest, value)}
    if isinstance(present, Mapping) and isinstance(value, Mapping):
        return {**mapping, name: {**value, **present}}
    return {name: value, **mapping}
