"""JSON of a BOP folder: errors with their location, atomic writes."""

import json
import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float

from posecore.errors import DatasetError
from posecore.files import read_regular, write_atomic
from posecore.schema import shown

LARGEST_INTEGER = 2**63 - 1
_MOST_DIGITS = 40


def read_json(path: str | Path, kind: type = dict) -> Any:
    """Read a JSON file whose top level is a `kind` (dict or list).

    Raises:
        DatasetError: missing or unreadable file, invalid JSON (with line and column), another top level.
    """
    file = Path(path)
    try:
        data = read_regular(file)
    except OSError as error:
        raise DatasetError(f"{file}: cannot be read ({error.strerror}); a BOP folder needs this file") from error
    return parse_bop_json(data, str(file), kind)


def parse_bop_json(data: bytes, name: str, kind: type = dict) -> Any:
    """Read JSON whose top level is a `kind` (dict or list).

    Args:
        data: the file's bytes.
        name: of the file, for errors.
        kind: of the top level.

    Raises:
        DatasetError: not UTF-8, invalid JSON (with line and column), a key that occurs twice in an object, nested too
            deep, a number with thousands of digits, another top level.
    """

    def unique(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
        content = dict(pairs)
        if len(content) < len(pairs):  # the parser would keep the last one in silence
            keys = [key for key, _ in pairs]
            twice = next(key for key in keys if keys.count(key) > 1)
            raise DatasetError(f"{name}: the key {shown(twice)} occurs twice in an object; remove one")
        return content

    try:
        content = json.loads(data.decode("utf-8-sig"), object_pairs_hook=unique)
    except UnicodeDecodeError as error:
        raise DatasetError(f"{name}: not UTF-8 text (byte {error.start}), expected JSON") from error
    except json.JSONDecodeError as error:
        raise DatasetError(
            f"{name}:{error.lineno}:{error.colno}: invalid JSON ({error.msg}); the file is cut off or was edited"
        ) from error
    except RecursionError as error:
        raise DatasetError(f"{name}: brackets are nested too deep, expected the JSON of a BOP dataset") from error
    except DatasetError:
        raise
    except ValueError as error:  # the interpreter's limit on the digits of a whole number
        raise DatasetError(f"{name}: a number has thousands of digits, expected the JSON of a BOP dataset") from error
    if not isinstance(content, kind):
        raise DatasetError(f"{name}: found a {type(content).__name__} at the top, expected a {kind.__name__}")
    return content


def write_json(path: str | Path, content: Any) -> None:
    """Write JSON atomically, indented by two."""
    write_atomic(path, (json.dumps(content, indent=2) + "\n").encode())


def numbers(entry: Any, key: str, count: int, where: str) -> Float[np.ndarray, " n"]:
    """The `count` finite numbers under `entry[key]`: one number, a list, or a list of rows.

    Raises:
        DatasetError: the key is missing, or it holds something else; the message starts with `where`.
    """
    if not isinstance(entry, dict) or key not in entry:
        raise DatasetError(f"{where}: has no '{key}', expected {count} numbers")
    content = entry[key]
    rows = content if isinstance(content, list) else [content]
    values = [value for row in rows for value in (row if isinstance(row, list) else [row])]
    if not all(isinstance(value, int | float) and not isinstance(value, bool) for value in values):
        raise DatasetError(f"{where}: '{key}' is {shown(content)}, expected {count} numbers")
    if len(values) != count:
        raise DatasetError(
            f"{where}: '{key}' has {len(values)} numbers, {shown(content)}, expected {count} finite numbers"
        )
    try:
        array = np.array([float(value) for value in values], np.float64)
    except OverflowError as error:
        raise DatasetError(f"{where}: '{key}' holds {shown(content)}, expected {count} finite numbers") from error
    if not np.isfinite(array).all():
        raise DatasetError(f"{where}: '{key}' holds {shown(content)}, expected {count} finite numbers")
    return array


def integer(entry: Any, key: str, where: str) -> int:
    """The whole number from 0 under `entry[key]`.

    Raises:
        DatasetError: the key is missing, or it holds something else; the message starts with `where`.
    """
    value = entry.get(key) if isinstance(entry, dict) else None
    if isinstance(value, bool) or not isinstance(value, int) or not 0 <= value <= LARGEST_INTEGER:
        raise DatasetError(f"{where}: '{key}' is {shown(value)}, expected an integer, 0 or more")
    return value


def fraction(entry: Any, key: str, where: str) -> float:
    """The number from 0 to 1 under `entry[key]`; rounding may have moved it out by 1e-6.

    Raises:
        DatasetError: the key is missing, or it holds something else; the message starts with `where`.
    """
    value = float(numbers(entry, key, 1, where)[0])
    if not -1e-6 <= value <= 1 + 1e-6 or not math.isfinite(value):
        raise DatasetError(f"{where}: '{key}' is {value:g}, expected 0 to 1")
    return min(max(value, 0.0), 1.0)


def id_of(text: str) -> int | None:
    """The id (scene, image or object) that digits mean, such as a ROS stamp's 19; None if they are none of 64 bits."""
    if not (text.isascii() and text.isdigit()) or len(text) > _MOST_DIGITS or int(text) > LARGEST_INTEGER:
        return None
    return int(text)


def integer_keys(content: dict[str, Any], file: str | Path) -> dict[int, Any]:
    """The same mapping with its keys as integers.

    Raises:
        DatasetError: a key is not a whole number from 0, or two keys are equal (`7` and `007`).
    """
    by_id: dict[int, Any] = {}
    for key, value in content.items():
        number = id_of(key)
        if number is None:
            raise DatasetError(f"{file}: a key is not an integer ({shown(key)}), expected image or object ids")
        if number in by_id:
            raise DatasetError(f"{file}: two keys mean {number}, such as {shown(key)}; remove one")
        by_id[number] = value
    return by_id


def as_list(values: Sequence[float] | Float[np.ndarray, "..."]) -> list[float]:
    """Plain floats for JSON, row by row."""
    return [float(value) for value in np.asarray(values, dtype=np.float64).reshape(-1)]
