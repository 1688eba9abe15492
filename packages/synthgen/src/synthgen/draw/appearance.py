"""Draws of lamps, materials, panoramas, backgrounds and camera effects."""

import colorsys
import math
from collections.abc import Sequence
from dataclasses import replace
from typing import Literal

import numpy as np
from jaxtyping import Float
from posecore.se3 import random_direction, rotation_from_rotvec

from synthgen.config import LightConfig, MaterialConfig, SensorConfig, SynthConfig
from synthgen.draw.random_streams import child_seed
from synthgen.draw.target import TargetObject
from synthgen.scene import Background, Environment, Light, Material, Pattern, Sensor, Vector

_CEILING_HEIGHT = 2.0  # of the ceiling lamp, in units of the largest distance of lamps
_CEILING_SIDE = 0.6  # of the ceiling lamp, in units of its height


def draw_lights(
    rng: np.random.Generator, config: LightConfig, centre_cam_m: Float[np.ndarray, "3"], diameter_m: float
) -> tuple[tuple[Light, ...], Vector]:
    """Draw lamps around the object, mostly on the camera's side, and the ambient light.

    A white matt surface that faces all lamps has the drawn brightness as its radiance: irradiance E gives radiance
    E / pi, and a lamp at distance d has the strength E d^2 4 pi (point) or E d^2 pi (area lamp, on its axis).
    """
    brightness = math.exp(rng.uniform(*np.log(config.brightness)))
    count = int(rng.integers(config.count[0], config.count[1] + 1))
    ambient_fraction = rng.uniform(*config.ambient_fraction) if count else 1.0
    ambient = _tinted(rng, config.colour / 2) * brightness * ambient_fraction
    weights = rng.dirichlet(np.ones(count)) if count else np.zeros(0)
    lights = []
    for weight in weights:
        direction = random_direction(rng)
        while direction[2] > 0.3:  # a lamp from behind would only light rims
            direction = random_direction(rng)
        distance_m = rng.uniform(*config.distance_diameter) * diameter_m
        size = math.exp(rng.uniform(*np.log(config.size)))
        irradiance = math.pi * brightness * (1 - ambient_fraction) * float(weight)
        kinds: tuple[Literal["point", "area", "sun"], ...] = ("point", "area", "sun")
        kind = kinds[int(rng.integers(3))]
        factor = {"point": 4 * math.pi * distance_m**2, "area": math.pi * distance_m**2, "sun": 1.0}[kind]
        lights.append(
            Light(
                kind=kind,
                position_cam_m=as_vector(centre_cam_m + direction * distance_m),
                direction_cam=as_vector(direction),
                rgb=as_vector(_tinted(rng, config.colour)),
                strength=irradiance * factor,
                size_m=min(size, 1.0) if kind == "sun" else size * distance_m,
            )
        )
    return tuple(lights), as_vector(ambient)


def draw_ceiling_lights(
    rng: np.random.Generator,
    config: LightConfig,
    T_ref_level: Float[np.ndarray, "4 4"],
    centre_m: Float[np.ndarray, "3"],
    diameter_m: float,
) -> tuple[tuple[Light, ...], Vector]:
    """Draw light as in a room: a large lamp overhead, a small lamp on a shell around the object, and ambient light.

    Brightness, ambient fraction, colour, size and the shell's radii are those of `config`; the lamp overhead has
    between 0.5 and 0.9 of the lamps' light. See `draw_lights` for the units.
    """
    brightness = math.exp(rng.uniform(*np.log(config.brightness)))
    ambient_fraction, overhead = rng.uniform(*config.ambient_fraction), rng.uniform(0.5, 0.9)
    R = T_ref_level[:3, :3]
    elevation, azimuth = math.asin(rng.uniform(*np.sin(np.deg2rad([5.0, 89.0])))), rng.uniform(0, 2 * math.pi)
    side = np.array([math.cos(elevation) * math.cos(azimuth), math.cos(elevation) * math.sin(azimuth)])
    direction = R @ np.append(side, math.sin(elevation))
    height_m = _CEILING_HEIGHT * config.distance_diameter[1] * diameter_m
    distance_m = rng.uniform(*config.distance_diameter) * diameter_m
    size_m = math.exp(rng.uniform(*np.log(config.size))) * distance_m
    irradiance = math.pi * brightness * (1 - ambient_fraction)
    colours = [1.0 - config.colour * rng.random(3) for _ in range(2)]
    lights = (
        Light(
            kind="area",
            position_cam_m=as_vector(centre_m + R[:, 2] * height_m),
            direction_cam=as_vector(R[:, 2]),
            rgb=as_vector(colours[0] / colours[0].max()),
            strength=irradiance * overhead * math.pi * height_m**2,
            size_m=_CEILING_SIDE * height_m,
        ),
        Light(
            kind="point",
            position_cam_m=as_vector(centre_m + direction * distance_m),
            direction_cam=as_vector(direction),
            rgb=as_vector(colours[1] / colours[1].max()),
            strength=irradiance * (1 - overhead) * 4 * math.pi * distance_m**2,
            size_m=size_m,
        ),
    )
    return lights, as_vector(np.full(3, brightness * ambient_fraction))


