"""Frames of objects with their origins at the pivots that poses are updated about."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float, Int
from posecore import se3
from posecore.bop import ModelInfo
from posecore.mesh import Mesh

from refinenet.refiner import Refinement, Request


@dataclass(frozen=True, kw_only=True, eq=False)
class PivotFrames:
    """Frames with the objects' axes and the origin at a pivot, where updates, rays and limits need no offset.

    Files, requests and results hold poses of the objects' own origins, which may lie anywhere: they are converted on
    the way in and out.

    Attributes:
        meshes: By object id, in the pivot's frame.
        pivots_m: Pivot of each object in its own frame, metres.
    """

    meshes: dict[int, Mesh]
    pivots_m: dict[int, Float[np.ndarray, "3"]]

    @classmethod
    def at_centers(cls, meshes: Mapping[int, Mesh]) -> "PivotFrames":
        """Pivots at the objects' centres."""
        return cls.at(meshes, {obj_id: mesh.center_m for obj_id, mesh in meshes.items()})

    @classmethod
    def at(cls, meshes: Mapping[int, Mesh], pivots_m: Mapping[int, Float[np.ndarray, "3"]]) -> "PivotFrames":
        """Pivots at points of the objects' own frames, metres."""
        return cls(
            meshes={obj_id: mesh.with_origin_at(pivots_m[obj_id]) for obj_id, mesh in meshes.items()},
            pivots_m=dict(pivots_m),
        )

    def models(self, models: Mapping[int, ModelInfo]) -> dict[int, ModelInfo]:
        """Symmetries in the pivots' frames, of the objects that have a pivot."""
        return {i: model.with_origin_at(self.pivots_m[i]) for i, model in models.items() if i in self.pivots_m}

    def poses(self, T_cam_obj: Float[np.ndarray, "n 4 4"], obj_id: Int[np.ndarray, " n"]) -> Float[np.ndarray, "n 4 4"]:
        """Poses of the pivots' frames from those of the objects' own."""
        points_m = np.array([self.pivots_m[int(i)] for i in obj_id]).reshape(-1, 3)
        return se3.with_origin_at(T_cam_obj, points_m)

    def requests(self, requests: Sequence[Request]) -> list[Request]:
        """Requests with poses of the pivots' frames."""
        return [replace(r, T_cam_obj=_moved(r.T_cam_obj, self.pivots_m[r.obj_id])) for r in requests]

    def own_requests(self, requests: Sequence[Request]) -> list[Request]:
        """Requests with poses of the objects' own frames: the way back of `requests`."""
        return [replace(r, T_cam_obj=_moved(r.T_cam_obj, -self.pivots_m[r.obj_id])) for r in requests]

    def results(self, results: Sequence[Refinement], requests: Sequence[Request]) -> list[Refinement]:
        """Results with poses of the pivots' frames, for requests of the objects' own frames."""
        pairs = zip(results, requests, strict=True)
        return [_converted(result, self.pivots_m[request.obj_id]) for result, request in pairs]

    def own_results(self, results: Sequence[Refinement], requests: Sequence[Request]) -> list[Refinement]:
        """Results with poses of the objects' own frames; a failure has the requested pose, digit by digit.

        Args:
            results: In the pivots' frames.
            requests: In the objects' own frames, in the same order.
        """
        pairs = zip(results, requests, strict=True)
        converted = [(_converted(result, -self.pivots_m[request.obj_id]), request) for result, request in pairs]
        return [
            replace(result, T_cam_obj=np.asarray(request.T_cam_obj, np.float64)) if result.failed else result
            for result, request in converted
        ]


def _moved(T_cam_obj: Float[np.ndarray, "4 4"], point_m: Float[np.ndarray, "3"]) -> Float[np.ndarray, "4 4"]:
    return se3.with_origin_at(np.asarray(T_cam_obj, np.float64), point_m)


def _converted(result: Refinement, point_m: Float[np.ndarray, "3"]) -> Refinement:
    candidates = tuple(_converted(candidate, point_m) for candidate in result.candidates)
    return replace(result, T_cam_obj=_moved(result.T_cam_obj, point_m), candidates=candidates)
