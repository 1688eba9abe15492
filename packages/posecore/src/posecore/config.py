"""Frozen dataclasses from YAML: nested, every key, type and range checked, unknown keys rejected by name.

Ranges stand beside the fields:

    @dataclass(frozen=True, kw_only=True)
    class SensorConfig:
        jpeg_fraction: Annotated[float, Range(0, 1)] = 0.5
        blur_sigma_px: Annotated[tuple[float, float], Range(0, 20)] = (0.0, 0.9)  # low <= high, both within
        widths: tuple[Annotated[int, Range(1)], ...] = (96, 128)  # each
        scale: Annotated[float, Range(0, 5, above=True, unit="diameters")] | None = None

        def __post_init__(self) -> None:
            check_ranges(self)
"""

import dataclasses
import itertools
import math
import types
import typing
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, TypeVar

import yaml

from posecore.errors import ConfigError
from posecore.files import read_regular
from posecore.renamed import refuse_renamed_keys

T = TypeVar("T")
LARGEST_YAML_BYTES = 1 << 20
MOST_YAML_VALUES = 100_000


@dataclasses.dataclass(frozen=True)
class Range:
    """Values that a field may have, as metadata of its type: `Annotated[float, Range(0, 1)]`.

    On a number it bounds the number, on a pair it demands low <= high within the bounds; None is in every range.

    Attributes:
        low: Smallest value.
        high: Largest value.
        above: Whether `low` itself is excluded.
        under: Whether `high` itself is excluded.
        unit: For messages, in the plural.
    """

    low: float = -math.inf
    high: float = math.inf
    above: bool = False
    under: bool = False
    unit: str = ""

    def __contains__(self, value: float) -> bool:
        is_high_enough = value > self.low if self.above else value >= self.low
        is_low_enough = value < self.high if self.under else value <= self.high
        return math.isfinite(value) and is_high_enough and is_low_enough

    def __str__(self) -> str:
        low, high = f"{'above ' if self.above else ''}{self.low:g}", f"{'under ' if self.under else ''}{self.high:g}"
        if math.isinf(self.high):
            text = low if self.above else f"{low} or more"
        elif math.isinf(self.low):
            text = high if self.under else f"{high} or less"
        else:
            text = f"{low} to {high}"
        return f"{text} {self.unit}".rstrip()


def check_ranges(config: Any) -> None:
    """Hold the fields of a dataclass against their ranges; call this first in its `__post_init__`.

    Raises:
        ConfigError: A value is outside of its range; the message names field, value and range.
    """
    for name, hint in _hints(type(config)).items():
        _check_range(name, getattr(config, name), hint, None)


def _hints(cls: type) -> Mapping[str, Any]:
    hints = typing.get_type_hints(cls, include_extras=True)
    return {field.name: hints[field.name] for field in dataclasses.fields(cls)}


def _check_range(name: str, value: Any, hint: Any, limits: Range | None) -> None:
    """Check a value against the range around its type, and its parts against the ranges within."""
    if value is None:
        return
    origin, arguments = typing.get_origin(hint), typing.get_args(hint)
    if origin is typing.Annotated:
        for limits in (item for item in arguments[1:] if isinstance(item, Range)):
            _check_range(name, value, arguments[0], limits)
    elif origin in (typing.Union, types.UnionType):
        for argument in arguments:
            if argument is not type(None):
                _check_range(name, value, argument, limits)
    elif origin is tuple:
        if limits is not None:
            low, high = value
            if not (low in limits and high in limits and low <= high):
                raise ConfigError(f"{name} is [{low}, {high}], expected low <= high within {limits}")
        for index, part in enumerate(value):
            part_hint = arguments[0] if arguments[-1] is Ellipsis else arguments[index]
            _check_range(f"{name}[{index}]", part, part_hint, None)
    elif limits is not None and value not in limits:
        raise ConfigError(f"{name} is {value}, expected {limits}")


