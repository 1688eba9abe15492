"""Scenes as plain data, independent of the rendering engine.

The camera frame is the world frame (OpenCV axes: x right, y down, z forward), in metres. Every record is frozen,
checked at construction and holds only numbers and strings, so that a scene can be pickled to a worker, stored, or
rendered by two engines and compared.
"""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Literal, get_args

import numpy as np
from jaxtyping import Float
from posecore import se3
from posecore.camera import Camera
from posecore.errors import ConfigError

LightKind = Literal["point", "area", "sun"]
BackgroundKind = Literal["procedural", "photo", "environment"]

Vector = tuple[float, float, float]

_ROTATION_TOLERANCE = 1e-3


def _fail(where: str, got: object, expected: str) -> ConfigError:
    return ConfigError(f"{where}: got {got!r}, expected {expected}")


def _number(where: str, value: float, low: float = -math.inf, high: float = math.inf) -> float:
    """The value as a float; ConfigError unless it is in [low, high]."""
    if not (math.isfinite(value) and low <= value <= high):
        raise _fail(where, value, f"a finite number in [{low:g}, {high:g}]")
    return float(value)


def _vector(where: str, value: Sequence[float], low: float = -math.inf, high: float = math.inf) -> Vector:
    """Three checked floats as a tuple, so that records with equal numbers compare equal."""
    if len(value) != 3:
        raise _fail(where, value, "3 numbers")
    x, y, z = (_number(where, float(v), low, high) for v in value)
    return (x, y, z)


@dataclass(frozen=True, kw_only=True)
class Pattern:
    """A procedural solid texture: bands, bent by a transverse wave.

    At p, in metres and object coordinates, the weight of the accent colour is a smooth step, `sharpness` steep, of
    sin(wave . p + bend sin(warp . p)). Blender's nodes and `pattern.accent_weight` evaluate the same formula.

    Attributes:
        accent_rgb: Display (sRGB) colour beside the material's base colour.
        wave: Wave vector of the bands, rad/m.
        warp: Wave vector of the bending wave, rad/m.
        bend: Amplitude of the bending wave, rad.
        sharpness: 1 is a soft wave, 20 has hard edges.
    """

    accent_rgb: Vector
    wave: Vector
    warp: Vector = (0.0, 0.0, 0.0)
    bend: float = 0.0
    sharpness: float = 4.0

    def __post_init__(self) -> None:
        object.__setattr__(self, "accent_rgb", _vector("pattern.accent_rgb", self.accent_rgb, 0.0, 1.0))
        object.__setattr__(self, "wave", _vector("pattern.wave", self.wave))
        object.__setattr__(self, "warp", _vector("pattern.warp", self.warp))
        _number("pattern.bend", self.bend, 0.0, 100.0)
        _number("pattern.sharpness", self.sharpness, 1.0, 100.0)


@dataclass(frozen=True, kw_only=True)
class Material:
    """Surface appearance of an object.

    Attributes:
        base_rgb: Display (sRGB) colour in [0, 1] that replaces the mesh's colours; None keeps them.
        pattern: Procedural texture between `base_rgb` and another colour; None is plain.
        hue_shift: Rotation of the hue in turns, [-0.5, 0.5].
        saturation: Factor on the saturation, [0, 4].
        value: Factor on the brightness, [0, 4].
        roughness: Principled BSDF roughness, [0, 1].
        metallic: Principled BSDF metallic, [0, 1].
        specular: Principled BSDF specular level, [0, 1]; 0.5 is an ordinary dielectric (4 % at normal incidence).
    """

    base_rgb: Vector | None = None
    pattern: Pattern | None = None
    hue_shift: float = 0.0
    saturation: float = 1.0
    value: float = 1.0
    roughness: float = 0.5
    metallic: float = 0.0
    specular: float = 0.5

    def __post_init__(self) -> None:
        if self.base_rgb is not None:
            object.__setattr__(self, "base_rgb", _vector("material.base_rgb", self.base_rgb, 0.0, 1.0))
        elif self.pattern is not None:
            raise ConfigError("material.pattern: got a pattern without material.base_rgb, expected both")
        _number("material.hue_shift", self.hue_shift, -0.5, 0.5)
        _number("material.saturation", self.saturation, 0.0, 4.0)
        _number("material.value", self.value, 0.0, 4.0)
        _number("material.roughness", self.roughness, 0.0, 1.0)
        _number("material.metallic", self.metallic, 0.0, 1.0)
        _number("material.specular", self.specular, 0.0, 1.0)


