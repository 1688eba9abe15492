"""A report as plain data: scores of every result file, and their change from the initial poses."""

import platform
from collections.abc import Mapping, Sequence
from importlib import metadata
from typing import Any

import numpy as np
import pandas as pd
from posecore.bop import BopDataset, ModelInfo
from posecore.files import sha256_bytes, sha256_file

from evalkit import __version__
from evalkit.error_table import column
from evalkit.evaluation.evaluator import VssKind
from evalkit.evaluation.scored_file import CaseKey, Scored
from evalkit.report.comparison import compare
from evalkit.scores import DEFINITIONS, bins, by_object, scores
from evalkit.scores.bootstrap import score_intervals
from evalkit.scores.convergence import by_level
from evalkit.scores.failure_causes import cause_counts, causes

VSS_DEFINITIONS = {
    "full": "full: whole silhouettes rendered at both poses, occluders ignored (1 - cus of bop_toolkit)",
    "visible": "visible: visible parts of both silhouettes by measured depth, tolerance 15 mm (1 - VSD, tau infinite)",
}


def summarise(dataset: BopDataset, scored: Sequence[Scored], vss: VssKind) -> dict[str, Any]:
    """The whole report as JSON-ready data; values without data are None."""
    initial = [item for item in scored if item.file.is_initial]
    distances_m = [column(item.table, "distance_m") for item in scored]
    distance_edges_m = bins.round_edges(np.concatenate(distances_m) if distances_m else np.zeros(0))
    summary = {
        "dataset": {
            "name": dataset.name,
            "path": str(dataset.root.resolve()),
            "split": dataset.split,
            "targets": len(dataset.targets),
            "sha256": dataset_sha256(dataset),
        },
        "vss": vss,
        "definitions": dict(DEFINITIONS) | {"VSS variant": VSS_DEFINITIONS[vss]},
        "versions": versions(),
        "files": [_file_summary(item, distance_edges_m, dataset.models_info) for item in scored],
        "against_initial": [
            compare(initial_of(item, initial), item) for item in scored if initial and item is not initial[0]
        ],
        "against_first": [] if initial else [compare(scored[0], item) for item in scored[1:]],
    }
    cleaned: dict[str, Any] = _without_nan(summary)
    return cleaned


def _causes(item: Scored, infos: Mapping[int, ModelInfo]) -> "pd.Series[str]":
    return causes(item.table, item.T_est, item.T_gt, item.center_m, infos)


def _file_summary(item: Scored, distance_edges_m: Sequence[float], infos: Mapping[int, ModelInfo]) -> dict[str, Any]:
    sidecar = {key: value for key, value in item.file.sidecar.items() if key not in ("perturbation", "initial_lines")}
    return {
        "name": item.file.name,
        "path": str(item.file.path),
        "sha256": item.file.sha256,
        "is_initial": item.file.is_initial,
        "sidecar": sidecar,
        "ignored_lines": item.ignored,
        "total": scores(item.table) | {name: value for name, value in item.precision.items() if name != "by_object"},
        "by_object": {
            str(obj_id): values | item.precision.get("by_object", {}).get(obj_id, {})
            for obj_id, values in by_object(item.table).items()
        },
        "by_level": by_level(item.table),
        "bins": bins_of(item.table, distance_edges_m),
        "causes": cause_counts(item.table, _causes(item, infos)).to_dict("index"),
        "intervals": {
            "total": score_intervals(item.table).as_json(),
            "by_object": {
                str(obj_id): score_intervals(group).as_json() for obj_id, group in item.table.groupby("obj_id")
            },
        },
    }


def initial_of(item: Scored, initial: Sequence[Scored]) -> Scored:
    """The initial poses of a file: those that its sidecar names as `init`, else the first."""
    named = [other for other in initial if other.file.path.name == item.file.sidecar.get("init")]
    return [*named, *initial][0]


def ranked_cases(scored: Sequence[Scored]) -> list[CaseKey]:
    """Keys of the poses found in the last result file, by rising VSS."""
    if not scored:
        return []
    table = scored[-1].table
    vss, angle = column(table, "vss"), column(table, "re_sym_rad")
    cases = [(key, row) for key, row in scored[-1].cases().items() if table.found.iloc[row]]
    return [key for key, _ in sorted(cases, key=lambda item: (vss[item[1]], -angle[item[1]]))]


def bins_of(table: pd.DataFrame, distance_edges_m: Sequence[float]) -> dict[str, list[dict[str, Any]]]:
    """Scores by visibility, distance and viewpoint, see `evalkit.scores.bins`; one mapping for each bin and score."""
    tables = {
        "visibility": bins.by_visibility(table),
        "distance": bins.by_distance(table, distance_edges_m),
        "azimuth": bins.by_azimuth(table),
        "elevation": bins.by_elevation(table),
        "viewpoint": bins.by_viewpoint(table, scores=("vss_mean",), resamples=0),
    }
    return {name: binned.to_dict("records") for name, binned in tables.items()}


def dataset_sha256(dataset: BopDataset) -> str:
    """One hash over the inputs of errors: targets, ground truth, cameras, models and their infos."""
    files = [dataset.root / f"{dataset.split}_targets_{edition}.json" for edition in ("bop19", "bop24")]
    files += [dataset.root / folder / "models_info.json" for folder in ("models", "models_eval")]
    files += [dataset.mesh_path(obj_id, eval=True) for obj_id in sorted({target.obj_id for target in dataset.targets})]
    for scene_id in dataset.scene_ids:
        files += dataset.files(scene_id)
    lines = [f"{file.relative_to(dataset.root)} {sha256_file(file)}" for file in files if file.is_file()]
    return sha256_bytes("\n".join(lines).encode())


def versions() -> dict[str, str]:
    """Versions of the software."""
    by_package = {"evalkit": __version__, "python": platform.python_version()}
    for name in ("posecore", "numpy", "scipy", "opencv-python-headless", "moderngl"):
        try:
            by_package[name] = metadata.version(name)
        except metadata.PackageNotFoundError:
            continue
    return by_package


def _without_nan(value: Any) -> Any:
    if isinstance(value, dict):
        return {key: _without_nan(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [_without_nan(item) for item in value]
    if isinstance(value, float) and not np.isfinite(value):
        return None
    return value
