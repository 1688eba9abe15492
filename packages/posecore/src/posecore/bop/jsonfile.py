"""JSON of a BOP folder: read with the place of every error, written atomically."""

import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float

from posecore.errors import DatasetError
from posecore.files import write_atomic

Array = np.ndarray


def read_json(path: str | Path, kind: type = dict) -> Any:
    """Read a JSON file whose top level is a `kind` (dict or list).

    Raises:
        DatasetError: missing or unreadable file, invalid JSON (with line and column), another top level.
    """
    file = Path(path)
    try:
        content = json.loads(file.read_text(encoding="utf-8"))
    except OSError as error:
        raise DatasetError(f"{file}: cannot be read ({error.strerror}); a BOP folder needs this file") from error
    except UnicodeDecodeError as error:
        raise DatasetError(f"{file}: not UTF-8 text (byte {error.start}), expected JSON") from error
    except json.JSONDecodeError as error:
        raise DatasetError(
            f"{file}:{error.lineno}:{error.colno}: invalid JSON ({error.msg}); the file is cut off or was edited"
        ) from error
    if not isinstance(content, kind):
        raise DatasetError(f"{file}: found a {type(content).__name__} at the top, expected a {kind.__name__}")
    return content


def write_json(path: str | Path, content: Any) -> None:
    """Write JSON atomically, indented by two."""
    write_atomic(path, (json.dumps(content, indent=2) + "\n").encode())


def numbers(entry: Any, key: str, count: int, where: str) -> Float[Array, " n"]:
    """The `count` finite numbers under `entry[key]`.

    Raises:
        DatasetError: the key is missing, or it holds something else; the message starts with `where`.
    """
    if not isinstance(entry, dict) or key not in entry:
        raise DatasetError(f"{where}: has no '{key}', expected {count} numbers")
    try:
        values = np.asarray(entry[key], dtype=np.float64).reshape(-1)
    except (TypeError, ValueError) as error:
        raise DatasetError(f"{where}: '{key}' is {str(entry[key])[:60]}, expected {count} numbers") from error
    if len(values) != count or not np.isfinite(values).all():
        raise DatasetError(f"{where}: '{key}' holds {str(entry[key])[:60]}, expected {count} finite numbers")
    return values


def integer(entry: Any, key: str, where: str) -> int:
    """The integer under `entry[key]`.

    Raises:
        DatasetError: the key is missing, or it holds something else; the message starts with `where`.
    """
    value = entry.get(key) if isinstance(entry, dict) else None
    if isinstance(value, bool) or not isinstance(value, int):
        raise DatasetError(f"{where}: '{key}' is {value!r}, expected an integer")
    return value


def integer_keys(content: dict[str, Any], file: Path) -> dict[int, Any]:
    """The same mapping with its keys as integers.

    Raises:
        DatasetError: a key is not an integer.
    """
    try:
        return {int(key): value for key, value in content.items()}
    except ValueError as error:
        raise DatasetError(f"{file}: a key is not an integer ({error}), expected image or object ids") from error


def as_list(values: Sequence[float] | Float[Array, "..."]) -> list[float]:
    """Plain floats for JSON, row by row."""
    return [float(value) for value in np.asarray(values, dtype=np.float64).reshape(-1)]
