"""What a report says: scores of every result file, and how each compares with the start poses. Plain data."""

import platform
from collections.abc import Sequence
from importlib import metadata
from itertools import pairwise
from typing import Any

import numpy as np
import pandas as pd
from posecore.bop import BopDataset
from posecore.files import sha256_bytes, sha256_file

from evalkit import __version__
from evalkit.evaluate import VssKind
from evalkit.scored import CaseKey, Scored
from evalkit.scores import DEFINITIONS, by_level, by_object, found_errors, scores
from evalkit.table import column

VSS_DEFINITIONS = {
    "full": "full: whole silhouettes rendered at both poses, occluders ignored (1 - cus of bop_toolkit)",
    "visible": "visible: visible parts of both silhouettes by measured depth, tolerance 15 mm (1 - VSD, tau infinite)",
}
COMPARED = {
    "re_sym_deg": "rotation error",
    "tx_mm": "x error",
    "ty_mm": "y error",
    "tz_mm": "z error",
    "add_mm": "ADD",
}
NO_ERROR = 1e-4
"""Degrees and millimetres: a result file's nine decimals lie below."""


def summarise(dataset: BopDataset, scored: Sequence[Scored], vss: VssKind) -> dict[str, Any]:
    """The whole report as JSON-ready data; values without data are None."""
    starts = [item for item in scored if item.file.is_start]
    summary = {
        "dataset": {
            "name": dataset.name,
            "path": str(dataset.root.resolve()),
            "split": dataset.split,
            "targets": len(dataset.targets),
            "sha256": dataset_sha256(dataset),
        },
        "vss": vss,
        "definitions": DEFINITIONS | {"VSS variant": VSS_DEFINITIONS[vss]},
        "versions": versions(),
        "files": [_file_summary(item) for item in scored],
        "against_start": [
            against_start(start_of(item, starts), item) for item in scored if starts and item is not starts[0]
        ],
    }
    cleaned: dict[str, Any] = _without_nan(summary)
    return cleaned


def _file_summary(item: Scored) -> dict[str, Any]:
    sidecar = {key: value for key, value in item.file.sidecar.items() if key not in ("perturbation", "start_lines")}
    return {
        "name": item.file.name,
        "path": str(item.file.path),
        "sha256": item.file.sha256,
        "is_start": item.file.is_start,
        "sidecar": sidecar,
        "ignored_lines": item.ignored,
        "total": scores(item.table),
        "by_object": {str(obj_id): values for obj_id, values in by_object(item.table).items()},
        "by_level": by_level(item.table),
    }


def start_of(item: Scored, starts: Sequence[Scored]) -> Scored:
    """The start poses that a file came from: those that its sidecar names as `init`, else the first."""
    named = [start for start in starts if start.file.path.name == item.file.sidecar.get("init")]
    return [*named, *starts][0]


def against_start(start: Scored, other: Scored) -> dict[str, Any]:
    """Medians of a file and of its start poses over the poses found in both, their ratios, and this in words."""
    start_cases, other_cases = start.cases(), other.cases()
    rows = np.array([(start_cases[key], row) for key, row in other_cases.items() if key in start_cases], np.int64)
    before, after = start.table.iloc[rows.reshape(-1, 2)[:, 0]], other.table.iloc[rows.reshape(-1, 2)[:, 1]]
    both = before.found.to_numpy() & after.found.to_numpy()
    before, after = before[both], after[both]
    medians = {name: _medians(name, before, after) for name in COMPARED}
    vss_mean = {"start": _mean_vss(before), "refined": _mean_vss(after)}
    missing = int((~other.table.found).sum())
    return {
        "name": other.file.name,
        "start": start.file.name,
        "poses": len(after),
        "missing": missing,
        "medians": medians,
        "vss_mean": vss_mean,
        "words": _words(other.file.name, start.file.name, len(after), missing, medians, vss_mean),
    }


def _medians(name: str, before: pd.DataFrame, after: pd.DataFrame) -> dict[str, float]:
    """Medians over the poses whose start has an error of this kind: curves also hold starts that are only moved."""
    old, new = found_errors(before)[name], found_errors(after)[name]
    off = old > NO_ERROR
    if not off.any():
        return {"poses": 0, "start": float("nan"), "refined": float("nan"), "ratio": float("nan")}
    start, refined = float(np.median(old[off])), float(np.median(new[off]))
    return {"poses": int(off.sum()), "start": start, "refined": refined, "ratio": refined / start}


