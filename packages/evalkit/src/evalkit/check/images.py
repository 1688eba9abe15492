"""Images, depth and masks: present, decodable, of equal size, and consistent with the annotations."""

from collections.abc import Mapping

import numpy as np
from jaxtyping import Float
from posecore.bop import BopDataset, GroundTruth, ModelInfo
from posecore.bop.images import image_size, read_depth, read_rgb
from posecore.bop.models_info import MM
from posecore.bop.sources import MaskKind
from posecore.camera import project
from posecore.errors import DatasetError

from evalkit.check.annotations import Image, Scenes, check_camera_size
from evalkit.check.findings import Findings

Size = tuple[int, int]
MASK_KINDS: tuple[MaskKind, ...] = ("mask", "mask_visib")
CLEARLY_VISIBLE = 0.3
DEPTH_RATIO = (0.5, 2.0)
"""Median over an image of depth / z at the objects' centres: outside this range the depth scale is wrong."""


def check_images(
    dataset: BopDataset, scenes: Scenes, infos: Mapping[int, ModelInfo], samples: int, findings: Findings
) -> list[Image]:
    """Check that every image is present and decode a sample, spread evenly; returns the sample."""
    there = [image for image in scenes.images if _is_there(dataset, image, findings)]
    chosen = spread(there, samples)
    without_depth, without_masks = [], []
    for image in chosen:
        try:
            size = _check_colour(dataset, image, findings)
        except DatasetError as error:
            findings.add_error("image", error)
            continue
        where = f"{dataset.annotation(image[0], 'camera')}, image {image[1]}"
        if image in scenes.matrices:
            check_camera_size(scenes.matrices[image], size, where, findings)
        instances = [gt for gt in scenes.instances.get(image, []) if gt.has_pose]
        _check_on_image(dataset, image, size, instances, scenes, infos, findings)
        if not _check_depth(dataset, image, size, instances, scenes, findings):
            without_depth.append(image)
        if scenes.instances.get(image) and not _check_masks(dataset, image, size, scenes.instances[image], findings):
            without_masks.append(image)
    findings.cover("images decoded", len(chosen))
    _report_some_without(dataset, "depth", without_depth, len(chosen), findings)
    _report_some_without(dataset, "mask", without_masks, sum(bool(scenes.instances.get(i)) for i in chosen), findings)
    return chosen


def spread(images: list[Image], samples: int) -> list[Image]:
    """At most `samples` images, evenly spaced from the first to the last."""
    if len(images) <= samples:
        return images
    return [images[index] for index in np.linspace(0, len(images) - 1, samples).round().astype(int).tolist()]


def _is_there(dataset: BopDataset, image: Image, findings: Findings) -> bool:
    try:
        dataset.image_file(*image)
    except DatasetError as error:
        findings.add_error("image-missing", error)
        return False
    return True


def _check_colour(dataset: BopDataset, image: Image, findings: Findings) -> Size:
    file = dataset.image_file(*image)
    rgb = read_rgb(file)
    size = (rgb.shape[1], rgb.shape[0])
    stated = image_size(file)
    if stated != size:
        findings.add("error", "image", str(file), f"is {_words(size)} pixels, its header states {_words(stated)}")
    if rgb.max() == rgb.min():
        findings.add("warning", "image-blank", str(file), f"every pixel is {rgb[0, 0].tolist()}, expected a picture")
    return size


def _words(size: Size) -> str:
    return f"{size[0]} x {size[1]}"


def _check_on_image(
    dataset: BopDataset,
    image: Image,
    size: Size,
    instances: list[GroundTruth],
    scenes: Scenes,
    infos: Mapping[int, ModelInfo],
    findings: Findings,
) -> None:
    if image not in scenes.matrices:
        return
    visible = [gt for gt in instances if gt.visib_fract is None or gt.visib_fract > CLEARLY_VISIBLE]
    visible = [gt for gt in visible if gt.obj_id in infos]
    if not visible:
        return
    T_cam_center = np.stack([scenes.of_center(gt) for gt in visible])
    reach_m = np.array([infos[gt.obj_id].diameter_m for gt in visible])
    for gt, off_px in zip(visible, off_image_px(T_cam_center, scenes.matrices[image], size, reach_m), strict=True):
        if off_px > 0:
            where = f"{dataset.annotation(image[0], 'gt')}, image {image[1]}, entry {gt.gt_index}"
            message = f"object {gt.obj_id} lies at least {off_px:.0f} px outside the image of {_words(size)}"
            findings.add("error", "off-image", where, message, "K or the pose is of another image?")


def off_image_px(
    T_cam_center: Float[np.ndarray, "n 4 4"], K: Float[np.ndarray, "3 3"], size: Size, reach_m: Float[np.ndarray, " n"]
) -> Float[np.ndarray, " n"]:
    """Distance of objects from the image in pixels, 0 where they may touch it.

    Args:
        T_cam_center: poses of the objects' centres, metres; one close to the camera or behind it counts as touching.
        K: camera matrix.
        size: width and height of the image, pixels.
        reach_m: largest distance of the object's points from its centre.
    """
    z_m = T_cam_center[:, 2, 3]
    is_far = z_m > 2 * reach_m
    uv = project(K, np.where(is_far[:, None], T_cam_center[:, :3, 3], [0.0, 0.0, 1.0]))
    outside = np.maximum(-uv, uv - np.array(size)).max(axis=1)
    reach_px = max(K[0, 0], K[1, 1]) * reach_m / np.where(is_far, z_m - reach_m, 1.0) * 2
    return np.where(is_far, np.maximum(outside - reach_px, 0.0), 0.0)


