"""Tracking of objects through a sequence: the poses of each frame start the refinement of the next."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from jaxtyping import Float
from posecore import se3
from posecore.symmetry import Symmetric, nearest_symmetric

from refinenet.refiner import Frame, PoseRefiner, Refinement, Request, ScoreKind
from refinenet.tracking.state import (
    GRADIENT_TRACKING,
    LEARNED_TRACKING,
    SEARCH_TRACKING,
    UNSCORED_TRACKING,
    Observation,
    TrackingConfig,
    TrackState,
    TrackStatus,
    at_depths,
    next_status,
    predicted,
)

DEFAULT_CONFIGS: dict[ScoreKind, TrackingConfig] = {
    "learned": LEARNED_TRACKING,
    "gradient": GRADIENT_TRACKING,
    "search": SEARCH_TRACKING,
    "none": UNSCORED_TRACKING,
}
DEPTH_MARGIN = 0.02
"""Margin of confidence for a hypothesis at another depth: a smaller difference is noise, which depth would follow."""

VELOCITY_OBSERVATIONS = 5
"""Observations for the velocity: between two alone it would be noise, above all in depth."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Tracked:
    """An object in a frame.

    Attributes:
        obj_id: Object.
        state: State after this frame.
        T_cam_obj: Pose, metres; None where no pose is accepted.
        confidence: Confidence of the best pose, accepted or not.
        restarted: Whether the pose came from an initial pose: at the first frame, or after the track was lost.
        failure: Reason why there is no pose; None where there is.
    """

    obj_id: int
    state: TrackState
    T_cam_obj: Float[np.ndarray, "4 4"] | None
    confidence: float
    restarted: bool
    failure: str | None = None