def load_yaml(path: str | Path) -> dict[str, Any]:
    """Read a YAML mapping.

    Raises:
        ConfigError: Missing file, invalid YAML (with its line), not a mapping, or nested or repeated without end.
    """
    file = Path(path)
    try:
        text = read_regular(file, LARGEST_YAML_BYTES).decode("utf-8")
    except OSError as error:
        raise ConfigError(f"{file}: cannot be read ({error.strerror}); give the path of a YAML file") from error
    except UnicodeDecodeError as error:
        raise ConfigError(f"{file}: invalid YAML (not UTF-8 text)") from error
    content = _parse_yaml(text, str(file))
    if content is None:
        return {}
    if not isinstance(content, dict):
        raise ConfigError(f"{file}: found a {type(content).__name__}, expected a mapping of keys")
    return content


def _parse_yaml(text: str, where: str) -> Any:
    try:
        content = yaml.safe_load(text)
    except yaml.MarkedYAMLError as error:
        mark = error.problem_mark
        line = f", line {mark.line + 1}" if mark and "\n" in text else ""
        raise ConfigError(f"{where}{line}: invalid YAML ({error.problem})") from error
    except RecursionError as error:
        raise ConfigError(f"{where}: invalid YAML (brackets are nested too deep)") from error
    except (yaml.YAMLError, ValueError) as error:  # a control character; a date such as 2026-99-99
        raise ConfigError(f"{where}: invalid YAML ({str(error).splitlines()[0]})") from error
    left = [content]
    for count in itertools.count():  # aliases are cheap to parse, and endless to walk
        if not left:
            return content
        if count > MOST_YAML_VALUES:
            raise ConfigError(f"{where}: more than {MOST_YAML_VALUES} values, aliases counted each time")
        value = left.pop()
        left += value.values() if isinstance(value, dict) else value if isinstance(value, list | set) else ()
    raise AssertionError("the count has no end")


def apply_overrides(mapping: Mapping[str, Any], overrides: Sequence[str]) -> dict[str, Any]:
    """Return a copy with `a.b=value` assignments applied; values are read as YAML, groups are laid over what is there.

    Raises:
        ConfigError: An assignment without `=` or through something that is not a group of keys.
    """
    result = _copy(mapping)
    for assignment in overrides:
        key, equals, text = assignment.partition("=")
        if not equals or not key:
            raise ConfigError(f"--set {assignment}: expected key=value, for example --set patch_px=128")
        value = _parse_yaml(text, f"--set {assignment}")
        *groups, leaf = key.split(".")
        target = result
        for group in groups:
            target = target.setdefault(group, {})
            if not isinstance(target, dict):
                raise ConfigError(f"--set {assignment}: {group} is a value, not a group of keys")
        below = target.get(leaf)
        target[leaf] = merge(below, value) if isinstance(below, dict) and isinstance(value, Mapping) else value
    return result


def sources(where: str, overrides: Sequence[str]) -> str:
    """Where a configuration comes from, for messages: a preset or file, then the assignments laid over it."""
    return "".join([where, *(f", --set {assignment}" for assignment in overrides)])


def assigned_keys(overrides: Sequence[str]) -> list[str]:
    """The keys, with dots between groups, that assignments give a value to; those of a group each."""
    return _leaves(apply_overrides({}, overrides), "")


def _leaves(mapping: Mapping[str, Any], prefix: str) -> list[str]:
    keys: list[str] = []
    for key, value in mapping.items():
        keys += _leaves(value, f"{prefix}{key}.") if isinstance(value, Mapping) else [f"{prefix}{key}"]
    return keys


def merge(base: Mapping[str, Any], top: Mapping[str, Any]) -> dict[str, Any]:
    """Return `base` with `top` laid over it, group by group."""
    result = _copy(base)
    for key, value in top.items():
        below = result.get(key)
        result[key] = merge(below, value) if isinstance(below, dict) and isinstance(value, Mapping) else value
    return result


