"""Start poses from ground truth: rotated and moved by known amounts, so that convergence can be drawn as a curve."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from posecore import se3
from posecore.bop import BopDataset, BopTarget, Estimate, GroundTruth, write_results
from posecore.errors import ConfigError

from evalkit import __version__
from evalkit.inputs.pairing import Level, truths_of
from evalkit.inputs.result_files import INITIAL_METHOD


@dataclass(frozen=True, kw_only=True)
class Protocol:
    """A published experiment: its levels, and what it asks of the refiner.

    Attributes:
        angles_deg: one start for each, not moved.
        translations_diameter: one start for each, not rotated.
        iterations: of the refiner.
        source: where it is described.
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
"""The paper says 5 to 45 degrees and 0 to 1 diameters; the steps of 5 degrees and 0.1 diameters are ours."""


def departures(sidecar: Mapping[str, Any]) -> list[str]:
    """In what a result file from perturbed starts departs from their protocol, a sentence each; empty where in nothing.

    Args:
        sidecar: of the refined file, which carries the starts' `perturbation`.
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
    if any(not (np.isfinite(share) and share >= 0) for share in translations_diameter):
        raise ConfigError(f"--translations: found {_listed(translations_diameter)}, expected diameters, 0 or more")
    levels = [Level(angle_deg=angle, translation_diameter=0.0) for angle in angles_deg]
    levels += [Level(angle_deg=0.0, translation_diameter=share) for share in translations_diameter]
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
    """Write start poses for every target, and in the sidecar the level of every line.

    A pose is rotated by exactly its angle about a random axis through the object's origin (in camera axes) and moved
    by exactly its length in a random direction. Randomness depends on the seed, the target's ids and the levels before.

    Args:
        dataset: with ground truth.
        out: result file.
        levels: levels for every target, one line each.
        seed: of all draws.
        random_up_to: where given, one more line for each target, its angle and length drawn evenly from 0 up to these.
        depth_stretch: factor on the part of the random line's move along the viewing ray; its level is what comes out.
        protocol: name of the `PROTOCOLS` entry that the levels are of, for the sidecar.

    Returns:
        Number of lines.

    Raises:
        ConfigError: neither levels nor random ones are wanted, or a start would lie behind the camera.
    """
    if not levels and random_up_to is None:
        raise ConfigError(
            "no levels: give --angles 5,10,15 or --translations 0.1,0.2 or --random-up-to 20 or --protocol paper"
        )
    estimates: list[Estimate] = []
    rows: list[dict[str, Any]] = []
    for target in dataset.targets:
        diameter_m = dataset.models_info[target.obj_id].diameter_m
        for truth in truths_of(dataset, target)[: target.inst_count]:
            rng = np.random.default_rng([seed, target.scene_id, target.im_id, target.obj_id, truth.gt_index])
            drawn = [_drawn(random_up_to, rng)] if random_up_to else []
            for number, level in enumerate([*levels, *drawn]):
                random = number >= len(levels)
                start = _start(target, truth, level, diameter_m, rng)
                if random and depth_stretch != 1:
                    start, level = _stretched(start, truth, level, diameter_m, depth_stretch)
                estimates.append(start)
                rows.append(_sidecar_row(len(estimates) + 1, target, truth, level) | {"random": random})
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


def _start(
    target: BopTarget, truth: GroundTruth, level: Level, diameter_m: float, rng: np.random.Generator
) -> Estimate:
    distance_m = level.translation_diameter * diameter_m
    return Estimate(
        scene_id=target.scene_id,
        im_id=target.im_id,
        obj_id=target.obj_id,
        T_cam_obj=se3.perturb(truth.T_cam_obj, float(np.deg2rad(level.angle_deg)), distance_m, rng),
    )


def _stretched(
    start: Estimate, truth: GroundTruth, level: Level, diameter_m: float, factor: float
) -> tuple[Estimate, Level]:
    """The start with its depth error times a factor, and its level."""
    T = se3.stretched_along_ray(truth.T_cam_obj, start.T_cam_obj, factor)
    if T[2, 3] <= 0:
        raise ConfigError(
            f"--depth-stretch {factor:g}: puts object {start.obj_id} of image {start.im_id}, scene {start.scene_id}, "
            "behind the camera; lower it or --random-translation"
        )
    moved = float(np.linalg.norm(T[:3, 3] - truth.T_cam_obj[:3, 3])) / diameter_m
    return replace(start, T_cam_obj=T), replace(level, translation_diameter=moved)


def _sidecar_row(line: int, target: BopTarget, truth: GroundTruth, level: Level) -> dict[str, Any]:
    return {
        "line": line,
        "scene_id": target.scene_id,
        "im_id": target.im_id,
        "obj_id": target.obj_id,
        "gt_index": truth.gt_index,
        "angle_deg": level.angle_deg,
        "translation_diameter": level.translation_diameter,
    }


def _listed(values: Sequence[float]) -> str:
    return ", ".join(f"{value:g}" for value in values)
