"""Visible fraction of an object in a patch, and visible-mask IoU of a hypothesis.

Masks are the bit fields of shards (`scene_mask`): the object's whole silhouette, its visible part, and everything in
front of the background.
"""

import numpy as np
from jaxtyping import Bool, Float, UInt8
from posecore.shard import BIT_OBJECT, BIT_VISIBLE


def visible_fraction(bits: UInt8[np.ndarray, "*b p p"]) -> Float[np.ndarray, "*b"]:
    """Fraction of the object's silhouette within the patch that nothing covers; 0 where there is no silhouette."""
    visible = ((bits & BIT_VISIBLE) > 0).sum(axis=(-2, -1))
    whole = ((bits & BIT_OBJECT) > 0).sum(axis=(-2, -1))
    return np.asarray(visible / np.maximum(whole, 1), np.float64)


def visible_mask_iou(
    hypothesis: Bool[np.ndarray, "*b p p"], bits: UInt8[np.ndarray, "*b p p"]
) -> Float[np.ndarray, "*b"]:
    """Intersection over union of a hypothesis' silhouette and the object's visible mask, without occluded pixels.

    1 for the ground-truth pose at any occlusion, 0 where the object is not visible or the masks do not meet. Beside the
    object's silhouette every pixel counts: the foreground there may be a floor or a wall, which occludes nothing.

    Args:
        hypothesis: Silhouettes in the patch.
        bits: Masks of the scene in the same patch.
    """
    whole, visible = (bits & BIT_OBJECT) > 0, (bits & BIT_VISIBLE) > 0
    both = (hypothesis & visible).sum(axis=(-2, -1))
    either = ((hypothesis & ~whole) | visible).sum(axis=(-2, -1))
    return np.asarray(both / np.maximum(either, 1), np.float64)
