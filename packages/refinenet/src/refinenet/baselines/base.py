"""The refiner's interface around a function that refines one pose."""

from abc import ABC, abstractmethod
from collections.abc import Mapping, Sequence
from typing import Any, ClassVar

import numpy as np
from jaxtyping import Float
from posecore import se3
from posecore.mesh import Mesh
from posecore.raster import Rasteriser

from refinenet.baselines.patch import Target
from refinenet.refiner import Frame, Refinement, Request, Status, require_meshes, unseeable

Array = np.ndarray
SMALL_ANGLE_RAD = np.deg2rad(0.5)
SMALL_DISTANCE = 0.01
"""Under this angle and this share of the diameter, an update is small."""

FAR_DEG, FAR_DIAMETERS = 60.0, 0.75
"""A pose further from its start than this, in angle or diameters, has diverged. Chosen on renders."""


class Baseline(ABC):
    """A `PoseRefiner` that goes through the poses one by one.

    Args:
        meshes: Objects by id.
        iterations: Renders, each followed by an update, at every resolution or search range.
    """

    name: str
    needs_depth: ClassVar[bool] = False

    def __init__(self, meshes: Mapping[int, Mesh], *, iterations: int = 5) -> None:
        self.iterations = iterations
        self._meshes = dict(meshes)
        self._rasteriser = Rasteriser(meshes)

    @property
    def settings(self) -> dict[str, Any]:
        """For the sidecar."""
        return {"iterations": self.iterations}

    def refine_batch(self, frame: Frame, requests: Sequence[Request]) -> list[Refinement]:
        """Refine poses in one image.

        Raises:
            ConfigError: An object has no mesh here.
        """
        require_meshes(requests, self._meshes)
        return [self._seen(frame, request.T_cam_obj, self._target(request)) for request in requests]

    def _seen(self, frame: Frame, T_cam_obj: Float[Array, "4 4"], target: Target) -> Refinement:
        """Refine one pose, if it can be drawn at all."""
        why = unseeable(T_cam_obj, target.mesh)
        return failed(T_cam_obj, 0, why) if why else self._refine(frame, T_cam_obj, target)

    def _target(self, request: Request) -> Target:
        return Target(obj_id=request.obj_id, mesh=self._meshes[request.obj_id], rasteriser=self._rasteriser)

    def close(self) -> None:
        """Free what the renderer holds."""
        self._rasteriser.close()

    @abstractmethod
    def _refine(self, frame: Frame, T_cam_obj: Float[Array, "4 4"], target: Target) -> Refinement: ...


def failed(start: Float[Array, "4 4"], iterations: int, why: str) -> Refinement:
    """The start pose and the reason."""
    T = np.asarray(start, np.float64)
    return Refinement(T_cam_obj=T, status=Status.FAILED, iterations=iterations, failure=why)


def refined(
    start: Float[Array, "4 4"],
    before: Float[Array, "4 4"],
    after: Float[Array, "4 4"],
    iterations: int,
    diameter_m: float,
) -> Refinement:
    """The pose `after`, converged if the last update, which led there from `before`, was small.

    It failed where it is too far from the start for a local method: what it found there is something else.
    """
    dR, dt_m = se3.update_between(start, after)
    turned_deg, moved_by = np.rad2deg(se3.rotation_angle_rad(dR)), np.linalg.norm(dt_m) / diameter_m
    if not (turned_deg <= FAR_DEG and moved_by <= FAR_DIAMETERS):
        return failed(
            start,
            iterations,
            f"it diverged: turned by {turned_deg:.0f} deg and moved by {moved_by:.1f} diameters, "
            f"{FAR_DEG:.0f} deg and {FAR_DIAMETERS:g} diameters are in its reach",
        )
    dR, dt_m = se3.update_between(before, after)
    small = se3.rotation_angle_rad(dR) < SMALL_ANGLE_RAD and np.linalg.norm(dt_m) < SMALL_DISTANCE * diameter_m
    return Refinement(T_cam_obj=after, status=Status.CONVERGED if small else Status.STOPPED, iterations=iterations)
