"""Models against `models_info.json`: loading, diameters, boxes and symmetries."""

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float
from posecore import se3
from posecore.bop import BopDataset, ModelInfo
from posecore.bop.jsonfile import integer_keys, numbers, read_json
from posecore.bop.models_info import MM, load_model_info
from posecore.errors import DatasetError, MeshError
from posecore.mesh import Mesh
from posecore.symmetry import rotations_about_axis
from scipy.spatial import cKDTree

from evalkit.check.findings import Findings, Level

DIAMETER_TOLERANCE = 5e-3
"""Largest relative difference of `models_info.json`'s diameter from the mesh beside the file."""
EVAL_DIAMETER_TOLERANCE = 2e-2
"""The same for simplified models against the full ones' numbers."""
MEAN_DISTANCE = 0.02
"""Smallest mean distance, in diameters, between a surface and its image under a transform that is not a symmetry.

Sampling alone gives 0.005; LM-O's two symmetries 0.008 and 0.010; 180 degrees about another axis 0.025 or more.
"""
MAX_DISTANCE = 0.1
"""BOP's limit for a symmetry: every point within a tenth of the diameter (or 15 mm)."""
SURFACE_POINTS = 20_000
MOVED_POINTS = 2_000
TURNS = 9
UNIT_FACTORS = ((1e-3, "metres instead of millimetres in models_info.json?"), (1e3, "the mesh in metres?"), (10, "cm?"))
"""Ratios of the stated diameter to the mesh's with their probable cause."""


def check_models(dataset: BopDataset, findings: Findings) -> dict[int, ModelInfo]:
    """Check every models folder; returns the usable entries of `models_info.json`."""
    infos: dict[int, ModelInfo] = {}
    chosen = dataset.models_info_file
    for folder in [folder for folder in dataset.models_folders() if folder != chosen.parent]:
        if (folder / "models_info.json").is_file():
            _load_infos(folder / "models_info.json", findings)
    infos = _load_infos(chosen, findings)
    folders = dataset.models_folders()
    if not folders:
        findings.add("error", "models", str(dataset.root), "found no models/ folder, expected models/obj_000001.ply")
    for folder in folders:
        _check_folder(dataset, folder, infos, findings, has_own_info=folder == chosen.parent)
    return infos


def _load_infos(file: Path, findings: Findings) -> dict[int, ModelInfo]:
    try:
        entries = integer_keys(read_json(file), file)
    except DatasetError as error:
        findings.add_error("models-info", error)
        return {}
    if not entries:
        findings.add("error", "models-info", str(file), "found no objects, expected one entry for each model")
    infos = {}
    for obj_id, entry in sorted(entries.items()):
        try:
            infos[obj_id] = load_model_info(entry, f"{file}, object {obj_id}")
        except DatasetError as error:
            findings.add_error("models-info", error)
    return infos


def _check_folder(
    dataset: BopDataset, folder: Path, infos: dict[int, ModelInfo], findings: Findings, *, has_own_info: bool
) -> None:
    for path in sorted(folder.glob("obj_*.ply")):
        number = path.stem.removeprefix("obj_")
        if not number.isdigit() or int(number) not in infos:
            findings.add(
                "warning", "model-unlisted", str(path), "models_info.json does not list it", "add its diameter"
            )
    for obj_id, info in sorted(infos.items()):
        path = folder / f"obj_{obj_id:06d}.ply"
        if not path.is_file():
            level: Level = "error" if has_own_info else "warning"
            findings.add(level, "model-missing", str(path), "models_info.json lists the object, found no file")
            continue
        try:
            mesh = dataset.mesh_at(path)
        except MeshError as error:
            findings.add_error("model", error)
            continue
        findings.cover("models")
        tolerance = DIAMETER_TOLERANCE if has_own_info else EVAL_DIAMETER_TOLERANCE
        _check_diameter(path, mesh, info, tolerance, findings)
        if has_own_info:
            _check_box(folder / "models_info.json", obj_id, mesh, findings)
            _check_symmetries(folder / "models_info.json", obj_id, mesh, info, findings)


