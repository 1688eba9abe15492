"""Whole images: frames and sequences of BOP datasets."""

from dataclasses import dataclass
from typing import Literal

from synthgen.config.ranges import IntRange, Range, check, check_range


@dataclass(frozen=True, kw_only=True)
class FrameConfig:
    """Whole camera images, as `synthgen bop` renders them.

    Attributes:
        objects: Number of labelled objects in an image.
        instances: How often one object may be among them.
        gap_diameter: Room between two that lie together, in diameters of the one that is added.
        lights: 'lamps' are those of training pairs; 'ceiling' is a large lamp overhead and a small one around.
        min_target_visible: Visible share from which an object is to be found (BOP's targets).
    """

    objects: IntRange = (1, 1)
    instances: int = 1
    gap_diameter: Range = (0.02, 0.5)
    lights: Literal["lamps", "ceiling"] = "lamps"
    min_target_visible: float = 0.1

    def __post_init__(self) -> None:
        check_range("objects", self.objects, 1, 1000)
        check("instances", self.instances, 1, 1000)
        check_range("gap_diameter", self.gap_diameter, 0.0, 10.0)
        check("min_target_visible", self.min_target_visible, 0.0, 1.0)


@dataclass(frozen=True, kw_only=True)
class SequenceConfig:
    """Motion of tracking sequences: how the first object moves as the camera sees it.

    Attributes:
        fps: Images a second.
        max_angular_speed_deg_s: Bound on its angular speed.
        max_speed_diameter_s: Bound on its box centre's speed.
        min_period_s: Nothing swings faster than with this period.
        occluder_period_s: A shape passes before it once in every such span; 0 for never.
        light_variation: Largest change of a lamp's strength either way, as a share.
        shutter: Share of the time between two images that the shutter is open: what motion blur covers.
    """

    fps: float = 30.0
    max_angular_speed_deg_s: float = 90.0
    max_speed_diameter_s: float = 3.0
    min_period_s: float = 2.0
    occluder_period_s: float = 4.0
    light_variation: float = 0.4
    shutter: Range = (0.0, 0.5)

    def __post_init__(self) -> None:
        check("fps", self.fps, 0.1, 10_000.0)
        check("max_angular_speed_deg_s", self.max_angular_speed_deg_s, 0.0, 3600.0)
        check("max_speed_diameter_s", self.max_speed_diameter_s, 0.0, 100.0)
        check("min_period_s", self.min_period_s, 0.05, 3600.0)
        check("occluder_period_s", self.occluder_period_s, 0.0, 3600.0)
        check("light_variation", self.light_variation, 0.0, 0.9)
        check_range("shutter", self.shutter, 0.0, 1.0)
