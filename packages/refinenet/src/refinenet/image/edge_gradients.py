"""How well a render agrees with the image by its gradients: what ranks hypotheses where no network does.

Colours and lighting of a render are not those of the image, but edges lie in the same places and run the same way. So
orientations are compared, without their sign and without their strength, where both pictures have an edge.

Source: the RGB verification of Kehl et al., SSD-6D, ICCV 2017, and the orientations of Hinterstoisser et al., LINE-2D.
"""

import numpy as np
from jaxtyping import Bool, Float, UInt8

Array = np.ndarray
RENDER_EDGE = 24.0
"""Smallest change of a channel over two pixels (0 to 255) that is an edge of the render."""
SCENE_EDGE = 10.0
"""The same for the image, where edges are softened by lens, compression and resampling."""
OUTLINE = 255.0
"""What the step from background to object counts as, whatever the object's colour."""


def gradient_agreement(
    scene_rgb: UInt8[Array, "b p p 3"],
    hypothesis_rgb: UInt8[Array, "b p p 3"],
    mask: Bool[Array, "b p p"],
    inside: Bool[Array, "b p p"],
) -> Float[Array, " b"]:
    """Mean agreement of gradient orientations over the render's edges, in [0, 1]: 1 if all agree, about 0 by chance.

    An edge pixel of the render, silhouette included, counts with the cosine of twice the angle between both gradients
    where the image has an edge too, and with 0 where it has none: equal and opposite gradients count 1, perpendicular
    ones -1, and orientations that have nothing to do with each other cancel. (The mean of the absolute cosine itself,
    as in LINE-2D, would be 0.64 for those.) A negative mean is 0. Where more than half of the silhouette cannot be seen
    the mean is over few pixels and counts less, down to 0 where nothing can.

    Args:
        scene_rgb: Patches of the image.
        hypothesis_rgb: Renders on black in the same windows.
        mask: Their silhouettes.
        inside: Patch pixels that lie in the image, and are not known to show something in front.
    """
    render, strength = render_gradients(hypothesis_rgb, mask)
    scene, scene_strength = gradients(scene_rgb.astype(np.float32))
    edges = (strength > RENDER_EDGE) & inside
    cosine = (render * scene).sum(axis=-1)
    agreement = (2 * cosine**2 - 1) * (edges & (scene_strength > SCENE_EDGE))
    mean = agreement.sum(axis=(1, 2)) / np.maximum(edges.sum(axis=(1, 2)), 1)
    seen = (mask & inside).sum(axis=(1, 2)) / np.maximum(mask.sum(axis=(1, 2)), 1)
    return np.clip(mean, 0.0, 1.0) * np.minimum(2.0 * seen, 1.0)


def render_gradients(
    rgb: UInt8[Array, "b p p 3"], mask: Bool[Array, "b p p"]
) -> tuple[Float[Array, "b p p 2"], Float[Array, "b p p"]]:
    """`gradients` of renders on black, whose silhouettes count as edges whatever the object's colour."""
    outline = np.where(mask, np.float32(OUTLINE), np.float32(0))
    return gradients(np.concatenate([rgb.astype(np.float32), outline[..., None]], axis=-1))


def gradients(values: Float[Array, "b p p c"]) -> tuple[Float[Array, "b p p 2"], Float[Array, "b p p"]]:
    """Unit direction (0 where flat) and strength of the gradient of the channel that changes most at each pixel."""
    padded = np.pad(values, ((0, 0), (1, 1), (1, 1), (0, 0)), mode="edge")
    across = padded[:, :, 2:] - padded[:, :, :-2]
    down = padded[:, 2:] - padded[:, :-2]
    dx = (across[:, :-2] + 2 * across[:, 1:-1] + across[:, 2:]) / 4
    dy = (down[:, :, :-2] + 2 * down[:, :, 1:-1] + down[:, :, 2:]) / 4
    best = (dx**2 + dy**2).argmax(axis=-1)[..., None]
    gradient = np.concatenate([np.take_along_axis(d, best, axis=-1) for d in (dx, dy)], axis=-1)
    strength = np.linalg.norm(gradient, axis=-1)
    return gradient / np.maximum(strength, 1e-6)[..., None], strength
