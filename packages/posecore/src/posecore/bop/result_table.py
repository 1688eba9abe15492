"""Result files as columns: a million lines in seconds; each fault with its line and field."""

import math
import warnings
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, fields

import numpy as np
from jaxtyping import Bool, Float, Int

from posecore import se3
from posecore.bop.jsonfile import LARGEST_INTEGER, id_of
from posecore.bop.models_info import MM, ROTATION_TOLERANCE
from posecore.errors import ResultFileError

COLUMNS = ("scene_id", "im_id", "obj_id", "score", "R", "t", "time")
HEADER = ",".join(COLUMNS)
COUNTS = {"R": 9, "t": 3}
"""Numbers in a field of these columns; 1 in the others."""
LARGEST_T_MM = 1e9
CHUNK_BYTES = 1 << 23
_IDS = COLUMNS[:3]
_BYTE_ORDER_MARK = b"\xef\xbb\xbf"
_PLAIN = b"0123456789+-.eE, \n"
"""Characters of plain decimal numbers. Lines with any other are parsed one by one."""


@dataclass(frozen=True, kw_only=True)
class LineFault:
    """A fault in a line of a result file.

    Attributes:
        line: from 1; 0 where it is the file as a whole.
        field: column, or "line".
        kind: short name of the rule that is broken.
        message: found and expected value, without the location.
    """

    line: int
    field: str
    kind: str
    message: str


@dataclass(frozen=True, kw_only=True, eq=False)
class ResultTable:
    """The estimates of a result file, a column each, in the file's order.

    Attributes:
        scene_id: scenes.
        im_id: images.
        obj_id: objects.
        score: confidence, any scale; the higher the better.
        T_cam_obj: poses, metres.
        time_s: run time of the whole image in seconds, negative where unknown.
        line: line in the file, from 1; 0 where it comes from elsewhere.
    """

    scene_id: Int[np.ndarray, " n"]
    im_id: Int[np.ndarray, " n"]
    obj_id: Int[np.ndarray, " n"]
    score: Float[np.ndarray, " n"]
    T_cam_obj: Float[np.ndarray, "n 4 4"]
    time_s: Float[np.ndarray, " n"]
    line: Int[np.ndarray, " n"]

    def __len__(self) -> int:
        return len(self.scene_id)

    def take(self, index: Int[np.ndarray, " m"] | Bool[np.ndarray, " n"]) -> "ResultTable":
        """The estimates at these positions, or where a mask is true."""
        return ResultTable(**{field.name: getattr(self, field.name)[index] for field in fields(self)})

    @staticmethod
    def concat(tables: Sequence["ResultTable"]) -> "ResultTable":
        """One table after the other; no tables give an empty one."""
        parts = [*tables] or [_table(np.zeros((0, 3), np.int64), np.zeros((0, 14)), np.zeros(0, np.int64))]
        names = [field.name for field in fields(ResultTable)]
        return ResultTable(**{name: np.concatenate([getattr(part, name) for part in parts]) for name in names})


def parse_results(data: bytes, name: str, on_fault: Callable[[LineFault], None] | None = None) -> ResultTable:
    """Read the bytes of a result file.

    Blank lines, a byte order mark, CRLF, spaces around fields, no header, and a header that names the columns in
    another order are harmless.

    Args:
        data: the file; translations in millimetres.
        name: of the file, for errors.
        on_fault: called with every fault, in the file's order; faulty lines are left out. By default the first raises.

    Raises:
        ResultFileError: the file is empty or not UTF-8, its header is unknown; or, without `on_fault`, a line breaks
            the format. The message names file and line.
    """

    def refuse(fault: LineFault) -> None:
        raise ResultFileError(f"{name}:{fault.line}: {fault.message}")

    report = on_fault or refuse
    body = data.removeprefix(_BYTE_ORDER_MARK)
    skipped, body = len(data) - len(body), body.rstrip()
    if not body:
        raise ResultFileError(f"{name}: no estimates in it, expected lines of {HEADER}")
    named, start, line = _header(body, name, skipped)
    order = named or COLUMNS
    parts, filled = [], 0
    for chunk, offset in _chunks(body, start):
        plain = _plain_numbers(chunk, order)
        if plain is not None:
            ids, numbers = plain
            lines = np.arange(line, line + len(ids))
            faults: list[LineFault] = []
        else:
            ids, numbers, lines, faults = _line_by_line(_text(chunk, name, skipped + offset), order, line)
        good, wrong = _valid(numbers, lines)
        for fault in sorted([*faults, *wrong], key=lambda fault: fault.line):
            report(fault)
        parts.append(_table(ids[good], numbers[good], lines[good]))
        filled += len(ids) + len(faults)
        line += chunk.count(b"\n")
    if not filled and named is None:
        raise ResultFileError(f"{name}: no estimates in it, expected lines of {HEADER}")
    return ResultTable.concat(parts)


