"""Annotations of every image: cameras, ground-truth poses, visibility; a faulty entry does not hide the others."""

from collections import Counter
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from jaxtyping import Float
from posecore import se3
from posecore.bop import BopDataset, GroundTruth, ModelInfo
from posecore.bop.annotations import camera_matrix, depth_scale, ground_truth, visib_fract
from posecore.bop.jsonfile import numbers
from posecore.bop.models_info import MM
from posecore.bop.results import POINT, Extent, in_metres
from posecore.bop.sources import Kind, scenes_of
from posecore.errors import DatasetError
from posecore.schema import shown

from evalkit.check.findings import Findings, Level

Image = tuple[int, int]
KINDS: tuple[Kind, ...] = ("camera", "gt", "gt_info")
ROUGH_ROTATION = 1e-3
"""Largest entry of R R^T - I without a finding; up to `ROTATION_TOLERANCE` it is a warning."""
FOCAL_RANGE = (0.2, 20.0)
"""Focal length in image sides: a view of 136 degrees, and one of 3."""


@dataclass(kw_only=True)
class Scenes:
    """Usable annotations of a split.

    Attributes:
        extents: of each object with a usable model.
        images: images with a camera, in order.
        instances: usable annotations of each image with ground truth.
        instance_counts: number of poses of each object in each image with ground truth.
        matrices: valid camera matrices by image.
    """

    extents: Mapping[int, Extent] = field(default_factory=dict)
    images: list[Image] = field(default_factory=list)
    instances: dict[Image, list[GroundTruth]] = field(default_factory=dict)
    instance_counts: dict[Image, Counter[int]] = field(default_factory=dict)
    matrices: dict[Image, Float[np.ndarray, "3 3"]] = field(default_factory=dict)

    def extent(self, obj_id: int) -> Extent:
        """Extent of an object, a point where it is unknown."""
        return self.extents.get(obj_id, POINT)

    def of_center(self, gt: GroundTruth) -> Float[np.ndarray, "4 4"]:
        """Pose of the object's centre; of the origin of an unknown object."""
        return se3.with_origin_at(gt.T_cam_obj, self.extent(gt.obj_id).center_m)


def check_scenes(
    dataset: BopDataset,
    infos: Mapping[int, ModelInfo],
    extents: Mapping[int, Extent],
    findings: Findings,
) -> Scenes:
    """Check every annotation of every scene."""
    scenes = Scenes(extents=extents)
    if not dataset.is_sharded:
        for folder, sensors in scenes_of(dataset.split_path).items():
            if not sensors:
                findings.add("error", "scene", str(folder), "found no scene_camera.json, expected one in every scene")
    for scene_id in dataset.scene_ids:
        entries = {kind: _entries(dataset, scene_id, kind, findings) for kind in KINDS}
        _check_keys(dataset, scene_id, entries, findings)
        for im_id, (entry, where) in entries["camera"].items():
            scenes.images.append((scene_id, im_id))
            _check_camera(entry, where, (scene_id, im_id), scenes, findings)
        for im_id, (entry, where) in entries["gt"].items():
            image = (scene_id, im_id)
            instances = _check_instances(entry, where, entries["gt_info"].get(im_id), infos, findings)
            for gt in instances:
                if gt.has_pose:
                    _check_pose(gt, scenes.of_center(gt)[2, 3] / MM, f"{where}, entry {gt.gt_index}", findings)
            scenes.instances[image] = instances
            scenes.instance_counts[image] = Counter(gt.obj_id for gt in instances if gt.has_pose)
        findings.cover("scenes")
        findings.cover("images", len(entries["camera"]))
        dataset.forget(scene_id)
    findings.cover("ground-truth poses", sum(len(instances) for instances in scenes.instances.values()))
    _check_units(dataset, scenes, findings)
    return scenes


def _entries(dataset: BopDataset, scene_id: int, kind: Kind, findings: Findings) -> dict[int, tuple[Any, str]]:
    try:
        im_ids = dataset.annotated_im_ids(scene_id, kind)
    except DatasetError as error:
        findings.add_error("json", error)
        return {}
    entries = {}
    for im_id in im_ids:
        try:
            annotation = dataset.entry(scene_id, im_id, kind)
        except DatasetError as error:
            findings.add_error("json", error)
            continue
        if annotation is not None:
            entries[im_id] = annotation
    return entries


