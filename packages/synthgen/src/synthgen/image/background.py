"""Backgrounds: procedural images of many kinds, random crops of photographs, views of panoramas."""

from collections.abc import Callable
from functools import lru_cache
from pathlib import Path

import cv2
import numpy as np
from jaxtyping import Float, UInt8
from posecore.errors import ConfigError
from posecore.image_file import picture_fault, read_picture

from synthgen.image import hdri
from synthgen.scene import Background, Scene

Canvas = Float[np.ndarray, "h w 3"]

PHOTO_SUFFIXES = (".jpg", ".jpeg", ".png", ".bmp", ".webp", ".tif", ".tiff")
PHOTO_SIDE_PX = 1280  # photographs are reduced to this side: enough for a crop, and many fit in memory
PHOTOS_IN_MEMORY = 48


def render_background(scene: Scene, width_px: int, height_px: int) -> UInt8[np.ndarray, "h w 3"]:
    """The background of a scene in display colours.

    Args:
        scene: Scene; `region_px` has the same size.
        width_px: Width.
        height_px: Height.

    Raises:
        ConfigError: A photograph or panorama cannot be read.
    """
    if scene.background.kind == "environment":
        assert scene.environment is not None
        x0, y0 = scene.region_px[:2]
        return hdri.crop(scene.environment, scene.camera.K, (x0, y0, width_px, height_px))
    return draw(scene.background, width_px, height_px)


def draw(background: Background, width_px: int, height_px: int) -> UInt8[np.ndarray, "h w 3"]:
    """Draw a background in display colours; the same background and size give the same bytes.

    Raises:
        ConfigError: A photograph cannot be read.
    """
    rng = np.random.default_rng(background.seed)
    if background.kind == "photo":
        assert background.path is not None
        return _crop(_photo(background.path), rng, width_px, height_px)
    return _procedural(rng, width_px, height_px)


def list_photos(folder: str | Path) -> tuple[str, ...]:
    """Photographs of a folder, sorted by name, subfolders included; start and end of each file are checked.

    Raises:
        ConfigError: The folder is missing, holds no image, or holds a broken one; the message names it.
    """
    root = Path(folder)
    if not root.is_dir():
        raise ConfigError(f"--backgrounds {folder}: no such folder; give a folder with photographs")
    photos = tuple(sorted(str(p) for p in root.rglob("*") if p.suffix.lower() in PHOTO_SUFFIXES))
    if not photos:
        raise ConfigError(f"--backgrounds {folder}: no image in it, expected {', '.join(PHOTO_SUFFIXES)} files")
    faults = {photo: fault for photo in photos if (fault := picture_fault(photo))}
    if faults:
        (first, fault), *others = faults.items()
        more = f" (and {len(others)} more)" if others else ""
        raise ConfigError(f"{first}{more}: {fault}; repair it or remove it from --backgrounds {folder}")
    return photos


@lru_cache(maxsize=PHOTOS_IN_MEMORY)
def _photo(path: str) -> UInt8[np.ndarray, "h w 3"]:
    image = read_picture(path, ConfigError)
    scale = PHOTO_SIDE_PX / max(image.shape[:2])
    if scale < 1.0:
        image = cv2.resize(image, None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA)
    return image


def _crop(
    photo: UInt8[np.ndarray, "a b 3"], rng: np.random.Generator, width_px: int, height_px: int
) -> UInt8[np.ndarray, "h w 3"]:
    """A random crop with the given aspect ratio, from a quarter of the largest possible size to all."""
    height, width = photo.shape[:2]
    largest = min(width / width_px, height / height_px)
    scale = largest * rng.uniform(0.25, 1.0)
    w, h = max(1, int(width_px * scale)), max(1, int(height_px * scale))
    x, y = int(rng.integers(0, width - w + 1)), int(rng.integers(0, height - h + 1))
    crop = photo[y : y + h, x : x + w]
    crop = crop[:, ::-1] if rng.random() < 0.5 else crop
    interpolation = cv2.INTER_AREA if scale > 1 else cv2.INTER_LINEAR
    return np.asarray(cv2.resize(np.ascontiguousarray(crop), (width_px, height_px), interpolation=interpolation))