def _table(
    ids: Int[np.ndarray, "n 3"], numbers: Float[np.ndarray, "n 14"], lines: Int[np.ndarray, " n"]
) -> ResultTable:
    return ResultTable(
        scene_id=np.ascontiguousarray(ids[:, 0]),
        im_id=np.ascontiguousarray(ids[:, 1]),
        obj_id=np.ascontiguousarray(ids[:, 2]),
        score=np.ascontiguousarray(numbers[:, 0]),
        T_cam_obj=se3.make_T(numbers[:, 1:10].reshape(-1, 3, 3), numbers[:, 10:13] * MM),
        time_s=np.ascontiguousarray(numbers[:, 13]),
        line=lines.astype(np.int64),
    )


def _text(data: bytes, name: str, offset: int) -> str:
    try:
        return data.decode("utf-8")
    except UnicodeDecodeError as error:
        at = offset + error.start
        raise ResultFileError(f"{name}: not UTF-8 text (byte {at}); give a BOP result file (CSV)") from error


def _header(body: bytes, name: str, offset: int) -> tuple[tuple[str, ...] | None, int, int]:
    """Order of the columns if it is named, and offset and line number of the first estimate."""
    start, line = 0, 1
    while True:  # up to the first line that is not blank; there is one
        end = body.find(b"\n", start)
        first = body[start:] if end < 0 else body[start:end]
        if first.strip():
            break
        start, line = end + 1, line + 1
    names = [field.strip() for field in _text(first, name, offset + start).split(",")]
    if not set(names) & set(COLUMNS):
        return None, start, line
    if sorted(names) != sorted(COLUMNS):
        missing = ", ".join(sorted(set(COLUMNS) - set(names))) or "none"
        extra = ", ".join(_short(extra) or "a blank one" for extra in names if extra not in COLUMNS) or "none"
        twice = ", ".join(sorted({column for column in names if names.count(column) > 1})) or "none"
        raise ResultFileError(
            f"{name}:{line}: the header is not {HEADER}: missing {missing}, unknown {extra}, twice {twice}"
        )
    return tuple(names), len(body) if end < 0 else end + 1, line + 1


def _chunks(body: bytes, start: int) -> Iterator[tuple[bytes, int]]:
    """Whole lines of at most CHUNK_BYTES together (or a longer one), each ended by a newline, with their offset."""
    while start < len(body):
        end = body.rfind(b"\n", start, start + CHUNK_BYTES) + 1 if start + CHUNK_BYTES < len(body) else len(body)
        if end == 0:  # one line is longer than a chunk
            end = body.find(b"\n", start) + 1 or len(body)
        chunk = body[start:end]
        yield (chunk if chunk.endswith(b"\n") else chunk + b"\n"), start
        start = end


def _plain_numbers(
    chunk: bytes, order: tuple[str, ...]
) -> tuple[Int[np.ndarray, "n 3"], Float[np.ndarray, "n 14"]] | None:
    """Ids and numbers of well-formed lines, parsed at once; None if any line may be malformed."""
    plain = chunk.replace(b"\r\n", b"\n")
    if plain.translate(None, _PLAIN):
        return None
    buffer = np.frombuffer(plain, np.uint8)
    newlines, commas = np.flatnonzero(buffer == ord("\n")), np.flatnonzero(buffer == ord(","))
    between = np.concatenate([[True], (buffer == ord("\n")) | (buffer == ord(",")) | (buffer == ord(" "))])
    starts = np.flatnonzero(between[:-1] & ~between[1:])  # of every number
    n, per_line = len(newlines), 17
    if len(commas) != 6 * n or len(starts) != per_line * n:
        return None
    commas, starts = commas.reshape(n, 6), starts.reshape(n, per_line)
    ends = np.cumsum([COUNTS.get(column, 1) for column in order])
    inside = (starts[:, ends[:-1] - 1] < commas).all() and (starts[:, ends[:-1]] > commas).all()
    if not inside or not (starts[:, -1] < newlines).all() or not (starts[1:, 0] > newlines[:-1]).all():
        return None
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", DeprecationWarning)  # it stops at the first thing that is not a number
        try:
            values = np.fromstring(plain.replace(b",", b" "), np.float64, sep=" ")
        except ValueError:
            return None
    if len(values) != per_line * n:  # every start gives a number or ends the reading, and '1-2' gives two
        return None
    values = values.reshape(n, per_line)
    where = {column: slice(end - COUNTS.get(column, 1), end) for column, end in zip(order, ends, strict=True)}
    ids = np.concatenate([values[:, where[column]] for column in _IDS], axis=1)
    signs = np.add.reduceat(buffer < ord("0"), starts.reshape(-1), dtype=np.int64)  # + - . and what separates
    signs += np.add.reduceat(buffer > ord("9"), starts.reshape(-1), dtype=np.int64)
    signs -= np.add.reduceat(between[1:], starts.reshape(-1), dtype=np.int64)
    of_ids = np.concatenate([signs.reshape(n, per_line)[:, where[column]] for column in _IDS], axis=1)
    if of_ids.any() or (ids >= 2.0**53).any():
        return None
    return ids.astype(np.int64), np.concatenate([values[:, where[column]] for column in COLUMNS[3:]], axis=1)


