"""Scene around the object (table, light, occluders, background), its material, and camera effects."""

from dataclasses import dataclass
from typing import Annotated, Literal

from posecore.config import Range, check_ranges
from posecore.errors import ConfigError


@dataclass(frozen=True, kw_only=True)
class SceneConfig:
    """Kinds of scene.

    Attributes:
        kind: `cutout` has the object in mid air over a background, with occluders floating around it; `tabletop` has it
            on or above a textured plane, among distractors; `mixed` draws one of the two for each scene.
        tabletop_fraction: Fraction of tabletop scenes, only for `mixed`.
    """

    kind: Literal["cutout", "tabletop", "mixed"] = "cutout"
    tabletop_fraction: Annotated[float, Range(0, 1)] = 0.5

    def __post_init__(self) -> None:
        check_ranges(self)


@dataclass(frozen=True, kw_only=True)
class TabletopConfig:
    """Scenes of kind `tabletop`. In-plane rotation is `view.roll_deg`; `view.viewpoint: upright` rests with +z up.

    Attributes:
        elevation_deg: Camera elevation above the table, uniform on the sphere's zone.
        near_fraction: Fraction of scenes with the object above the table in any orientation, not at rest.
        hover_diameter: Height of its lowest point in these scenes; 0 touches.
        tables: Number of different tables in a dataset.
        size_diameter: Sides of a table, log-uniform; in units of 0.1 m times the power of two nearest to the object's
            diameter, so that objects of about the same size share their tables.
        distractors: Number of distractors on the table.
        gap_diameter: Clearance between the footprint circles of two objects on the table.
    """

    elevation_deg: Annotated[tuple[float, float], Range(1, 90)] = (20.0, 80.0)
    near_fraction: Annotated[float, Range(0, 1)] = 0.25
    hover_diameter: Annotated[tuple[float, float], Range(0, 2)] = (0.0, 0.25)
    tables: Annotated[int, Range(1, 200)] = 12
    size_diameter: Annotated[tuple[float, float], Range(2, 40)] = (4.0, 10.0)
    distractors: Annotated[tuple[int, int], Range(0, 50)] = (0, 4)
    gap_diameter: Annotated[tuple[float, float], Range(0, 10)] = (0.02, 0.8)

    def __post_init__(self) -> None:
        check_ranges(self)


@dataclass(frozen=True, kw_only=True)
class LightConfig:
    """Lighting.

    Attributes:
        hdri_fraction: Fraction of scenes lit by a panorama instead of lamps, where a folder of panoramas is given; its
            brightness is drawn from `brightness`, its rotation about the vertical uniformly.
        count: Number of lamps.
        brightness: Linear radiance of a white surface that faces all lamps, log-uniform.
        ambient_fraction: Fraction of the brightness that is ambient light.
        colour: Largest departure of a lamp's colour from white, 0 to 1.
        distance_diameter: Distance of the lamps from the object.
        size: Size of a lamp as a fraction of its distance; small lamps cast hard shadows.
    """

    hdri_fraction: Annotated[float, Range(0, 1)] = 0.5
    count: Annotated[tuple[int, int], Range(0, 16)] = (1, 3)
    brightness: Annotated[tuple[float, float], Range(1e-3, 100)] = (0.5, 1.6)
    ambient_fraction: Annotated[tuple[float, float], Range(0, 1)] = (0.15, 0.7)
    colour: Annotated[float, Range(0, 1)] = 0.35
    distance_diameter: Annotated[tuple[float, float], Range(1)] = (2.0, 8.0)
    size: Annotated[tuple[float, float], Range(1e-3, 2)] = (0.02, 0.6)

    def __post_init__(self) -> None:
        check_ranges(self)


