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
from posecore import se3
from posecore.camera import Camera
from posecore.errors import CameraError, ConfigError
from posecore.mesh import Mesh

from refinenet.errors import RefinementError

Array = np.ndarray
CENTRE_TOLERANCE = 0.2
"""A principal point further off the image's centre, as a share of its size, and equally far in both directions, is
that of an image of another size."""

SUSPICIOUS_M = 0.01
"""A pose nearer than this was divided by a thousand once too often."""
NEAREST_DIAMETERS = 0.6
"""An object whose centre is nearer than so many diameters reaches the camera."""
FARTHEST_DIAMETERS = 500.0
"""A pose further away is in another unit: the object would be about a pixel wide."""
ROTATION_TOLERANCE = 0.02
"""Of a rotation's orthonormality; result files are written with few digits."""

NETWORK = "network"
BASELINES: dict[str, str] = {
    "edge-icp": "refinenet.baselines.edge_icp:EdgeIcp",
    "depth-icp": "refinenet.baselines.depth_icp:DepthIcp",
    "region": "refinenet.baselines.region_tracker:RegionTracker",
    "search": "refinenet.baselines.global_search:GradientSearch",
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

    Raises:
        RefinementError: The image is no 8-bit RGB, or the depth has another size.
        CameraError: K is no camera matrix, or that of an image of another size.
    """

    image: UInt8[Array, "h w 3"]
    K: Float[Array, "3 3"]
    depth_m: Float[Array, "h w"] | None = None

    def __post_init__(self) -> None:
        image = np.asarray(self.image)
        if image.dtype != np.uint8 or image.ndim != 3 or image.shape[2] != 3:
            raise RefinementError(
                f"image: found {image.dtype} of shape {image.shape}, expected uint8 of (height, width, 3), RGB"
            )
        if self.depth_m is not None and np.shape(self.depth_m) != image.shape[:2]:
            raise RefinementError(
                f"depth: found shape {np.shape(self.depth_m)}, expected the image's {image.shape[:2]}"
            )
        height, width = image.shape[:2]
        K = Camera(K=self.K, width_px=width, height_px=height).K
        object.__setattr__(self, "K", K)
        across, down = K[0, 2] / width, K[1, 2] / height
        is_scaled = abs(across - down) < 0.1 and min(abs(across - 0.5), abs(down - 0.5)) > CENTRE_TOLERANCE
        if not (0 <= across <= 1 and 0 <= down <= 1) or is_scaled:
            raise CameraError(
                f"camera matrix: the principal point ({K[0, 2]:.1f}, {K[1, 2]:.1f}) px does not fit an image of "
                f"{width} x {height} px; it looks like that of {2 * K[0, 2]:.0f} x {2 * K[1, 2]:.0f} px: "
                "scale K with the image"
            )


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
        tried: Every pose that was weighed on the way, with the confidence that it got, those of the search that it is
            from last; none from a method that follows one pose.
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


def unseeable(T_cam_obj: Float[Array, "4 4"], mesh: Mesh) -> str | None:
    """Why an object cannot even be drawn at a pose (metres), whatever the image; None where it can."""
    if not np.isfinite(T_cam_obj).all():
        return "its pose is not finite"
    if not se3.is_rotation(T_cam_obj[:3, :3], ROTATION_TOLERANCE):
        return "its rotation is none: scaled, mirrored or sheared"
    z_m = float(T_cam_obj[2, :3] @ mesh.center_m + T_cam_obj[2, 3])
    if z_m < NEAREST_DIAMETERS * mesh.diameter_m:
        unit = "; were metres taken for millimetres?" if 0 < z_m < SUSPICIOUS_M else ""
        return f"at z = {z_m:.3g} m it is behind the camera or reaches it{unit}"
    if z_m > FARTHEST_DIAMETERS * mesh.diameter_m:
        return f"it is {z_m:.6g} m away with a diameter of {mesh.diameter_m:.3g} m; were millimetres taken for metres?"
    return None


def require_meshes(requests: Sequence[Request], meshes: Mapping[int, Mesh]) -> None:
    """Refuse objects that a method was not made for.

    Raises:
        ConfigError: There is one; those that it knows are named.
    """
    for request in requests:
        if request.obj_id not in meshes:
            known = ", ".join(map(str, sorted(meshes)))
            raise ConfigError(f"object {request.obj_id} has no mesh here, there are those of {known}")


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
