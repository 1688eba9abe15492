"""Tensors that flow from the data to the network and the loss. Poses are those of the objects' pivots."""

from collections.abc import Callable
from typing import NamedTuple

import torch
from jaxtyping import Float, Int, UInt8
from torch import Tensor


class NetworkInput(NamedTuple):
    """Network input: an image patch and the render of a hypothesis in the same window.

    Attributes:
        scene_rgb: (b, 3, p, p) patch of the image.
        hypothesis_rgb: (b, 3, p, p) render of the object alone on black, same window.
        T_cam_obj: (b, 4, 4) hypothesis, metres, its origin at the pivot.
        K_crop: (b, 3, 3) intrinsics of the patch.
        hypothesis_depth_m: (b, p, p) camera z of the render, 0 on the background; None where it is not an input.
    """

    scene_rgb: UInt8[Tensor, "b 3 p p"]
    hypothesis_rgb: UInt8[Tensor, "b 3 p p"]
    T_cam_obj: Float[Tensor, "b 4 4"]
    K_crop: Float[Tensor, "b 3 3"]
    hypothesis_depth_m: Float[Tensor, "b p p"] | None = None

    def mapped(self, change: Callable[[Tensor], Tensor]) -> "NetworkInput":
        """A function applied to every tensor."""
        return NetworkInput(*(x if x is None else change(x) for x in self))  # type: ignore[arg-type]


class LossTarget(NamedTuple):
    """Labels that a loss compares an update with.

    Attributes:
        T_cam_obj: (b, 4, 4) ground-truth pose, metres.
        T_cam_obj_hypothesis: (b, 4, 4) pose before the update, metres.
        K_crop: (b, 3, 3) intrinsics of the patch.
        scene_contour_m: (b, n, 3) contour points of the object at the ground-truth pose, camera frame.
        hypothesis_contour_m: (b, n, 3) contour points of the hypothesis, camera frame.
        scene_distance_px: (b, p, p) distance transform of the contour in the scene patch.
        hypothesis_distance_px: (b, p, p) distance transform of the hypothesis' contour.
        object_index: (b,) row of each sample's object in `ObjectPoints`.
        scene_bits: (b, p, p) mask bits of the scene patch, as in shards' `scene_mask`; None where unknown.
        visible_iou: (b,) IoU of the hypothesis' silhouette and the object's visible mask, in [0, 1].
    """

    T_cam_obj: Float[Tensor, "b 4 4"]
    T_cam_obj_hypothesis: Float[Tensor, "b 4 4"]
    K_crop: Float[Tensor, "b 3 3"]
    scene_contour_m: Float[Tensor, "b n 3"]
    hypothesis_contour_m: Float[Tensor, "b n 3"]
    scene_distance_px: Float[Tensor, "b p p"]
    hypothesis_distance_px: Float[Tensor, "b p p"]
    object_index: Int[Tensor, " b"]
    scene_bits: UInt8[Tensor, "b p p"] | None = None
    visible_iou: Float[Tensor, " b"] | None = None

    def mapped(self, change: Callable[[Tensor], Tensor]) -> "LossTarget":
        """A function applied to every tensor."""
        return LossTarget(*(x if x is None else change(x) for x in self))  # type: ignore[arg-type]


class Batch(NamedTuple):
    """One training or validation batch.

    Attributes:
        inputs: Network input.
        target: Labels for the loss.
        sample_ids: (b, 2) shard and row of every pair.
        skipped: Errors of unreadable shards, whose samples are replaced by others; each is reported once.
        visible_fraction: (b,) fraction of each object's silhouette in the patch that is visible.
        render_colours: (b, 3, 3) colour matrices that augmentation applied to the renders; always on the CPU.
    """

    inputs: NetworkInput
    target: LossTarget
    sample_ids: Int[Tensor, "b 2"]
    skipped: tuple[str, ...] = ()
    visible_fraction: Float[Tensor, " b"] | None = None
    render_colours: Float[Tensor, "b 3 3"] | None = None

    def to(self, device: torch.device) -> "Batch":
        """The same batch on another device; copies from pinned memory are only queued."""
        inputs = self.inputs.mapped(lambda x: x.to(device, non_blocking=True))
        target = self.target.mapped(lambda x: x.to(device, non_blocking=True))
        return self._replace(inputs=inputs, target=target)
