"""Whole images of BOP datasets: single frames and sequences."""

from dataclasses import dataclass
from typing import Annotated, Literal

from posecore.config import Range, check_ranges


@dataclass(frozen=True, kw_only=True)
class FrameConfig:
    """Whole camera images, as `synthgen bop` renders them.

    Attributes:
        objects: Number of labelled objects in an image.
        instances: Maximum number of instances of an object in an image.
        gap_diameter: Clearance between adjacent objects, in diameters of the added object.
        lights: `lamps` are those of training pairs; `ceiling` is a large lamp overhead and a small lamp at any side.
        min_target_visible: Smallest visible fraction of an object in the list of targets (BOP's).
    """

    objects: Annotated[tuple[int, int], Range(1, 1000)] = (1, 1)
    instances: Annotated[int, Range(1, 1000)] = 1
    gap_diameter: Annotated[tuple[float, float], Range(0, 10)] = (0.02, 0.5)
    lights: Literal["lamps", "ceiling"] = "lamps"
    min_target_visible: Annotated[float, Range(0, 1)] = 0.1

    def __post_init__(self) -> None:
        check_ranges(self)


@dataclass(frozen=True, kw_only=True)
class SequenceConfig:
    """Motion of tracking sequences. Speeds are those of the first object in the camera frame.

    Attributes:
        fps: Images per second.
        max_angular_speed_deg_s: Maximum angular speed.
        max_speed_diameter_s: Maximum speed of the box centre.
        min_period_s: Shortest period of any motion.
        occluder_period_s: Time in which an occluder crosses in front of the object once; 0 for none.
        light_variation: Largest change of a lamp's strength either way, as a fraction.
        shutter: Exposure time (motion blur) as a fraction of the time between two images.
    """

    fps: Annotated[float, Range(0.1, 10_000)] = 30.0
    max_angular_speed_deg_s: Annotated[float, Range(0, 3600)] = 90.0
    max_speed_diameter_s: Annotated[float, Range(0, 100)] = 3.0
    min_period_s: Annotated[float, Range(0.05, 3600)] = 2.0
    occluder_period_s: Annotated[float, Range(0, 3600)] = 4.0
    light_variation: Annotated[float, Range(0, 0.9)] = 0.4
    shutter: Annotated[tuple[float, float], Range(0, 1)] = (0.0, 0.5)

    def __post_init__(self) -> None:
        check_ranges(self)
