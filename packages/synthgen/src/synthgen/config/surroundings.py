"""What is around the object: tables, light, occluders, backgrounds; and its surface and the camera's effects."""

from dataclasses import dataclass
from typing import Literal

from posecore.errors import ConfigError

from synthgen.config.ranges import IntRange, Range, check, check_range


@dataclass(frozen=True, kw_only=True)
class SceneConfig:
    """Which kinds of scene.

    Attributes:
        kind: 'cutout' has the object in mid air over a background, with shapes floating around it; 'tabletop' has it on
            or near a textured plane, among things that lie there; 'mixed' draws one of the two for each scene.
        tabletop_fraction: Share of tabletop scenes, only for 'mixed'.
    """

    kind: Literal["cutout", "tabletop", "mixed"] = "cutout"
    tabletop_fraction: float = 0.5

    def __post_init__(self) -> None:
        check("tabletop_fraction", self.tabletop_fraction, 0.0, 1.0)


@dataclass(frozen=True, kw_only=True)
class TabletopConfig:
    """Scenes of kind 'tabletop'. In-plane rotation is `view.roll_deg`; `view.viewpoint` 'upright' rests with +z up.

    Attributes:
        elevation_deg: Camera elevation above the table, uniform on the sphere's zone.
        near_fraction: Share of scenes with the object in any orientation, its lowest point above the table by
            `hover_diameter`, instead of at rest.
        hover_diameter: Height of that lowest point; 0 touches.
        tables: Number of different tables made for a dataset.
        size_diameter: Sides of a table, uniform in the logarithm; in units of 0.1 m doubled or halved to come nearest
            to the object's diameter, so that objects of about one size share their tables.
        distractors: Number of other things on the table.
        gap_diameter: Clearance between the circles around two things on the table.
    """

    elevation_deg: Range = (20.0, 80.0)
    near_fraction: float = 0.25
    hover_diameter: Range = (0.0, 0.25)
    tables: int = 12
    size_diameter: Range = (4.0, 10.0)
    distractors: IntRange = (0, 4)
    gap_diameter: Range = (0.02, 0.8)

    def __post_init__(self) -> None:
        check_range("elevation_deg", self.elevation_deg, 1.0, 90.0)
        check("near_fraction", self.near_fraction, 0.0, 1.0)
        check_range("hover_diameter", self.hover_diameter, 0.0, 2.0)
        check("tables", self.tables, 1, 200)
        check_range("size_diameter", self.size_diameter, 2.0, 40.0)
        check_range("distractors", self.distractors, 0, 50)
        check_range("gap_diameter", self.gap_diameter, 0.0, 10.0)


@dataclass(frozen=True, kw_only=True)
class LightConfig:
    """Lamps around the object.

    Attributes:
        hdri_fraction: Share of scenes lit by a panorama instead of lamps, where a folder of panoramas is given; its
            brightness is drawn from `brightness`, its turn about the vertical uniformly.
        count: Number of lamps.
        brightness: Linear radiance of a white surface that faces all the light, drawn uniformly in its logarithm.
        ambient_fraction: Share of it that comes evenly from all around.
        colour: How far a lamp's colour may leave white, 0 to 1.
        distance_diameter: Distance of the lamps from the object.
        size: A lamp's size as a share of its distance; small is hard shadows.
    """

    hdri_fraction: float = 0.5
    count: IntRange = (1, 3)
    brightness: Range = (0.5, 1.6)
    ambient_fraction: Range = (0.15, 0.7)
    colour: float = 0.35
    distance_diameter: Range = (2.0, 8.0)
    size: Range = (0.02, 0.6)

    def __post_init__(self) -> None:
        check("hdri_fraction", self.hdri_fraction, 0.0, 1.0)
        check_range("count", self.count, 0, 16)
        check_range("brightness", self.brightness, 1e-3, 100.0)
        check_range("ambient_fraction", self.ambient_fraction, 0.0, 1.0)
        check("colour", self.colour, 0.0, 1.0)
        check_range("distance_diameter", self.distance_diameter, 1.0)
        check_range("size", self.size, 1e-3, 2.0)


