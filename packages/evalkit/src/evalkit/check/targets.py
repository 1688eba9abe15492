"""Targets: each one exists, and its count does not exceed the ground truth."""

from pathlib import Path
from typing import Any

from posecore.bop import BopDataset
from posecore.bop.jsonfile import integer, read_json
from posecore.errors import DatasetError

from evalkit.check.annotations import Scenes
from evalkit.check.findings import Findings

EDITIONS = ("bop19", "bop24")


def check_targets(dataset: BopDataset, scenes: Scenes, objects: set[int], findings: Findings) -> None:
    """Check the split's targets files."""
    for edition in EDITIONS:
        file = dataset.targets_file(edition)
        if file is None:
            continue
        try:
            entries = read_json(file, list)
        except DatasetError as error:
            findings.add_error("json", error)
            continue
        _check_entries(file, entries, dataset, scenes, objects, findings)
        findings.cover(f"{edition} targets", len(entries))


def _check_entries(
    file: Path, entries: list[Any], dataset: BopDataset, scenes: Scenes, objects: set[int], findings: Findings
) -> None:
    images, scene_ids, seen = set(scenes.images), set(dataset.scene_ids), dict[tuple[int, int, int], int]()
    for index, entry in enumerate(entries):
        where = f"{file}, entry {index}"
        try:
            scene_id, im_id = integer(entry, "scene_id", where), integer(entry, "im_id", where)
            obj_id = integer(entry, "obj_id", where) if "obj_id" in entry else -1
            count = integer(entry, "inst_count", where) if "inst_count" in entry else 1
        except DatasetError as error:
            findings.add_error("target", error)
            continue
        image = (scene_id, im_id)
        first = seen.setdefault((*image, obj_id), index)
        if first != index:
            findings.add("error", "target", where, f"repeats entry {first}; remove either")
        elif scene_id not in scene_ids:
            findings.add("error", "target", where, f"scene {scene_id} is not in {dataset.split_path}", "download it")
        elif image not in images and image not in scenes.instances:
            findings.add("error", "target", where, f"scene {scene_id} has no image {im_id}")
        elif obj_id >= 0:
            _check_count(where, image, obj_id, count, scenes, objects, findings)


def _check_count(
    where: str, image: tuple[int, int], obj_id: int, count: int, scenes: Scenes, objects: set[int], findings: Findings
) -> None:
    if objects and obj_id not in objects:
        findings.add("error", "target", where, f"'obj_id' is {obj_id}, which models_info.json does not list")
    if count < 1:
        findings.add("error", "target", where, f"'inst_count' is {count}, expected 1 or more")
    if image not in scenes.instances:  # ground truth that is not public
        return
    annotated = scenes.instance_counts[image][obj_id]
    if count > annotated:
        message = f"asks for {count} of object {obj_id}, scene_gt.json has {annotated} in image {image[1]}"
        findings.add("error", "target", where, message)
