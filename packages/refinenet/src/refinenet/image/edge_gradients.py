"""Gradient similarity of render and image: the score of hypotheses without a learned confidence.

A render has other colours and lighting than the image, but its edges have the same positions and orientations. So
orientations are compared, without sign and strength, where both render and image have an edge.

Source: the RGB verification of Kehl et al., SSD-6D, ICCV 2017, and the orientations of Hinterstoisser et al., LINE-2D.
"""

import numpy as np
from jaxtyping import Bool, Float, UInt8

RENDER_EDGE = 24.0
"""Smallest change of a channel over two pixels (0 to 255) that is an edge of the render."""
SCENE_EDGE = 10.0
"""The same for the image, whose edges are softened by lens, compression and resampling."""
OUTLINE = 255.0
"""Strength of the step from background to object, whatever the object's colour."""


def gradient_similarity(
    scene_rgb: UInt8[np.ndarray, "b p p 3"],
    hypothesis_rgb: UInt8[np.ndarray, "b p p 3"],
    mask: Bool[np.ndarray, "b p p"],
    inside: Bool[np.ndarray, "b p p"],
) -> Float[np.ndarray, " b"]:
    """Mean similarity of gradient orientations over the render's edges, in [0, 1]: 1 if equal, about 0 by chance.

    An edge pixel of the render, silhouette included, scores the cosine of twice the angle between both gradients where
    the image has an edge too, else 0: equal and opposite gradients score 1, perpendicular gradients -1, and unrelated
    orientations cancel. (Their mean absolute cosine, as in LINE-2D, would be 0.64.) A negative mean becomes 0. If less
    than half of the silhouette is visible, the mean is over few pixels and is scaled down, to 0 without visible pixels.

    Args:
        scene_rgb: Patches of the image.
        hypothesis_rgb: Renders on black in the same windows.
        mask: Silhouettes of the renders.
        inside: Patch pixels that lie in the image and show no known occluder.
    """
    render, strength = render_gradients(hypothesis_rgb, mask)
    scene, scene_strength = orientation_gradients(scene_rgb.astype(np.float32))
    edges = (strength > RENDER_EDGE) & inside
    cosine = (render * scene).sum(axis=-1)
    similarity = (2 * cosine**2 - 1) * (edges & (scene_strength > SCENE_EDGE))
    mean = similarity.sum(axis=(1, 2)) / np.maximum(edges.sum(axis=(1, 2)), 1)
    visible = (mask & inside).sum(axis=(1, 2)) / np.maximum(mask.sum(axis=(1, 2)), 1)
    return np.clip(mean, 0.0, 1.0) * np.minimum(2.0 * visible, 1.0)


def render_gradients(
    rgb: UInt8[np.ndarray, "b p p 3"], mask: Bool[np.ndarray, "b p p"]
) -> tuple[Float[np.ndarray, "b p p 2"], Float[np.ndarray, "b p p"]]:
    """`orientation_gradients` of renders on black; silhouettes are edges whatever the object's colour."""
    outline = np.where(mask, np.float32(OUTLINE), np.float32(0))
    return orientation_gradients(np.concatenate([rgb.astype(np.float32), outline[..., None]], axis=-1))


def orientation_gradients(
    values: Float[np.ndarray, "b p p c"],
) -> tuple[Float[np.ndarray, "b p p 2"], Float[np.ndarray, "b p p"]]:
    """Unit direction (0 where flat) and strength of the gradient, at each pixel of the channel that changes most."""
    padded = np.pad(values, ((0, 0), (1, 1), (1, 1), (0, 0)), mode="edge")
    across = padded[:, :, 2:] - padded[:, :, :-2]
    down = padded[:, 2:] - padded[:, :-2]
    dx = (across[:, :-2] + 2 * across[:, 1:-1] + across[:, 2:]) / 4
    dy = (down[:, :, :-2] + 2 * down[:, :, 1:-1] + down[:, :, 2:]) / 4
    best = (dx**2 + dy**2).argmax(axis=-1)[..., None]
    gradient = np.concatenate([np.take_along_axis(d, best, axis=-1) for d in (dx, dy)], axis=-1)
    strength = np.linalg.norm(gradient, axis=-1)
    return gradient / np.maximum(strength, 1e-6)[..., None], strength
