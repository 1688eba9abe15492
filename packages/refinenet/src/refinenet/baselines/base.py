"""Base class of the baselines: the `PoseRefiner` interface around the refinement of a single pose."""

from abc import ABC, abstractmethod
from collections.abc import Mapping, Sequence
from typing import Any, ClassVar

import numpy as np
from jaxtyping import Float
from posecore import se3
from posecore.mesh import Mesh
from posecore.raster import Rasteriser

from refinenet.baselines.patch import TrackedObject
from refinenet.geometry.pivots import PivotFrames
from refinenet.refiner import Frame, Refinement, Request, ScoreKind, Status, render_obstacle, require_meshes

SMALL_ANGLE_RAD = np.deg2rad(0.5)
SMALL_DISTANCE = 0.01
"""An update below this angle and this fraction of the diameter is small."""

FAR_DEG, FAR_DIAMETERS = 60.0, 0.75
"""A pose farther from its initial pose than this has diverged. Tuned on renders."""
NOT_VISIBLE = "the object is not visible in the image at the initial pose"


class Baseline(ABC):
    """A `PoseRefiner` that refines the poses one after the other.

    Inside, an object's origin is its centre: the pivot of updates, and the end of viewing rays and distances.

    Args:
        meshes: Objects by id.
        iterations: Renders, each followed by an update, at every resolution or search range.

    Attributes:
        meshes: As given.
        iterations: As given.
    """

    name: str
    needs_depth: ClassVar[bool] = False
    score_kind: ScoreKind = "none"
    corrects_depth: ClassVar[bool] = True

    def __init__(self, meshes: Mapping[int, Mesh], *, iterations: int = 5) -> None:
        self.iterations = iterations
        self.meshes: Mapping[int, Mesh] = dict(meshes)
        self._frames = PivotFrames.at_centers(meshes)
        self._rasteriser = Rasteriser(self._frames.meshes)

    @property
    def settings(self) -> dict[str, Any]:
        """Settings for the sidecar."""
        return {"iterations": self.iterations}

    def refine_batch(self, frame: Frame, requests: Sequence[Request]) -> list[Refinement]:
        """Refine poses in an image.

        Raises:
            ConfigError: An object has no mesh here.
        """
        require_meshes(requests, self.meshes)
        return self._frames.own_results(self._refine_all(frame, self._frames.requests(requests)), requests)

    def _refine_all(self, frame: Frame, requests: Sequence[Request]) -> list[Refinement]:
        """Refine poses of the centres."""
        return [
            self._refine_if_renderable(frame, request.T_cam_obj, self._tracked_object(request)) for request in requests
        ]

    def _refine_if_renderable(
        self, frame: Frame, T_cam_obj: Float[np.ndarray, "4 4"], target: TrackedObject
    ) -> Refinement:
        """Refine a pose; one that cannot be rendered fails."""
        obstacle = render_obstacle(T_cam_obj, target.mesh)
        return failed(T_cam_obj, 0, obstacle) if obstacle else self._refine(frame, T_cam_obj, target)

    def _tracked_object(self, request: Request) -> TrackedObject:
        return TrackedObject(
            obj_id=request.obj_id, mesh=self._frames.meshes[request.obj_id], rasteriser=self._rasteriser
        )

    def close(self) -> None:
        """Free the renderer."""
        self._rasteriser.close()

    @abstractmethod
    def _refine(self, frame: Frame, T_cam_obj: Float[np.ndarray, "4 4"], target: TrackedObject) -> Refinement: ...


def failed(initial: Float[np.ndarray, "4 4"], iterations: int, reason: str) -> Refinement:
    """A failure: the initial pose and the reason."""
    T = np.asarray(initial, np.float64)
    return Refinement(T_cam_obj=T, status=Status.FAILED, iterations=iterations, failure=reason)


def refined(
    initial: Float[np.ndarray, "4 4"],
    before: Float[np.ndarray, "4 4"],
    after: Float[np.ndarray, "4 4"],
    iterations: int,
    diameter_m: float,
) -> Refinement:
    """The pose `after`; it converged if the last update, from `before`, was small.

    It failed if it is too far from the initial pose for a local method, which has then matched something else.
    """
    dR, dt_m = se3.update_between(initial, after)
    angle_deg, distance = np.rad2deg(se3.rotation_angle_rad(dR)), np.linalg.norm(dt_m) / diameter_m
    if not (angle_deg <= FAR_DEG and distance <= FAR_DIAMETERS):
        return failed(
            initial,
            iterations,
            f"it diverged: rotated by {angle_deg:.0f} deg and translated by {distance:.1f} diameters, at most "
            f"{FAR_DEG:.0f} deg and {FAR_DIAMETERS:g} diameters expected",
        )
    dR, dt_m = se3.update_between(before, after)
    small = se3.rotation_angle_rad(dR) < SMALL_ANGLE_RAD and np.linalg.norm(dt_m) < SMALL_DISTANCE * diameter_m
    return Refinement(T_cam_obj=after, status=Status.CONVERGED if small else Status.STOPPED, iterations=iterations)