def _line_by_line(
    text: str, order: tuple[str, ...], first_line: int
) -> tuple[Int[np.ndarray, "n 3"], Float[np.ndarray, "n 14"], Int[np.ndarray, " n"], list[LineFault]]:
    ids: list[list[int]] = []
    numbers: list[list[float]] = []
    lines: list[int] = []
    faults: list[LineFault] = []
    for number, raw in enumerate(text.split("\n"), start=first_line):
        line = raw.strip()
        if not line:
            continue
        wrong = len(faults)
        parts = line.split(",")
        if len(parts) != len(COLUMNS):
            message = f"found {len(parts)} fields, expected the 7 of {HEADER}"
            faults.append(LineFault(line=number, field="line", kind="fields", message=message))
            continue
        by_name = dict(zip(order, parts, strict=True))
        values: dict[str, list[float]] = {}
        id_values: list[int] = []
        for column in COLUMNS:
            try:
                if column in _IDS:
                    id_values.append(_id(by_name[column], column))
                else:
                    values[column] = _floats(by_name[column], COUNTS.get(column, 1), column)
            except ResultFileError as error:
                faults.append(LineFault(line=number, field=column, kind="format", message=str(error)))
        if len(faults) == wrong:
            ids.append(id_values)
            numbers.append([value for column in COLUMNS[3:] for value in values[column]])
            lines.append(number)
    n = len(lines)
    return (
        np.array(ids, np.int64).reshape(n, 3),
        np.array(numbers, np.float64).reshape(n, 14),
        np.array(lines, np.int64),
        faults,
    )


def _id(text: str, column: str) -> int:
    number = id_of(text.strip())
    if number is None:
        raise ResultFileError(f"{column} is '{_short(text)}', expected a whole number from 0 to {LARGEST_INTEGER}")
    return number


def _floats(text: str, count: int, column: str) -> list[float]:
    parts = text.split()
    if not text.isascii() or "_" in text:  # Python reads 1_000 and Arabic digits as numbers
        raise ResultFileError(f"{column} is '{_short(text)}', expected {count} number(s)")
    try:
        values = [float(part) for part in parts]
    except ValueError as error:
        raise ResultFileError(f"{column} is '{_short(text)}', expected {count} number(s)") from error
    if len(values) != count:
        raise ResultFileError(f"{column} has {len(values)} numbers, expected {count} separated by spaces")
    return values


def _valid(
    numbers: Float[np.ndarray, "n 14"], lines: Int[np.ndarray, " n"]
) -> tuple[Bool[np.ndarray, " n"], list[LineFault]]:
    """Mask of the lines with finite numbers, a rotation and a plausible translation, and the others' faults."""
    finite = np.isfinite(numbers)
    good = finite.all(axis=1)
    faults = []
    for column, where in (("score", slice(0, 1)), ("R", slice(1, 10)), ("t", slice(10, 13)), ("time", slice(13, 14))):
        message = f"{column} holds NaN or infinity; leave the line out where there is no estimate"
        for index in np.flatnonzero(~finite[:, where].all(axis=1)):
            faults.append(LineFault(line=int(lines[index]), field=column, kind="not finite", message=message))
    far = good & (np.abs(numbers[:, 10:13]) > LARGEST_T_MM).any(axis=1)
    for index in np.flatnonzero(far):
        largest = float(np.abs(numbers[index, 10:13]).max())
        message = f"t holds {largest:.4g} mm, expected less than {LARGEST_T_MM:g}; leave the line out if it diverged"
        faults.append(LineFault(line=int(lines[index]), field="t", kind="too far", message=message))
    R = np.where(good[:, None], numbers[:, 1:10], np.eye(3).reshape(-1)).reshape(-1, 3, 3)
    huge = (np.abs(R) > 1e6).any(axis=(1, 2))  # their products may overflow
    improper = huge | ~se3.is_rotation(np.where(huge[:, None, None], np.eye(3), R), ROTATION_TOLERANCE)
    for index in np.flatnonzero(improper):
        message = f"R is {_improper(R[index])}, expected a rotation, 9 numbers by rows"
        faults.append(LineFault(line=int(lines[index]), field="R", kind="rotation", message=message))
    return good & ~far & ~improper, faults


def _improper(R: Float[np.ndarray, "3 3"]) -> str:
    with np.errstate(over="ignore", invalid="ignore"):
        determinant = float(np.linalg.det(R))
        scale = math.copysign(abs(determinant) ** (1 / 3), determinant) if math.isfinite(determinant) else math.nan
        if scale < 0:
            return "mirrored (determinant below 0)"
        if scale > 0 and bool(se3.is_rotation(R / scale, ROTATION_TOLERANCE)):
            return f"scaled by {scale:.4g}"
        return f"not orthonormal (determinant {determinant:.4g})"


def _short(text: str) -> str:
    return " ".join(text.split())[:40]
