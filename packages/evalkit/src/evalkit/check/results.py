"""Result files against a dataset: format of every line, ids, times, counts, poses outside the view."""

import re
from collections import defaultdict
from collections.abc import Mapping
from pathlib import Path

import numpy as np
from jaxtyping import Bool
from posecore import se3
from posecore.bop import BopDataset, ResultTable, read_sidecar
from posecore.bop.models_info import MM
from posecore.bop.result_table import LineFault, parse_results
from posecore.bop.results import POINT, Extent, metres_fault, read_result_bytes, unknown_ids
from posecore.errors import PoseError, ResultFileError

from evalkit.check.annotations import ROUGH_ROTATION
from evalkit.check.findings import Findings
from evalkit.check.images import off_image_px

TIME_TOLERANCE_S = 1e-3
"""Largest difference between an image's times that bop_toolkit accepts."""
_NAME = re.compile(r"[^_]+_(?P<dataset>[^_-]+)-(?P<split>[^_-]+)(-[^_-]+)?(_.+)?\.csv")


def check_results(path: Path, dataset: BopDataset | None, extents: Mapping[int, Extent], findings: Findings) -> None:
    """Check a result file, and where `dataset` is given also against it; `extents` are of its usable models."""
    faults = 0

    def note(fault: LineFault) -> None:
        nonlocal faults
        faults += 1
        findings.add("error", f"line-{fault.field}", f"{path}:{fault.line}", fault.message)

    try:
        table = parse_results(read_result_bytes(path), str(path), note)
    except ResultFileError as error:
        findings.add_error("result-file", error)
        return
    findings.cover("result files")
    findings.cover("estimates", len(table))
    metres = metres_fault(table, extents)
    if metres is not None:
        findings.add("error", "units", f"{path}:{metres.line}", metres.message, "metres?")
    try:
        read_sidecar(path)
    except PoseError as error:
        findings.add_error("sidecar", error)
    if not len(table) and not faults:
        findings.add("warning", "no-estimates", str(path), "found no estimates, every target counts as missing")
    _check_repeated(path, table, findings)
    _check_times(path, table, findings)
    _check_scores(path, table, findings)
    _check_rotations(path, table, findings)
    if dataset is not None:
        _check_against(path, table, dataset, extents, findings)
    _check_name(path, dataset, findings)


def _check_repeated(path: Path, table: ResultTable, findings: Findings) -> None:
    ids = np.stack([table.scene_id, table.im_id, table.obj_id], axis=1)
    same = np.concatenate([ids.astype(np.float64), table.T_cam_obj[:, :3].reshape(-1, 12)], axis=1)
    _, first, group = np.unique(same, axis=0, return_index=True, return_inverse=True)
    firsts = first[group.reshape(-1)]
    for index in np.flatnonzero(firsts != np.arange(len(table))).tolist():
        message = f"repeats the estimate of line {int(table.line[firsts[index]])}"
        findings.add(
            "warning",
            "duplicate",
            f"{path}:{int(table.line[index])}",
            message,
            "it counts again if a target asks for it",
        )


def _check_times(path: Path, table: ResultTable, findings: Findings) -> None:
    if not len(table):
        return
    _, first, group = np.unique(
        np.stack([table.scene_id, table.im_id], axis=1), axis=0, return_index=True, return_inverse=True
    )
    group = group.reshape(-1)
    differs = np.abs(table.time_s - table.time_s[first][group]) > TIME_TOLERANCE_S
    for index in np.flatnonzero(differs).tolist():
        other = int(first[group[index]])
        message = (
            f"time is {table.time_s[index]:g}, line {int(table.line[other])} of the same image has "
            f"{table.time_s[other]:g}; it is the image's run time, or -1 in every line"
        )
        findings.add("error", "time", f"{path}:{int(table.line[index])}", message)
    negative = table.time_s < 0
    for index in np.flatnonzero(negative & (table.time_s != -1)).tolist():
        message = f"time is {table.time_s[index]:g}, expected seconds or -1 for unknown"
        findings.add("warning", "time", f"{path}:{int(table.line[index])}", message)
    if negative.any() and not negative.all():
        message = f"{int(negative.sum())} of {len(table)} lines have no time; bop_toolkit then reports none at all"
        findings.add("warning", "time", str(path), message)


def _check_scores(path: Path, table: ResultTable, findings: Findings) -> None:
    if not len(table):
        return
    low, high = float(table.score.min()), float(table.score.max())
    if low < 0 or high > 1:
        message = f"scores reach from {low:g} to {high:g}; any scale is allowed, 0 to 1 is usual"
        findings.add("hint", "score", str(path), message)
    keys = np.stack([table.scene_id, table.im_id, table.obj_id], axis=1)
    competing = len(np.unique(keys, axis=0)) < len(table)
    if competing and low == high:
        message = f"every score is {low:g}, so nothing decides between several estimates of an object"
        findings.add("warning", "score", str(path), message)