def _check_depth(
    dataset: BopDataset, image: Image, size: Size, instances: list[GroundTruth], scenes: Scenes, findings: Findings
) -> bool:
    file = dataset.depth_file(*image)
    if file is None:
        return False
    try:
        raw = read_depth(file)
        scale = dataset.depth_scale(*image)
    except DatasetError as error:
        findings.add_error("depth", error)
        return True
    if (raw.shape[1], raw.shape[0]) != size:
        message = f"is {raw.shape[1]} x {raw.shape[0]} pixels, the colour image {_words(size)}"
        findings.add("error", "depth", str(file), message)
        return True
    if raw.dtype != np.uint16 and raw.dtype.kind != "f":
        findings.add("warning", "depth", str(file), f"holds {raw.dtype} numbers, expected 16 bits")
    depth_m = np.asarray(raw, np.float64) * (scale * MM)
    wrong = ~np.isfinite(depth_m) | (depth_m < 0)
    if wrong.any():
        message = f"{int(wrong.sum())} pixels are NaN, infinite or negative, expected 0 where depth is unknown"
        findings.add("warning", "depth", str(file), message)
        depth_m[wrong] = 0
    if not (depth_m > 0).any():
        findings.add("warning", "depth", str(file), "is 0 everywhere")
    elif image in scenes.matrices:
        _check_depth_scale(str(file), depth_m, scale, instances, scenes, scenes.matrices[image], findings)
    return True


def _check_depth_scale(
    where: str,
    depth_m: Float[np.ndarray, "h w"],
    scale: float,
    instances: list[GroundTruth],
    scenes: Scenes,
    K: Float[np.ndarray, "3 3"],
    findings: Findings,
) -> None:
    ratios = []
    for gt in instances:
        center_m = scenes.of_center(gt)[:3, 3]
        z_m = float(center_m[2])
        if z_m <= 0 or (gt.visib_fract is not None and gt.visib_fract < CLEARLY_VISIBLE):
            continue
        column, row = (int(value) for value in np.floor(project(K, center_m[None])[0]))
        if 0 <= row < depth_m.shape[0] and 0 <= column < depth_m.shape[1] and depth_m[row, column] > 0:
            ratios.append(depth_m[row, column] / z_m)
    if ratios and not DEPTH_RATIO[0] < float(np.median(ratios)) < DEPTH_RATIO[1]:
        median = float(np.median(ratios))
        message = (
            f"depth is {median:.4g} times that of the objects' centres, expected about 1 ('depth_scale' is {scale:g})"
        )
        findings.add("error", "depth-scale", where, message, f"is the scale {scale / median:.3g} mm?")


def _check_masks(
    dataset: BopDataset, image: Image, size: Size, instances: list[GroundTruth], findings: Findings
) -> bool:
    """Check an image's masks; False where it has none of any kind."""
    info = _pixel_counts(dataset, image)
    has_any = False
    for kind in MASK_KINDS:
        missing = []
        for gt in instances:
            try:
                mask_and_where = dataset.mask_and_location(*image, gt.gt_index, kind)
            except DatasetError as error:
                findings.add_error("mask", error)
                has_any = True
                continue
            if mask_and_where is None:
                missing.append(gt.gt_index)
                continue
            has_any = True
            mask, where = mask_and_where
            if (mask.shape[1], mask.shape[0]) != size:
                message = f"is {mask.shape[1]} x {mask.shape[0]} pixels, the image {_words(size)}"
                findings.add("error", "mask", where, message)
                continue
            stated_count = info.get(gt.gt_index)
            if kind == "mask_visib" and stated_count is not None and stated_count != int(mask.sum()):
                message = f"has {int(mask.sum())} pixels, 'px_count_visib' of scene_gt_info.json is {stated_count}"
                findings.add("warning", "mask", where, message)
        if missing and len(missing) < len(instances):
            where = f"{dataset.scene_path(image[0])}, image {image[1]}"
            listed = ", ".join(map(str, missing))
            findings.add("error", "mask-missing", where, f"found no {kind} of entries {listed}, the others have one")
    return has_any


def _pixel_counts(dataset: BopDataset, image: Image) -> dict[int, int]:
    try:
        entry = dataset.entry(*image, "gt_info")
    except DatasetError:
        return {}
    entries = entry[0] if entry is not None and isinstance(entry[0], list) else []
    counts = {index: e.get("px_count_visib") for index, e in enumerate(entries) if isinstance(e, dict)}
    return {index: count for index, count in counts.items() if isinstance(count, int)}


def _report_some_without(
    dataset: BopDataset, what: str, without: list[Image], checked: int, findings: Findings
) -> None:
    """Report images without depth or masks where other images have them."""
    if len(without) == checked:
        return
    for scene_id, im_id in without:
        where = f"{dataset.scene_path(scene_id)}, image {im_id}"
        findings.add("warning", f"{what}-missing", where, f"found no {what}, other images have one")
