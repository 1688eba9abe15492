"""Interface of pose refinement methods, shared by the network and the baselines: frame, request, result."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from enum import StrEnum
from typing import Any, Literal, Protocol, runtime_checkable

import numpy as np
from jaxtyping import Float, UInt8
from posecore import se3
from posecore.camera import Camera
from posecore.errors import CameraError, ConfigError
from posecore.mesh import Mesh

from refinenet.errors import RefinementError

HypothesisScorer = Literal["gradient", "learned", "none"]
"""Ranking of a hypothesis set before refinement: image gradients, the network's confidence, or no ranking."""
ScoreKind = Literal["learned", "gradient", "search", "none"]
"""Source of a method's confidences: a trained output of the network; gradient similarity of render and image; a global
search, which fails below its own threshold; none."""

CENTRE_TOLERANCE = 0.2
"""Largest distance of the principal point from the image's centre, as a fraction of the image size. A larger one that
is equal in both directions belongs to an image of another size."""

SUSPICIOUS_M = 0.01
"""Closer than 1 cm: translation probably converted from millimetres twice."""
NEAREST_DIAMETERS = 0.6
"""Least distance of the object's centre, in diameters; a nearer object reaches the camera."""
FARTHEST_DIAMETERS = 500.0
"""Largest distance in diameters; a farther pose is in another unit, as the object would be about a pixel wide."""
ROTATION_TOLERANCE = 0.02
"""Tolerance of the orthonormality check; result files hold few digits."""


class Status(StrEnum):
    """Outcome of the refinement of a pose."""

    CONVERGED = "converged"
    """The last update was small."""
    STOPPED = "stopped"
    """All iterations were used before an update was small."""
    FAILED = "failed"
    """There is no refined pose."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Frame:
    """An image with its camera.

    Attributes:
        image: RGB.
        K: Camera matrix, pixel centres at + 0.5.
        depth_m: Camera z in metres, 0 where unknown; None without depth.

    Raises:
        RefinementError: The image is not 8-bit RGB, or the depth has another size.
        CameraError: K is not a camera matrix, or belongs to an image of another size.
    """

    image: UInt8[np.ndarray, "h w 3"]
    K: Float[np.ndarray, "3 3"]
    depth_m: Float[np.ndarray, "h w"] | None = None

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
                f"{width} x {height} px; it fits {2 * K[0, 2]:.0f} x {2 * K[1, 2]:.0f} px: scale K with the image"
            )


@dataclass(frozen=True, kw_only=True, eq=False)
class Request:
    """A pose to refine: object and initial pose (metres, object to camera)."""

    obj_id: int
    T_cam_obj: Float[np.ndarray, "4 4"]


@dataclass(frozen=True, kw_only=True, eq=False)
class Refinement:
    """A refined pose.

    Attributes:
        T_cam_obj: Metres; the initial pose after a failure.
        status: Outcome.
        iterations: Number of applied updates.
        confidence: In [0, 1], 0 after a failure; None from a method without confidences.
        failure: Reason of a failure, without a full stop; else None.
        candidates: All poses that a global search scored, with their confidences; the pose that it chose is last. Empty
            from a local method.
    """

    T_cam_obj: Float[np.ndarray, "4 4"]
    status: Status
    iterations: int
    confidence: float | None = None
    failure: str | None = None
    candidates: tuple["Refinement", ...] = ()

    @property
    def failed(self) -> bool:
        """Whether there is no refined pose."""
        return self.status is Status.FAILED


def render_obstacle(T_cam_obj: Float[np.ndarray, "4 4"], mesh: Mesh) -> str | None:
    """Reason why an object cannot be rendered at a pose (metres) in any image; None where it can."""
    if not np.isfinite(T_cam_obj).all():
        return "its pose is not finite"
    if not se3.is_rotation(T_cam_obj[:3, :3], ROTATION_TOLERANCE):
        return "its upper 3 x 3 block is not a rotation: it is scaled, mirrored or sheared"
    z_m = float(mesh.center_cam_m(T_cam_obj)[2])
    if z_m < NEAREST_DIAMETERS * mesh.diameter_m:
        unit = "; were metres taken for millimetres?" if 0 < z_m < SUSPICIOUS_M else ""
        return f"at z = {z_m:.3g} m it is behind the camera or reaches it{unit}"
    if z_m > FARTHEST_DIAMETERS * mesh.diameter_m:
        return f"it is {z_m:.6g} m away with a diameter of {mesh.diameter_m:.3g} m; were millimetres taken for metres?"
    return None


def require_meshes(requests: Sequence[Request], meshes: Mapping[int, Mesh]) -> None:
    """Refuse objects whose meshes a method does not have.

    Raises:
        ConfigError: An object has no mesh; the message lists the objects that have one.
    """
    for request in requests:
        if request.obj_id not in meshes:
            obj_ids = ", ".join(map(str, sorted(meshes)))
            raise ConfigError(f"object {request.obj_id} has no mesh here, there are those of {obj_ids}")


@runtime_checkable
class PoseRefiner(Protocol):
    """A refinement method; its constructor takes the objects' meshes and the settings."""

    @property
    def name(self) -> str:
        """Name in a report."""
        ...

    @property
    def needs_depth(self) -> bool:
        """Whether frames must have depth."""
        ...

    @property
    def score_kind(self) -> ScoreKind:
        """Source of the confidences."""
        ...

    @property
    def corrects_depth(self) -> bool:
        """Whether updates correct depth well enough that tracking needs no hypotheses at other depths."""
        ...

    @property
    def settings(self) -> dict[str, Any]:
        """Settings for the result file's sidecar: JSON values, units in the keys."""
        ...

    @property
    def meshes(self) -> Mapping[int, Mesh]:
        """The objects' meshes, as given to the constructor."""
        ...

    def refine_batch(self, frame: Frame, requests: Sequence[Request]) -> list[Refinement]:
        """Refine poses in an image: a result for each request, in the same order.

        Poses are those of the meshes' origins; the result does not depend on where an origin lies.

        A pose that cannot be refined is a result with status `FAILED`, not an error.
        """
        ...

    def close(self) -> None:
        """Free the renderers."""
        ...


class NetworkRefiner(PoseRefiner, Protocol):
    """A network that another method uses."""

    @property
    def predicts_pose_quality(self) -> bool:
        """Whether confidences were trained on the pose error, rotation included."""
        ...
