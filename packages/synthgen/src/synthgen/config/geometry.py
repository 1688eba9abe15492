"""Geometry: camera, object distance and viewpoint, hypotheses, window."""

from dataclasses import dataclass
from typing import Annotated, Literal

from posecore.camera import Camera, intrinsics
from posecore.config import Range, check_ranges
from posecore.errors import ConfigError

MAX_PATCH_PX = 362
"""Largest patch: its diagonal is 512 px, the largest distance that shards can store."""


@dataclass(frozen=True, kw_only=True)
class CameraConfig:
    """Intrinsics and image size in pixels; the default is the LINEMOD camera to one decimal."""

    width_px: Annotated[int, Range(16)] = 640
    height_px: Annotated[int, Range(16)] = 480
    fx: Annotated[float, Range(1)] = 572.4
    fy: Annotated[float, Range(1)] = 573.6
    cx: float = 325.3
    cy: float = 242.0

    def __post_init__(self) -> None:
        check_ranges(self)

    def camera(self) -> Camera:
        """The pinhole camera."""
        return Camera(
            K=intrinsics(self.fx, self.fy, self.cx, self.cy), width_px=self.width_px, height_px=self.height_px
        )


@dataclass(frozen=True, kw_only=True)
class DistanceConfig:
    """Camera z of the object's box centre.

    Attributes:
        unit: `diameter` scales with the object, `m` is absolute.
        min: Smallest distance, in `unit`; it also decides the window's side.
        max: Largest distance, in `unit`.
    """

    unit: Literal["diameter", "m"] = "diameter"
    min: Annotated[float, Range(1e-6)] = 4.0
    max: Annotated[float, Range(1e-6)] = 10.0

    def __post_init__(self) -> None:
        check_ranges(self)
        if self.min > self.max:
            raise ConfigError(f"min is {self.min} and max is {self.max}, expected min <= max")

    def range_m(self, diameter_m: float) -> tuple[float, float]:
        """Distance range in metres for an object.

        Raises:
            ConfigError: At the smallest distance the camera is inside the object.
        """
        factor = diameter_m if self.unit == "diameter" else 1.0
        low, high = self.min * factor, self.max * factor
        if low < diameter_m:
            raise ConfigError(
                f"distance.min is {low:.4g} m for an object of {diameter_m:.4g} m diameter, expected at least one "
                "diameter; raise distance.min or set distance.unit=diameter"
            )
        return low, high


@dataclass(frozen=True, kw_only=True)
class ViewConfig:
    """Viewpoint, and position of the object in the image.

    Attributes:
        viewpoint: `so3` draws rotations uniformly; `upright` keeps the object's +z up within `elevation_deg` and
            `roll_deg`, as for objects that stand on a table.
        elevation_deg: Camera elevation above the object's xy plane, only for `upright`.
        roll_deg: In-plane rotation, only for `upright`.
        position_jitter: The projected box centre is uniform within this fraction of the image around its middle.
        min_inside: Smallest fraction of the silhouette's box inside the image.
    """

    viewpoint: Literal["so3", "upright"] = "so3"
    elevation_deg: Annotated[tuple[float, float], Range(-90, 90)] = (0.0, 90.0)
    roll_deg: Annotated[tuple[float, float], Range(-180, 180)] = (-30.0, 30.0)
    position_jitter: Annotated[float, Range(0, 1)] = 0.6
    min_inside: Annotated[float, Range(0, 1)] = 0.8

    def __post_init__(self) -> None:
        check_ranges(self)


@dataclass(frozen=True, kw_only=True)
class PerturbationConfig:
    """Distance of hypotheses from the ground truth.

    Attributes:
        max_angle_deg: Maximum rotation angle; uniform from 0, about a random axis.
        max_translation_diameter: Maximum translation; uniform from 0, in a random direction.
        easy_fraction: Fraction of hypotheses whose two bounds are multiplied by `easy_scale`, so that a refiner is also
            trained on nearly correct initial poses.
        easy_scale: Factor on both bounds of easy hypotheses.
    """

    max_angle_deg: Annotated[float, Range(0, 180)] = 40.0
    max_translation_diameter: Annotated[float, Range(0, 2)] = 0.25
    easy_fraction: Annotated[float, Range(0, 1)] = 0.2
    easy_scale: Annotated[float, Range(0, 1)] = 0.25

    def __post_init__(self) -> None:
        check_ranges(self)


@dataclass(frozen=True, kw_only=True)
class FixedWindowConfig:
    """The fixed square window of an object.

    Attributes:
        padding: Margin, as a fraction of the largest silhouette box at the smallest distance.
        shared: Whether all objects have the largest object's window, as in datasets of a category, whose members stand
            for unseen objects.
        min_area_px: Smallest silhouette area in patch pixels; draws below it are rejected.
    """

    padding: Annotated[float, Range(0, 4)] = 0.3
    shared: bool = False
    min_area_px: Annotated[int, Range(1)] = 150

    def __post_init__(self) -> None:
        check_ranges(self)