def _check_diameter(path: Path, mesh: Mesh, info: ModelInfo, tolerance: float, findings: Findings) -> None:
    measured_mm, stated_mm = mesh.diameter_m / MM, info.diameter_m / MM
    if abs(measured_mm - stated_mm) <= tolerance * measured_mm:
        return
    ratio = stated_mm / measured_mm
    hint = next(
        (text for factor, text in UNIT_FACTORS if abs(ratio / factor - 1) < 0.02), "calculate models_info.json anew"
    )
    findings.add(
        "error",
        "diameter",
        str(path),
        f"is {measured_mm:.6g} mm across, models_info.json states {stated_mm:.6g} mm",
        hint,
    )


def _check_box(file: Path, obj_id: int, mesh: Mesh, findings: Findings) -> None:
    entry: Any = integer_keys(read_json(file), file)[obj_id]
    names = [f"{kind}_{axis}" for kind in ("min", "size") for axis in "xyz"]
    missing = [name for name in names if name not in entry]
    where = f"{file}, object {obj_id}"
    if missing:
        findings.add("hint", "model-box", where, f"has no {', '.join(missing)}; bop_toolkit's scripts write them")
        return
    try:
        stated = np.array([numbers(entry, name, 1, where)[0] for name in names])
    except DatasetError as error:
        findings.add_error("models-info", error)
        return
    low, high = mesh.vertices_m.min(axis=0) / MM, mesh.vertices_m.max(axis=0) / MM
    measured = np.concatenate([low, high - low])
    wrong = np.flatnonzero(np.abs(measured - stated) > DIAMETER_TOLERANCE * mesh.diameter_m / MM)
    if len(wrong):
        first = int(wrong[0])
        message = f"'{names[first]}' is {stated[first]:.6g}, the model's is {measured[first]:.6g} mm"
        findings.add("warning", "model-box", where, message, "calculate models_info.json anew")


def _check_symmetries(file: Path, obj_id: int, mesh: Mesh, info: ModelInfo, findings: Findings) -> None:
    if not info.is_symmetric:
        return
    surface = cKDTree(surface_points(mesh, SURFACE_POINTS))
    points = surface_points(mesh, MOVED_POINTS)
    for name, transforms in _symmetries(info):
        moved = se3.apply(transforms, points).reshape(-1, 3)
        distances = np.asarray(surface.query(moved)[0]) / mesh.diameter_m
        where = f"{file}, object {obj_id}, {name}"
        distance = f"moves the surface by {distances.mean():.3g} diameters on average, {distances.max():.3g} at most"
        if distances.mean() > MEAN_DISTANCE:
            findings.add(
                "error", "symmetry", where, f"{distance}; a symmetry maps it onto itself", "wrong axis or offset?"
            )
        elif distances.max() > MAX_DISTANCE:
            findings.add(
                "warning", "symmetry", where, f"{distance}; BOP allows {MAX_DISTANCE} at most", "a handle or a text?"
            )


def _symmetries(info: ModelInfo) -> Iterator[tuple[str, Float[np.ndarray, "n 4 4"]]]:
    for index, transform in enumerate(info.symmetries_discrete):
        yield f"symmetries_discrete {index}", transform[None]
    angles = np.arange(1, TURNS + 1) * (2 * np.pi / (TURNS + 1))
    for index, (axis, offset_m) in enumerate(info.symmetries_continuous):
        yield f"symmetries_continuous {index}", rotations_about_axis(np.array(axis), angles, np.array(offset_m))


def surface_points(mesh: Mesh, count: int) -> Float[np.ndarray, "n 3"]:
    """Points spread evenly over a surface, metres; the same at every call."""
    corners = mesh.vertices_m[mesh.faces]
    areas = np.linalg.norm(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1)
    total = areas.sum()
    if not total > 0:
        return mesh.vertices_m
    rng = np.random.default_rng(0)
    along = (np.arange(count) + 0.5) / count * total
    faces = np.searchsorted(np.cumsum(areas), along).clip(0, len(areas) - 1)
    u, v = rng.random((2, count))
    outside = u + v > 1
    u[outside], v[outside] = 1 - u[outside], 1 - v[outside]
    a, b, c = corners[faces, 0], corners[faces, 1], corners[faces, 2]
    return np.asarray(a + u[:, None] * (b - a) + v[:, None] * (c - a))
