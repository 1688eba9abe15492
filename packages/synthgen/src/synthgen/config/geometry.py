"""Where the camera, the object, the hypotheses and the window are."""

from dataclasses import dataclass
from typing import Literal

from posecore.camera import Camera, intrinsics
from posecore.errors import ConfigError

from synthgen.config.ranges import Range, check, check_range


@dataclass(frozen=True, kw_only=True)
class CameraConfig:
    """Intrinsics and image size in pixels; the default is the LINEMOD camera to one decimal."""

    width_px: int = 640
    height_px: int = 480
    fx: float = 572.4
    fy: float = 573.6
    cx: float = 325.3
    cy: float = 242.0

    def __post_init__(self) -> None:
        check("width_px", self.width_px, 16)
        check("height_px", self.height_px, 16)
        check("fx", self.fx, 1.0)
        check("fy", self.fy, 1.0)

    def camera(self) -> Camera:
        """The camera as posecore knows it."""
        return Camera(
            K=intrinsics(self.fx, self.fy, self.cx, self.cy), width_px=self.width_px, height_px=self.height_px
        )


@dataclass(frozen=True, kw_only=True)
class DistanceConfig:
    """Camera z of the object's box centre.

    Attributes:
        unit: 'diameter' scales with the object, 'm' is absolute.
        min: Smallest distance in that unit; it also decides the window's side.
        max: Largest distance in that unit.
    """

    unit: Literal["diameter", "m"] = "diameter"
    min: float = 4.0
    max: float = 10.0

    def __post_init__(self) -> None:
        check_range("min, max", (self.min, self.max), 1e-6)

    def range_m(self, diameter_m: float) -> Range:
        """Distance range in metres for an object.

        Raises:
            ConfigError: The nearest distance puts the camera inside the object.
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
    """From where the object is seen and where in the image it lies.

    Attributes:
        viewpoint: 'so3' draws rotations uniformly; 'upright' keeps the object's +z up within `elevation_deg` and
            `roll_deg`, as for things that stand on a table.
        elevation_deg: Camera elevation above the object's xy plane, only for 'upright'.
        roll_deg: In-plane rotation, only for 'upright'.
        position_jitter: The projected box centre is uniform within this share of the image around its middle.
        min_inside: Smallest share of the silhouette's box that must lie inside the image.
    """

    viewpoint: Literal["so3", "upright"] = "so3"
    elevation_deg: Range = (0.0, 90.0)
    roll_deg: Range = (-30.0, 30.0)
    position_jitter: float = 0.6
    min_inside: float = 0.8

    def __post_init__(self) -> None:
        check_range("elevation_deg", self.elevation_deg, -90.0, 90.0)
        check_range("roll_deg", self.roll_deg, -180.0, 180.0)
        check("position_jitter", self.position_jitter, 0.0, 1.0)
        check("min_inside", self.min_inside, 0.0, 1.0)


@dataclass(frozen=True, kw_only=True)
class PerturbationConfig:
    """How far a hypothesis lies from the truth.

    Attributes:
        max_angle_deg: The angle is uniform in 0 to this, about a random axis.
        max_translation_diameter: The object moves in a random direction, the length uniform in 0 to this.
        easy_fraction: Share of hypotheses whose two bounds are multiplied by `easy_scale`, so that a refiner also sees
            starts that are nearly right.
        easy_scale: That factor.
    """

    max_angle_deg: float = 40.0
    max_translation_diameter: float = 0.25
    easy_fraction: float = 0.2
    easy_scale: float = 0.25

    def __post_init__(self) -> None:
        check("max_angle_deg", self.max_angle_deg, 0.0, 180.0)
        check("max_translation_diameter", self.max_translation_diameter, 0.0, 2.0)
        check("easy_fraction", self.easy_fraction, 0.0, 1.0)
        check("easy_scale", self.easy_scale, 0.0, 1.0)


@dataclass(frozen=True, kw_only=True)
class WindowConfig:
    """The fixed square window of an object.

    Attributes:
        padding: Added to the largest silhouette box at the smallest distance, as a share of it.
        shared: Whether all objects have the window of the one that needs the largest, as in datasets of a category,
            whose members stand for objects that nobody has seen.
        min_area_px: A silhouette with fewer patch pixels rejects the draw.
    """

    padding: float = 0.3
    shared: bool = False
    min_area_px: int = 150

    def __post_init__(self) -> None:
        check("padding", self.padding, 0.0, 4.0)
        check("min_area_px", self.min_area_px, 1)
