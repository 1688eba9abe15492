"""Colours and backgrounds exchanged at training time, on whole batches of uint8 patches."""

import cv2
import numpy as np
from jaxtyping import Bool, Float, UInt8

from refinenet.config import AugmentConfig

Array = np.ndarray


def colour(
    scene_rgb: UInt8[Array, "b p p 3"],
    hypothesis_rgb: UInt8[Array, "b p p 3"],
    config: AugmentConfig,
    rng: np.random.Generator,
) -> tuple[UInt8[Array, "b p p 3"], UInt8[Array, "b p p 3"]]:
    """Change colours: what a different object colour would do to both patches, what a camera would do to the scene's.

    Args:
        scene_rgb: Scene patches.
        hypothesis_rgb: Renders; their black background stays black.
        config: Strengths; all zero returns the input.
        rng: Source of every draw.

    Returns:
        New scene and hypothesis patches.
    """
    b = len(scene_rgb)
    if config == AugmentConfig(background=config.background):
        return scene_rgb, hypothesis_rgb
    scene, hypothesis = scene_rgb.astype(np.float32), hypothesis_rgb.astype(np.float32)
    for i in np.flatnonzero(rng.random(b) < config.permute_channels):
        order = rng.permutation(3)
        scene[i], hypothesis[i] = scene[i][..., order], hypothesis[i][..., order]
    both = _spread(rng, b, config.gain)
    hypothesis *= both
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
    return _to_uint8(scene), _to_uint8(hypothesis)


def _spread(rng: np.random.Generator, b: int, width: float, channels: int = 3) -> Float[Array, "b 1 1 c"]:
    return rng.uniform(1 - width, 1 + width, (b, 1, 1, channels)).astype(np.float32)


def _to_uint8(values: Float[Array, "b p p 3"]) -> UInt8[Array, "b p p 3"]:
    return np.clip(values + 0.5, 0, 255).astype(np.uint8)


def backdrop(
    source_rgb: UInt8[Array, "q q 3"] | None,
    foreground: Bool[Array, "q q"] | None,
    patch_px: int,
    rng: np.random.Generator,
) -> UInt8[Array, "p p 3"]:
    """A background for a patch: an enlarged piece of another scene with little foreground in it, or smooth noise.

    Args:
        source_rgb: Another scene's patch; None asks for noise.
        foreground: Where that scene shows objects, the target among them: a second target would mislead.
        patch_px: Side of the result.
        rng: Chooses piece, turn and mirroring.
    """
    if source_rgb is None or foreground is None or rng.random() < 0.2:
        coarse = rng.integers(0, 256, (int(rng.integers(2, 9)),) * 2 + (3,), dtype=np.uint8)
        return np.asarray(cv2.resize(coarse, (patch_px, patch_px), interpolation=cv2.INTER_CUBIC))
    size = len(source_rgb)
    best, piece = np.inf, source_rgb
    for _ in range(4):
        side = int(size * rng.uniform(0.25, 0.6))
        row, column = rng.integers(0, size - side + 1, 2)
        share = float(foreground[row : row + side : 2, column : column + side : 2].mean())
        if share < best:
            best, piece = share, source_rgb[row : row + side, column : column + side]
    piece = np.rot90(piece, int(rng.integers(4)))
    if rng.random() < 0.5:
        piece = piece[:, ::-1]
    return np.asarray(cv2.resize(np.ascontiguousarray(piece), (patch_px, patch_px), interpolation=cv2.INTER_LINEAR))