def _procedural(rng: np.random.Generator, width_px: int, height_px: int) -> UInt8[np.ndarray, "h w 3"]:
    canvas = _LAYERS[int(rng.integers(len(_LAYERS)))](rng, width_px, height_px)
    if rng.random() < 0.35:  # a blend of two kinds
        other = _LAYERS[int(rng.integers(len(_LAYERS)))](rng, width_px, height_px)
        weight = _noise(rng, width_px, height_px, channels=1, octaves=3)
        canvas = canvas * weight + other * (1 - weight)
    if rng.random() < 0.5:
        canvas = _clutter(canvas, rng, int(rng.integers(1, 25)))
    if rng.random() < 0.6:
        canvas = canvas * (0.5 + 0.8 * _gradient(rng, width_px, height_px)[..., :1])
    if rng.random() < 0.4:
        canvas = cv2.GaussianBlur(np.ascontiguousarray(canvas, np.float32), (0, 0), float(rng.uniform(0.5, 5.0)))
    elif rng.random() < 0.5:
        grain = rng.standard_normal((height_px, width_px, 1), np.float32) * np.float32(rng.uniform(0.01, 0.06))
        canvas = canvas + grain
    return np.asarray((np.clip(canvas, 0.0, 1.0) * 255.0 + 0.5).astype(np.uint8))


def _colour(rng: np.random.Generator) -> Float[np.ndarray, "3"]:
    """A random colour, nearly grey with probability one half, as in photographs."""
    grey = rng.random()
    saturation = rng.uniform(0.0, 0.25) if rng.random() < 0.5 else rng.uniform(0.25, 1.0)
    return np.asarray(grey + (rng.random(3) - grey) * saturation, np.float32)


def _gradient(rng: np.random.Generator, width_px: int, height_px: int) -> Canvas:
    angle = rng.uniform(0, 2 * np.pi)
    x = np.linspace(-1, 1, width_px, dtype=np.float32)[None, :]
    y = np.linspace(-1, 1, height_px, dtype=np.float32)[:, None]
    t = np.clip(0.5 + 0.5 * (np.float32(np.cos(angle)) * x + np.float32(np.sin(angle)) * y), 0, 1)[..., None]
    return np.asarray(_colour(rng) * (1 - t) + _colour(rng) * t, np.float32)


def _noise(
    rng: np.random.Generator, width_px: int, height_px: int, *, channels: int = 3, octaves: int = 6
) -> Float[np.ndarray, "h w c"]:
    """Smooth noise of several octaves, normalised to [0, 1]."""
    total = np.zeros((height_px, width_px, channels), np.float32)
    roughness = rng.uniform(0.4, 0.9)
    for octave in range(octaves):
        cells = 2 ** (octave + 1)
        if cells > max(width_px, height_px):
            break
        grid = rng.random((cells + 1, cells + 1, channels), np.float32)
        layer = cv2.resize(grid, (width_px, height_px), interpolation=cv2.INTER_CUBIC)
        total += layer.reshape(total.shape) * np.float32(roughness**octave)
    low, high = float(total.min()), float(total.max())
    return np.asarray((total - low) / max(high - low, 1e-6), np.float32)


def _coloured_noise(rng: np.random.Generator, width_px: int, height_px: int) -> Canvas:
    """Noise between two colours, or independent noise in every channel."""
    if rng.random() < 0.4:
        return _noise(rng, width_px, height_px)
    t = _noise(rng, width_px, height_px, channels=1)
    if rng.random() < 0.3:
        t = (t > 0.5).astype(np.float32)
    return np.asarray(_colour(rng) * (1 - t) + _colour(rng) * t, np.float32)


