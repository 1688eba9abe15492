"""Augmentation of colours, backgrounds and occluders, on uint8 patches."""

import cv2
import numpy as np
from jaxtyping import Bool, Float, UInt8
from posecore.shard import BIT_FOREGROUND, BIT_OBJECT, BIT_VISIBLE

from refinenet.config import AugmentConfig
from refinenet.image.crops import warp


def colour(
    scene_rgb: UInt8[np.ndarray, "b p p 3"],
    hypothesis_rgb: UInt8[np.ndarray, "b p p 3"],
    config: AugmentConfig,
    rng: np.random.Generator,
) -> tuple[UInt8[np.ndarray, "b p p 3"], UInt8[np.ndarray, "b p p 3"], Float[np.ndarray, "b 3 3"]]:
    """Augment colours: of the object in both patches alike, of camera and light in the scene alone.

    Args:
        scene_rgb: Scene patches.
        hypothesis_rgb: Renders; their black background stays black.
        config: Strengths; all zero returns the input.
        rng: Source of every draw.

    Returns:
        New scene and hypothesis patches, and the colour matrices applied to the renders.
    """
    b = len(scene_rgb)
    geometric = AugmentConfig(
        background=config.background, occlusion=config.occlusion, min_visible_fraction=config.min_visible_fraction
    )
    if config == geometric:
        return scene_rgb, hypothesis_rgb, np.tile(np.eye(3, dtype=np.float32), (b, 1, 1))
    render_colours = np.tile(np.eye(3, dtype=np.float32), (b, 1, 1))
    scene, hypothesis = scene_rgb.astype(np.float32), hypothesis_rgb.astype(np.float32)
    for i in np.flatnonzero(rng.random(b) < config.permute_channels):
        order = rng.permutation(3)
        scene[i], hypothesis[i] = scene[i][..., order], hypothesis[i][..., order]
        render_colours[i] = render_colours[i][order]
    both = _spread(rng, b, config.gain)
    hypothesis *= both
    render_colours *= both[:, 0, 0, :, None]
    scene *= both * _spread(rng, b, config.scene_gain)
    contrast = _spread(rng, b, config.contrast, channels=1)
    shift = 255.0 * (_spread(rng, b, config.brightness, channels=1) - 1.0)
    mean = scene.mean(axis=(1, 2, 3), keepdims=True)
    scene = (scene - mean) * contrast + (mean + shift)
    for i in np.flatnonzero(rng.random(b) < config.blur):
        scene[i] = cv2.GaussianBlur(scene[i], (0, 0), rng.uniform(0.4, 1.2))
    if config.noise > 0:
        sigma = (config.noise * rng.random(b)).astype(np.float32)[:, None, None, None]
        scene += rng.standard_normal(scene.shape, dtype=np.float32) * sigma
    return _to_uint8(scene), _to_uint8(hypothesis), render_colours


def _spread(rng: np.random.Generator, b: int, width: float, channels: int = 3) -> Float[np.ndarray, "b 1 1 c"]:
    return rng.uniform(1 - width, 1 + width, (b, 1, 1, channels)).astype(np.float32)


def _to_uint8(values: Float[np.ndarray, "b p p 3"]) -> UInt8[np.ndarray, "b p p 3"]:
    return np.clip(values + 0.5, 0, 255).astype(np.uint8)


