"""Stored JSON and mappings held against a schema: typed, bounded, one line that names file and key.

A schema is a `msgspec.Struct` whose fields have bounds as metadata: `n: Annotated[int, Meta(ge=1)]`. Keys that it does
not list pass, so that a later version can add some. Nothing is converted: what was checked is used as it was read.
"""

import re
import reprlib
from typing import Any

import msgspec

from posecore.errors import PoseError

DEEPEST = 64
"""Brackets within brackets that stored JSON may have."""


def parse_json(data: bytes, where: str, error: type[PoseError], advice: str) -> Any:
    """Read JSON of this project's own files, which is strict: no NaN, limited nesting.

    Args:
        data: The file's bytes.
        where: File, and line where there are several, for errors.
        error: Class of the errors.
        advice: Ends every error: what to do.

    Raises:
        PoseError: Of that class: not JSON, or nested too deep.
    """
    try:
        content = msgspec.json.decode(data)
    except (msgspec.DecodeError, UnicodeDecodeError) as reason:
        raise error(f"{where}: not JSON ({_first_line(reason)}); {advice}") from reason
    except RecursionError:
        content = None
    if content is None or _is_deep(content):
        what = "null" if data.strip() == b"null" else "brackets nested too deep"
        raise error(f"{where}: found {what}, expected JSON of this project; {advice}")
    return content


def check(content: Any, schema: type[msgspec.Struct], where: str, error: type[PoseError], advice: str) -> None:
    """Hold content against a schema.

    Args:
        content: Mapping, as it was read.
        schema: Its keys, their types and bounds.
        where: File, and line where there are several, for errors.
        error: Class of the errors.
        advice: Ends every error: what to do.

    Raises:
        PoseError: Of that class; the message names the first key that is missing or wrong.
    """
    try:
        msgspec.convert(content, schema)
    except (msgspec.ValidationError, RecursionError) as reason:
        raise error(f"{where}: {_in_words(_first_line(reason), content)}; {advice}") from reason


def check_entries(name: str, mapping: dict[str, Any], schema: type[msgspec.Struct]) -> None:
    """Hold the values of a mapping against a schema, from a struct's `__post_init__`: its errors name the entry.

    Raises:
        ValueError: An entry is wrong; msgspec turns it into its own error.
    """
    for key, entry in mapping.items():
        try:
            msgspec.convert(entry, schema)
        except msgspec.ValidationError as reason:
            raise ValueError(f"{name}.{shown(key)}: {_in_words(_first_line(reason), entry)}") from reason


def shown(value: Any) -> str:
    """A value in an error: one line, and short however large it is."""
    short = reprlib.Repr()
    short.maxlist = short.maxdict = 9
    short.maxstring = short.maxother = 60
    try:
        text = short.repr(value)
    except ValueError:  # a whole number with more digits than the interpreter writes
        return f"a {type(value).__name__}"
    return text if len(text) <= 80 else text[:77] + "..."


def _in_words(text: str, content: Any) -> str:
    """An error of msgspec, such as "Expected `int` >= 1 - at `$.n`", with the value that was found."""
    reason, _, path = text.replace("`$", "`").rpartition(" - at `")
    if not reason:  # of the content itself
        reason, path = text, ""
    reason, key = reason.replace("`", ""), path.rstrip("`").lstrip(".")
    if (missing := re.fullmatch(r"Object missing required field (.+)", reason)) is not None:
        return f"the key {'.'.join(filter(None, (key, missing[1])))} is missing"
    if not reason.startswith("Expected "):
        return f"{key}: {reason}" if key else reason
    expected = re.sub(r", got \w+$", "", reason.removeprefix("Expected "))
    return f"{key or 'the content'} is {_value_at(content, key)}, expected {expected}"


def _value_at(content: Any, key: str) -> str:
    value = content
    for name, index in re.findall(r"([^.\[\]]+)|\[(\d+)\]", key):
        try:
            value = value[int(index)] if index else value[name]
        except (LookupError, TypeError):
            return "of another kind"
    return shown(value)


def _is_deep(content: Any) -> bool:
    level = [content]
    for _ in range(DEEPEST):
        level = [
            part
            for value in level
            if isinstance(value, dict | list)
            for part in (value.values() if isinstance(value, dict) else value)
        ]
        if not level:
            return False
    return True


def _first_line(error: BaseException) -> str:
    return (str(error).splitlines() or [type(error).__name__])[0][:300]
