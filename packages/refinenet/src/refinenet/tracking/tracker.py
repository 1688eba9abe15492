"""Tracking of objects through a sequence: each frame's poses start the next frame's refinement."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from jaxtyping import Float
from posecore.symmetry import Symmetric

from refinenet.baselines.global_search import GradientSearch
from refinenet.refine.network_refiner import Refiner
from refinenet.refiner import Frame, PoseRefiner, Refinement, Request
from refinenet.tracking.state import (
    GRADIENT_TRACKING,
    LEARNED_TRACKING,
    SEARCH_TRACKING,
    UNJUDGED_TRACKING,
    Sighting,
    Standing,
    TrackingConfig,
    TrackState,
    at_depths,
    nearest_copy,
    next_standing,
    predicted,
)

Array = np.ndarray
DEPTH_MARGIN = 0.02
"""By so much a start from nearer or farther has to be more confident: less is noise, and depth would jump with it."""

VELOCITY_SIGHTINGS = 5
"""Velocity is measured over so many frames: between two alone it would be noise, in depth above all."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Tracked:
    """One object in one frame.

    Attributes:
        obj_id: Object.
        state: After this frame.
        T_cam_obj: Its pose, metres; None where no pose is believed.
        confidence: Of the best pose found, believed or not.
        restarted: Whether the pose came from an offered start pose: at the first frame, or after the track was lost.
        failure: Why there is no pose; None where there is one.
    """

    obj_id: int
    state: TrackState
    T_cam_obj: Float[Array, "4 4"] | None
    confidence: float
    restarted: bool
    failure: str | None = None


@dataclass(kw_only=True, eq=False)
class Track:
    """One object's track; `wanted` says what to refine in a frame, `take` what came of it.

    Attributes:
        obj_id: Object.
        config: When a pose fits.
        symmetries: Of the object; None without.
        motion: Whether the next pose is predicted with constant velocity, instead of expected where the last one was.
        standing: State.
    """

    obj_id: int
    config: TrackingConfig
    symmetries: Symmetric | None = None
    motion: bool = False
    standing: Standing = field(default_factory=lambda: Standing(state=TrackState.LOST))
    _seen: list[Sighting] = field(default_factory=list)
    _own: int = 0

    def wanted(self, frame: int, offered: Sequence[Float[Array, "4 4"]]) -> list[Request]:
        """Poses to refine in a frame.

        A lost track tries the poses offered, and the place where it last was. Others go on from their last pose, with
        the motion model from its prediction; each is tried at a few depths.
        """
        own = [] if not self._seen else [self._seen[-1].T_cam_obj]
        if self.motion and len(self._seen) > 1:
            own.insert(0, predicted(self._seen[0], self._seen[-1], frame))
            if self.standing.state is TrackState.TRACKING:
                own = own[:1]
        own = [near for T in own for near in at_depths(T, self.config.depth_step)]
        self._own = len(own)
        if self.standing.state is TrackState.LOST:
            own += list(offered)
        return [Request(obj_id=self.obj_id, T_cam_obj=np.asarray(T, np.float64)) for T in own]

    def take(self, frame: int, results: Sequence[Refinement]) -> Tracked:
        """Result and new state of a frame, from the refinements of what was wanted in it, in their order."""
        if not results:
            return self._without("there is no pose to start from in this frame", 0.0)
        best = self._best(results)
        found, confidence = results[best], _confidence(results[best])
        gap = self.standing.missed > 0 or self.standing.state is TrackState.LOST
        self.standing = next_standing(self.standing, None if found.failed else confidence, self.config)
        if self.standing.state is TrackState.LOST or self.standing.missed:
            return self._without(found.failure or f"the best pose has a confidence of {confidence:.2f}", confidence)
        pose = found.T_cam_obj
        if self._seen and self.symmetries is not None:
            pose = nearest_copy(pose, self._seen[-1].T_cam_obj, self.symmetries)
        restarted = best >= self._own
        # Across a gap there is no velocity: the way between may have been any.
        follows = bool(self._seen) and not restarted and not gap
        self._seen = [*(self._seen[1 - VELOCITY_SIGHTINGS :] if follows else []), Sighting(frame=frame, T_cam_obj=pose)]
        return Tracked(
            obj_id=self.obj_id, state=self.standing.state, T_cam_obj=pose, confidence=confidence, restarted=restarted
        )

    def _best(self, results: Sequence[Refinement]) -> int:
        """The most confident result; of one start's three depths its own, unless another's is clearly more so."""
        best = max(range(len(results)), key=lambda i: (not results[i].failed, _confidence(results[i])))
        if best >= self._own or not self.config.depth_step:
            return best
        own = 3 * (best // 3)
        return best if _confidence(results[best]) > _confidence(results[own]) + DEPTH_MARGIN else own

    def _without(self, why: str, confidence: float) -> Tracked:
        return Tracked(
            obj_id=self.obj_id, state=self.standing.state, T_cam_obj=None, confidence=confidence, restarted=False,
            failure=why,
        )  # fmt: skip


def _confidence(result: Refinement) -> float:
    """A method without confidences is believed unless it fails."""
    if result.failed:
        return 0.0
    return 1.0 if result.confidence is None else result.confidence


def usual_config(refiner: PoseRefiner) -> TrackingConfig:
    """When a pose of this method fits, where nobody says otherwise."""
    if not isinstance(refiner, Refiner):
        return SEARCH_TRACKING if isinstance(refiner, GradientSearch) else UNJUDGED_TRACKING
    usual = LEARNED_TRACKING if refiner.scorer == "learned" else GRADIENT_TRACKING
    corrects_depth = refiner.checkpoint.provenance.config.network.kind == "flow"
    return replace(usual, depth_step=0.0) if corrects_depth else usual


class Tracker:
    """Tracks one instance of each of several objects; all that a frame needs is refined together.

    Args:
        refiner: Method; stays open.
        obj_ids: Objects.
        config: When a pose fits; `usual_config` by default.
        symmetries: By object id, of those that have any.
        motion: Whether poses are predicted with constant velocity.

    Attributes:
        refiner: Method.
    """

    def __init__(
        self,
        refiner: PoseRefiner,
        obj_ids: Sequence[int],
        config: TrackingConfig | None = None,
        *,
        symmetries: Mapping[int, Symmetric] | None = None,
        motion: bool = False,
    ) -> None:
        self.refiner = refiner
        known = symmetries or {}
        config = config or usual_config(refiner)
        self._tracks = [
            Track(obj_id=i, config=config, symmetries=known.get(i), motion=motion) for i in sorted(set(obj_ids))
        ]

    def step(
        self, number: int, frame: Frame, offered: Mapping[int, Sequence[Float[Array, "4 4"]]] | None = None
    ) -> list[Tracked]:
        """Poses of all objects in the next frame.

        Args:
            number: Of the frame; rises from call to call.
            frame: Image and camera.
            offered: Start poses by object id, used by tracks that are lost; before the first frame all are.

        Raises:
            CameraError: The camera is that of an image of another size.
        """
        starts = offered or {}
        wanted = [track.wanted(number, starts.get(track.obj_id, ())) for track in self._tracks]
        requests = [request for of_track in wanted for request in of_track]
        results = iter(self.refiner.refine_batch(frame, requests) if requests else [])
        return [
            track.take(number, [next(results) for _ in of_track])
            for track, of_track in zip(self._tracks, wanted, strict=True)
        ]
