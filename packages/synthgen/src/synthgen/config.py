"""Sampling configuration: every number that decides what a dataset looks like, with the defaults that are shipped.

Ranges are (low, high) pairs drawn uniformly unless said otherwise. Sizes are in units of the object's diameter where
the field's name ends in `_diameter`, so that one preset serves a 3 cm screw and a 2 m chair.
"""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal

from posecore import config as config_tools
from posecore.camera import Camera, intrinsics
from posecore.errors import ConfigError
from posecore.files import data_spec

from synthgen.engine import Device, EngineName

Range = tuple[float, float]
IntRange = tuple[int, int]

MAX_PATCH_PX = 362  # shards hold distances up to 512 px, which is this patch's diagonal


def _check_range(name: str, value: tuple[float, float], low: float = -math.inf, high: float = math.inf) -> None:
    a, b = value
    if not (math.isfinite(a) and math.isfinite(b) and low <= a <= b <= high):
        raise ConfigError(f"{name} is [{a}, {b}], expected low <= high within [{low:g}, {high:g}]")


def _check(name: str, value: float, low: float, high: float = math.inf) -> None:
    if not (math.isfinite(value) and low <= value <= high):
        raise ConfigError(f"{name} is {value}, expected a number in [{low:g}, {high:g}]")


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
        _check("width_px", self.width_px, 16)
        _check("height_px", self.height_px, 16)
        _check("fx", self.fx, 1.0)
        _check("fy", self.fy, 1.0)

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
        _check_range("min, max", (self.min, self.max), 1e-6)

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
        _check_range("elevation_deg", self.elevation_deg, -90.0, 90.0)
        _check_range("roll_deg", self.roll_deg, -180.0, 180.0)
        _check("position_jitter", self.position_jitter, 0.0, 1.0)
        _check("min_inside", self.min_inside, 0.0, 1.0)


@dataclass(frozen=True, kw_only=True)
class PerturbationConfig:
    """How far a hypothesis lies from the truth.

    Attributes:
        max_angle_deg: The angle is uniform in 0 to this, about a random axis.
        max_translation_diameter: The object moves in a random direction, the length uniform in 0 to this.
        easy_share: Share of hypotheses whose two bounds are multiplied by `easy_scale`, so that a refiner also sees
            starts that are nearly right.
        easy_scale: That factor.
    """

    max_angle_deg: float = 40.0
    max_translation_diameter: float = 0.25
    easy_share: float = 0.2
    easy_scale: float = 0.25

    def __post_init__(self) -> None:
        _check("max_angle_deg", self.max_angle_deg, 0.0, 180.0)
        _check("max_translation_diameter", self.max_translation_diameter, 0.0, 2.0)
        _check("easy_share", self.easy_share, 0.0, 1.0)
        _check("easy_scale", self.easy_scale, 0.0, 1.0)


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
        _check("padding", self.padding, 0.0, 4.0)
        _check("min_area_px", self.min_area_px, 1)


@dataclass(frozen=True, kw_only=True)
class SceneConfig:
    """Which kinds of scene.

    Attributes:
        kind: 'cutout' has the object in mid air over a background, with shapes floating around it; 'tabletop' has it on
            or near a textured plane, among things that lie there; 'mixed' draws one of the two for each scene.
        tabletop_share: Share of tabletop scenes, only for 'mixed'.
    """

    kind: Literal["cutout", "tabletop", "mixed"] = "cutout"
    tabletop_share: float = 0.5

    def __post_init__(self) -> None:
        _check("tabletop_share", self.tabletop_share, 0.0, 1.0)