def build(cls: type[T], mapping: Mapping[str, Any], where: str, renamed: Mapping[str, str] | None = None) -> T:
    """Make a frozen dataclass from a mapping; keys that are left out keep their defaults.

    Args:
        cls: The dataclass; its fields may be dataclasses, tuples, optionals, literals and plain values.
        mapping: Values by field name.
        where: File or option, for messages.
        renamed: Keys of earlier versions that are refused with their new name, see `posecore.renamed`; what is stored
            can be read with `migrated_keys` first.

    Raises:
        ConfigError: Unknown, renamed or missing key, value of another type or out of range, or one that the class
            refuses.
    """
    refuse_renamed_keys(mapping, renamed or {}, where)
    return typing.cast(T, _build(cls, mapping, where, ""))


def to_dict(config: Any) -> dict[str, Any]:
    """The plain mapping (lists, numbers, strings) that `build` makes this dataclass of."""
    return typing.cast(dict[str, Any], _plain(config))


def dump_yaml(config: Any) -> str:
    """The resolved configuration as YAML, in field order."""
    return yaml.safe_dump(to_dict(config), sort_keys=False, allow_unicode=True)


def _build(cls: type, mapping: Any, where: str, prefix: str) -> Any:
    if not isinstance(mapping, Mapping):
        raise ConfigError(f"{where}: {prefix.rstrip('.')} is {mapping!r}, expected a group of keys")
    hints = typing.get_type_hints(cls)
    names = [f.name for f in dataclasses.fields(cls)]
    unknown = [key for key in mapping if key not in names]
    if unknown:
        raise ConfigError(f"{where}: unknown key {prefix}{unknown[0]}; known keys here: {', '.join(names)}")
    values = {key: _value(hints[key], value, where, prefix + key) for key, value in mapping.items()}
    for field in dataclasses.fields(cls):
        required = field.default is dataclasses.MISSING and field.default_factory is dataclasses.MISSING
        if required and field.name not in values:
            raise ConfigError(f"{where}: the key {prefix}{field.name} is missing")
    try:
        config = cls(**values)
        check_ranges(config)
        return config
    except ConfigError as error:
        raise ConfigError(f"{where}: {prefix}{error}") from error


def _value(hint: Any, value: Any, where: str, key: str) -> Any:
    origin, arguments = typing.get_origin(hint), typing.get_args(hint)
    if origin in (typing.Union, types.UnionType):
        if value is None and type(None) in arguments:
            return None
        return _value(next(a for a in arguments if a is not type(None)), value, where, key)
    if dataclasses.is_dataclass(hint):
        return _build(typing.cast(type, hint), value, where, key + ".")
    if origin is tuple and isinstance(value, list | tuple):
        inner = [arguments[0]] * len(value) if arguments[-1] is Ellipsis else list(arguments)
        if len(inner) == len(value):
            return tuple(_value(h, v, where, f"{key}[{i}]") for i, (h, v) in enumerate(zip(inner, value, strict=True)))
        raise ConfigError(f"{where}: {key} has {len(value)} entries, expected {len(inner)}")
    if origin is typing.Literal:
        if value in arguments:
            return value
        raise ConfigError(f"{where}: {key} is {value!r}, expected one of {', '.join(map(str, arguments))}")
    if hint is float and isinstance(value, int | float) and not isinstance(value, bool):
        return float(value)
    if hint is float and isinstance(value, str):  # YAML 1.1 reads 3e-4 as a string
        try:
            return float(value)
        except ValueError:
            pass
    if isinstance(hint, type) and isinstance(value, hint) and not (hint is int and isinstance(value, bool)):
        return value
    expected = getattr(hint, "__name__", str(hint))
    raise ConfigError(f"{where}: {key} is {value!r}, expected {expected}")


def _plain(value: Any) -> Any:
    if dataclasses.is_dataclass(value):
        return {f.name: _plain(getattr(value, f.name)) for f in dataclasses.fields(value)}
    if isinstance(value, list | tuple):
        return [_plain(v) for v in value]
    if isinstance(value, Mapping):
        return {k: _plain(v) for k, v in value.items()}
    return value


def _copy(mapping: Mapping[str, Any]) -> dict[str, Any]:
    return {k: _copy(v) if isinstance(v, Mapping) else v for k, v in mapping.items()}
