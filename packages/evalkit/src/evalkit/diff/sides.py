"""The two files of a comparison: BOP result files, or error tables (`estimates.csv`) of `evalkit report`."""

import csv
import io
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

import pandas as pd
from posecore.bop import BopDataset
from posecore.errors import ConfigError, ResultFileError
from posecore.files import open_regular, read_regular, sha256_file

from evalkit.error_table import COLUMNS, RENAMED_COLUMNS
from evalkit.evaluation.evaluator import Evaluator, VssKind
from evalkit.evaluation.scored_file import Scored, score_file
from evalkit.inputs.result_files import dataset_of, load_result_files
from evalkit.tables.csv_cells import unescaped

NAMES_COLUMN = "results"
"""Column of an error table with the result file's name."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Side:
    """One file of a comparison.

    Attributes:
        name: for tables.
        path: of the file.
        sha256: of its bytes.
        table: its errors, see `evalkit.error_table`.
        scored: the same with its poses; None for an error table.
    """

    name: str
    path: Path
    sha256: str
    table: pd.DataFrame
    scored: Scored | None = None


@dataclass(frozen=True, kw_only=True, eq=False)
class Sides:
    """Reference `a`, compared file `b`, and the evaluator unless both are error tables."""

    a: Side
    b: Side
    evaluator: Evaluator | None


@contextmanager
def open_sides(
    paths: tuple[Path, Path],
    *,
    results: tuple[str | None, str | None] = (None, None),
    dataset: Path | None = None,
    split: str | None = None,
    vss: VssKind = "full",
    workers: int = 1,
) -> Iterator[Sides]:
    """Read two files, and evaluate those that are result files.

    Args:
        paths: each a BOP result file or an `estimates.csv` of a report.
        results: names of the result files within error tables that hold several.
        dataset: folder; by default the one that the result files' sidecars name. Error tables need none.
        split: of the dataset.
        vss: whole silhouettes or visible parts.
        workers: number of processes that score poses.

    Raises:
        PoseError: a file or the dataset is not usable; the message names it.
    """
    tables = [
        read_errors(path, name) if is_error_table(path) else None for path, name in zip(paths, results, strict=True)
    ]
    to_score = list(dict.fromkeys(path for path, side in zip(paths, tables, strict=True) if side is None))
    if not to_score:
        a, b = _renamed([side for side in tables if side is not None])
        yield Sides(a=a, b=b, evaluator=None)
        return
    for path, name, side in zip(paths, results, tables, strict=True):
        if side is None and name is not None:
            raise ConfigError(f"{path}: is a result file, which has no '{name}'; leave --result-a and --result-b out")
    opened = BopDataset(dataset or dataset_of(to_score, Path()), split)
    with Evaluator(opened, vss, workers=workers) as evaluator:
        scored = {file.path: score_file(evaluator, file) for file in load_result_files(to_score, opened)}
        both = [side or _side_of(scored[path]) for path, side in zip(paths, tables, strict=True)]
        a, b = _renamed(both)
        yield Sides(a=a, b=b, evaluator=evaluator)


def _side_of(scored: Scored) -> Side:
    file = scored.file
    return Side(name=file.name, path=file.path, sha256=file.sha256, table=scored.table, scored=scored)


def _renamed(sides: Sequence[Side]) -> tuple[Side, Side]:
    """Both sides under different names."""
    a, b = sides
    if a.name != b.name:
        return a, b
    return _named(a, f"{a.name} (A)"), _named(b, f"{b.name} (B)")


def _named(side: Side, name: str) -> Side:
    return Side(name=name, path=side.path, sha256=side.sha256, table=side.table, scored=side.scored)


def is_error_table(path: Path) -> bool:
    """Whether a file is an `estimates.csv` of a report, by its first line.

    Raises:
        ResultFileError: the file cannot be read.
    """
    try:
        with open_regular(path) as stream:
            head = stream.readline(10_000).decode("utf-8-sig", "replace")
    except OSError as error:
        raise ResultFileError(
            f"{path}: cannot be read ({error.strerror}); give a BOP result file or a report's estimates.csv"
        ) from error
    return {"scene_id", "gt_index"} <= {name.strip() for name in head.split(",")}


def read_errors(path: Path, name: str | None = None) -> Side:
    """Read the rows of a result file from an error table.

    Args:
        path: an `estimates.csv` of a report.
        name: of the result file in the table's column `results`; not needed for a single one.

    Raises:
        ResultFileError: columns are missing, or a value is not a number.
        ConfigError: the table holds several result files and `name` is None or none of their names.
    """
    rows = _rows(path)
    named = rows[NAMES_COLUMN].map(unescaped) if NAMES_COLUMN in rows else pd.Series(path.stem, index=rows.index)
    names = list(dict.fromkeys(named))
    if name is None and len(names) > 1:
        raise ConfigError(f"{path}: holds {', '.join(names)}; name one with --result-a and --result-b")
    if name is not None and name not in names:
        raise ConfigError(f"{path}: has no result file '{name}'; it holds {', '.join(names)}")
    chosen = name or (names[0] if names else path.stem)
    return Side(
        name=chosen,
        path=path,
        sha256=sha256_file(path),
        table=_typed(rows[named == chosen].drop(columns=NAMES_COLUMN, errors="ignore"), path),
    )


def _rows(path: Path) -> pd.DataFrame:
    try:
        text = read_regular(path).decode("utf-8-sig")
        lines = list(csv.reader(io.StringIO(text, newline="")))
    except (OSError, UnicodeDecodeError, csv.Error) as error:
        raise ResultFileError(f"{path}: cannot be read as CSV ({error})") from error
    head = [RENAMED_COLUMNS.get(name, name) for name in map(str.strip, lines[0])]
    body = {number: line for number, line in enumerate(lines[1:], start=2) if any(part.strip() for part in line)}
    for number, line in body.items():
        if len(line) != len(head):
            raise ResultFileError(f"{path}:{number}: found {len(line)} fields, expected {len(head)} as in the header")
    missing = [name for name in COLUMNS if name not in head]
    if missing:
        raise ResultFileError(
            f"{path}:1: no column {', '.join(missing)}; write the table again with this version's evalkit report"
        )
    return pd.DataFrame(list(body.values()), columns=head, index=list(body))


def _typed(rows: pd.DataFrame, path: Path) -> pd.DataFrame:
    """The table with numbers; the index of `rows` holds line numbers."""
    table = pd.DataFrame(index=rows.index)
    for name in rows.columns:
        text = rows[name].str.strip()
        numbers = pd.to_numeric(text, errors="coerce")
        dtype = COLUMNS[name].dtype if name in COLUMNS else "float64"
        wrong = numbers.isna() & ((text != "") | (dtype != "float64"))
        if dtype != "float64":
            wrong |= numbers.fillna(0) % 1 != 0
        if dtype == "bool":
            wrong |= ~numbers.isin([0, 1])
        wrong &= text.str.lower() != "nan"
        if wrong.any() and name not in COLUMNS:
            continue  # a column of words
        if wrong.any():
            line = int(wrong.idxmax())
            expected = {"float64": "a number", "int64": "a whole number", "bool": "0 or 1"}[dtype]
            raise ResultFileError(f"{path}:{line}: {name} is '{text[line][:40]}', expected {expected}")
        table[name] = numbers.astype(dtype)
    return table.reset_index(drop=True)
