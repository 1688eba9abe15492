"""Panoramas (HDRIs): reading, normalisation of the exposure, camera views, approximation by lamps."""

import math
from dataclasses import dataclass, replace
from functools import lru_cache
from pathlib import Path

import cv2
import numpy as np
import OpenEXR
from jaxtyping import Float, UInt8
from posecore.errors import ConfigError
from posecore.files import read_regular, require_regular
from posecore.image_file import decode_image, require_size

from synthgen.image.sensor import display_from_linear
from synthgen.scene import Background, Environment, Light, Scene

SUFFIXES = (".hdr", ".exr")
LIGHT_SIZE_PX = (512, 256)  # resolution for lighting: a renderer's importance map is no finer
VIEW_WIDTH_PX = 2048  # resolution as a background
IN_MEMORY = 8  # decoded panoramas kept in memory, each at most 14 MB
_CUT_LEVEL = 2.0
_MAX_SUNS = 8
_MIN_SUN_FRACTION = 0.01  # of the panorama's light
_SUN_RADIUS_RAD = math.radians(15.0)
_SMALLEST_SUN_RAD = 0.01
_ASPECT_TOLERANCE = 0.02


@dataclass(frozen=True, kw_only=True, eq=False)
class Panorama:
    """A decoded panorama at unit level; row 0 is straight up, columns go to the right as seen from inside.

    Attributes:
        light: (256, 512, 3) linear radiance.
        view: (h, w, 3) linear radiance at a higher resolution, in half precision.
    """

    light: Float[np.ndarray, "256 512 3"]
    view: Float[np.ndarray, "h w 3"]


def list_hdris(folder: str | Path) -> tuple[str, ...]:
    """Panoramas of a folder, sorted by name, subfolders included; every file is decoded as a check.

    Raises:
        ConfigError: The folder is missing, holds no panorama, or one does not decode; the message names it.
    """
    root = Path(folder)
    if not root.is_dir():
        raise ConfigError(f"--hdris {folder}: no such folder; give a folder with .hdr or .exr panoramas")
    panoramas = tuple(sorted(str(p) for p in root.rglob("*") if p.suffix.lower() in SUFFIXES))
    if not panoramas:
        raise ConfigError(f"--hdris {folder}: no panorama in it, expected {' or '.join(SUFFIXES)} files")
    for path in panoramas:
        _decode(path)
    return panoramas