def _check_keys(
    dataset: BopDataset, scene_id: int, entries: Mapping[Kind, Mapping[int, Any]], findings: Findings
) -> None:
    """Check that the three files list the same images."""
    rules: tuple[tuple[Kind, Kind, Level], ...] = (
        ("gt", "camera", "error"),
        ("gt", "gt_info", "error"),
        ("camera", "gt", "warning"),
    )
    for kind, other, level in rules:
        if not entries[kind] or not entries[other]:  # absent or reported already
            continue
        for im_id in sorted(set(entries[kind]) - set(entries[other])):
            message = f"found no image {im_id}, scene_{kind}.json has it"
            findings.add(level, "images-differ", dataset.annotation(scene_id, other), message)
    for im_id in sorted(set(entries["gt_info"]) - set(entries["gt"])):
        where = dataset.annotation(scene_id, "gt_info")
        findings.add("warning", "images-differ", where, f"has image {im_id}, which scene_gt.json has not")


def _check_camera(entry: Any, where: str, image: Image, scenes: Scenes, findings: Findings) -> None:
    try:
        K = camera_matrix(entry, where)
    except DatasetError as error:
        findings.add_error("camera", error)
    else:
        if K[0, 0] <= 0 or K[1, 1] <= 0 or abs(K[0, 1]) > 1e-9 or abs(K[2, 2] - 1) > 1e-9:
            message = f"'cam_K' is {K.reshape(-1).tolist()}, expected fx 0 cx 0 fy cy 0 0 1 with positive fx and fy"
            findings.add("error", "camera", where, message)
        else:
            scenes.matrices[image] = K
            if not 0.5 < K[0, 0] / K[1, 1] < 2:
                findings.add(
                    "warning", "camera", where, f"fx is {K[0, 0]:g} and fy {K[1, 1]:g}, expected about the same"
                )
    try:
        depth_scale(entry, where)
    except DatasetError as error:
        findings.add_error("depth-scale", error)
    if isinstance(entry, dict) and ("cam_R_w2c" in entry or "cam_t_w2c" in entry):
        try:
            R = numbers(entry, "cam_R_w2c", 9, where).reshape(3, 3)
            numbers(entry, "cam_t_w2c", 3, where)
        except DatasetError as error:
            findings.add_error("camera", error)
        else:
            if np.abs(R).max() > 2 or not bool(se3.is_rotation(R, ROUGH_ROTATION)):
                findings.add("warning", "camera", where, "'cam_R_w2c' is not a rotation (9 numbers by rows)")


def check_camera_size(K: Float[np.ndarray, "3 3"], size: tuple[int, int], where: str, findings: Findings) -> None:
    """Check a camera matrix against its image's width and height."""
    width, height = size
    focal = float(K[0, 0]) / max(width, height)
    if not FOCAL_RANGE[0] < focal < FOCAL_RANGE[1]:
        message = f"the focal length is {K[0, 0]:g} px in an image of {width} x {height}, expected {focal_words()}"
        findings.add("warning", "camera-size", where, message, "K of another image size?")
    if not (-0.5 * width < K[0, 2] < 1.5 * width and -0.5 * height < K[1, 2] < 1.5 * height):
        message = f"the principal point ({K[0, 2]:g}, {K[1, 2]:g}) is far outside the image of {width} x {height}"
        findings.add("warning", "camera-size", where, message, "K of another image size?")


def focal_words() -> str:
    """The focal lengths that pass, in words."""
    return f"{FOCAL_RANGE[0]:g} to {FOCAL_RANGE[1]:g} times the longer side"