def _mean_vss(table: pd.DataFrame) -> float:
    return float(column(table, "vss").mean()) if len(table) else float("nan")


def _words(
    name: str,
    start: str,
    count: int,
    missing: int,
    medians: dict[str, dict[str, float]],
    vss_mean: dict[str, float],
) -> str:
    if not count:
        return f"{name} and {start} have no pose in common."
    said = []
    for key, label in COMPARED.items():
        values = medians[key]
        if not values["poses"]:
            continue
        unit = "°" if key.endswith("_deg") else " mm"
        part = f", {values['poses']} starts" if values["poses"] < count else ""
        said.append(
            f"{label} {_change(values['ratio'])} ({values['start']:.3g}{unit} to {values['refined']:.3g}{unit}{part})"
        )
    said.append(f"mean VSS {vss_mean['start']:.3f} to {vss_mean['refined']:.3f}")
    are = "pose is" if missing == 1 else "poses are"
    lost = f" {missing} {are} missing in {name}: failures in the tables." if missing else ""
    compared = f"{name} against its start poses ({start}), medians over the {count} poses found in both"
    return f"{compared}: {'; '.join(said)}.{lost}"


def _change(ratio: float) -> str:
    if abs(ratio - 1.0) < 0.02:
        return f"unchanged, {ratio:.2f} of the start's"
    return f"{'down to' if ratio < 1 else 'up to'} {ratio:.2f} of the start's"


def worst_cases(scored: Sequence[Scored], count: int) -> list[CaseKey]:
    """Keys of the lowest VSS among the found poses of the last result file, lowest first."""
    if not scored:
        return []
    table = scored[-1].table
    vss, angle = column(table, "vss"), column(table, "re_sym_rad")
    found = [(key, row) for key, row in scored[-1].cases().items() if table.found.iloc[row]]
    ordered = sorted(found, key=lambda item: (vss[item[1]], -angle[item[1]]))
    return [key for key, _ in ordered[:count]]


def visibility_bins(table: pd.DataFrame, edges: Sequence[float]) -> list[tuple[float, float, int]]:
    """Centre, mean VSS and number of rows for each bin of the visible share; empty bins are left out."""
    visible, vss = column(table, "visib_fract"), column(table, "vss")
    bins = []
    for low, high in pairwise(edges):
        inside = (visible >= low) & ((visible < high) | ((high == edges[-1]) & (visible <= high)))
        if inside.any():
            bins.append(((low + high) / 2, float(vss[inside].mean()), int(inside.sum())))
    return bins


def dataset_sha256(dataset: BopDataset) -> str:
    """One hash over what errors depend on: targets, ground truth, cameras, models and their infos."""
    files = [dataset.root / f"{dataset.split}_targets_{edition}.json" for edition in ("bop19", "bop24")]
    files += [dataset.root / folder / "models_info.json" for folder in ("models", "models_eval")]
    files += [dataset.mesh_path(obj_id, eval=True) for obj_id in sorted({target.obj_id for target in dataset.targets})]
    for scene_id in dataset.scene_ids:
        files += [dataset.scene_path(scene_id) / name for name in ("scene_gt.json", "scene_camera.json")]
    lines = [f"{file.relative_to(dataset.root)} {sha256_file(file)}" for file in files if file.is_file()]
    return sha256_bytes("\n".join(lines).encode())


def versions() -> dict[str, str]:
    """Versions of what computed the numbers."""
    found = {"evalkit": __version__, "python": platform.python_version()}
    for name in ("posecore", "numpy", "scipy", "opencv-python-headless", "moderngl"):
        try:
            found[name] = metadata.version(name)
        except metadata.PackageNotFoundError:
            continue
    return found


def _without_nan(value: Any) -> Any:
    if isinstance(value, dict):
        return {key: _without_nan(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [_without_nan(item) for item in value]
    if isinstance(value, float) and not np.isfinite(value):
        return None
    return value
