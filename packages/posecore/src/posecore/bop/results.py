"""BOP result files: `scene_id,im_id,obj_id,score,R,t,time`, millimetres, one estimate a line, with a JSON sidecar."""

import json
import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float

from posecore import se3
from posecore.bop.dataset import BopDataset
from posecore.bop.jsonfile import read_json
from posecore.bop.models_info import MM, ROTATION_TOLERANCE
from posecore.errors import ResultFileError
from posecore.files import write_atomic

Array = np.ndarray
HEADER = "scene_id,im_id,obj_id,score,R,t,time"
SUSPICIOUS_DISTANCE_MM = 10.0


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
    T_cam_obj: Float[Array, "4 4"]
    time_s: float = -1.0
    line: int = 0


def read_results(path: str | Path, dataset: BopDataset | None = None) -> list[Estimate]:
    """Read a result file, with or without the header line.

    Args:
        path: CSV file; translations in millimetres.
        dataset: where given, scenes, images and objects that it does not have are errors.

    Raises:
        ResultFileError: missing or empty file, a line that breaks the format, NaN, a scaled or mirrored rotation, an
            unknown id, translations that look like metres. The message names file and line.
    """
    file = Path(path)
    try:
        text = file.read_text(encoding="utf-8-sig")
    except OSError as error:
        raise ResultFileError(f"{file}: cannot be read ({error.strerror}); give a BOP result file (CSV)") from error
    except UnicodeDecodeError as error:
        raise ResultFileError(f"{file}: not UTF-8 text (byte {error.start}); give a BOP result file (CSV)") from error
    estimates = []
    for number, line in enumerate(text.split("\n"), start=1):
        stripped = line.strip()
        if not stripped or (number == 1 and stripped.replace(" ", "") == HEADER):
            continue
        estimates.append(_estimate(stripped, number, f"{file}:{number}"))
    if not estimates:
        raise ResultFileError(f"{file}: no estimates in it, expected lines of {HEADER}")
    _refuse_metres(estimates, file)
    if dataset is not None:
        _refuse_unknown_ids(estimates, dataset, file)
    return estimates


def _estimate(line: str, number: int, where: str) -> Estimate:
    fields = line.split(",")
    if len(fields) != 7:
        raise ResultFileError(f"{where}: found {len(fields)} fields, expected the 7 of {HEADER}")
    scene_id, im_id, obj_id = (_id(fields[i], HEADER.split(",")[i], where) for i in range(3))
    score, time_s = _floats(fields[3], 1, "score", where)[0], _floats(fields[6], 1, "time", where)[0]
    R, t_mm = _floats(fields[4], 9, "R", where).reshape(3, 3), _floats(fields[5], 3, "t", where)
    _refuse_improper(R, where)
    T_cam_obj = se3.make_T(R, t_mm * MM)
    return Estimate(
        scene_id=scene_id,
        im_id=im_id,
        obj_id=obj_id,
        score=float(score),
        T_cam_obj=T_cam_obj,
        time_s=float(time_s),
        line=number,
    )


def _id(text: str, name: str, where: str) -> int:
    digits = text.strip()
    if not (digits.isascii() and digits.isdigit()):
        raise ResultFileError(f"{where}: {name} is '{_short(text)}', expected a whole number")
    return int(digits)


def _floats(text: str, count: int, name: str, where: str) -> Float[Array, " n"]:
    try:
        values = np.array([float(part) for part in text.split()], dtype=np.float64)
    except ValueError as error:
        raise ResultFileError(f"{where}: {name} is '{_short(text)}', expected {count} number(s)") from error
    if len(values) != count:
        raise ResultFileError(f"{where}: {name} has {len(values)} numbers, expected {count} separated by spaces")
    if not np.isfinite(values).all():
        raise ResultFileError(f"{where}: {name} holds NaN or infinity; leave the line out where there is no estimate")
    return values


def _refuse_improper(R: Float[Array, "3 3"], where: str) -> None:
    if bool(se3.is_rotation(R, ROTATION_TOLERANCE)):
        return
    determinant = float(np.linalg.det(R))
    scale = math.copysign(abs(determinant) ** (1 / 3), determinant) if math.isfinite(determinant) else math.nan
    if scale < 0:
        found = "mirrored (determinant below 0)"
    elif scale > 0 and bool(se3.is_rotation(R / scale, ROTATION_TOLERANCE)):
        found = f"scaled by {scale:.4g}"
    else:
        found = f"not orthonormal (determinant {determinant:.4g})"
    raise ResultFileError(f"{where}: R is {found}, expected a rotation, 9 numbers by rows")


def _refuse_metres(estimates: Sequence[Estimate], file: Path) -> None:
    median_mm = float(np.median([abs(estimate.T_cam_obj[2, 3]) / MM for estimate in estimates]))
    if median_mm < SUSPICIOUS_DISTANCE_MM:
        raise ResultFileError(
            f"{file}:{estimates[0].line}: the median t_z of the file is {median_mm:.4g}, which looks like metres; "
            "BOP result files hold millimetres, multiply t by 1000"
        )


def _refuse_unknown_ids(estimates: Sequence[Estimate], dataset: BopDataset, file: Path) -> None:
    objects = set(dataset.obj_ids)
    images = {scene_id: set(dataset.im_ids(scene_id)) for scene_id in dataset.scene_ids}
    for estimate in estimates:
        where = f"{file}:{estimate.line}"
        if estimate.scene_id not in images:
            raise ResultFileError(f"{where}: scene {estimate.scene_id} is not in {dataset.split_path}")
        if estimate.im_id not in images[estimate.scene_id]:
            scene = dataset.scene_path(estimate.scene_id)
            raise ResultFileError(f"{where}: image {estimate.im_id} has no ground truth in {scene / 'scene_gt.json'}")
        if estimate.obj_id not in objects:
            known = ", ".join(map(str, sorted(objects)))
            raise ResultFileError(f"{where}: object {estimate.obj_id} is unknown, {dataset.name} has {known}")


def sidecar_path(path: str | Path) -> Path:
    """The JSON beside a result file: `results/quick.csv` has `results/quick.csv.json`."""
    file = Path(path)
    return file.with_name(file.name + ".json")


def read_sidecar(path: str | Path) -> dict[str, Any] | None:
    """What a result file's sidecar says (dataset, method, settings), or None where there is none.

    Raises:
        DatasetError: the sidecar is not valid JSON; the message names file, line and column.
    """
    file = sidecar_path(path)
    if not file.is_file():
        return None
    content: dict[str, Any] = read_json(file)
    return content


def write_results(path: str | Path, estimates: Sequence[Estimate], sidecar: dict[str, Any] | None = None) -> None:
    """Write a result file atomically, millimetres with nine decimals; the sidecar first, where given."""
    lines = [HEADER]
    for estimate in estimates:
        R = " ".join(f"{value:.9f}" for value in estimate.T_cam_obj[:3, :3].reshape(-1))
        t = " ".join(f"{value:.9f}" for value in estimate.T_cam_obj[:3, 3] / MM)
        ids = f"{estimate.scene_id},{estimate.im_id},{estimate.obj_id}"
        lines.append(f"{ids},{estimate.score:.9g},{R},{t},{estimate.time_s:.9g}")
    if sidecar is not None:
        write_atomic(sidecar_path(path), (json.dumps(sidecar, indent=2) + "\n").encode())
    write_atomic(path, ("\n".join(lines) + "\n").encode())


def _short(text: str) -> str:
    return text.strip().replace("\n", " ")[:40]