def _check_instances(
    entries: Any, where: str, info: tuple[Any, str] | None, infos: Mapping[int, ModelInfo], findings: Findings
) -> list[GroundTruth]:
    if not isinstance(entries, list):
        findings.add("error", "ground-truth", where, f"found a {type(entries).__name__}, expected a list of objects")
        return []
    about: list[Any] = []
    if info is not None:
        if not isinstance(info[0], list) or len(info[0]) != len(entries):
            message = f"does not list the {len(entries)} objects of scene_gt.json in the same order"
            findings.add("error", "info-misaligned", info[1], message)
        else:
            about = info[0]
            for index, item in enumerate(about):
                _check_info(item, f"{info[1]}, entry {index}", findings)
    instances = []
    for index, entry in enumerate(entries):
        entry_where = f"{where}, entry {index}"
        visible_fraction = _visible_fraction(about[index]) if about else None
        try:
            gt = ground_truth(entry, index, visible_fraction, entry_where)
        except DatasetError as error:
            findings.add_error("ground-truth", error)
            continue
        instances.append(gt)
        if infos and gt.obj_id not in infos:
            listed = ", ".join(map(str, sorted(infos)))
            findings.add(
                "error", "unknown-object", entry_where, f"'obj_id' is {gt.obj_id}, models_info.json has {listed}"
            )
    _check_repeated(instances, where, findings)
    return instances


def _visible_fraction(entry: Any) -> float | None:
    try:
        return visib_fract(entry, "")
    except DatasetError:
        return None


def _check_pose(gt: GroundTruth, center_z_mm: float, where: str, findings: Findings) -> None:
    R = gt.T_cam_obj[:3, :3]
    if center_z_mm <= 0:
        message = f"the object's centre is at z = {center_z_mm:g} mm, expected a pose in front of the camera"
        findings.add("error", "behind-camera", where, message)
    residual = float(np.abs(R @ R.T - np.eye(3)).max())
    if residual > ROUGH_ROTATION:
        scale = float(np.linalg.det(R)) ** (1 / 3)
        message = f"'cam_R_m2c' is {residual:.2g} from orthonormal (scale {scale:.5f}), expected {ROUGH_ROTATION:g}"
        findings.add("warning", "rough-rotation", where, message, "it is used as it stands, as bop_toolkit does")


def _check_repeated(instances: list[GroundTruth], where: str, findings: Findings) -> None:
    seen: dict[tuple[int, bytes], int] = {}
    for gt in instances:
        if gt.has_pose:
            first = seen.setdefault((gt.obj_id, gt.T_cam_obj.tobytes()), gt.gt_index)
            if first != gt.gt_index:
                message = f"entries {first} and {gt.gt_index} are the same pose of object {gt.obj_id}"
                findings.add("warning", "repeated-ground-truth", where, message)


def _check_info(entry: Any, where: str, findings: Findings) -> None:
    try:
        visible_fraction = visib_fract(entry, where)
    except DatasetError as error:
        findings.add_error("visibility", error)
        return
    if visible_fraction is None:
        findings.add("warning", "visibility", where, "has no 'visib_fract'")
    counts = [entry.get(f"px_count_{name}") for name in ("all", "visib")]
    for box in ("bbox_obj", "bbox_visib"):
        if box in entry:
            try:
                numbers(entry, box, 4, where)
            except DatasetError as error:
                findings.add_error("visibility", error)
    if not all(isinstance(count, int) and not isinstance(count, bool) for count in counts):
        if any(count is not None for count in counts):
            findings.add("error", "visibility", where, f"pixel counts are {shown(counts)}, expected whole numbers")
        return
    every, visible = counts
    if not 0 <= visible <= every:
        message = f"'px_count_visib' is {visible} and 'px_count_all' {every}, expected 0 <= visible <= all"
        findings.add("error", "visibility", where, message)
    elif visible_fraction is not None and every and abs(visible_fraction - visible / every) > 1e-3:
        message = f"'visib_fract' is {visible_fraction:g}, expected {visible}/{every} = {visible / every:.4g}"
        findings.add("error", "visibility", where, message)


def _check_units(dataset: BopDataset, scenes: Scenes, findings: Findings) -> None:
    instances = [gt for listed in scenes.instances.values() for gt in listed if gt.has_pose]
    poses = np.array([gt.T_cam_obj for gt in instances]).reshape(-1, 4, 4)
    if in_metres(poses, [scenes.extent(gt.obj_id) for gt in instances]):
        median_mm = float(np.median(np.linalg.norm(poses[:, :3, 3], axis=1))) / MM
        message = f"the median length of t of {len(poses)} ground-truth poses is {median_mm:.4g} mm"
        findings.add("error", "units", str(dataset.split_path), message, "metres? BOP files hold millimetres")
