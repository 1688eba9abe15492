"""Configuration of the global pose search."""

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from posecore.errors import ConfigError


class Round(NamedTuple):
    """A resampling round: poses to draw, poses to keep, and reach of an image edge in pixels."""

    draws: int
    kept: int
    spread_px: int


INITIAL_ROUND = Round(20_000, 400, 3)


@dataclass(frozen=True, kw_only=True)
class SearchConfig:
    """Constants of `GradientSearch`, tuned on renders.

    Attributes:
        orientations: Bins of edge orientation over half a turn.
        patch_px: Side of the patch of the search.
        score_patch_px: Side of the patch that scores candidates by a render.
        window_scale: Window side over the projected diameter.
        initial_round: First round, drawn around the initial pose.
        max_angle_rad: Largest rotation of the first draws.
        shift_std: Standard deviation of the first shifts across the image, diameters.
        log_depth_std: Standard deviation of the logarithm of the first depths.
        rounds: Resampling rounds around the best poses together.
        local_rounds: Resampling rounds around each candidate alone.
        resample_std: Standard deviations of a resampled pose: rotation vector (rad), shift (diameters), log depth.
        std_decay: Factor on the standard deviations after each round.
        candidates: Largest number of candidates.
        min_candidate_distance: Least distance between candidates before their local rounds, as the mean distance of
            points around the centre, diameters.
        trial_iterations: Edge-ICP iterations per candidate.
        prior_weight: Score that a candidate loses for each squared standard deviation from the initial pose.
        angle_tail_rad: Standard deviation of rotations beyond `max_angle_rad`; up to it, all are equally likely.
        same_instance_distance: Diameters; a pose farther from the initial pose belongs to another instance.
        min_similarity: Least gradient similarity of the result. A less similar pose is more likely wrong than right,
            and mostly worse than its initial pose.
        min_combined_score: The same for the mean of gradient similarity and predicted pose quality.

    Raises:
        ConfigError: A count or a deviation is not positive, or a round keeps more poses than it draws.
    """

    orientations: int = 16
    patch_px: int = 96
    score_patch_px: int = 112
    window_scale: float = 1.9
    initial_round: Round = INITIAL_ROUND
    max_angle_rad: float = float(np.deg2rad(70))
    shift_std: float = 0.13
    log_depth_std: float = 0.1
    rounds: tuple[Round, ...] = (
        Round(8000, 200, 2),
        Round(6000, 150, 2),
        Round(4000, 100, 1),
        Round(4000, 100, 1),
    )
    local_rounds: tuple[Round, ...] = (Round(400, 1, 1), Round(400, 1, 0), Round(400, 1, 0))
    resample_std: tuple[float, ...] = (0.15, 0.15, 0.15, 0.04, 0.04, 0.035)
    std_decay: float = 0.65
    candidates: int = 10
    min_candidate_distance: float = 0.12
    trial_iterations: int = 3
    prior_weight: float = 0.01
    angle_tail_rad: float = 0.2
    same_instance_distance: float = 0.5
    min_similarity: float = 0.4
    min_combined_score: float = 0.5

    def __post_init__(self) -> None:
        for name in ("orientations", "patch_px", "score_patch_px", "candidates", "trial_iterations"):
            if getattr(self, name) < 1:
                raise ConfigError(f"{name} is {getattr(self, name)}, expected 1 or more")
        for name in ("window_scale", "shift_std", "log_depth_std", "std_decay", "angle_tail_rad"):
            if not getattr(self, name) > 0:
                raise ConfigError(f"{name} is {getattr(self, name)}, expected more than 0")
        if len(self.resample_std) != 6:
            raise ConfigError(f"resample_std has {len(self.resample_std)} values, expected 6: rotation, shift, depth")
        for draws, kept, spread_px in (self.initial_round, *self.rounds, *self.local_rounds):
            if not 1 <= kept <= draws or spread_px < 0:
                raise ConfigError(f"round ({draws}, {kept}, {spread_px}): expected draws >= kept >= 1, spread_px >= 0")

    @property
    def max_faces(self) -> int:
        """Faces of the simplified mesh of the search: a pixel each."""
        return self.patch_px**2

    @property
    def spreads_px(self) -> set[int]:
        """Reaches of an image edge over all rounds."""
        return {round_.spread_px for round_ in (self.initial_round, *self.rounds, *self.local_rounds)}