@dataclass(frozen=True, kw_only=True)
class TabletopConfig:
    """Scenes of kind 'tabletop'. In-plane rotation is `view.roll_deg`; `view.viewpoint` 'upright' rests with +z up.

    Attributes:
        elevation_deg: Camera elevation above the table, uniform on the sphere's zone.
        near_share: Share of scenes with the object in any orientation, its lowest point above the table by
            `hover_diameter`, instead of at rest.
        hover_diameter: Height of that lowest point; 0 touches.
        tables: Number of different tables made for a dataset.
        size_diameter: Sides of a table, uniform in the logarithm; in units of 0.1 m doubled or halved to come nearest
            to the object's diameter, so that objects of about one size share their tables.
        distractors: Number of other things on the table.
        gap_diameter: Clearance between the circles around two things on the table.
    """

    elevation_deg: Range = (20.0, 80.0)
    near_share: float = 0.25
    hover_diameter: Range = (0.0, 0.25)
    tables: int = 12
    size_diameter: Range = (4.0, 10.0)
    distractors: IntRange = (0, 4)
    gap_diameter: Range = (0.02, 0.8)

    def __post_init__(self) -> None:
        _check_range("elevation_deg", self.elevation_deg, 1.0, 90.0)
        _check("near_share", self.near_share, 0.0, 1.0)
        _check_range("hover_diameter", self.hover_diameter, 0.0, 2.0)
        _check("tables", self.tables, 1, 200)
        _check_range("size_diameter", self.size_diameter, 2.0, 40.0)
        _check_range("distractors", self.distractors, 0, 50)
        _check_range("gap_diameter", self.gap_diameter, 0.0, 10.0)


@dataclass(frozen=True, kw_only=True)
class LightConfig:
    """Lamps around the object.

    Attributes:
        hdri_share: Share of scenes lit by a panorama instead of lamps, where a folder of panoramas is given; its
            brightness is drawn from `brightness`, its turn about the vertical uniformly.
        count: Number of lamps.
        brightness: Linear radiance of a white surface that faces all the light, drawn uniformly in its logarithm.
        ambient_share: Share of it that comes evenly from all around.
        colour: How far a lamp's colour may leave white, 0 to 1.
        distance_diameter: Distance of the lamps from the object.
        size: A lamp's size as a share of its distance; small is hard shadows.
    """

    hdri_share: float = 0.5
    count: IntRange = (1, 3)
    brightness: Range = (0.5, 1.6)
    ambient_share: Range = (0.15, 0.7)
    colour: float = 0.35
    distance_diameter: Range = (2.0, 8.0)
    size: Range = (0.02, 0.6)

    def __post_init__(self) -> None:
        _check("hdri_share", self.hdri_share, 0.0, 1.0)
        _check_range("count", self.count, 0, 16)
        _check_range("brightness", self.brightness, 1e-3, 100.0)
        _check_range("ambient_share", self.ambient_share, 0.0, 1.0)
        _check("colour", self.colour, 0.0, 1.0)
        _check_range("distance_diameter", self.distance_diameter, 1.0)
        _check_range("size", self.size, 1e-3, 2.0)


@dataclass(frozen=True, kw_only=True)
class MaterialConfig:
    """Variation of the target's surface around its own colours.

    Attributes:
        textureless_share: Share of scenes in which the object has its mean colour all over.
        random_colour_share: Share of scenes in which its colours are random: half of them one colour, half a procedural
            texture of two.
        hue_shift: Largest hue rotation in turns, either way.
        saturation: Factor on the saturation.
        value: Factor on the brightness.
        roughness: Principled roughness.
        metallic: Principled metallic.
        specular: Principled specular level.
    """

    textureless_share: float = 0.0
    random_colour_share: float = 0.0
    hue_shift: float = 0.04
    saturation: Range = (0.7, 1.3)
    value: Range = (0.75, 1.2)
    roughness: Range = (0.2, 1.0)
    metallic: Range = (0.0, 0.3)
    specular: Range = (0.1, 0.7)

    def __post_init__(self) -> None:
        _check("textureless_share", self.textureless_share, 0.0, 1.0)
        _check("random_colour_share", self.random_colour_share, 0.0, 1.0 - self.textureless_share)
        _check("hue_shift", self.hue_shift, 0.0, 0.5)
        for name in ("saturation", "value"):
            _check_range(name, getattr(self, name), 0.0, 4.0)
        for name in ("roughness", "metallic", "specular"):
            _check_range(name, getattr(self, name), 0.0, 1.0)


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
        _check("library", self.library, 1, 1000)
        _check_range("size_diameter", self.size_diameter, 0.01, 10.0)
        _check_range("front", self.front, 0, 50)
        _check_range("props", self.props, 0, 50)
        _check("min_visible", self.min_visible, 0.0, 1.0)
        if self.visible_fraction is not None:
            _check_range("visible_fraction", self.visible_fraction, 0.0, 1.0)
            if self.visible_fraction[0] < self.min_visible:
                raise ConfigError(
                    f"visible_fraction starts at {self.visible_fraction[0]}, expected at least min_visible "
                    f"({self.min_visible}) because scenes below that are rejected; lower min_visible"
                )