@dataclass(frozen=True, kw_only=True, eq=False)
class SceneObject:
    """One mesh placed in the camera's frame.

    Attributes:
        mesh_key: Key of the mesh in `Engine.load`.
        T_cam_obj: (4, 4) rigid transform, metres; kept as a read-only float64 copy.
        material: Surface.
    """

    mesh_key: int
    T_cam_obj: Float[np.ndarray, "4 4"]
    material: Material = field(default_factory=Material)

    def __post_init__(self) -> None:
        T = np.array(self.T_cam_obj, dtype=np.float64)
        if T.shape != (4, 4) or not np.isfinite(T).all():
            raise ConfigError(f"object.T_cam_obj: got shape {T.shape}, expected 4 x 4 finite numbers")
        R = T[:3, :3]
        rigid = np.allclose(R @ R.T, np.eye(3), atol=_ROTATION_TOLERANCE) and np.linalg.det(R) > 0.0
        if not (rigid and np.array_equal(T[3], (0.0, 0.0, 0.0, 1.0))):
            raise ConfigError("object.T_cam_obj: got a scaled, mirrored or sheared matrix, expected a rigid transform")
        T.setflags(write=False)
        object.__setattr__(self, "T_cam_obj", T)


def with_origins_at(
    objects: Sequence[SceneObject], points_m: Mapping[int, Float[np.ndarray, "3"]]
) -> tuple[SceneObject, ...]:
    """Objects in frames with their own axes and the origin at a point of each mesh key; others stay."""
    return tuple(
        replace(item, T_cam_obj=se3.with_origin_at(item.T_cam_obj, points_m[item.mesh_key]))
        if item.mesh_key in points_m
        else item
        for item in objects
    )


@dataclass(frozen=True, kw_only=True)
class Light:
    """One lamp.

    Attributes:
        kind: `point` (a sphere of diameter `size_m`), `area` (a square of side `size_m`) or `sun` (at infinity).
        position_cam_m: Position; without effect for a sun.
        direction_cam: From the lit scene TOWARDS the lamp (as in posecore.raster), any length but 0: the direction of a
            sun, the opposite of an area lamp's normal. Without effect for a point.
        rgb: Linear colour, factors of `strength`.
        strength: Radiant power in W for point and area, irradiance in W/m^2 for a sun.
        size_m: Size in m; for a sun the angle it subtends in rad. 0 gives hard shadows.
    """

    kind: LightKind
    position_cam_m: Vector = (0.0, 0.0, 0.0)
    direction_cam: Vector = (0.0, 0.0, -1.0)
    rgb: Vector = (1.0, 1.0, 1.0)
    strength: float = 1.0
    size_m: float = 0.0

    def __post_init__(self) -> None:
        if self.kind not in get_args(LightKind):
            raise _fail("light.kind", self.kind, f"one of {', '.join(get_args(LightKind))}")
        object.__setattr__(self, "position_cam_m", _vector("light.position_cam_m", self.position_cam_m))
        object.__setattr__(self, "direction_cam", _vector("light.direction_cam", self.direction_cam))
        object.__setattr__(self, "rgb", _vector("light.rgb", self.rgb, 0.0))
        if not any(self.direction_cam):
            raise _fail("light.direction_cam", self.direction_cam, "a vector of non-zero length")
        _number("light.strength", self.strength, 0.0)
        _number("light.size_m", self.size_m, 0.0, math.pi if self.kind == "sun" else math.inf)
        if self.kind == "area" and self.size_m == 0.0:
            raise _fail("light.size_m", self.size_m, "more than 0 for an area light")


@dataclass(frozen=True, kw_only=True, eq=False)
class Environment:
    """A panorama (HDRI) that lights the scene from all around.

    Attributes:
        path: Image file, .hdr or .exr, equirectangular.
        R_cam_env: (3, 3) rotation from the panorama's frame to the camera's: the panorama's x axis points at the middle
            of the image, y at the middle of its left half, z up (row 0).
        strength: Linear radiance of a white surface that faces the panorama's average side; the file's exposure is
            without effect (see `hdri.load`).
    """

    path: str
    R_cam_env: Float[np.ndarray, "3 3"]
    strength: float = 1.0

    def __post_init__(self) -> None:
        R = np.array(self.R_cam_env, dtype=np.float64)
        if R.shape != (3, 3) or not np.allclose(R @ R.T, np.eye(3), atol=_ROTATION_TOLERANCE) or np.linalg.det(R) < 0:
            raise ConfigError(f"environment.R_cam_env: got {R.tolist()}, expected a 3 x 3 rotation matrix")
        R.setflags(write=False)
        object.__setattr__(self, "R_cam_env", R)
        _number("environment.strength", self.strength, 0.0)