@lru_cache(maxsize=IN_MEMORY)
def load(path: str) -> Panorama:
    """Read a panorama and scale it to unit level.

    At unit level the radiance of a white matt surface is 1 in the mean of two cases: facing up, and averaged over all
    orientations. This level is invariant to rotations about the vertical, and suits both a sun and an overcast sky.

    Raises:
        ConfigError: The file does not decode.
    """
    image = _decode(path)
    width = min(image.shape[1], VIEW_WIDTH_PX)
    view = cv2.resize(image, (width, width // 2), interpolation=cv2.INTER_AREA)
    light = cv2.resize(image, LIGHT_SIZE_PX, interpolation=cv2.INTER_AREA)
    directions, weights = _sphere(*LIGHT_SIZE_PX)
    luminance = light.mean(axis=2) * weights
    facing_up = float((luminance * np.maximum(directions[..., 2], 0.0)).sum() / math.pi)
    level = max(0.5 * facing_up + 0.5 * float(luminance.sum() / (4 * math.pi)), 1e-9)
    return Panorama(
        light=(light / np.float32(level)).astype(np.float32),
        view=np.minimum(view / np.float32(level), np.float32(6e4)).astype(np.float16),
    )


def crop(
    environment: Environment, K: Float[np.ndarray, "3 3"], region_px: tuple[int, int, int, int]
) -> UInt8[np.ndarray, "h w 3"]:
    """The panorama in a region of a camera's image plane, display colours.

    Args:
        environment: Panorama with its rotation.
        K: Camera matrix.
        region_px: (x0, y0, width, height).
    """
    x0, y0, width, height = region_px
    rays = np.empty((height, width, 3), np.float32)
    rays[..., 0] = ((x0 + np.arange(width) + 0.5 - K[0, 2]) / K[0, 0])[None, :]
    rays[..., 1] = ((y0 + np.arange(height) + 0.5 - K[1, 2]) / K[1, 1])[:, None]
    rays[..., 2] = 1.0
    x, y, z = np.moveaxis(rays @ environment.R_cam_env.astype(np.float32), -1, 0)  # row vectors: the inverse rotation
    view = load(environment.path).view
    rows, columns = view.shape[:2]
    # one column is repeated on either side for interpolation across the seam
    padded = np.concatenate([view[:, -1:], view, view[:, :1]], axis=1).astype(np.float32)
    u = (0.5 - np.arctan2(y, x) / np.float32(2 * np.pi)) * columns
    v = (0.5 - np.arctan2(z, np.hypot(x, y)) / np.float32(np.pi)) * rows
    radiance = cv2.remap(
        padded,
        (u + 0.5).astype(np.float32),
        (v - 0.5).astype(np.float32),
        cv2.INTER_LINEAR,
        borderMode=cv2.BORDER_REPLICATE,
    )
    display = display_from_linear(radiance * np.float32(environment.strength))
    return np.asarray((display * np.float32(255.0) + np.float32(0.5)).astype(np.uint8))


@dataclass(frozen=True, kw_only=True, eq=False)
class SplitLight:
    """A panorama's light, split into suns (small bright areas) and a residual that renders without noise.

    Attributes:
        residual: (256, 512, 3) linear radiance without the suns.
        ambient: (3,) mean of the residual over all directions.
        suns: Of each sun the direction towards it in the panorama's frame, the irradiance of each channel, and the
            angle that it subtends, rad.
    """

    residual: Float[np.ndarray, "256 512 3"]
    ambient: Float[np.ndarray, "3"]
    suns: tuple[tuple[Float[np.ndarray, "3"], Float[np.ndarray, "3"], float], ...]


@lru_cache(maxsize=IN_MEMORY)
def split_light(path: str) -> SplitLight:
    """Split a panorama at unit level; the irradiance summed over all directions is preserved.

    Radiance above a level of 2 is cut off. The light cut off around the brightest areas becomes suns of the same size;
    the remainder of the light cut off is blurred.

    Raises:
        ConfigError: The file does not decode.
    """
    light = load(path).light
    directions, weights = _sphere(*LIGHT_SIZE_PX)
    clipped = light * np.minimum(1.0, _CUT_LEVEL / np.maximum(light.mean(axis=2, keepdims=True), 1e-9))
    cut = (light - clipped) * weights[..., None]
    energy, total = cut.mean(axis=2), float((light.mean(axis=2) * weights).sum())
    suns: list[tuple[Float[np.ndarray, "3"], Float[np.ndarray, "3"], float]] = []
    while len(suns) < _MAX_SUNS and energy.max() > 0.0 and energy.sum() > _MIN_SUN_FRACTION * total:
        peak = directions[np.unravel_index(energy.argmax(), energy.shape)]
        here = (directions @ peak > math.cos(_SUN_RADIUS_RAD)) & (energy > 0.0)
        towards = (energy[here][:, None] * directions[here]).sum(axis=0)
        towards /= np.linalg.norm(towards)
        angle = np.arccos(np.clip(directions[here] @ towards, -1.0, 1.0))
        spread = math.sqrt(float((energy[here] * angle**2).sum() / energy[here].sum()))
        suns.append((towards, cut[here].sum(axis=0).astype(np.float64), max(2.0 * spread, _SMALLEST_SUN_RAD)))
        cut[here], energy[here] = 0.0, 0.0
    residual = clipped + _blurred_radiance(cut, weights)
    ambient = (residual * weights[..., None]).sum(axis=(0, 1)) / (4 * math.pi)
    return SplitLight(residual=residual.astype(np.float32), ambient=ambient.astype(np.float64), suns=tuple(suns))


def _blurred_radiance(cut: Float[np.ndarray, "h w 3"], weights: Float[np.ndarray, "h w"]) -> Float[np.ndarray, "h w 3"]:
    """Radiance of light (radiance times solid angle) after a blur of about 20 degrees that preserves the total."""
    around = cut.shape[1] // 2
    padded = np.concatenate([cut[:, -around:], cut, cut[:, :around]], axis=1)  # columns are periodic
    blurred = cv2.GaussianBlur(padded, (0, 0), cut.shape[1] / 18, borderType=cv2.BORDER_REFLECT)[:, around:-around]
    solid_angle = cv2.GaussianBlur(weights, (0, 0), cut.shape[1] / 18, borderType=cv2.BORDER_REFLECT)
    radiance = blurred / solid_angle[..., None]
    light = np.maximum((radiance * weights[..., None]).sum(axis=(0, 1)), 1e-12)
    return np.asarray((radiance * (cut.sum(axis=(0, 1)) / light)).astype(np.float32))


def with_suns(scene: Scene) -> Scene:
    """The scene with the panorama's suns as lamps; the panorama then contributes `SplitLight.residual` only."""
    if scene.environment is None:
        return scene
    environment = scene.environment
    suns = []
    for towards, irradiance, size_rad in split_light(environment.path).suns:
        x, y, z = (environment.R_cam_env @ towards).tolist()
        brightest = float(irradiance.max())
        r, g, b = (irradiance / brightest).tolist()
        suns.append(
            Light(
                kind="sun",
                direction_cam=(x, y, z),
                rgb=(r, g, b),
                strength=brightest * environment.strength,
                size_m=size_rad,
            )
        )
    return replace(scene, lights=(*scene.lights, *suns))


def with_lamps(scene: Scene) -> Scene:
    """The scene with its panorama replaced by suns and ambient light, for engines without panoramas.

    A background of kind `environment` is replaced too: this scene is for lighting only.
    """
    if scene.environment is None:
        return scene
    ambient = split_light(scene.environment.path).ambient * scene.environment.strength
    r, g, b = (np.array(scene.ambient_rgb) + ambient).tolist()
    return replace(with_suns(scene), ambient_rgb=(r, g, b), environment=None, background=Background())


@lru_cache(maxsize=4)
def _sphere(width_px: int, height_px: int) -> tuple[Float[np.ndarray, "h w 3"], Float[np.ndarray, "h w"]]:
    """Direction and solid angle of every pixel of a panorama, in the panorama's frame."""
    azimuth = (0.5 - (np.arange(width_px) + 0.5) / width_px) * 2 * np.pi
    elevation = (0.5 - (np.arange(height_px) + 0.5) / height_px) * np.pi
    e, a = np.meshgrid(elevation, azimuth, indexing="ij")
    directions = np.stack([np.cos(e) * np.cos(a), np.cos(e) * np.sin(a), np.sin(e)], axis=-1)
    weights = np.cos(e)
    return directions, weights * (4 * np.pi / weights.sum())


def _decode(path: str) -> Float[np.ndarray, "h w 3"]:
    image = _read_exr(path) if path.lower().endswith(".exr") else _read_radiance(path)
    if image is None or image.ndim != 3 or image.shape[2] < 3 or image.dtype != np.float32:
        raise ConfigError(
            f"{path}: cannot be decoded as an HDRI, expected a panorama in {' or '.join(SUFFIXES)}; "
            "export it again or remove it from the --hdris folder"
        )
    height, width = image.shape[:2]
    if height < 2 or abs(width / height - 2.0) > _ASPECT_TOLERANCE:
        raise ConfigError(
            f"{path}: the image is {width} x {height} px, expected an equirectangular panorama, twice as wide as "
            "high; remove it from the --hdris folder"
        )
    rgb = image[..., :3] if path.lower().endswith(".exr") else image[..., 2::-1]
    return np.maximum(np.nan_to_num(rgb, nan=0.0, posinf=6e4, neginf=0.0), 0.0).astype(np.float32)


def _read_radiance(path: str) -> np.ndarray:
    try:
        return decode_image(read_regular(path), path, cv2.IMREAD_UNCHANGED, ConfigError)
    except OSError as error:
        raise ConfigError(f"{path}: cannot be read ({error.strerror}); remove it from the --hdris folder") from error


def _read_exr(path: str) -> Float[np.ndarray, "h w 3"] | None:
    try:
        require_regular(path)
        with OpenEXR.File(path, header_only=True) as file:
            low, high = file.header()["dataWindow"]
        require_size((int(high[0]) - int(low[0]) + 1, int(high[1]) - int(low[1]) + 1), path, ConfigError)
        with OpenEXR.File(path, separate_channels=True) as file:
            channels = {name.split(".")[-1]: np.asarray(c.pixels, np.float32) for name, c in file.channels().items()}
    except ConfigError:
        raise
    except (RuntimeError, OSError, ValueError, KeyError):
        return None
    if not {"R", "G", "B"} <= channels.keys():
        return None
    return np.stack([channels[name] for name in "RGB"], axis=-1)
