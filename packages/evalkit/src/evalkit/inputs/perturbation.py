"""Initial poses at known rotations and translations from the ground truth, for convergence curves."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float
from posecore import se3
from posecore.bop import BopDataset, BopTarget, Estimate, GroundTruth, write_results
from posecore.errors import ConfigError

from evalkit import __version__
from evalkit.inputs.pairing import Level, instances_of
from evalkit.inputs.result_files import INITIAL_METHOD


@dataclass(frozen=True, kw_only=True)
class Protocol:
    """A published experiment: its levels, and its number of refinement iterations.

    Attributes:
        angles_deg: one initial pose for each, not translated.
        translations_diameter: one initial pose for each, not rotated.
        iterations: of the refiner.
        source: publication.
    """

    angles_deg: tuple[float, ...]
    translations_diameter: tuple[float, ...]
    iterations: int
    source: str


PROTOCOLS: Mapping[str, Protocol] = {
    "paper": Protocol(
        angles_deg=(5.0, 10.0, 15.0, 20.0, 25.0, 30.0, 35.0, 40.0, 45.0),
        translations_diameter=(0.0, 0.1, 0.2, 0.3, 0.4, 0.5, 0.6, 0.7, 0.8, 0.9, 1.0),
        iterations=10,
        source="Deep Model-Based 6D Pose Refinement in RGB, ECCV 2018, section 4.1 and figure 4",
    )
}
"""The ranges, 5 to 45 degrees and 0 to 1 diameters, are the paper's; the steps, 5 degrees and 0.1 diameters, ours."""


@dataclass(frozen=True, kw_only=True)
class PerturbJob:
    """A file of initial poses to make.

    Attributes:
        dataset: BOP folder with ground truth.
        out: result file to write; its sidecar goes beside it.
        split: of the dataset.
        protocol: name of a `PROTOCOLS` entry that gives the levels, None for the two below.
        angles_deg: one initial pose for each.
        translations_diameter: one initial pose for each.
        random_up_to: one more initial pose, angle and length drawn uniformly from 0 up to these; None for none.
        depth_stretch: factor on the part of the random initial pose's translation along the viewing ray, 1 or more.
        seed: of all draws.
    """

    dataset: Path
    out: Path
    split: str | None = None
    protocol: str | None = None
    angles_deg: tuple[float, ...] = ()
    translations_diameter: tuple[float, ...] = ()
    random_up_to: Level | None = None
    depth_stretch: float = 1.0
    seed: int = 0

    def __post_init__(self) -> None:
        if self.protocol is not None and self.protocol not in PROTOCOLS:
            raise ConfigError(f"protocol: got {self.protocol!r}, expected one of {', '.join(PROTOCOLS)}")
        if self.protocol is not None and (self.angles_deg or self.translations_diameter):
            raise ConfigError(
                f"--protocol {self.protocol} brings its own levels; leave --angles and --translations away"
            )
        if self.depth_stretch != 1 and not (self.random_up_to and self.random_up_to.translation_diameter):
            raise ConfigError("--depth-stretch needs a random initial pose; give --random-translation too")

    @property
    def levels(self) -> list[Level]:
        """Levels of every target."""
        protocol = PROTOCOLS[self.protocol] if self.protocol is not None else self
        return levels_of(protocol.angles_deg, protocol.translations_diameter)


def write_initial_poses(job: PerturbJob) -> int:
    """Write the result file of a job and its sidecar; the number of its lines.

    Raises:
        PoseError: the dataset or the job's levels are not usable; the message names them.
    """
    return perturb_dataset(
        BopDataset(job.dataset, job.split),
        job.out,
        levels=job.levels,
        seed=job.seed,
        random_up_to=job.random_up_to,
        depth_stretch=job.depth_stretch,
        protocol=job.protocol,
    )


def protocol_deviations(sidecar: Mapping[str, Any]) -> list[str]:
    """Deviations of a refined result file from the protocol of its initial poses, a sentence each.

    Args:
        sidecar: of the refined file, with the initial poses' `perturbation`.
    """
    perturbation, settings = sidecar.get("perturbation"), sidecar.get("settings")
    name = perturbation.get("protocol") if isinstance(perturbation, dict) else None
    protocol = PROTOCOLS.get(name) if isinstance(name, str) else None
    iterations = settings.get("iterations") if isinstance(settings, dict) else None
    if protocol is None or iterations is None or iterations == protocol.iterations:
        return []
    return [f"refined in {iterations} iterations, while protocol '{name}' asks for {protocol.iterations}"]


def levels_of(angles_deg: Sequence[float], translations_diameter: Sequence[float]) -> list[Level]:
    """One level for each angle without translation, and one for each translation without rotation.

    Raises:
        ConfigError: a level is outside 0 to 180 degrees, or negative.
    """
    if any(not 0 <= angle <= 180 for angle in angles_deg):
        raise ConfigError(f"--angles: found {_listed(angles_deg)}, expected degrees from 0 to 180")
    if any(not (np.isfinite(distance) and distance >= 0) for distance in translations_diameter):
        raise ConfigError(f"--translations: found {_listed(translations_diameter)}, expected diameters, 0 or more")
    levels = [Level(angle_deg=angle, translation_diameter=0.0) for angle in angles_deg]
    levels += [Level(angle_deg=0.0, translation_diameter=distance) for distance in translations_diameter]
    return list(dict.fromkeys(levels))


def perturb_dataset(
    dataset: BopDataset,
    out: Path,
    *,
    levels: Sequence[Level],
    seed: int,
    random_up_to: Level | None = None,
    depth_stretch: float = 1.0,
    protocol: str | None = None,
) -> int:
    """Write initial poses for every target, and in the sidecar the level of every line.

    A pose is rotated by exactly its angle about a random axis through the object's centre (in camera axes) and
    translated by exactly its length in a random direction. The draws depend on the seed, the target's ids and the
    previous levels.

    Args:
        dataset: with ground truth.
        out: result file.
        levels: levels for every target, one line each.
        seed: of all draws.
        random_up_to: one more line for each target, angle and length drawn uniformly from 0 up to these; None for none.
        depth_stretch: factor on the random line's translation along the viewing ray; its level is the stretched one.
        protocol: name of the levels' `PROTOCOLS` entry, for the sidecar.

    Returns:
        Number of lines.

    Raises:
        ConfigError: there are no levels, or an initial pose would lie behind the camera.
    """
    if not levels and random_up_to is None:
        raise ConfigError(
            "no levels: give --angles 5,10,15 or --translations 0.1,0.2 or --random-up-to 20 or --protocol paper"
        )
    estimates: list[Estimate] = []
    rows: list[dict[str, Any]] = []
    for target in dataset.targets:
        diameter_m = dataset.models_info[target.obj_id].diameter_m
        center_m = dataset.center_m(target.obj_id)
        for gt in instances_of(dataset, target)[: target.inst_count]:
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
        "settings": {"seed": seed, "depth_stretch": depth_stretch, "evalkit": __version__},
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
            f"--depth-stretch {factor:g}: puts object {target.obj_id} of image {target.im_id}, "
            f"scene {target.scene_id}, behind the camera; lower it or --random-translation"
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


def _listed(values: Sequence[float]) -> str:
    return ", ".join(f"{value:g}" for value in values)