@dataclass(frozen=True, kw_only=True)
class Background:
    """Background of the rendered objects.

    Attributes:
        kind: `procedural` (drawn from `seed`), `photo` (a crop of the image at `path`, chosen by `seed`) or
            `environment` (the scene's panorama in the camera's direction).
        seed: Seed of the procedural image or the crop.
        path: Image file; only for `photo`.
    """

    kind: BackgroundKind = "procedural"
    seed: int = 0
    path: str | None = None

    def __post_init__(self) -> None:
        if self.kind not in get_args(BackgroundKind):
            raise _fail("background.kind", self.kind, f"one of {', '.join(get_args(BackgroundKind))}")
        if (self.kind == "photo") != (self.path is not None):
            raise _fail("background.path", self.path, "a file for kind 'photo' and nothing for the others")


@dataclass(frozen=True, kw_only=True)
class Sensor:
    """Camera effects, from the lens to the image file.

    Attributes:
        exposure_ev: Exposure in stops; linear light is multiplied by 2**exposure_ev.
        white_balance: Factors on linear r, g, b.
        noise_sigma: Standard deviation of the noise in display units, [0, 1].
        blur_sigma_px: Gaussian defocus, standard deviation in px.
        motion_px: Length of the straight motion blur in px.
        motion_angle_rad: Direction of the motion blur in the image, from x right towards y down.
        jpeg_quality: 1 to 100; None for no JPEG compression.
        seed: Seed of the noise.
    """

    exposure_ev: float = 0.0
    white_balance: Vector = (1.0, 1.0, 1.0)
    noise_sigma: float = 0.0
    blur_sigma_px: float = 0.0
    motion_px: float = 0.0
    motion_angle_rad: float = 0.0
    jpeg_quality: int | None = None
    seed: int = 0

    def __post_init__(self) -> None:
        object.__setattr__(self, "white_balance", _vector("sensor.white_balance", self.white_balance, 0.0))
        _number("sensor.exposure_ev", self.exposure_ev, -20.0, 20.0)
        _number("sensor.noise_sigma", self.noise_sigma, 0.0, 1.0)
        _number("sensor.blur_sigma_px", self.blur_sigma_px, 0.0)
        _number("sensor.motion_px", self.motion_px, 0.0)
        _number("sensor.motion_angle_rad", self.motion_angle_rad)
        if self.jpeg_quality is not None and not 1 <= self.jpeg_quality <= 100:
            raise _fail("sensor.jpeg_quality", self.jpeg_quality, "1 to 100 or nothing")


@dataclass(frozen=True, kw_only=True, eq=False)
class Scene:
    """Everything that decides the pixels of an image.

    Attributes:
        camera: Pinhole camera of the full image.
        region_px: (x0, y0, width, height) of the image plane to render. It may start below 0 or end past the image.
        objects: Objects; index 0 is the target object, the rest are occluders and props. The position in this tuple is
            the value in `RenderedScene.index`.
        lights: Lamps.
        ambient_rgb: Linear radiance from every direction; it lights objects and is itself invisible.
        environment: Panorama that lights the scene in addition to the lamps, or None.
        background: Background behind the objects.
        sensor: Camera effects.
        samples: Light paths per pixel.
        render_seed: Seed of the noise pattern, 0 to 2**31 - 1, different for each scene.
    """

    camera: Camera
    region_px: tuple[int, int, int, int]
    objects: tuple[SceneObject, ...]
    lights: tuple[Light, ...] = ()
    ambient_rgb: Vector = (0.5, 0.5, 0.5)
    environment: Environment | None = None
    background: Background = field(default_factory=Background)
    sensor: Sensor = field(default_factory=Sensor)
    samples: int = 8
    render_seed: int = 0

    def __post_init__(self) -> None:
        if len(self.region_px) != 4 or min(self.region_px[2:]) < 1:
            raise _fail("scene.region_px", self.region_px, "x0, y0, width, height with a size of at least 1 px")
        object.__setattr__(self, "region_px", tuple(int(v) for v in self.region_px))
        if not self.objects:
            raise ConfigError("scene.objects: got none, expected the target object at index 0")
        if len(self.objects) > np.iinfo(np.int16).max:
            raise _fail("scene.objects", len(self.objects), f"at most {np.iinfo(np.int16).max}")
        object.__setattr__(self, "objects", tuple(self.objects))
        object.__setattr__(self, "lights", tuple(self.lights))
        object.__setattr__(self, "ambient_rgb", _vector("scene.ambient_rgb", self.ambient_rgb, 0.0))
        if self.background.kind == "environment" and self.environment is None:
            raise _fail("scene.background", "environment", "a scene with an environment for this kind of background")
        if self.samples < 1:
            raise _fail("scene.samples", self.samples, "at least 1")
        if not 0 <= self.render_seed < 2**31:
            raise _fail("scene.render_seed", self.render_seed, "0 to 2**31 - 1")