@dataclass(frozen=True, kw_only=True)
class BackgroundConfig:
    """What lies behind.

    Attributes:
        hdri_share: Share of the scenes lit by a panorama that show it as well.
        photo_share: Share of the other scenes over a photograph where a folder of photographs is given; the rest is
            drawn.
    """

    hdri_share: float = 0.5
    photo_share: float = 0.7

    def __post_init__(self) -> None:
        _check("hdri_share", self.hdri_share, 0.0, 1.0)
        _check("photo_share", self.photo_share, 0.0, 1.0)


@dataclass(frozen=True, kw_only=True)
class SensorConfig:
    """Camera effects.

    Attributes:
        exposure_ev: Stops.
        white_balance: Standard deviation of the log gain of a channel.
        noise_sigma: Noise in display units [0, 1].
        blur_sigma_px: Defocus.
        motion_px: Length of straight motion blur.
        motion_share: Share of scenes with motion blur.
        jpeg_quality: Quality range.
        jpeg_share: Share of scenes that go through JPEG.
    """

    exposure_ev: Range = (-0.5, 0.5)
    white_balance: float = 0.08
    noise_sigma: Range = (0.0, 0.03)
    blur_sigma_px: Range = (0.0, 0.9)
    motion_px: Range = (1.0, 5.0)
    motion_share: float = 0.15
    jpeg_quality: IntRange = (60, 98)
    jpeg_share: float = 0.5

    def __post_init__(self) -> None:
        _check_range("exposure_ev", self.exposure_ev, -10.0, 10.0)
        _check("white_balance", self.white_balance, 0.0, 1.0)
        _check_range("noise_sigma", self.noise_sigma, 0.0, 1.0)
        _check_range("blur_sigma_px", self.blur_sigma_px, 0.0, 20.0)
        _check_range("motion_px", self.motion_px, 0.0, 64.0)
        _check_range("jpeg_quality", self.jpeg_quality, 1, 100)
        for name in ("motion_share", "jpeg_share"):
            _check(name, getattr(self, name), 0.0, 1.0)


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
        _check_range("objects", self.objects, 1, 1000)
        _check("instances", self.instances, 1, 1000)
        _check_range("gap_diameter", self.gap_diameter, 0.0, 10.0)
        _check("min_target_visible", self.min_target_visible, 0.0, 1.0)


@dataclass(frozen=True, kw_only=True)
class SequenceConfig:
    """Motion of tracking sequences: how the first object moves as the camera sees it.

    Attributes:
        fps: Images a second.
        max_turn_deg_s: Bound on its angular speed.
        max_speed_diameter_s: Bound on its box centre's speed.
        smoothness_s: Nothing swings faster than with this period.
        pass_every_s: A shape passes before it once in every such span; 0 for never.
        light_swing: Largest change of a lamp's strength either way, as a share.
        shutter: Share of the time between two images that the shutter is open: what motion blur covers.
    """

    fps: float = 30.0
    max_turn_deg_s: float = 90.0
    max_speed_diameter_s: float = 3.0
    smoothness_s: float = 2.0
    pass_every_s: float = 4.0
    light_swing: float = 0.4
    shutter: Range = (0.0, 0.5)

    def __post_init__(self) -> None:
        _check("fps", self.fps, 0.1, 10_000.0)
        _check("max_turn_deg_s", self.max_turn_deg_s, 0.0, 3600.0)
        _check("max_speed_diameter_s", self.max_speed_diameter_s, 0.0, 100.0)
        _check("smoothness_s", self.smoothness_s, 0.05, 3600.0)
        _check("pass_every_s", self.pass_every_s, 0.0, 3600.0)
        _check("light_swing", self.light_swing, 0.0, 0.9)
        _check_range("shutter", self.shutter, 0.0, 1.0)