def _pattern(rng: np.random.Generator, width_px: int, height_px: int) -> Canvas:
    """Stripes or checkers of random orientation and spacing."""
    angle = rng.uniform(0, np.pi)
    y, x = np.mgrid[0:height_px, 0:width_px].astype(np.float32)
    u = x * np.float32(np.cos(angle)) + y * np.float32(np.sin(angle))
    period = np.float32(np.exp(rng.uniform(np.log(4), np.log(120))))
    t = u / period % 1 < rng.uniform(0.2, 0.8)
    if rng.random() < 0.5:
        v = -x * np.float32(np.sin(angle)) + y * np.float32(np.cos(angle))
        t = t ^ (v / np.float32(period * rng.uniform(0.5, 2.0)) % 1 < 0.5)
    return np.where(t[..., None], _colour(rng), _colour(rng)).astype(np.float32)


def _flat_clutter(rng: np.random.Generator, width_px: int, height_px: int) -> Canvas:
    """Many polygons and blobs over one colour."""
    canvas = np.broadcast_to(_colour(rng), (height_px, width_px, 3)).astype(np.float32)
    return _clutter(canvas, rng, int(rng.integers(15, 70)))


def _clutter(canvas: Canvas, rng: np.random.Generator, count: int) -> Canvas:
    canvas = np.ascontiguousarray(canvas, np.float32)
    height, width = canvas.shape[:2]
    side = max(width, height)
    for _ in range(count):
        colour = tuple(float(v) for v in _colour(rng))
        centre = rng.uniform((0, 0), (width, height))
        size = side * np.exp(rng.uniform(np.log(0.02), np.log(0.35)))
        kind = rng.integers(3)
        if kind == 0:
            angles = np.sort(rng.uniform(0, 2 * np.pi, int(rng.integers(3, 8))))
            ring = np.stack([np.cos(angles), np.sin(angles)], -1) * size * rng.uniform(0.4, 1.0, (len(angles), 1))
            cv2.fillPoly(canvas, [(centre + ring).astype(np.int32)], colour, cv2.LINE_AA)
        elif kind == 1:
            axes = (int(size) + 1, int(size * rng.uniform(0.2, 1.0)) + 1)
            middle = (int(centre[0]), int(centre[1]))
            cv2.ellipse(canvas, middle, axes, float(rng.uniform(0, 180)), 0, 360, colour, -1, cv2.LINE_AA)
        else:
            end = centre + rng.normal(0, size, 2)
            a, b = (int(centre[0]), int(centre[1])), (int(end[0]), int(end[1]))
            cv2.line(canvas, a, b, colour, int(rng.integers(1, max(2, side // 30) + 1)), cv2.LINE_AA)
    return canvas


def _blurred_picture(rng: np.random.Generator, width_px: int, height_px: int) -> Canvas:
    """Defocused clutter in front of sky and ground, with the colour statistics of a photograph."""
    canvas = np.empty((height_px, width_px, 3), np.float32)
    horizon = int(height_px * rng.uniform(0.2, 0.8))
    canvas[:horizon] = _gradient(rng, width_px, height_px)[:horizon]
    canvas[horizon:] = _coloured_noise(rng, width_px, height_px)[horizon:]
    canvas = _clutter(canvas, rng, int(rng.integers(10, 40)))
    soft = cv2.GaussianBlur(canvas, (0, 0), float(rng.uniform(1.0, 6.0)))
    texture = _noise(rng, width_px, height_px, channels=1) - np.float32(0.5)
    return np.asarray(soft + texture * np.float32(rng.uniform(0.0, 0.5)), np.float32)


_LAYERS: tuple[Callable[[np.random.Generator, int, int], Canvas], ...] = (
    _gradient,
    _coloured_noise,
    _coloured_noise,
    _pattern,
    _flat_clutter,
    _blurred_picture,
    _blurred_picture,
)
