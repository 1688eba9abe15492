"""Initial poses for refinement: ground truth rotated and translated by known amounts, as a result file."""

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float

from posecore import se3
from posecore.bop.dataset import BopDataset, BopTarget, GroundTruth
from posecore.bop.results import Estimate, write_results
from posecore.errors import ConfigError

INITIAL_METHOD = "initial"
"""`method` in the sidecar of a file of initial poses."""


@dataclass(frozen=True, kw_only=True)
class Level:
    """Perturbation of an initial pose: its distance from the ground truth."""

    angle_deg: float
    translation_diameter: float


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

    A pose is rotated by its angle about a random axis through the object's centre (in camera axes) and translated by
    its length in a random direction. The draws depend on the seed, the target's ids and the previous levels.

    Args:
        dataset: with ground truth.
        out: result file.
        levels: levels for every target, one line each.
        seed: of all draws.
        random_up_to: one more line for each target, angle and length drawn uniformly from 0 up to these; None for none.
        depth_stretch: factor on the random line's translation along the viewing ray; its level is the stretched one.
        protocol: name of the published experiment that the levels are of, for the sidecar.
        obj_ids: objects to take, None for all.
        program: name and version of the program that writes the file, for the sidecar.

    Raises:
        ConfigError: there are no levels, or an initial pose would lie behind the camera.
    """
    if not levels and random_up_to is None:
        raise ConfigError("levels and random_up_to: found neither, expected one at least")
    estimates: list[Estimate] = []
    rows: list[dict[str, Any]] = []
    for target in (target for target in dataset.targets if obj_ids is None or target.obj_id in obj_ids):
        diameter_m = dataset.models_info[target.obj_id].diameter_m
        center_m = dataset.center_m(target.obj_id)
        for gt in dataset.instances(target):
            rng = np.random.default_rng([seed, target.scene_id, target.im_id, target.obj_id, gt.gt_index])
            drawn = [_drawn(random_up_to, rng)] if random_up_to else []
            for number, level in enumerate([*levels, *drawn]):
                random = number >= len(levels)
                T_gt = se3.with_origin_at(gt.T_cam_obj, center_m)
                T = se3.perturb(T_gt, float(np.deg2rad(level.angle_deg)), level.translation_diameter * diameter_m, rng)
                if random and depth_stretch != 1:
                    T, level = _stretched(T, T_gt, target, level, diameter_m, depth_stretch)
                estimates.append(_estimate(target, se3.with_origin_at(T, -center_m)))
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


def _estimate(target: BopTarget, T_cam_obj: Float[np.ndarray, "4 4"]) -> Estimate:
    return Estimate(scene_id=target.scene_id, im_id=target.im_id, obj_id=target.obj_id, T_cam_obj=np.asarray(T_cam_obj))


def _stretched(
    initial: Float[np.ndarray, "4 4"],
    T_gt: Float[np.ndarray, "4 4"],
    target: BopTarget,
    level: Level,
    diameter_m: float,
    factor: float,
) -> tuple[Float[np.ndarray, "4 4"], Level]:
    """The initial pose of the centre with its depth error times a factor, and its level."""
    T = se3.stretched_along_ray(T_gt, initial, factor)
    if T[2, 3] <= 0:
        raise ConfigError(
            f"depth_stretch {factor:g}: puts object {target.obj_id} of image {target.im_id}, "
            f"scene {target.scene_id}, behind the camera; lower it or random_up_to.translation_diameter"
        )
    distance_diameter = float(np.linalg.norm(T[:3, 3] - T_gt[:3, 3])) / diameter_m
    return T, replace(level, translation_diameter=distance_diameter)


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
