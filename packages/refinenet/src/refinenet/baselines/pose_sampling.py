"""Evolution strategy over poses: draws around an initial pose, resampled around the best, for any score.

A pose is an offset from the initial pose: rotation vector in camera axes (rad), shift across the image (diameters), and
logarithm of the depth ratio.
"""

from collections.abc import Callable, Sequence

import numpy as np
from jaxtyping import Float
from posecore import se3
from posecore.mesh import Mesh

from refinenet.baselines.search_config import Round, SearchConfig

Score = Callable[[Float[np.ndarray, "n 4 4"], int], Float[np.ndarray, " n"]]
"""Scores of poses, for an image edge's reach in pixels."""


class PoseSampler:
    """Draws poses around an initial pose of an object.

    Args:
        initial: Initial pose, metres.
        mesh: Object.
        score: Score, higher is better.
        config: Numbers of draws and their deviations.
        rng: Source of all draws.
    """

    def __init__(
        self,
        initial: Float[np.ndarray, "4 4"],
        mesh: Mesh,
        score: Score,
        config: SearchConfig,
        rng: np.random.Generator,
    ) -> None:
        self._initial = initial
        self._mesh = mesh
        self._score = score
        self._config = config
        self._rng = rng

    def candidates(self) -> list[Float[np.ndarray, "4 4"]]:
        """Poses with a high score that differ from each other, the best first."""
        config = self._config
        first = sample_offsets(config, self._rng)
        offsets, _ = self._best(first, config.initial_round.kept, config.initial_round.spread_px)
        offsets, _, std = self.resample(offsets, np.array(config.resample_std), config.rounds)
        poses = offset_poses(self._initial, offsets, self._mesh)
        locally = [
            self.resample(offsets[i : i + 1], std, config.local_rounds)
            for i in distinct_poses(poses, self._mesh, config)
        ]
        locally.sort(key=lambda result: -result[1][0])
        return [offset_poses(self._initial, best, self._mesh)[0] for best, _, _ in locally]

    def resample(
        self, offsets: Float[np.ndarray, "m 6"], std: Float[np.ndarray, "6"], rounds: Sequence[Round]
    ) -> tuple[Float[np.ndarray, "k 6"], Float[np.ndarray, " k"], Float[np.ndarray, "6"]]:
        """Draw around offsets and keep the best, round by round.

        Returns:
            The best offsets, their scores, and the standard deviations after the rounds.
        """
        scores = np.zeros(len(offsets))
        for draws, kept, spread_px in rounds:
            drawn = offsets[self._rng.integers(len(offsets), size=draws)] + self._rng.normal(size=(draws, 6)) * std
            offsets, scores = self._best(np.concatenate([offsets, drawn]), kept, spread_px)
            std = std * self._config.std_decay
        return offsets, scores, std

    def _best(self, offsets: Float[np.ndarray, "n 6"], kept: int, spread_px: int) -> tuple[np.ndarray, np.ndarray]:
        scores = self._score(offset_poses(self._initial, offsets, self._mesh), spread_px)
        order = np.argsort(-scores, kind="stable")[:kept]
        return offsets[order], scores[order]


def sample_offsets(config: SearchConfig, rng: np.random.Generator) -> Float[np.ndarray, "n 6"]:
    """Rotations about a random axis by at most the largest angle, and normal shifts; the first offset is zero."""
    draws = config.initial_round.draws
    axis = rng.normal(size=(draws, 3))
    angle_rad = rng.uniform(0, config.max_angle_rad, (draws, 1))
    shifts = rng.normal(size=(draws, 3)) * np.array([config.shift_std, config.shift_std, config.log_depth_std])
    offsets = np.concatenate([axis / np.linalg.norm(axis, axis=1, keepdims=True) * angle_rad, shifts], axis=1)
    offsets[0] = 0
    return np.asarray(offsets)


def offset_poses(
    initial: Float[np.ndarray, "4 4"], offsets: Float[np.ndarray, "n 6"], mesh: Mesh
) -> Float[np.ndarray, "n 4 4"]:
    """Poses at offsets: rotated about the mesh's centre, shifted across the image, scaled in depth along the ray."""
    centre_m = mesh.center_cam_m(initial)
    across_m = np.pad(mesh.diameter_m * offsets[:, 3:5], ((0, 0), (0, 1)))
    R = se3.rotation_from_rotvec(offsets[:, :3]) @ initial[:3, :3]
    t = np.exp(offsets[:, 5:]) * (centre_m + across_m) - se3.rotated(R, mesh.center_m)
    return se3.make_T(R, t)


def distinct_poses(T_cam_obj: Float[np.ndarray, "n 4 4"], mesh: Mesh, config: SearchConfig) -> list[int]:
    """Indices of the first poses that lie at least the candidates' distance from all chosen poses before."""
    points_m = se3.apply(T_cam_obj, mesh.center_m + 0.3 * mesh.diameter_m * se3.even_directions(32))
    chosen: list[int] = []
    for i, points in enumerate(points_m):
        distance_m = np.linalg.norm(points_m[chosen] - points, axis=-1).mean(axis=-1)
        if (distance_m > config.min_candidate_distance * mesh.diameter_m).all():
            chosen.append(i)
        if len(chosen) == config.candidates:
            break
    return chosen


def prior_distance(
    initial: Float[np.ndarray, "4 4"], T_cam_obj: Float[np.ndarray, "4 4"], mesh: Mesh, config: SearchConfig
) -> float:
    """Squared distance of a pose from the initial pose, in standard deviations of the first draws."""
    initial_m, centre_m = mesh.center_cam_m(initial), mesh.center_cam_m(T_cam_obj)
    across_m = centre_m[:2] * initial_m[2] / centre_m[2] - initial_m[:2]
    angle_rad = float(se3.rotation_angle_rad(T_cam_obj[:3, :3] @ initial[:3, :3].T))
    tail_rad = max(0.0, angle_rad - config.max_angle_rad)
    shifts = np.append(
        across_m / (config.shift_std * mesh.diameter_m), np.log(centre_m[2] / initial_m[2]) / config.log_depth_std
    )
    return float(np.square(shifts).sum() + (tail_rad / config.angle_tail_rad) ** 2)
