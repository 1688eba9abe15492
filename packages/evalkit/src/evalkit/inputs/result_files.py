"""Which result files belong to a report, what their sidecars say, and which dataset they speak of."""

import logging
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from posecore.bop import BopDataset, Estimate, read_results, read_sidecar, sidecar_path
from posecore.errors import ConfigError, ResultFileError
from posecore.files import sha256_file

log = logging.getLogger(__name__)

INITIAL_METHOD = "initial"


@dataclass(frozen=True, kw_only=True)
class ResultFile:
    """A result file that has been read.

    Attributes:
        name: what tables and plots call it, unique in a report.
        path: where it lies.
        sha256: of its bytes.
        sidecar: what `<path>.json` says, empty where there is none.
        estimates: its lines.
    """

    name: str
    path: Path
    sha256: str
    sidecar: dict[str, Any]
    estimates: list[Estimate]

    @property
    def is_start(self) -> bool:
        """Whether these are the poses that the other files started from."""
        return self.sidecar.get("method") == INITIAL_METHOD


def find_result_files(folder: Path, is_dataset_given: bool = False) -> list[Path]:
    """Result files with a sidecar that names a dataset, in a folder and in its `results/`; others are told.

    Args:
        folder: Where.
        is_dataset_given: whether the dataset is known otherwise; then sidecars need not name one.

    Raises:
        ConfigError: there are none.
        ResultFileError: a sidecar is damaged.
    """
    found = [path for place in (folder, folder / "results") for path in sorted(place.glob("*.csv"))]
    with_sidecar = []
    for path in found:
        if sidecar_path(path).is_file():
            if is_dataset_given or (read_sidecar(path) or {}).get("dataset"):
                with_sidecar.append(path)
            else:
                log.warning("%s: left out, its sidecar names no dataset", path)
    if not with_sidecar:
        raise ConfigError(
            f"{folder.resolve()}: no result file (*.csv with *.csv.json beside it that names a dataset) here or in "
            "results/; name them with --results FILE.csv --dataset DIR"
        )
    return with_sidecar


def dataset_of(paths: Sequence[Path], folder: Path) -> Path:
    """The dataset folder that the files' sidecars name; relative paths are tried from `folder`, then from the file.

    Raises:
        ConfigError: no sidecar names one, they name several, or it does not exist.
    """
    named: dict[Path, Path] = {}
    for path in paths:
        value = (read_sidecar(path) or {}).get("dataset")
        if not isinstance(value, str) or not value:
            continue
        choices = [place / value for place in (folder, path.parent, path.parent.parent)]
        existing = [choice for choice in choices if choice.is_dir()]
        if not existing:
            raise ConfigError(f"{sidecar_path(path)}: its dataset {value} is not a folder; name it with --dataset DIR")
        named.setdefault(existing[0].resolve(), path)
    if not named:
        raise ConfigError(f"{paths[0]}: no sidecar says which dataset this is; name it with --dataset DIR")
    if len(named) > 1:
        both = ", ".join(f"{path} ({dataset})" for dataset, path in named.items())
        raise ConfigError(f"the result files are of several datasets: {both}; report one with --dataset and --results")
    return next(iter(named))


def load_result_files(paths: Sequence[Path], dataset: BopDataset) -> list[ResultFile]:
    """Read and check result files: starts come first, the others stay in order.

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
    return sorted(_share_levels(files), key=lambda file: not file.is_start)


def _share_levels(files: Sequence[ResultFile]) -> list[ResultFile]:
    """Give the perturbation levels of start poses to files with a line for each start that do not say them."""
    counts = [Counter((line.scene_id, line.im_id, line.obj_id) for line in file.estimates) for file in files]
    starts = [
        (file.sidecar["perturbation"], count)
        for file, count in zip(files, counts, strict=True)
        if file.is_start and "perturbation" in file.sidecar
    ]
    shared = []
    for file, count in zip(files, counts, strict=True):
        same = [levels for levels, planned in starts if planned == count]
        lent = {"perturbation": same[0]} if same and "perturbation" not in file.sidecar else {}
        shared.append(replace(file, sidecar=file.sidecar | lent))
    return shared


def _unique_names(paths: Sequence[Path]) -> list[str]:
    stems = [path.stem for path in paths]
    if len(set(stems)) == len(stems):
        return stems
    longer = [f"{path.resolve().parent.name}/{path.stem}" for path in paths]
    return longer if len(set(longer)) == len(longer) else [str(path) for path in paths]