@dataclass(frozen=True, kw_only=True)
class SynthConfig:
    """A dataset's whole recipe; with the object and the number of samples it decides every byte.

    Attributes:
        seed: Dataset seed.
        engine: Renderer of the scenes.
        hypothesis_engine: Renderer of the hypothesis patches; the rasteriser is what inference uses.
        device: Where Cycles traces.
        samples: Light paths per pixel of the Blender engines.
        patch_px: Side of the patches.
        contour_points: Contour points per silhouette.
        hypotheses_per_scene: Hypotheses that share one rendered scene.
        shard_size: Samples in a shard: the unit of work and of resuming. A multiple of `hypotheses_per_scene`.
        camera: Intrinsics.
        distance: Distance of the object.
        view: Viewpoint and place in the image.
        perturbation: Distance of the hypotheses from the truth.
        window: Fixed window.
        scene: Kinds of scene.
        tabletop: Scenes on a table.
        lights: Lamps.
        material: The object's surface.
        occluders: Shapes around it.
        background: What lies behind.
        sensor: Camera effects.
        frames: Whole camera images.
        sequence: Motion of tracking sequences.
    """

    seed: int = 0
    engine: EngineName = "cycles"
    hypothesis_engine: EngineName = "raster"
    device: Device = "cpu"
    samples: int = 16
    patch_px: int = 224
    contour_points: int = 100
    hypotheses_per_scene: int = 8
    shard_size: int = 64
    camera: CameraConfig = field(default_factory=CameraConfig)
    distance: DistanceConfig = field(default_factory=DistanceConfig)
    view: ViewConfig = field(default_factory=ViewConfig)
    perturbation: PerturbationConfig = field(default_factory=PerturbationConfig)
    window: WindowConfig = field(default_factory=WindowConfig)
    scene: SceneConfig = field(default_factory=SceneConfig)
    tabletop: TabletopConfig = field(default_factory=TabletopConfig)
    lights: LightConfig = field(default_factory=LightConfig)
    material: MaterialConfig = field(default_factory=MaterialConfig)
    occluders: OccluderConfig = field(default_factory=OccluderConfig)
    background: BackgroundConfig = field(default_factory=BackgroundConfig)
    sensor: SensorConfig = field(default_factory=SensorConfig)
    frames: FrameConfig = field(default_factory=FrameConfig)
    sequence: SequenceConfig = field(default_factory=SequenceConfig)

    def __post_init__(self) -> None:
        _check("seed", self.seed, 0, 2**63 - 1)
        _check("samples", self.samples, 1, 65536)
        _check("patch_px", self.patch_px, 16, MAX_PATCH_PX)
        _check("contour_points", self.contour_points, 1, 100_000)
        _check("hypotheses_per_scene", self.hypotheses_per_scene, 1, 4096)
        _check("shard_size", self.shard_size, 1, 1_000_000)
        if self.shard_size % self.hypotheses_per_scene:
            near = max(1, round(self.shard_size / self.hypotheses_per_scene)) * self.hypotheses_per_scene
            raise ConfigError(
                f"shard_size is {self.shard_size}, expected a multiple of hypotheses_per_scene "
                f"({self.hypotheses_per_scene}) because a scene lives in one shard; try shard_size={near}"
            )


def preset_names() -> list[str]:
    """Names of the shipped presets."""
    return sorted(p.stem for p in data_spec("presets").glob("*.yaml"))


def load_config(
    preset: str = "default", overrides: Sequence[str] = (), values: Mapping[str, Any] | None = None
) -> SynthConfig:
    """Resolve a preset, `key=value` overrides and option values (in rising priority) to a configuration.

    Args:
        preset: Name of a shipped preset, or a YAML file.
        overrides: Assignments such as `window.padding=0.5`.
        values: Top-level values from command-line options; None entries are left out.

    Raises:
        ConfigError: Unknown preset, key or value; the message names it.
    """
    if preset.endswith((".yaml", ".yml")) or Path(preset).is_file():
        where, mapping = preset, config_tools.load_yaml(preset)
    elif preset in preset_names():
        where, mapping = f"preset {preset}", config_tools.load_yaml(data_spec(f"presets/{preset}.yaml"))
    else:
        raise ConfigError(
            f"--preset {preset}: there is no such preset; choose one of {', '.join(preset_names())} or a .yaml file"
        )
    mapping = config_tools.apply_overrides(mapping, overrides)
    mapping.update({k: v for k, v in (values or {}).items() if v is not None})
    return config_tools.build(SynthConfig, mapping, where)
