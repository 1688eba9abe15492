"""What can be seen of an object in a patch: its visible share, and how well a silhouette fits what is visible.

Masks are bit fields as shards hold them (`scene_mask`): the object's whole silhouette, its visible part, and everything
in front of the background.
"""

import numpy as np
from jaxtyping import Bool, Float, UInt8
from posecore.shard import BIT_OBJECT, BIT_VISIBLE

Array = np.ndarray


def visible_share(bits: UInt8[Array, "*b p p"]) -> Float[Array, "*b"]:
    """Share of the object's silhouette within the patch that nothing covers; 0 where there is no silhouette."""
    seen = ((bits & BIT_VISIBLE) > 0).sum(axis=(-2, -1))
    whole = ((bits & BIT_OBJECT) > 0).sum(axis=(-2, -1))
    return np.asarray(seen / np.maximum(whole, 1), np.float64)


def visible_overlap(hypothesis: Bool[Array, "*b p p"], bits: UInt8[Array, "*b p p"]) -> Float[Array, "*b"]:
    """Intersection over union of a hypothesis' silhouette and the object's, leaving out where the object is hidden.

    1 for the true pose however much is hidden, 0 where nothing of the object is visible or the two do not meet. Beside
    the object's silhouette every pixel counts: the foreground there may be a floor or a wall, which hides nothing.

    Args:
        hypothesis: Silhouettes in the patch.
        bits: The scene's masks in the same patch.
    """
    whole, visible = (bits & BIT_OBJECT) > 0, (bits & BIT_VISIBLE) > 0
    both = (hypothesis & visible).sum(axis=(-2, -1))
    either = ((hypothesis & ~whole) | visible).sum(axis=(-2, -1))
    return np.asarray(both / np.maximum(either, 1), np.float64)