def _check_rotations(path: Path, table: ResultTable, findings: Findings) -> None:
    R = table.T_cam_obj[:, :3, :3]
    residual = np.abs(R @ np.swapaxes(R, 1, 2) - np.eye(3)).max(axis=(1, 2), initial=0.0)
    for index in np.flatnonzero(residual > ROUGH_ROTATION).tolist():
        message = f"R is {residual[index]:.2g} from orthonormal, expected {ROUGH_ROTATION:g} at most"
        hint = "write more decimals; it is used as it stands, as bop_toolkit does"
        findings.add("warning", "rough-rotation", f"{path}:{int(table.line[index])}", message, hint)


def _check_against(
    path: Path, table: ResultTable, dataset: BopDataset, extents: Mapping[int, Extent], findings: Findings
) -> None:
    try:
        unknown = unknown_ids(table, dataset)
    except PoseError as error:  # the dataset's own fault, reported with it
        findings.add_error("result-ids", error)
        return
    for fault in unknown:
        findings.add("error", f"line-{fault.field}", f"{path}:{fault.line}", fault.message)
    is_valid = ~np.isin(table.line, [fault.line for fault in unknown])
    _check_counts(path, table, dataset, findings)
    _check_poses(path, table, is_valid, dataset, extents, findings)


def _check_counts(path: Path, table: ResultTable, dataset: BopDataset, findings: Findings) -> None:
    """Against localisation targets: missing estimates are failures; surplus ones, lowest scores first, are ignored."""
    try:
        targets = dataset.targets
    except PoseError:  # reported with the dataset
        return
    lines: dict[tuple[int, int, int], list[int]] = defaultdict(list)
    ids = zip(table.scene_id.tolist(), table.im_id.tolist(), table.obj_id.tolist(), strict=True)
    for index, key in enumerate(ids):
        lines[key].append(index)
    counts = {(target.scene_id, target.im_id, target.obj_id): target.inst_count for target in targets}
    for key, count in counts.items():
        count_in_file = len(lines.get(key, ()))
        if count_in_file < count:
            message = f"found {count_in_file} of {count} estimates of object {key[2]} in scene {key[0]}, image {key[1]}"
            findings.add("warning", "missing", str(path), message, "missing estimates count as failures")
    for key, indices in lines.items():
        count = counts.get(key, 0)
        by_score = sorted(indices, key=lambda index: -table.score[index])
        for index in sorted(by_score[count:]):
            asked = f"the targets ask for {count} of object {key[2]} here" if count else "no target asks for it"
            findings.add("warning", "superfluous", f"{path}:{int(table.line[index])}", asked, "it is ignored")


def _check_poses(
    path: Path,
    table: ResultTable,
    is_valid: Bool[np.ndarray, " n"],
    dataset: BopDataset,
    extents: Mapping[int, Extent],
    findings: Findings,
) -> None:
    """Poses behind the camera or outside the image."""
    points_m = np.array([extents.get(i, POINT).center_m for i in table.obj_id.tolist()]).reshape(-1, 3)
    T_cam_center = se3.with_origin_at(table.T_cam_obj, points_m)
    behind = is_valid & (T_cam_center[:, 2, 3] <= 0)
    for index in np.flatnonzero(behind).tolist():
        message = f"the object's centre is at z = {T_cam_center[index, 2, 3] / MM:.6g} mm, behind the camera"
        findings.add("warning", "behind-camera", f"{path}:{int(table.line[index])}", message)
    indices = np.flatnonzero(is_valid & ~behind)
    if not len(indices):
        return
    images = np.stack([table.scene_id[indices], table.im_id[indices]], axis=1)
    unique, group = np.unique(images, axis=0, return_inverse=True)
    by_image = np.argsort(group.reshape(-1), kind="stable")
    bounds = np.searchsorted(group.reshape(-1)[by_image], np.arange(len(unique) + 1))
    diameters = {obj_id: info.diameter_m for obj_id, info in dataset.models_info.items()}
    off_px = np.zeros(len(table))
    for number, (scene_id, im_id) in enumerate(unique.tolist()):
        here = indices[by_image[bounds[number] : bounds[number + 1]]]
        try:
            camera = dataset.camera(scene_id, im_id)
        except PoseError:  # reported with the dataset
            continue
        reach_m = np.array([diameters[obj_id] for obj_id in table.obj_id[here].tolist()])
        off_px[here] = off_image_px(T_cam_center[here], camera.K, (camera.width_px, camera.height_px), reach_m)
    for index in np.flatnonzero(off_px > 0).tolist():
        message = f"object {int(table.obj_id[index])} lies at least {off_px[index]:.0f} px outside its image"
        findings.add("warning", "off-image", f"{path}:{int(table.line[index])}", message)


def _check_name(path: Path, dataset: BopDataset | None, findings: Findings) -> None:
    match = _NAME.fullmatch(path.name)
    if match is None:
        message = "its name is not METHOD_DATASET-SPLIT.csv, which the BOP server asks for"
        findings.add("hint", "file-name", str(path), message)
    elif dataset is not None and match["dataset"] != dataset.name:
        message = f"its name has the dataset {match['dataset']}, the folder is {dataset.name}"
        findings.add("hint", "file-name", str(path), message)
