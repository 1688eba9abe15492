"""Multi-hypothesis refinement: several poses around an initial pose are ranked against the image, then refined."""

import math
from collections.abc import Mapping, Sequence
from typing import Any, Literal

import numpy as np
from posecore import se3
from posecore.errors import ConfigError
from posecore.mesh import Mesh

from refinenet.data.online_pairs import draw_hypothesis
from refinenet.refine.network_refiner import Refiner
from refinenet.refiner import Frame, HypothesisScorer, Refinement, Request, ScoreKind

KEPT_FRACTION = 0.25
"""Fraction of a hypothesis set that is refined after ranking."""


class MultiHypothesisRefiner:
    """Refines the best hypotheses of a set around each initial pose: a `PoseRefiner`.

    A hypothesis set is the initial pose and poses drawn around it, rotated about the object's centre and shifted across
    the image by as much as the network was trained to correct. All keep the centre's depth, which edges hardly show.
    The set is ranked before refinement, its best quarter is refined, and the most confident result is returned. With
    scorer `none` the whole set is refined. With a seed, every pose of an object has the same draws.

    Args:
        refiner: Network; closed with this object.
        hypotheses: Size of a hypothesis set, the initial pose included.
        scorer: Ranking of a hypothesis set.
        seed: Seed of the draws.

    Raises:
        ConfigError: A hypothesis set of less than one pose.
    """

    needs_depth = False

    def __init__(self, refiner: Refiner, hypotheses: int, scorer: HypothesisScorer = "gradient", seed: int = 0) -> None:
        if hypotheses < 1:
            raise ConfigError(f"hypotheses is {hypotheses}, expected 1 or more")
        self._refiner = refiner
        self._hypotheses = hypotheses
        self._scorer: HypothesisScorer = scorer
        self._seed = seed

    @property
    def name(self) -> str:
        """Name of the network, and the size of the hypothesis set."""
        return f"{self._refiner.name}, {self._hypotheses} hypotheses"

    @property
    def score_kind(self) -> ScoreKind:
        """Source of the network's confidences."""
        return self._refiner.score_kind

    @property
    def corrects_depth(self) -> bool:
        """Whether the network corrects depth."""
        return self._refiner.corrects_depth

    @property
    def meshes(self) -> Mapping[int, Mesh]:
        """The network's meshes."""
        return self._refiner.meshes

    @property
    def settings(self) -> dict[str, Any]:
        """Settings for the sidecar."""
        hypothesis_set = {"hypotheses": self._hypotheses, "scorer": self._scorer, "seed": self._seed}
        return self._refiner.settings | hypothesis_set

    def close(self) -> None:
        """Close the network."""
        self._refiner.close()

    def refine_batch(self, frame: Frame, requests: Sequence[Request]) -> list[Refinement]:
        """The most confident result of each hypothesis set; the initial pose's failure where all hypotheses fail."""
        sets = [self._hypothesis_set(request) for request in requests]
        if self._scorer != "none" and self._hypotheses > 1:
            sets = self._best(frame, sets, self._scorer)
        results = iter(self._refiner.refine_batch(frame, [request for hypotheses in sets for request in hypotheses]))
        return [
            max([next(results) for _ in hypotheses], key=lambda result: (not result.failed, result.confidence or 0.0))
            for hypotheses in sets
        ]

    def _hypothesis_set(self, request: Request) -> list[Request]:
        # Of the pose's digits, the draws would depend on where its origin lies.
        rng = np.random.default_rng([self._seed, request.obj_id])
        config = self._refiner.checkpoint.provenance.config.hypothesis
        mesh = self._refiner.meshes[request.obj_id]
        T_cam_center = se3.with_origin_at(np.asarray(request.T_cam_obj, np.float64), mesh.center_m)
        drawn = [draw_hypothesis(T_cam_center, mesh.diameter_m, config, rng) for _ in range(self._hypotheses - 1)]
        for T in drawn:
            T[:3, 3] *= T_cam_center[2, 3] / T[2, 3]  # along the ray, back to the initial depth
        drawn = [se3.with_origin_at(T, -mesh.center_m) for T in drawn]
        return [request, *(Request(obj_id=request.obj_id, T_cam_obj=T) for T in drawn)]

    def _best(
        self, frame: Frame, sets: list[list[Request]], scorer: Literal["gradient", "learned"]
    ) -> list[list[Request]]:
        """The best quarter of each hypothesis set, best first."""
        scores = self._refiner.confidences(frame, [request for hypotheses in sets for request in hypotheses], scorer)
        count = math.ceil(KEPT_FRACTION * self._hypotheses)
        return [
            [hypotheses[i] for i in np.argsort(-set_scores, kind="stable")[:count]]
            for hypotheses, set_scores in zip(sets, scores.reshape(len(sets), -1), strict=True)
        ]
