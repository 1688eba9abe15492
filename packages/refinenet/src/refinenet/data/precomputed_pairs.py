"""Precomputed pairs, as shards hold them, for networks with the shards' fixed window."""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from posecore.errors import ConfigError
from posecore.shard import BIT_FOREGROUND

from refinenet.config import AugmentConfig, TrainConfig
from refinenet.data.online_pairs import PairArrays
from refinenet.image import augmentation
from refinenet.image.masks import visible_mask_iou

PRECOMPUTED_FIELDS = (
    "scene_rgb", "hypothesis_rgb", "T_cam_obj", "T_cam_obj_hypothesis", "K_crop", "scene_contour_cam_m",
    "hypothesis_contour_cam_m", "scene_distance_px", "hypothesis_distance_px", "scene_mask", "obj_id",
)  # fmt: skip


def precomputed_pairs(
    samples: Sequence[Mapping[str, Any]],
    rngs: Sequence[np.random.Generator],
    config: TrainConfig,
    augment_config: AugmentConfig,
    url: str,
) -> PairArrays:
    """Stack samples into a batch; contour points are subsampled evenly to the configured number.

    Raises:
        ConfigError: The shards' patches are not of the network's size, or hold fewer contour points than asked for.
    """
    shard_px, patch_px = len(samples[0]["scene_rgb"]), config.network.patch_px
    if shard_px != patch_px:
        raise ConfigError(
            f"{url}: patches of {shard_px} px, preset {config.preset} expects {patch_px}; "
            f"render with --set patch_px={patch_px}"
        )
    available, n = len(samples[0]["scene_contour_cam_m"]), config.loss.contour_points
    if n > available:
        raise ConfigError(
            f"{url}: {available} contour points, loss.contour_points is {n}; set it to {available} or less"
        )
    thin = (np.arange(n) * available) // n

    def stack(name: str) -> np.ndarray:
        return np.stack([sample[name] for sample in samples])

    scenes = stack("scene_rgb")
    for i, (sample, rng) in enumerate(zip(samples, rngs, strict=True)):
        if rng.random() < augment_config.background:
            other = samples[int(rng.integers(len(samples)))]
            behind = augmentation.background_patch(
                other["scene_rgb"], (other["scene_mask"] & BIT_FOREGROUND) > 0, shard_px, rng
            )
            scenes[i] = np.where((sample["scene_mask"] & BIT_FOREGROUND)[..., None] > 0, scenes[i], behind)
    depth_m = stack("hypothesis_depth_m") if "hypothesis_depth_m" in samples[0] else None
    visible_iou = None if depth_m is None else visible_mask_iou(depth_m > 0, stack("scene_mask"))
    scene_rgb, hypothesis_rgb, render_colours = augmentation.colour(
        scenes, stack("hypothesis_rgb"), augment_config, rngs[0]
    )
    return PairArrays(
        scene_rgb=scene_rgb,
        hypothesis_rgb=hypothesis_rgb,
        T_cam_obj=stack("T_cam_obj"),
        T_cam_obj_hypothesis=stack("T_cam_obj_hypothesis"),
        K_crop=stack("K_crop"),
        scene_contour_m=stack("scene_contour_cam_m")[:, thin],
        hypothesis_contour_m=stack("hypothesis_contour_cam_m")[:, thin],
        scene_distance_px=stack("scene_distance_px"),
        hypothesis_distance_px=stack("hypothesis_distance_px"),
        hypothesis_depth_m=depth_m,
        scene_bits=stack("scene_mask"),
        visible_iou=visible_iou,
        render_colours=render_colours,
        obj_id=stack("obj_id"),
        kept=np.arange(len(samples)),
    )
