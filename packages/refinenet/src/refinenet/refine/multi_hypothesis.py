"""Pools of hypotheses: several start poses for one, verified against the image before they are refined."""

import math
import zlib
from collections.abc import Sequence
from typing import Any, Literal

import numpy as np
from posecore.errors import ConfigError

from refinenet.data.online_pairs import draw_hypothesis
from refinenet.refine.network_refiner import Refiner
from refinenet.refiner import Frame, Refinement, Request

PoolScorer = Literal["gradient", "learned", "none"]
KEPT_SHARE = 0.25
"""Share of a pool that is refined after it was ranked."""


class PooledRefiner:
    """Refines the best of a pool of hypotheses around each start pose: a `PoseRefiner`.

    A pool is the start pose and poses drawn around it, turned and moved across the image by as much as the network was
    trained to correct; their depth is the start's, which edges hardly show. It is ranked as it is, its best quarter is
    refined, and the most confident result is returned. With `none` nothing is ranked and all of it is refined. Draws
    depend on the seed and the start pose alone.

    Args:
        refiner: Network; closed with this.
        hypotheses: Poses in a pool, the start pose included.
        scorer: What ranks a pool.
        seed: Of the draws.

    Raises:
        ConfigError: A pool of less than one pose.
    """

    needs_depth = False

    def __init__(self, refiner: Refiner, hypotheses: int, scorer: PoolScorer = "gradient", seed: int = 0) -> None:
        if hypotheses < 1:
            raise ConfigError(f"hypotheses is {hypotheses}, expected 1 or more")
        self._refiner = refiner
        self._hypotheses = hypotheses
        self._scorer: PoolScorer = scorer
        self._seed = seed

    @property
    def name(self) -> str:
        """That of the network, and the size of the pool."""
        return f"{self._refiner.name}, {self._hypotheses} hypotheses"

    @property
    def settings(self) -> dict[str, Any]:
        """For the sidecar."""
        pool = {"hypotheses": self._hypotheses, "scorer": self._scorer, "seed": self._seed}
        return self._refiner.settings | pool

    def close(self) -> None:
        """Close the network."""
        self._refiner.close()

    def refine_batch(self, frame: Frame, requests: Sequence[Request]) -> list[Refinement]:
        """The most confident result of each pool; the start pose's own failure where all of it failed."""
        pools = [self._pool(request) for request in requests]
        if self._scorer != "none" and self._hypotheses > 1:
            pools = self._best(frame, pools, self._scorer)
        results = iter(self._refiner.refine_batch(frame, [request for pool in pools for request in pool]))
        return [
            max([next(results) for _ in pool], key=lambda result: (not result.failed, result.confidence or 0.0))
            for pool in pools
        ]

    def _pool(self, request: Request) -> list[Request]:
        pose = np.ascontiguousarray(request.T_cam_obj, np.float64)
        rng = np.random.default_rng([self._seed, request.obj_id, zlib.crc32(pose.tobytes())])
        config = self._refiner.checkpoint.provenance.config.hypothesis
        diameter_m = self._refiner.meshes[request.obj_id].diameter_m
        drawn = [draw_hypothesis(pose, diameter_m, config, rng) for _ in range(self._hypotheses - 1)]
        for T in drawn:
            T[:3, 3] *= pose[2, 3] / T[2, 3]  # along its ray, back to the start's depth
        return [request, *(Request(obj_id=request.obj_id, T_cam_obj=T) for T in drawn)]

    def _best(
        self, frame: Frame, pools: list[list[Request]], scorer: Literal["gradient", "learned"]
    ) -> list[list[Request]]:
        """The best quarter of each pool, best first."""
        scores = self._refiner.confidences(frame, [request for pool in pools for request in pool], scorer)
        kept = math.ceil(KEPT_SHARE * self._hypotheses)
        best = []
        for pool, of_pool in zip(pools, scores.reshape(len(pools), -1), strict=True):
            best.append([pool[i] for i in np.argsort(-of_pool, kind="stable")[:kept]])
        return best
