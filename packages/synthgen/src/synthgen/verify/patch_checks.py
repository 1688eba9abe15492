"""Checks of the patches and masks."""

import math

import cv2
import numpy as np
from jaxtyping import Float
from posecore.shard import BIT_FOREGROUND, BIT_OBJECT, BIT_VISIBLE

from synthgen.image.region import inside_image
from synthgen.verify.check import CheckList
from synthgen.verify.facts import SampleBatch
from synthgen.verify.pose_checks import as_window

_RIM = np.ones((5, 5), np.uint8)
CHECKS = CheckList()


@CHECKS.register("scene patch", 0, "flag", "sensor noise alone makes more than half a grey level")
def scene_patch(batch: SampleBatch) -> Float[np.ndarray, " n"]:
    """The scene patch is not blank: its grey levels differ by more than 0.5 (standard deviation)."""
    flat = batch["scene_rgb"].reshape(len(batch), -1)
    return np.array([float(cv2.meanStdDev(row)[1].item() <= 0.5) for row in flat])


@CHECKS.register(
    "hypothesis patch", 0, "pixels", "the silhouette is the render's own; 2 px more where an engine anti-aliases"
)
def hypothesis_patch(batch: SampleBatch) -> Float[np.ndarray, " n"]:
    """The hypothesis patch shows something inside its silhouette and is black outside."""
    exact = not batch.facts.rendered or batch.facts.card["config"]["hypothesis_engine"] == "raster"
    count = np.zeros(len(batch))
    for i, (rgb, mask) in enumerate(zip(batch["hypothesis_rgb"], batch.hypothesis_mask, strict=True)):
        lit = rgb.any(axis=-1)
        wide = mask if exact else cv2.dilate(mask.astype(np.uint8), _RIM) > 0
        count[i] = (lit & ~wide).sum() if (lit & mask).any() else np.inf
    return count


@CHECKS.register("mask", 0, "pixels", "bits are exact")
def mask(batch: SampleBatch) -> Float[np.ndarray, " n"]:
    """Visible pixels are object and foreground, foreground has depth and nothing else has, no other bit is set."""
    bits, depth = batch["scene_mask"], batch["scene_depth_m"] > 0
    visible, whole, front = bits & BIT_VISIBLE > 0, bits & BIT_OBJECT > 0, bits & BIT_FOREGROUND > 0
    wrong = (
        (visible & ~whole) | (visible & ~front) | (front != depth) | (bits > BIT_OBJECT + BIT_VISIBLE + BIT_FOREGROUND)
    )
    return np.asarray(wrong.sum(axis=(1, 2)), np.float64)


@CHECKS.register("outside", 0, "pixels", "whether a patch pixel's centre lies in the image is exact")
def outside(batch: SampleBatch) -> Float[np.ndarray, " n"]:
    """Nothing is visible outside the camera's image, where the scene patch is black but for its outermost pixels."""
    count = np.zeros(len(batch))
    for i, values in enumerate(batch["window_px"]):
        if not (np.isfinite(values).all() and values[2] > 0):
            count[i] = np.inf
            continue
        outer = ~inside_image(as_window(values), batch.facts.patch_px, batch.facts.camera)
        if outer.any():
            count[i] = (outer & (batch["scene_mask"][i] & (BIT_VISIBLE | BIT_FOREGROUND) > 0)).sum()
            reach_px = max(2, math.ceil(0.5 * batch.facts.patch_px / values[2]) + 1)  # half an image pixel, enlarged
            rim = np.ones((2 * reach_px + 1, 2 * reach_px + 1), np.uint8)
            inner = cv2.erode(outer.astype(np.uint8), rim, borderType=cv2.BORDER_REPLICATE) > 0
            count[i] += (inner & batch["scene_rgb"][i].any(axis=-1)).sum()
    return count


@CHECKS.register("visible fraction", 1e-6, "1", "one division of whole numbers, stored in float32")
def visible_fraction(batch: SampleBatch) -> Float[np.ndarray, " n"]:
    """visible_fraction is the mask's visible pixels over its object pixels."""
    visible = (batch["scene_mask"] & BIT_VISIBLE > 0).sum(axis=(1, 2))
    whole = batch.object_mask.sum(axis=(1, 2))
    return np.abs(
        batch["visible_fraction"] - np.divide(visible, whole, out=np.full(len(batch), np.nan), where=whole > 0)
    )
