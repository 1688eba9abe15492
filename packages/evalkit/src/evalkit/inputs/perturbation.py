"""Initial poses at known rotations and translations from the ground truth, for convergence curves."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from posecore.bop import BopDataset
from posecore.bop.perturbation import Level, perturb_dataset
from posecore.errors import ConfigError

from evalkit import __version__


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
        if not (self.protocol or self.angles_deg or self.translations_diameter or self.random_up_to):
            raise ConfigError(
                "no levels: give --angles 5,10,15 or --translations 0.1,0.2 or --random-up-to 20 or --protocol paper"
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
        program={"evalkit": __version__},
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


def _listed(values: Sequence[float]) -> str:
    return ", ".join(f"{value:g}" for value in values)
