"""Strict check of ASCII PLY files against their header: a lenient reader would skip, shift or round values."""

from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path

from posecore.errors import MeshError

_NO_NUMBERS = (b"nan", b"inf", b"infinity")  # refused with the vertex they are in
_NUMBER_CHARACTERS = b"0123456789+-.eE \t\r\n"
_MOST_DIGITS = 18  # of a count


@dataclass(kw_only=True)
class _Element:
    name: str
    count: int
    is_list: list[bool] = field(default_factory=list)


def refuse_broken_ply(file: Path, data: bytes) -> None:
    """Refuse an ASCII PLY whose rows contradict its header.

    Readers take a file that is cut off for one with fewer faces, `3O.5` for 3 and `10-20` for two numbers. Binary files
    are left alone: their length gives them away.

    Args:
        file: for the error.
        data: its bytes.

    Raises:
        MeshError: rows are missing, or one holds something that is not a number, too few or too many; names the line.
    """
    head, end, body = data.partition(b"end_header")
    lines = head.decode("ascii", "replace").splitlines()
    if not end or not any(line.split()[:2] == ["format", "ascii"] for line in lines):
        return
    rows = body.partition(b"\n")[2].splitlines()
    first_line = len(lines) + 2
    row = 0
    for element in _elements(lines):
        n_rows = sum(bool(text.strip()) for text in rows[row:])
        if n_rows < element.count:
            raise MeshError(
                f"{file}: has {n_rows} rows of '{element.name}', its header gives {element.count}; the file is cut off"
            )
        for text in rows[row : row + element.count]:
            reason = _wrong_row(text, element)
            if reason:
                raise MeshError(f"{file}:{first_line + row}: the {element.name} {reason}; export the mesh again")
            row += 1


def _elements(lines: list[str]) -> Iterator[_Element]:
    element: _Element | None = None
    for line in lines:
        words = line.split()
        if len(words) == 3 and words[0] == "element" and _is_count(words[2]):
            if element is not None:
                yield element
            element = _Element(name=words[1], count=int(words[2]))
        elif len(words) >= 3 and words[0] == "property" and element is not None:
            element.is_list.append(words[1] == "list")
    if element is not None:
        yield element


def _wrong_row(text: bytes, element: _Element) -> str:
    """Fault of a row, or an empty string."""
    words = text.split()
    if text.translate(None, _NUMBER_CHARACTERS) and any(
        word.translate(None, _NUMBER_CHARACTERS) and word.lower().strip(b"+-") not in _NO_NUMBERS for word in words
    ):
        return f"is '{text[:60].decode('ascii', 'replace').strip()}', expected numbers"
    if not all(map(_is_number, words)):
        return f"is '{text[:60].decode('ascii', 'replace').strip()}', expected numbers"
    position = 0
    for is_list in element.is_list:
        if not is_list:
            position += 1
            continue
        if position >= len(words) or not _is_count(words[position]):
            return "has no count of its list"
        size = int(words[position])
        inside = words[position + 1 : position + 1 + size]
        if element.name == "face" and position == 0 and not all(word.isdigit() for word in inside):
            return "names a vertex by something that is not a whole number"
        position += 1 + size
    return "" if position == len(words) else f"has {len(words)} numbers, its header gives {position}"


def _is_count(word: str | bytes) -> bool:
    return word.isdigit() and len(word) <= _MOST_DIGITS


def _is_number(word: bytes) -> bool:
    try:
        float(word)
    except ValueError:
        return False
    return True