@dataclass(frozen=True, kw_only=True)
class MaterialConfig:
    """Variation of the target object's material around the mesh's colours.

    Attributes:
        textureless_fraction: Fraction of scenes with the object's mean colour all over.
        random_colour_fraction: Fraction of scenes with random colours: half plain, half with a procedural texture of
            two colours.
        hue_shift: Largest hue rotation in turns, either way.
        saturation: Factor on the saturation.
        value: Factor on the brightness.
        roughness: Principled roughness.
        metallic: Principled metallic.
        specular: Principled specular level.
    """

    textureless_fraction: Annotated[float, Range(0, 1)] = 0.0
    random_colour_fraction: Annotated[float, Range(0, 1)] = 0.0
    hue_shift: Annotated[float, Range(0, 0.5)] = 0.04
    saturation: Annotated[tuple[float, float], Range(0, 4)] = (0.7, 1.3)
    value: Annotated[tuple[float, float], Range(0, 4)] = (0.75, 1.2)
    roughness: Annotated[tuple[float, float], Range(0, 1)] = (0.2, 1.0)
    metallic: Annotated[tuple[float, float], Range(0, 1)] = (0.0, 0.3)
    specular: Annotated[tuple[float, float], Range(0, 1)] = (0.1, 0.7)

    def __post_init__(self) -> None:
        check_ranges(self)
        if self.textureless_fraction + self.random_colour_fraction > 1.0:
            raise ConfigError(
                f"textureless_fraction is {self.textureless_fraction} and random_colour_fraction "
                f"{self.random_colour_fraction}, expected a sum of at most 1"
            )


@dataclass(frozen=True, kw_only=True)
class OccluderConfig:
    """Shapes in front of, beside and behind the object: primitives, or the meshes of a folder.

    Attributes:
        library: Number of different shapes in a dataset; the maximum where a folder of meshes is given.
        scale: `fit` scales a folder's meshes to `size_diameter`, `own` keeps their size.
        size_diameter: Diameter of a shape.
        front: Number of shapes in front of the object.
        props: Number of shapes around it, in cutout scenes.
        visible_fraction: Visible fraction of the object to reach, uniform in this range: the shapes in front are moved
            in, and up to four are added. Null keeps the shapes where they are drawn. Without effect where `front`
            allows none.
        min_visible: Smallest visible fraction of the object; a scene below it is drawn again.
    """

    library: Annotated[int, Range(1, 1000)] = 32
    scale: Literal["fit", "own"] = "fit"
    size_diameter: Annotated[tuple[float, float], Range(0.01, 10)] = (0.25, 1.0)
    front: Annotated[tuple[int, int], Range(0, 50)] = (0, 2)
    props: Annotated[tuple[int, int], Range(0, 50)] = (0, 3)
    visible_fraction: Annotated[tuple[float, float], Range(0, 1)] | None = None
    min_visible: Annotated[float, Range(0, 1)] = 0.4

    def __post_init__(self) -> None:
        check_ranges(self)
        if self.visible_fraction is not None and self.visible_fraction[0] < self.min_visible:
            raise ConfigError(
                f"visible_fraction starts at {self.visible_fraction[0]}, expected at least min_visible "
                f"({self.min_visible}) because scenes below it are rejected; lower min_visible"
            )


@dataclass(frozen=True, kw_only=True)
class BackgroundConfig:
    """Background of the scenes.

    Attributes:
        hdri_fraction: Fraction of the scenes lit by a panorama that also show it as background.
        photo_fraction: Fraction of the other scenes with a photograph as background, where a folder of photographs is
            given; the others have a procedural background.
    """

    hdri_fraction: Annotated[float, Range(0, 1)] = 0.5
    photo_fraction: Annotated[float, Range(0, 1)] = 0.7

    def __post_init__(self) -> None:
        check_ranges(self)


@dataclass(frozen=True, kw_only=True)
class SensorConfig:
    """Camera effects.

    Attributes:
        exposure_ev: Exposure in stops.
        white_balance: Standard deviation of the log gain of a channel.
        noise_sigma: Standard deviation of the noise in display units [0, 1].
        blur_sigma_px: Standard deviation of the defocus.
        motion_px: Length of straight motion blur.
        motion_fraction: Fraction of scenes with motion blur.
        jpeg_quality: JPEG quality.
        jpeg_fraction: Fraction of scenes with JPEG compression.
    """

    exposure_ev: Annotated[tuple[float, float], Range(-10, 10)] = (-0.5, 0.5)
    white_balance: Annotated[float, Range(0, 1)] = 0.08
    noise_sigma: Annotated[tuple[float, float], Range(0, 1)] = (0.0, 0.03)
    blur_sigma_px: Annotated[tuple[float, float], Range(0, 20)] = (0.0, 0.9)
    motion_px: Annotated[tuple[float, float], Range(0, 64)] = (1.0, 5.0)
    motion_fraction: Annotated[float, Range(0, 1)] = 0.15
    jpeg_quality: Annotated[tuple[int, int], Range(1, 100)] = (60, 98)
    jpeg_fraction: Annotated[float, Range(0, 1)] = 0.5

    def __post_init__(self) -> None:
        check_ranges(self)
