"""Result files with their sidecars, names and dataset."""

import logging
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from posecore.bop import BopDataset, Estimate, read_results, read_sidecar, sidecar_path
from posecore.bop.perturbation import INITIAL_METHOD
from posecore.errors import ConfigError, ResultFileError
from posecore.files import sha256_file

log = logging.getLogger(__name__)

UNREFINED = "no refinement"
"""Name of the initial poses in tables, as in the 2018 paper's."""


@dataclass(frozen=True, kw_only=True)
class ResultFile:
    """A result file that has been read.

    Attributes:
        name: for tables and plots, unique in a report.
        path: of the CSV file.
        sha256: of its bytes.
        sidecar: content of `<path>.json`, empty without one.
        estimates: its lines.
    """

    name: str
    path: Path
    sha256: str
    sidecar: dict[str, Any]
    estimates: list[Estimate]

    @property
    def is_initial(self) -> bool:
        """Whether the file holds the initial poses of the other files."""
        return self.sidecar.get("method") == INITIAL_METHOD


def find_result_files(folder: Path, is_dataset_given: bool = False) -> list[Path]:
    """Result files with a sidecar that names a dataset, in a folder and in its `results/`; the others are logged.

    Args:
        folder: to search.
        is_dataset_given: whether the dataset is given; then sidecars need not name one.

    Raises:
        ConfigError: there are none.
        ResultFileError: a sidecar is damaged.
    """
    paths = [path for base in (folder, folder / "results") for path in sorted(base.glob("*.csv"))]
    with_sidecar = []
    for path in paths:
        if sidecar_path(path).is_file():
            if is_dataset_given or (read_sidecar(path) or {}).get("dataset"):
                with_sidecar.append(path)
            else:
                log.warning("%s: left out, its sidecar names no dataset", path)
    if not with_sidecar:
        raise ConfigError(
            f"{folder.resolve()}: no result file (*.csv with *.csv.json beside it that names a dataset) here or in "
            f"results/; {_command_for_results(folder)}, or name files with --results FILE.csv --dataset DIR"
        )
    return with_sidecar


def _command_for_results(folder: Path) -> str:
    """The commands that make result files, from what a folder holds."""
    if (folder / "shards").is_dir():
        return "make some with `refinenet train shards/` or `refinenet refine`"
    return "make some with `synthgen render --object MESH --n N` and then `refinenet train shards/`"


def dataset_of(paths: Sequence[Path], folder: Path) -> Path:
    """The dataset folder that the files' sidecars name; relative paths are tried from `folder`, then from the file.

    Raises:
        ConfigError: no sidecar names one, they name several, or it does not exist.
    """
    named: dict[Path, Path] = {}
    for path in paths:
        if not path.exists():
            raise ConfigError(f"{path}: no such file; give a BOP result file")
        value = (read_sidecar(path) or {}).get("dataset")
        if not isinstance(value, str) or not value:
            continue
        choices = [base / value for base in (folder, path.parent, path.parent.parent)]
        existing = [choice for choice in choices if choice.is_dir()]
        if not existing:
            raise ConfigError(f"{sidecar_path(path)}: its dataset {value} is not a folder; name it with --dataset DIR")
        named.setdefault(existing[0].resolve(), path)
    if not named:
        raise ConfigError(f"{paths[0]}: no sidecar names the dataset; name it with --dataset DIR")
    if len(named) > 1:
        both = ", ".join(f"{path} ({dataset})" for dataset, path in named.items())
        raise ConfigError(f"the result files are of several datasets: {both}; report one with --dataset and --results")
    return next(iter(named))


def open_dataset(
    results: Sequence[Path], dataset: Path | None = None, split: str | None = None, folder: Path = Path()
) -> tuple[BopDataset, list[Path]]:
    """The dataset and the result files of a command.

    Args:
        results: result files; without any, those of `find_result_files`.
        dataset: its folder; by default the one that the sidecars name.
        split: of the dataset.
        folder: searched for result files and relative dataset folders.

    Raises:
        PoseError: there is no result file or no dataset; the message names the missing one.
    """
    paths = list(results) or find_result_files(folder, dataset is not None)
    return BopDataset(dataset or dataset_of(paths, folder), split), paths


def load_result_files(paths: Sequence[Path], dataset: BopDataset) -> list[ResultFile]:
    """Read and check result files: initial poses first, the others in order.

    Raises:
        ResultFileError: a file breaks the format or is named twice.
    """
    resolved = [path.resolve() for path in paths]
    for index, path in enumerate(resolved):
        if path in resolved[:index]:
            raise ResultFileError(f"{paths[index]}: is named twice; name each result file once")
    files = [
        ResultFile(
            name=name,
            path=path,
            estimates=read_results(path, dataset),
            sha256=sha256_file(path),
            sidecar=read_sidecar(path) or {},
        )
        for path, name in zip(paths, _unique_names(paths), strict=True)
    ]
    for file in files:
        if left := file.sidecar.get("not_reached"):
            log.warning(
                "%s: its run was stopped early; %s poses or frames were not reached, and count as missing",
                file.path,
                left,
            )
    return sorted(_with_levels(files), key=lambda file: not file.is_initial)


def _with_levels(files: Sequence[ResultFile]) -> list[ResultFile]:
    """Copy the perturbation of initial poses to files without one that have a line for each initial pose."""
    counts = [Counter((line.scene_id, line.im_id, line.obj_id) for line in file.estimates) for file in files]
    initial = [
        (file.sidecar["perturbation"], count)
        for file, count in zip(files, counts, strict=True)
        if file.is_initial and "perturbation" in file.sidecar
    ]
    shared = []
    for file, count in zip(files, counts, strict=True):
        same = [levels for levels, initial_count in initial if initial_count == count]
        lent = {"perturbation": same[0]} if same and "perturbation" not in file.sidecar else {}
        shared.append(replace(file, sidecar=file.sidecar | lent))
    return shared


def _unique_names(paths: Sequence[Path]) -> list[str]:
    stems = [path.stem for path in paths]
    if len(set(stems)) == len(stems):
        return stems
    longer = [f"{path.resolve().parent.name}/{path.stem}" for path in paths]
    return longer if len(set(longer)) == len(longer) else [str(path) for path in paths]


def method_names(files: Sequence[ResultFile]) -> list[str]:
    """Unique names: sidecar's `method` and `loss`, `UNREFINED` for initial poses; the file's name where these fail.

    The loss is `loss` in the sidecar or in its `settings`.
    """
    described = [_described(file) for file in files]
    count = Counter(described)
    return [
        (f"{name} ({file.name})" if name else file.name) if count[name] > 1 or not name else name
        for name, file in zip(described, files, strict=True)
    ]


def _described(file: ResultFile) -> str:
    if file.is_initial:
        return UNREFINED
    settings = file.sidecar.get("settings")
    inner = settings.get("loss") if isinstance(settings, dict) else None
    method, loss = file.sidecar.get("method"), file.sidecar.get("loss", inner)
    parts = [method if isinstance(method, str) else "", f"{loss} loss" if isinstance(loss, str) and loss else ""]
    return ", ".join(part for part in parts if part)
