"""BOP result files: `scene_id,im_id,obj_id,score,R,t,time`, millimetres, one estimate a line, with a JSON sidecar."""

import json
from collections.abc import Callable, Iterable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal, NamedTuple

import numpy as np
from jaxtyping import Bool, Float

from posecore import se3
from posecore.bop.dataset import BopDataset
from posecore.bop.jsonfile import as_list, read_json
from posecore.bop.models_info import MM
from posecore.bop.result_table import HEADER, LineFault, ResultTable, parse_results
from posecore.errors import PoseError, ResultFileError
from posecore.files import read_regular, write_atomic
from posecore.renamed import migrated_keys

__all__ = [
    "Estimate",
    "Extent",
    "LineFault",
    "ResultTable",
    "estimate_table",
    "estimates_of",
    "extents_of",
    "in_metres",
    "metres_fault",
    "read_result_bytes",
    "read_result_table",
    "read_results",
    "read_sidecar",
    "sidecar_path",
    "unknown_ids",
    "write_results",
]

SUSPICIOUS_DISTANCE_MM = 10.0
REACH_DIAMETERS = 0.6
"""A nearer object reaches the camera."""
NEAREST_MM = 1e-3 * SUSPICIOUS_DISTANCE_MM
"""Least length that is suspected: in metres, a smaller one would be no nearer to any object."""
RENAMED = {
    "start_lines": "initial_lines",
    "method=start": "method=initial",
    "settings.sure": "settings.tracking_threshold",
    "settings.found": "settings.accept_threshold",
}
"""Sidecar keys and values of version 0.1 by name, see `posecore.renamed`."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Estimate:
    """One estimated pose.

    Attributes:
        scene_id: scene.
        im_id: image.
        obj_id: object.
        score: confidence, any scale; the higher the better.
        T_cam_obj: (4, 4) pose, metres.
        time_s: run time of the whole image in seconds, negative where unknown.
        line: line in the result file, from 1; 0 where it comes from elsewhere.
    """

    scene_id: int
    im_id: int
    obj_id: int
    score: float = 1.0
    T_cam_obj: Float[np.ndarray, "4 4"]
    time_s: float = -1.0
    line: int = 0


def read_results(
    path: str | Path, dataset: BopDataset | None = None, *, images: Literal["gt", "camera"] = "gt"
) -> list[Estimate]:
    """Read a result file as a list; `read_result_table` gives the same as columns, which is faster.

    Args:
        path: CSV file; translations in millimetres.
        dataset: if given, unknown scenes, images and objects are errors.
        images: images that are known, see `unknown_ids`.

    Raises:
        ResultFileError: as `read_result_table`.
    """
    return estimates_of(read_result_table(path, dataset, images=images))


def read_result_table(
    path: str | Path, dataset: BopDataset | None = None, *, images: Literal["gt", "camera"] = "gt"
) -> ResultTable:
    """Read a result file as columns. A file with a header and nothing else has no estimates.

    Blank lines, a byte order mark, CRLF, spaces around fields, no header, and a header that names the columns in
    another order are harmless.

    Args:
        path: CSV file; translations in millimetres.
        dataset: if given, unknown scenes, images and objects are errors.
        images: images that are known, see `unknown_ids`.

    Raises:
        ResultFileError: missing or empty file, a line that breaks the format, NaN, a scaled or mirrored rotation, an
            unknown id, translations that look like metres (`in_metres`; without a dataset, by the origins alone). The
            message names file and line.
    """
    file = Path(path)
    table = parse_results(read_result_bytes(file), str(file))
    metres = metres_fault(table)
    if metres is not None and dataset is not None:  # only then, as centres are read from the meshes
        metres = metres_fault(table, extents_of(dataset, np.unique(table.obj_id).tolist()))
    if metres is not None:
        raise ResultFileError(f"{file}:{metres.line}: {metres.message}")
    if dataset is not None:
        unknown = min(unknown_ids(table, dataset, images), key=lambda fault: fault.line, default=None)
        if unknown is not None:
            raise ResultFileError(f"{file}:{unknown.line}: {unknown.message}")
    return table


def read_result_bytes(file: Path) -> bytes:
    """The bytes of a result file.

    Raises:
        ResultFileError: it cannot be read.
    """
    try:
        return read_regular(file)
    except OSError as error:
        raise ResultFileError(f"{file}: cannot be read ({error.strerror}); give a BOP result file (CSV)") from error


def estimates_of(table: ResultTable) -> list[Estimate]:
    """One object for each line."""
    ids = zip(table.scene_id.tolist(), table.im_id.tolist(), table.obj_id.tolist(), strict=True)
    rest = zip(table.score.tolist(), table.T_cam_obj, table.time_s.tolist(), table.line.tolist(), strict=True)
    return [
        Estimate(
            scene_id=scene_id, im_id=im_id, obj_id=obj_id, score=score, T_cam_obj=T_cam_obj, time_s=time_s, line=line
        )
        for (scene_id, im_id, obj_id), (score, T_cam_obj, time_s, line) in zip(ids, rest, strict=True)
    ]


def estimate_table(estimates: Sequence[Estimate]) -> ResultTable:
    """Estimates as columns."""
    return ResultTable(
        scene_id=np.array([estimate.scene_id for estimate in estimates], np.int64),
        im_id=np.array([estimate.im_id for estimate in estimates], np.int64),
        obj_id=np.array([estimate.obj_id for estimate in estimates], np.int64),
        score=np.array([estimate.score for estimate in estimates], np.float64),
        T_cam_obj=np.array([estimate.T_cam_obj for estimate in estimates], np.float64).reshape(-1, 4, 4),
        time_s=np.array([estimate.time_s for estimate in estimates], np.float64),
        line=np.array([estimate.line for estimate in estimates], np.int64),
    )


class Extent(NamedTuple):
    """Place and size of an object.

    Attributes:
        center_m: Centre in its frame, metres.
        diameter_m: Diameter, metres.
    """

    center_m: Float[np.ndarray, "3"]
    diameter_m: float


POINT = Extent(np.zeros(3), 0.0)
"""An object that is unknown."""


def in_metres(T_cam_obj: Float[np.ndarray, "n 4 4"], extents: Sequence[Extent]) -> bool:
    """Whether translations of BOP files are probably in metres: origins are at the camera, which is in the objects.

    An origin alone may lie there, as that of a mesh scanned in the camera's frame.

    Args:
        T_cam_obj: Poses as read, metres.
        extents: Of each pose's object; `POINT` where it is unknown.
    """
    if not len(T_cam_obj):
        return False
    centers_m = np.array([extent.center_m for extent in extents])
    origin_mm, center_mm = (
        np.linalg.norm(T[:, :3, 3], axis=1) / MM for T in (T_cam_obj, se3.with_origin_at(T_cam_obj, centers_m))
    )
    reach_mm = np.array([REACH_DIAMETERS * extent.diameter_m for extent in extents]) / MM
    is_at_camera = NEAREST_MM <= float(np.median(origin_mm)) < SUSPICIOUS_DISTANCE_MM
    return is_at_camera and float(np.median(center_mm / np.maximum(reach_mm, SUSPICIOUS_DISTANCE_MM))) < 1


def metres_fault(table: ResultTable, extents: Mapping[int, Extent] | None = None) -> LineFault | None:
    """Fault if a file's translations are probably in metres, else None.

    Args:
        table: Result file.
        extents: Of the objects that are known.
    """
    by_id = extents or {}
    if not in_metres(table.T_cam_obj, [by_id.get(obj_id, POINT) for obj_id in table.obj_id.tolist()]):
        return None
    median_mm = float(np.median(np.linalg.norm(table.T_cam_obj[:, :3, 3], axis=1))) / MM
    message = (
        f"the median length of t in the file is {median_mm:.4g}, probably in metres; "
        "BOP result files hold millimetres, multiply t by 1000"
    )
    return LineFault(line=int(table.line[0]), field="t", kind="metres", message=message)


def extents_of(dataset: BopDataset, obj_ids: Iterable[int]) -> dict[int, Extent]:
    """Extent of each object whose model is usable."""
    extents = {}
    for obj_id in obj_ids:
        with suppress(PoseError):  # no such model, or a damaged one
            extents[obj_id] = Extent(dataset.center_m(obj_id), dataset.mesh(obj_id).diameter_m)
    return extents


def unknown_ids(table: ResultTable, dataset: BopDataset, images: Literal["gt", "camera"] = "gt") -> list[LineFault]:
    """Lines with a scene, image or object that the dataset does not have; the first of the three is reported.

    Args:
        table: Result file.
        dataset: Its dataset.
        images: `gt`: only annotated images where a scene has ground truth; `camera`: all images with a camera.
    """
    faults: dict[int, LineFault] = {}

    def note(wrong: Bool[np.ndarray, " n"], field: str, message: Callable[[int], str]) -> None:
        for index in np.flatnonzero(wrong).tolist():
            fault = LineFault(line=int(table.line[index]), field=field, kind="unknown id", message=message(index))
            faults.setdefault(index, fault)

    scenes, of_scene = np.unique(table.scene_id, return_inverse=True)
    strange = ~np.isin(scenes, dataset.scene_ids)
    note(strange[of_scene], "scene_id", lambda i: f"scene {table.scene_id[i]} is not in {dataset.split_path}")
    by_scene = np.argsort(of_scene, kind="stable")
    bounds = np.searchsorted(of_scene[by_scene], np.arange(len(scenes) + 1))
    nowhere = np.zeros(len(table), bool)
    for number, scene_id in enumerate(scenes.tolist()):
        if not strange[number]:
            here = by_scene[bounds[number] : bounds[number + 1]]
            known_ids = dataset.im_ids(scene_id) if images == "gt" else dataset.annotated_im_ids(scene_id, "camera")
            nowhere[here] = ~np.isin(table.im_id[here], sorted(known_ids))
    note(
        nowhere,
        "im_id",
        lambda i: f"image {table.im_id[i]} has no {dataset.annotated_by(int(table.scene_id[i]), images)}",
    )
    listed = ", ".join(map(str, dataset.obj_ids))
    note(
        ~np.isin(table.obj_id, dataset.obj_ids),
        "obj_id",
        lambda i: f"object {table.obj_id[i]} is unknown, {dataset.name} has {listed}",
    )
    return [faults[index] for index in sorted(faults)]


def sidecar_path(path: str | Path) -> Path:
    """The JSON beside a result file: `results/quick.csv` has `results/quick.csv.json`."""
    file = Path(path)
    return file.with_name(file.name + ".json")


def read_sidecar(path: str | Path) -> dict[str, Any] | None:
    """Content of a result file's sidecar (dataset, method, settings), or None where there is none.

    Sidecars of earlier versions have the names of this one.

    Raises:
        DatasetError: the sidecar is not valid JSON; the message names file, line and column.
    """
    file = sidecar_path(path)
    if not file.is_file():
        return None
    content: dict[str, Any] = read_json(file)
    return migrated_keys(content, RENAMED)


def write_results(path: str | Path, estimates: Sequence[Estimate], sidecar: dict[str, Any] | None = None) -> None:
    """Write a result file atomically, in millimetres; the sidecar first, where given.

    Numbers have all their digits, as bop_toolkit writes them: an origin metres off the object is a long lever for a
    rounded rotation.
    """
    lines = [HEADER]
    for estimate in estimates:
        R = " ".join(map(repr, as_list(estimate.T_cam_obj[:3, :3])))
        t = " ".join(map(repr, as_list(estimate.T_cam_obj[:3, 3] / MM)))
        ids = f"{estimate.scene_id},{estimate.im_id},{estimate.obj_id}"
        lines.append(f"{ids},{estimate.score:.9g},{R},{t},{estimate.time_s:.9g}")
    if sidecar is not None:
        write_atomic(sidecar_path(path), (json.dumps(sidecar, indent=2) + "\n").encode())
    write_atomic(path, ("\n".join(lines) + "\n").encode())