def draw_material(rng: np.random.Generator, config: MaterialConfig, target: TargetObject) -> Material:
    """Draw the object's material: its mesh colours varied or replaced."""
    material = Material(
        hue_shift=float(rng.uniform(-config.hue_shift, config.hue_shift)),
        saturation=float(rng.uniform(*config.saturation)),
        value=float(rng.uniform(*config.value)),
        roughness=float(rng.uniform(*config.roughness)),
        metallic=float(rng.uniform(*config.metallic)),
        specular=float(rng.uniform(*config.specular)),
    )
    kind = rng.random()
    if kind < config.textureless_fraction:
        mean = as_vector(target.mean_rgb)
        hue, saturation, value = colorsys.rgb_to_hsv(*mean)
        varied = ((hue + material.hue_shift) % 1.0, saturation * material.saturation, value * material.value)
        base = colorsys.hsv_to_rgb(varied[0], min(varied[1], 1.0), min(varied[2], 1.0))
    elif kind < config.textureless_fraction + config.random_colour_fraction:
        base = _random_colour(rng)
    else:
        return material
    is_patterned = kind >= config.textureless_fraction and rng.random() < 0.5
    pattern = _pattern(rng, target.mesh.diameter_m) if is_patterned else None
    return replace(material, base_rgb=base, pattern=pattern, hue_shift=0.0, saturation=1.0, value=1.0)


def _random_colour(rng: np.random.Generator) -> Vector:
    return colorsys.hsv_to_rgb(rng.random(), rng.uniform(0.0, 1.0), rng.uniform(0.1, 1.0))


def _pattern(rng: np.random.Generator, diameter_m: float) -> Pattern:
    """Bands of another colour, 2 to 15 per diameter, straight or bent."""
    wave = random_direction(rng) * 2 * math.pi * math.exp(rng.uniform(math.log(2), math.log(15))) / diameter_m
    warp = random_direction(rng) * 2 * math.pi * rng.uniform(1.0, 6.0) / diameter_m
    bend = float(rng.uniform(0.0, 6.0)) if rng.random() < 0.7 else 0.0
    return Pattern(
        accent_rgb=_random_colour(rng),
        wave=as_vector(wave),
        warp=as_vector(warp),
        bend=bend,
        sharpness=float(math.exp(rng.uniform(0.0, math.log(20.0)))),
    )


def draw_environment(
    rng: np.random.Generator, config: SynthConfig, hdris: Sequence[str], R_cam_level: Float[np.ndarray, "3 3"]
) -> tuple[Environment | None, bool]:
    """Draw the panorama that lights a scene, or None, and whether it is the background.

    Args:
        rng: Stream.
        config: Configuration.
        hdris: Panoramas.
        R_cam_level: Rotation from a frame whose z axis points up; the panorama stands upright in it.
    """
    if not hdris or rng.random() >= config.lights.hdri_fraction:
        return None, False
    path = hdris[int(rng.integers(len(hdris)))]
    rotation = rotation_from_rotvec(np.array([0.0, 0.0, rng.uniform(0, 2 * math.pi)]))
    strength = math.exp(rng.uniform(*np.log(config.lights.brightness)))
    is_visible = bool(rng.random() < config.background.hdri_fraction)
    return Environment(path=path, R_cam_env=R_cam_level @ rotation, strength=strength), is_visible


def draw_background(rng: np.random.Generator, photo_fraction: float, photos: Sequence[str]) -> Background:
    """Draw a background; a photograph only where there are any."""
    seed, is_photo = child_seed(rng), rng.random() < photo_fraction
    if photos and is_photo:
        return Background(kind="photo", seed=seed, path=photos[int(rng.integers(len(photos)))])
    return Background(kind="procedural", seed=seed)


def draw_sensor(rng: np.random.Generator, config: SensorConfig) -> Sensor:
    """Draw camera effects."""
    return Sensor(
        exposure_ev=float(rng.uniform(*config.exposure_ev)),
        white_balance=as_vector(np.exp(rng.normal(0.0, config.white_balance, 3))),
        noise_sigma=float(rng.uniform(*config.noise_sigma)),
        blur_sigma_px=float(rng.uniform(*config.blur_sigma_px)),
        motion_px=float(rng.uniform(*config.motion_px)) if rng.random() < config.motion_fraction else 0.0,
        motion_angle_rad=float(rng.uniform(0, math.pi)),
        jpeg_quality=int(rng.integers(config.jpeg_quality[0], config.jpeg_quality[1] + 1))
        if rng.random() < config.jpeg_fraction
        else None,
        seed=child_seed(rng),
    )


def _tinted(rng: np.random.Generator, strength: float) -> Float[np.ndarray, "3"]:
    """A light colour between white and, at strength 1, any colour; its brightest channel is 1."""
    colour = 1.0 - strength * rng.random(3)
    return np.asarray(colour / colour.max())


def as_vector(values: Float[np.ndarray, "3"]) -> Vector:
    """Three plain floats."""
    return (float(values[0]), float(values[1]), float(values[2]))