def background_patch(
    source_rgb: UInt8[np.ndarray, "q q 3"] | None,
    foreground: Bool[np.ndarray, "q q"] | None,
    patch_px: int,
    rng: np.random.Generator,
) -> UInt8[np.ndarray, "p p 3"]:
    """A background for a patch: an enlarged piece of another scene with little foreground, or smooth noise.

    Args:
        source_rgb: Another scene's patch; None gives noise.
        foreground: Foreground of that scene, the target included: a second target would mislead.
        patch_px: Side of the result.
        rng: Source of piece, rotation and mirroring.
    """
    if source_rgb is None or foreground is None or rng.random() < 0.2:
        coarse = rng.integers(0, 256, (int(rng.integers(2, 9)),) * 2 + (3,), dtype=np.uint8)
        return np.asarray(cv2.resize(coarse, (patch_px, patch_px), interpolation=cv2.INTER_CUBIC))
    size = len(source_rgb)
    best, piece = np.inf, source_rgb
    for _ in range(4):
        side = int(size * rng.uniform(0.25, 0.6))
        row, column = rng.integers(0, size - side + 1, 2)
        fraction = float(foreground[row : row + side : 2, column : column + side : 2].mean())
        if fraction < best:
            best, piece = fraction, source_rgb[row : row + side, column : column + side]
    piece = np.rot90(piece, int(rng.integers(4)))
    if rng.random() < 0.5:
        piece = piece[:, ::-1]
    return np.asarray(cv2.resize(np.ascontiguousarray(piece), (patch_px, patch_px), interpolation=cv2.INTER_LINEAR))


def occlude(
    scene_rgb: UInt8[np.ndarray, "p p 3"],
    scene_bits: UInt8[np.ndarray, "p p"],
    source_rgb: UInt8[np.ndarray, "q q 3"],
    source_bits: UInt8[np.ndarray, "q q"],
    min_visible_fraction: float,
    rng: np.random.Generator,
) -> tuple[UInt8[np.ndarray, "p p 3"], UInt8[np.ndarray, "p p"]]:
    """Paste a piece of another scene's foreground over the visible object.

    The piece is an elliptic part of the foreground, rotated and scaled: a whole silhouette of the same object would be
    a second target. Other objects are preferred to the target's. A piece that covers too much is halved in size.

    Args:
        scene_rgb: Patch.
        scene_bits: Mask bits of the patch, as in shards' `scene_mask`.
        source_rgb: Another scene's patch.
        source_bits: Mask bits of that patch.
        min_visible_fraction: Smallest fraction of the visible object that stays visible.
        rng: Source of piece, position, rotation and size.

    Returns:
        New patch and mask bits; unchanged where there is nothing to paste or to cover.
    """
    visible = np.argwhere((scene_bits & BIT_VISIBLE) > 0)
    foreground = (source_bits & BIT_FOREGROUND) > 0
    others = foreground & ((source_bits & BIT_OBJECT) == 0)
    if others.mean() > 0.01:
        foreground = others
    candidates = np.argwhere(foreground)
    if not len(visible) or not len(candidates):
        return scene_rgb, scene_bits
    row, column = candidates[rng.integers(len(candidates))]
    goal = visible[rng.integers(len(visible))]
    extent = visible.max(axis=0) - visible.min(axis=0) + 1
    size, angle = len(source_rgb), rng.uniform(-np.pi, np.pi)
    a, b = size * rng.uniform(0.06, 0.2, 2)
    v, u = np.mgrid[:size, :size]
    piece = (foreground & (((u - column) / a) ** 2 + ((v - row) / b) ** 2 <= 1)).astype(np.uint8)
    scale = rng.uniform(0.3, 0.8) * float(extent.mean()) / (a + b)
    for _ in range(3):
        c, s = scale * np.cos(angle), scale * np.sin(angle)
        linear = np.array([[c, -s], [s, c]])
        shift = goal[::-1] + 0.5 - linear @ (column + 0.5, row + 0.5)
        affine = np.concatenate([linear, shift[:, None]], axis=1)
        covering = warp(piece, affine, len(scene_rgb), nearest=True) > 0
        hidden = (scene_bits[covering] & BIT_VISIBLE) > 0
        if hidden.sum() <= (1 - min_visible_fraction) * len(visible):
            rgb = np.where(covering[..., None], warp(source_rgb, affine, len(scene_rgb)), scene_rgb)
            covered = (scene_bits & np.uint8(0xFF ^ BIT_VISIBLE)) | np.uint8(BIT_FOREGROUND)
            return rgb, np.where(covering, covered, scene_bits)
        scale *= 0.5
    return scene_rgb, scene_bits