@dataclass(frozen=True, kw_only=True)
class MaterialConfig:
    """Variation of the target's surface around its own colours.

    Attributes:
        textureless_fraction: Share of scenes in which the object has its mean colour all over.
        random_colour_fraction: Fraction of scenes in which its colours are random: half are plain, half have a
            procedural texture of two colours.
        hue_shift: Largest hue rotation in turns, either way.
        saturation: Factor on the saturation.
        value: Factor on the brightness.
        roughness: Principled roughness.
        metallic: Principled metallic.
        specular: Principled specular level.
    """

    textureless_fraction: float = 0.0
    random_colour_fraction: float = 0.0
    hue_shift: float = 0.04
    saturation: Range = (0.7, 1.3)
    value: Range = (0.75, 1.2)
    roughness: Range = (0.2, 1.0)
    metallic: Range = (0.0, 0.3)
    specular: Range = (0.1, 0.7)

    def __post_init__(self) -> None:
        check("textureless_fraction", self.textureless_fraction, 0.0, 1.0)
        check("random_colour_fraction", self.random_colour_fraction, 0.0, 1.0 - self.textureless_fraction)
        check("hue_shift", self.hue_shift, 0.0, 0.5)
        for name in ("saturation", "value"):
            check_range(name, getattr(self, name), 0.0, 4.0)
        for name in ("roughness", "metallic", "specular"):
            check_range(name, getattr(self, name), 0.0, 1.0)


@dataclass(frozen=True, kw_only=True)
class OccluderConfig:
    """Shapes in front of, beside and behind the object: primitives, or the meshes of a folder.

    Attributes:
        library: Number of different shapes made for a dataset; of a folder's meshes at most this many are used.
        scale: 'fit' gives a folder's meshes `size_diameter`, 'own' leaves them at their own size.
        size_diameter: Diameter of a shape.
        front: Number of shapes that may hide the object.
        props: Number of shapes around it, in cutout scenes.
        visible_fraction: Wanted visible share of the object, uniform in this range: shapes in front are slid in, and up
            to four are added, until it is met. Nothing (null) leaves it to where the shapes happen to be. Without
            effect where `front` allows none.
        min_visible: Smallest visible share of the object; a scene below it is drawn again.
    """

    library: int = 32
    scale: Literal["fit", "own"] = "fit"
    size_diameter: Range = (0.25, 1.0)
    front: IntRange = (0, 2)
    props: IntRange = (0, 3)
    visible_fraction: Range | None = None
    min_visible: float = 0.4

    def __post_init__(self) -> None:
        check("library", self.library, 1, 1000)
        check_range("size_diameter", self.size_diameter, 0.01, 10.0)
        check_range("front", self.front, 0, 50)
        check_range("props", self.props, 0, 50)
        check("min_visible", self.min_visible, 0.0, 1.0)
        if self.visible_fraction is not None:
            check_range("visible_fraction", self.visible_fraction, 0.0, 1.0)
            if self.visible_fraction[0] < self.min_visible:
                raise ConfigError(
                    f"visible_fraction starts at {self.visible_fraction[0]}, expected at least min_visible "
                    f"({self.min_visible}) because scenes below that are rejected; lower min_visible"
                )


@dataclass(frozen=True, kw_only=True)
class BackgroundConfig:
    """What lies behind.

    Attributes:
        hdri_fraction: Share of the scenes lit by a panorama that show it as well.
        photo_fraction: Share of the other scenes over a photograph where a folder of photographs is given; the rest is
            drawn.
    """

    hdri_fraction: float = 0.5
    photo_fraction: float = 0.7

    def __post_init__(self) -> None:
        check("hdri_fraction", self.hdri_fraction, 0.0, 1.0)
        check("photo_fraction", self.photo_fraction, 0.0, 1.0)


@dataclass(frozen=True, kw_only=True)
class SensorConfig:
    """Camera effects.

    Attributes:
        exposure_ev: Stops.
        white_balance: Standard deviation of the log gain of a channel.
        noise_sigma: Noise in display units [0, 1].
        blur_sigma_px: Defocus.
        motion_px: Length of straight motion blur.
        motion_fraction: Share of scenes with motion blur.
        jpeg_quality: Quality range.
        jpeg_fraction: Share of scenes that go through JPEG.
    """

    exposure_ev: Range = (-0.5, 0.5)
    white_balance: float = 0.08
    noise_sigma: Range = (0.0, 0.03)
    blur_sigma_px: Range = (0.0, 0.9)
    motion_px: Range = (1.0, 5.0)
    motion_fraction: float = 0.15
    jpeg_quality: IntRange = (60, 98)
    jpeg_fraction: float = 0.5

    def __post_init__(self) -> None:
        check_range("exposure_ev", self.exposure_ev, -10.0, 10.0)
        check("white_balance", self.white_balance, 0.0, 1.0)
        check_range("noise_sigma", self.noise_sigma, 0.0, 1.0)
        check_range("blur_sigma_px", self.blur_sigma_px, 0.0, 20.0)
        check_range("motion_px", self.motion_px, 0.0, 64.0)
        check_range("jpeg_quality", self.jpeg_quality, 1, 100)
        for name in ("motion_fraction", "jpeg_fraction"):
            check(name, getattr(self, name), 0.0, 1.0)
