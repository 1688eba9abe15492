"""What refines poses: the interface that the network and the baselines share.

`refinenet refine --method NAME` takes the network, or a baseline that is listed in `BASELINES`.
"""

import importlib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from enum import StrEnum
from typing import Any, Protocol, runtime_checkable

import numpy as np
from jaxtyping import Float, UInt8
from posecore.mesh import Mesh

Array = np.ndarray

NETWORK = "network"
BASELINES: dict[str, str] = {
    "edge-icp": "refinenet.baselines.edge_icp:EdgeIcp",
    "depth-icp": "refinenet.baselines.depth_icp:DepthIcp",
    "region": "refinenet.baselines.region:RegionTracker",
    "search": "refinenet.baselines.search:GradientSearch",
}
"""By name of the method, `module:class` of a `PoseRefiner` that is made with `(meshes, iterations=...)`."""


class Status(StrEnum):
    """How refinement of one pose ended."""

    CONVERGED = "converged"
    """The last update was small."""
    STOPPED = "stopped"
    """The iterations were used up before."""
    FAILED = "failed"
    """There is no refined pose."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Frame:
    """One image with its camera.

    Attributes:
        image: RGB.
        K: Its camera matrix, pixel centres at + 0.5.
        depth_m: Camera z in metres, 0 where unknown; None where there is no depth.
    """

    image: UInt8[Array, "h w 3"]
    K: Float[Array, "3 3"]
    depth_m: Float[Array, "h w"] | None = None


@dataclass(frozen=True, kw_only=True, eq=False)
class Request:
    """One pose to refine: object and start pose (metres, object to camera)."""

    obj_id: int
    T_cam_obj: Float[Array, "4 4"]


@dataclass(frozen=True, kw_only=True, eq=False)
class Refinement:
    """One refined pose.

    Attributes:
        T_cam_obj: Metres; the start pose where it failed.
        status: How it ended.
        iterations: Updates that were applied.
        confidence: In [0, 1], 0 where it failed; None from a method that has none.
        failure: Why it failed, without a full stop; None where it did not.
        tried: Every pose that was weighed on the way, with the confidence that it got; none from a method that follows
            one pose.
    """

    T_cam_obj: Float[Array, "4 4"]
    status: Status
    iterations: int
    confidence: float | None = None
    failure: str | None = None
    tried: tuple["Refinement", ...] = ()

    @property
    def failed(self) -> bool:
        """Whether there is no refined pose."""
        return self.status is Status.FAILED


@runtime_checkable
class PoseRefiner(Protocol):
    """A method. Its objects' meshes and its settings were given when it was made."""

    @property
    def name(self) -> str:
        """What a report calls it."""
        ...

    @property
    def needs_depth(self) -> bool:
        """Whether frames must have depth."""
        ...

    @property
    def settings(self) -> dict[str, Any]:
        """What the result file's sidecar says of it; JSON values, units in the keys."""
        ...

    def refine_batch(self, frame: Frame, requests: Sequence[Request]) -> list[Refinement]:
        """Refine poses in one image: a result for each request, in their order.

        A pose that cannot be refined is a result with status `FAILED`, not an error.
        """
        ...

    def close(self) -> None:
        """Free what it holds."""
        ...


class NetworkRefiner(PoseRefiner, Protocol):
    """A network as another method uses it."""

    @property
    def tells_closeness(self) -> bool:
        """Whether its confidences were trained to say how near a pose is to the truth, turns included."""
        ...


WITH_NETWORK = ("search",)
"""Those that a network makes more exact, where there is one."""
WITH_CONFIDENCE = (NETWORK, *WITH_NETWORK)
"""Those that tell how confident they are of a pose."""


def make_baseline(
    name: str,
    meshes: Mapping[int, Mesh],
    iterations: int,
    *,
    network: NetworkRefiner | None = None,
    min_confidence: float | None = None,
) -> PoseRefiner:
    """A method of `BASELINES`.

    Args:
        name: Of the method.
        meshes: Objects by id.
        iterations: Most updates of a pose.
        network: For those of `WITH_NETWORK`, closed with the method.
        min_confidence: For those of `WITH_CONFIDENCE`, the least that is no failure; the method's own where it is None.
    """
    module, _, made = BASELINES[name].partition(":")
    given = {"network": network, "min_confidence": min_confidence}
    more = {key: value for key, value in given.items() if value is not None}
    refiner: PoseRefiner = getattr(importlib.import_module(module), made)(meshes, iterations=iterations, **more)
    return refiner
