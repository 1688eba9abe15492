"""models_info.json: diameters and symmetries of a dataset's objects."""

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float

from posecore import se3
from posecore.bop.jsonfile import as_list, integer_keys, numbers, read_json, write_json
from posecore.errors import DatasetError
from posecore.mesh import Mesh
from posecore.schema import shown
from posecore.symmetry import ContinuousSymmetry, symmetry_transforms

__all__ = [
    "ContinuousSymmetry",
    "ModelInfo",
    "load_model_info",
    "load_models_info",
    "save_models_info",
    "symmetry_transforms",
]

MM = 1e-3
LARGEST_MM = 1e6
"""No length in `models_info.json` is larger: a kilometre."""
ROTATION_TOLERANCE = 2e-2
"""Largest entry of R R^T - I that passes: LM-O's own annotations reach 0.0096 (a scale of 1.0048)."""


@dataclass(frozen=True, kw_only=True, eq=False)
class ModelInfo:
    """An object's entry in `models_info.json`.

    Attributes:
        diameter_m: largest distance between two vertices, metres.
        symmetries_discrete: (4, 4) transforms in the object frame, metres, without the identity.
        symmetries_continuous: rotation axes with a point on each.
    """

    diameter_m: float
    symmetries_discrete: tuple[Float[np.ndarray, "4 4"], ...] = ()
    symmetries_continuous: tuple[ContinuousSymmetry, ...] = ()

    @property
    def is_symmetric(self) -> bool:
        """Whether any symmetry is listed."""
        return bool(self.symmetries_discrete or self.symmetries_continuous)

    def with_origin_at(self, point_m: Float[np.ndarray, "3"]) -> "ModelInfo":
        """The entry in the frame with the same axes and its origin at a point, metres."""
        point_m = np.asarray(point_m, np.float64)
        there, back = se3.make_T(np.eye(3), point_m), se3.make_T(np.eye(3), -point_m)
        axes = []
        for axis, offset_m in self.symmetries_continuous:
            x, y, z = as_list(np.array(offset_m) - point_m)
            axes.append(ContinuousSymmetry(axis, (x, y, z)))
        return replace(
            self,
            symmetries_discrete=tuple(back @ T @ there for T in self.symmetries_discrete),
            symmetries_continuous=tuple(axes),
        )


def load_models_info(path: str | Path) -> dict[int, ModelInfo]:
    """Read `models_info.json` (millimetres) as {object id: info in metres}.

    Raises:
        DatasetError: missing file, invalid JSON, no objects, a diameter that is not positive, a symmetry that is not
            a rigid transform.
    """
    file = Path(path)
    entries = integer_keys(read_json(file), file)
    if not entries:
        raise DatasetError(f"{file}: no objects, expected one entry for each model")
    return {obj_id: load_model_info(entry, f"{file}, object {obj_id}") for obj_id, entry in sorted(entries.items())}


def load_model_info(entry: Any, where: str) -> ModelInfo:
    """Read an object's entry of `models_info.json`, in metres.

    Raises:
        DatasetError: as `load_models_info`; the message starts with `where`.
    """
    diameter_mm = float(numbers(entry, "diameter", 1, where)[0])
    if not 0 < diameter_mm <= LARGEST_MM:
        raise DatasetError(f"{where}: the diameter is {diameter_mm}, expected a positive number of millimetres")
    return ModelInfo(
        diameter_m=diameter_mm * MM,
        symmetries_discrete=tuple(_discrete(item, where) for item in _listed(entry, "symmetries_discrete", where)),
        symmetries_continuous=tuple(
            _continuous(item, where) for item in _listed(entry, "symmetries_continuous", where)
        ),
    )


def _listed(entry: dict[str, Any], key: str, where: str) -> list[Any]:
    items = entry.get(key, [])
    if not isinstance(items, list):
        raise DatasetError(f"{where}: '{key}' is {shown(items)}, expected a list")
    return items


def _discrete(item: Any, where: str) -> Float[np.ndarray, "4 4"]:
    T = numbers({"symmetries_discrete": item}, "symmetries_discrete", 16, where).reshape(4, 4).copy()
    is_rigid = np.abs(T).max() <= LARGEST_MM and bool(se3.is_rotation(T[:3, :3], ROTATION_TOLERANCE))
    if not is_rigid or not np.allclose(T[3], [0, 0, 0, 1]):
        raise DatasetError(f"{where}: a discrete symmetry is not a rotation and a translation (16 numbers by rows)")
    T[:3, 3] *= MM
    return T


def _continuous(item: Any, where: str) -> ContinuousSymmetry:
    axis, offset_mm = numbers(item, "axis", 3, where), numbers(item, "offset", 3, where)
    if np.abs(offset_mm).max() > LARGEST_MM:
        raise DatasetError(f"{where}: the offset of a continuous symmetry is {offset_mm.tolist()} mm, expected a point")
    length = float(np.linalg.norm(axis)) if np.abs(axis).max() <= LARGEST_MM else 0.0
    if length < 1e-6:
        raise DatasetError(f"{where}: the axis of a continuous symmetry is {axis.tolist()}, expected a direction")
    x, y, z = as_list(axis / length)
    offset_x, offset_y, offset_z = as_list(offset_mm * MM)
    return ContinuousSymmetry((x, y, z), (offset_x, offset_y, offset_z))


def save_models_info(path: str | Path, meshes: dict[int, Mesh], infos: dict[int, ModelInfo]) -> None:
    """Write `models_info.json`: box and diameter from the mesh, symmetries from `infos`, millimetres."""
    content = {}
    for obj_id, mesh in sorted(meshes.items()):
        low, high = mesh.vertices_m.min(axis=0) / MM, mesh.vertices_m.max(axis=0) / MM
        entry: dict[str, Any] = {"diameter": mesh.diameter_m / MM}
        entry |= {f"min_{axis}": float(low[i]) for i, axis in enumerate("xyz")}
        entry |= {f"size_{axis}": float(high[i] - low[i]) for i, axis in enumerate("xyz")}
        entry |= _symmetry_entries(infos[obj_id]) if obj_id in infos else {}
        content[str(obj_id)] = entry
    write_json(path, content)


def _symmetry_entries(info: ModelInfo) -> dict[str, Any]:
    entries: dict[str, Any] = {}
    if info.symmetries_discrete:
        scale = np.ones((4, 4))
        scale[:3, 3] = 1 / MM
        entries["symmetries_discrete"] = [as_list(T * scale) for T in info.symmetries_discrete]
    if info.symmetries_continuous:
        entries["symmetries_continuous"] = [
            {"axis": as_list(axis), "offset": as_list(np.array(offset_m) / MM)}
            for axis, offset_m in info.symmetries_continuous
        ]
    return entries
