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
        min_area_px: A silhouette with fewer patch pixels rejects the draw.
    """

    padding: float = 0.3
    min_area_px: int = 150

    def __post_init__(self) -> None:
        _check("padding", self.padding, 0.0, 4.0)
        _check("min_area_px", self.min_area_px, 1)


@dataclass(frozen=True, kw_only=True)
class LightConfig:
    """Lamps around the object.

    Attributes:
        count: Number of lamps.
        brightness: Linear radiance of a white surface that faces all the light, drawn uniformly in its logarithm.
        ambient_share: Share of it that comes evenly from all around.
        colour: How far a lamp's colour may leave white, 0 to 1.
        distance_diameter: Distance of the lamps from the object.
        size: A lamp's size as a share of its distance; small is hard shadows.
    """

    count: IntRange = (1, 3)
    brightness: Range = (0.5, 1.6)
    ambient_share: Range = (0.15, 0.7)
    colour: float = 0.35
    distance_diameter: Range = (2.0, 8.0)
    size: Range = (0.02, 0.6)

    def __post_init__(self) -> None:
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
        hue_shift: Largest hue rotation in turns, either way.
        saturation: Factor on the saturation.
        value: Factor on the brightness.
        roughness: Principled roughness.
        metallic: Principled metallic.
        specular: Principled specular level.
    """

    hue_shift: float = 0.04
    saturation: Range = (0.7, 1.3)
    value: Range = (0.75, 1.2)
    roughness: Range = (0.2, 1.0)
    metallic: Range = (0.0, 0.3)
    specular: Range = (0.1, 0.7)

    def __post_init__(self) -> None:
        _check("hue_shift", self.hue_shift, 0.0, 0.5)
        for name in ("saturation", "value"):
            _check_range(name, getattr(self, name), 0.0, 4.0)
        for name in ("roughness", "metallic", "specular"):
            _check_range(name, getattr(self, name), 0.0, 1.0)


@dataclass(frozen=True, kw_only=True)
class OccluderConfig:
    """Primitive shapes in front of, beside and behind the object.

    Attributes:
        library: Number of different shapes made for a dataset.
        size_diameter: Diameter of a shape.
        front: Number of shapes that may hide the object.
        props: Number of shapes around it.
        min_visible: Smallest visible share of the object; a scene below it is drawn again.
    """

    library: int = 32
    size_diameter: Range = (0.25, 1.0)
    front: IntRange = (0, 2)
    props: IntRange = (0, 3)
    min_visible: float = 0.4

    def __post_init__(self) -> None:
        _check("library", self.library, 1, 1000)
        _check_range("size_diameter", self.size_diameter, 0.01, 10.0)
        _check_range("front", self.front, 0, 50)
        _check_range("props", self.props, 0, 50)
        _check("min_visible", self.min_visible, 0.0, 1.0)


@dataclass(frozen=True, kw_only=True)
class BackgroundConfig:
    """What lies behind.

    Attributes:
        photo_share: Share of scenes over a photograph where a folder of photographs is given; the rest is drawn.
    """

    photo_share: float = 0.7

    def __post_init__(self) -> None:
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
        lights: Lamps.
        material: The object's surface.
        occluders: Shapes around it.
        background: What lies behind.
        sensor: Camera effects.
    """

    seed: int = 0
    engine: EngineName = "cycles"
    hypothesis_engine: EngineName = "raster"
    device: Device = "cpu"
    samples: int = 16
    patch_px: int = 224
    contour_points: int = 100
    hypotheses_per_scene: int = 4
    shard_size: int = 64
    camera: CameraConfig = field(default_factory=CameraConfig)
    distance: DistanceConfig = field(default_factory=DistanceConfig)
    view: ViewConfig = field(default_factory=ViewConfig)
    perturbation: PerturbationConfig = field(default_factory=PerturbationConfig)
    window: WindowConfig = field(default_factory=WindowConfig)
    lights: LightConfig = field(default_factory=LightConfig)
    material: MaterialConfig = field(default_factory=MaterialConfig)
    occluders: OccluderConfig = field(default_factory=OccluderConfig)
    background: BackgroundConfig = field(default_factory=BackgroundConfig)
    sensor: SensorConfig = field(default_factory=SensorConfig)

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