@dataclass(kw_only=True, eq=False)
class ObjectTrack:
    """Track of an object: `hypotheses` gives the poses to refine in a frame, `update` takes the results.

    Attributes:
        obj_id: Object.
        config: Thresholds.
        center_m: Centre of the object, in its own frame.
        symmetries: Symmetries of the object, in its own frame; None without.
        motion_model: Whether the next pose is predicted at constant velocity, instead of equal to the last.
        status: State.
    """

    obj_id: int
    config: TrackingConfig
    center_m: Float[np.ndarray, "3"]
    symmetries: Symmetric | None = None
    motion_model: bool = False
    status: TrackStatus = field(default_factory=lambda: TrackStatus(state=TrackState.LOST))
    _observations: list[Observation] = field(default_factory=list)
    _continued: int = 0
    """Hypotheses of the current frame that continue the track; those after are initial poses."""

    def hypotheses(self, frame: int, initial: Sequence[Float[np.ndarray, "4 4"]]) -> list[Request]:
        """Poses to refine in a frame.

        A lost track tries its last pose and the initial poses. Other tracks continue from the last pose, with the
        motion model from the predicted pose. The poses that continue a track are each tried at several depths.
        """
        poses = [] if not self._observations else [self._observations[-1].T_cam_obj]
        if self.motion_model and len(self._observations) > 1:
            poses.insert(0, predicted(self._observations[0], self._observations[-1], frame))
            if self.status.state is TrackState.TRACKING:
                poses = poses[:1]
        shifted = [copy for T in poses for copy in at_depths(T, self.config.depth_step)]
        poses = [se3.with_origin_at(T, -self.center_m) for T in shifted]
        self._continued = len(poses)
        if self.status.state is TrackState.LOST:
            poses += list(initial)
        return [Request(obj_id=self.obj_id, T_cam_obj=np.asarray(T, np.float64)) for T in poses]

    def update(self, frame: int, results: Sequence[Refinement]) -> Tracked:
        """Pose and new state after a frame, from the refinements of its hypotheses, in their order."""
        if not results:
            return self._without_pose("there is no initial pose in this frame", 0.0)
        best = self._best(results)
        result, confidence = results[best], _confidence(results[best])
        gap = self.status.missed > 0 or self.status.state is TrackState.LOST
        self.status = next_status(self.status, None if result.failed else confidence, self.config)
        if self.status.state is TrackState.LOST or self.status.missed:
            return self._without_pose(
                result.failure or f"the best pose has a confidence of {confidence:.2f}", confidence
            )
        pose = result.T_cam_obj
        if self._observations and self.symmetries is not None:
            last = se3.with_origin_at(self._observations[-1].T_cam_obj, -self.center_m)
            pose = nearest_symmetric(pose, last, self.symmetries)
        restarted = best >= self._continued
        # Across a gap there is no velocity: the motion in between is unknown.
        continues = bool(self._observations) and not restarted and not gap
        before = self._observations[1 - VELOCITY_OBSERVATIONS :] if continues else []
        of_center = Observation(frame=frame, T_cam_obj=se3.with_origin_at(pose, self.center_m))
        self._observations = [*before, of_center]
        return Tracked(
            obj_id=self.obj_id, state=self.status.state, T_cam_obj=pose, confidence=confidence, restarted=restarted
        )

    def _best(self, results: Sequence[Refinement]) -> int:
        """Index of the most confident result; of three depths the unshifted one, unless another is clearly better."""
        best = max(range(len(results)), key=lambda i: (not results[i].failed, _confidence(results[i])))
        if best >= self._continued or not self.config.depth_step:
            return best
        unshifted = 3 * (best // 3)
        is_better = _confidence(results[best]) > _confidence(results[unshifted]) + DEPTH_MARGIN
        return best if is_better else unshifted

    def _without_pose(self, reason: str, confidence: float) -> Tracked:
        return Tracked(
            obj_id=self.obj_id, state=self.status.state, T_cam_obj=None, confidence=confidence, restarted=False,
            failure=reason,
        )  # fmt: skip


def _confidence(result: Refinement) -> float:
    """Confidence of a result; 1 without a failure from a method without confidences."""
    if result.failed:
        return 0.0
    return 1.0 if result.confidence is None else result.confidence


def default_config(refiner: PoseRefiner) -> TrackingConfig:
    """Default thresholds for the confidences of a method."""
    config = DEFAULT_CONFIGS[refiner.score_kind]
    return replace(config, depth_step=0.0) if refiner.corrects_depth else config


class Tracker:
    """Tracks an instance of each of several objects; all hypotheses of a frame are refined together.

    Args:
        refiner: Method; not closed.
        obj_ids: Objects; the method has their meshes.
        config: Thresholds; `default_config` by default.
        symmetries: Symmetries by object id, of the symmetric objects.
        motion_model: Whether poses are predicted at constant velocity.

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
        motion_model: bool = False,
    ) -> None:
        self.refiner = refiner
        symmetric = symmetries or {}
        config = config or default_config(refiner)
        self._tracks = [
            ObjectTrack(
                obj_id=i,
                config=config,
                center_m=refiner.meshes[i].center_m,
                symmetries=symmetric.get(i),
                motion_model=motion_model,
            )
            for i in sorted(set(obj_ids))
        ]

    def step(
        self, number: int, frame: Frame, initial_poses: Mapping[int, Sequence[Float[np.ndarray, "4 4"]]] | None = None
    ) -> list[Tracked]:
        """Poses of all objects in the next frame.

        Args:
            number: Frame number; rises from call to call.
            frame: Image and camera.
            initial_poses: Initial poses by object id, for lost tracks; before the first frame all tracks are lost.

        Raises:
            CameraError: The camera is that of an image of another size.
        """
        initial = initial_poses or {}
        hypotheses = [track.hypotheses(number, initial.get(track.obj_id, ())) for track in self._tracks]
        requests = [request for track_requests in hypotheses for request in track_requests]
        results = iter(self.refiner.refine_batch(frame, requests) if requests else [])
        return [
            track.update(number, [next(results) for _ in track_requests])
            for track, track_requests in zip(self._tracks, hypotheses, strict=True)
        ]
