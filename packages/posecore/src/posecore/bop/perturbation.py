"""Initial poses for refinement: ground truth rotated and translated by known amounts, as a result file."""

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from posecore import se3
from posecore.bop.dataset import BopDataset, BopTarget, GroundTruth
from posecore.bop.results import Estimate, write_results
from posecore.errors import ConfigError, DatasetError

INITIAL_METHOD = "initial"
"""`method` in the sidecar of a file of initial poses."""


@dataclass(frozen=True, kw_only=True)
class Level:
    """Perturbation of an initial pose: its distance from the ground truth."""

    angle_deg: float
    translation_diameter: float


def instances_of(dataset: BopDataset, target: BopTarget) -> list[GroundTruth]:
    """Annotated instances of a target with a pose, the most visible first.

    Raises:
        DatasetError: there is none.
    """
    instances = [gt for gt in dataset.gt(target.scene_id, target.im_id) if gt.obj_id == target.obj_id and gt.has_pose]
    if not instances:
        scene = dataset.scene_path(target.scene_id)
        raise DatasetError(
            f"{scene / 'scene_gt.json'}: image {target.im_id} has no pose of object {target.obj_id}, "
            "which the targets ask for"
        )
    return sorted(instances, key=lambda gt: -(1.0 if gt.visib_fract is None else gt.visib_fract))


def perturb_dataset(
    dataset: BopDataset,
    out: Path,
    *,
    levels: Sequence[Level],
    seed: int,
    random_up_to: Level | None = None,
    depth_stretch: float = 1.0,
    protocol: str | None = None,
    obj_ids: Collection[int] | None = None,
    program: Mapping[str, str] | None = None,
) -> int:
    """Write initial poses for every target, and in the sidecar the level of every line; the number of lines.

    A pose is rotated by exactly its angle about a random axis through the object's origin (in camera axes) and
    translated by exactly its length in a random direction. The draws depend on the seed, the target's ids and the
    previous levels.

    Args:
        dataset: with ground truth.
        out: result file.
        levels: levels for every target, one line each.
        seed: of all draws.
        random_up_to: one more line for each target, angle and length drawn uniformly from 0 up to these; None for none.
        depth_stretch: factor on the random line's translation along the viewing ray; its level is the stretched one.
        protocol: name of the published experiment that the levels are of, for the sidecar.
        obj_ids: objects to take, None for all; the poses of the others do not depend on it.
        program: name and version of the program that writes the file, for the sidecar.

    Raises:
        ConfigError: there are no levels, or an initial pose would lie behind the camera.
    """
    if not levels and random_up_to is None:
        raise ConfigError(
            "no levels: give --angles 5,10,15 or --translations 0.1,0.2 or --random-up-to 20 or --protocol paper"
        )
    estimates: list[Estimate] = []
    rows: list[dict[str, Any]] = []
    for target in (target for target in dataset.targets if obj_ids is None or target.obj_id in obj_ids):
        diameter_m = dataset.models_info[target.obj_id].diameter_m
        for gt in instances_of(dataset, target)[: target.inst_count]:
            rng = np.random.default_rng([seed, target.scene_id, target.im_id, target.obj_id, gt.gt_index])
            drawn = [_drawn(random_up_to, rng)] if random_up_to else []
            for number, level in enumerate([*levels, *drawn]):
                random = number >= len(levels)
                initial = _perturbed(target, gt, level, diameter_m, rng)
                if random and depth_stretch != 1:
                    initial, level = _stretched(initial, gt, level, diameter_m, depth_stretch)
                estimates.append(initial)
                rows.append(_sidecar_row(len(estimates) + 1, target, gt, level) | {"random": random})
    sidecar = {
        "dataset": str(dataset.root.resolve()),
        "split": dataset.split,
        "method": INITIAL_METHOD,
        "settings": {"seed": seed, "depth_stretch": depth_stretch, **(program or {})},
        "perturbation": ({} if protocol is None else {"protocol": protocol}) | {"rows": rows},
    }
    write_results(out, estimates, sidecar)
    return len(estimates)


def _drawn(limit: Level, rng: np.random.Generator) -> Level:
    return Level(
        angle_deg=float(rng.uniform(0.0, limit.angle_deg)),
        translation_diameter=float(rng.uniform(0.0, limit.translation_diameter)),
    )


def _perturbed(
    target: BopTarget, gt: GroundTruth, level: Level, diameter_m: float, rng: np.random.Generator
) -> Estimate:
    distance_m = level.translation_diameter * diameter_m
    return Estimate(
        scene_id=target.scene_id,
        im_id=target.im_id,
        obj_id=target.obj_id,
        T_cam_obj=se3.perturb(gt.T_cam_obj, float(np.deg2rad(level.angle_deg)), distance_m, rng),
    )


def _stretched(
    initial: Estimate, gt: GroundTruth, level: Level, diameter_m: float, factor: float
) -> tuple[Estimate, Level]:
    """The initial pose with its depth error times a factor, and its level."""
    T = se3.stretched_along_ray(gt.T_cam_obj, initial.T_cam_obj, factor)
    if T[2, 3] <= 0:
        raise ConfigError(
            f"--depth-stretch {factor:g}: puts object {initial.obj_id} of image {initial.im_id}, "
            f"scene {initial.scene_id}, behind the camera; lower it or --random-translation"
        )
    distance_diameter = float(np.linalg.norm(T[:3, 3] - gt.T_cam_obj[:3, 3])) / diameter_m
    return replace(initial, T_cam_obj=T), replace(level, translation_diameter=distance_diameter)


def _sidecar_row(line: int, target: BopTarget, gt: GroundTruth, level: Level) -> dict[str, Any]:
    return {
        "line": line,
        "scene_id": target.scene_id,
        "im_id": target.im_id,
        "obj_id": target.obj_id,
        "gt_index": gt.gt_index,
        "angle_deg": level.angle_deg,
        "translation_diameter": level.translation_diameter,
    }
