"""Configuration of training pairs cropped from annotated images."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Annotated, Any, Literal

from posecore import config as config_tools
from posecore.config import Range, check_ranges
from posecore.renamed import refuse_renamed_keys

from synthgen.config.geometry import MAX_PATCH_PX, PerturbationConfig
from synthgen.config.renamed_keys import RENAMED_KEYS


@dataclass(frozen=True, kw_only=True)
class CutConfig:
    """Crops of annotated images; with the images, this configuration decides every byte.

    Attributes:
        seed: Seed of the hypotheses.
        patch_px: Side of the patches.
        contour_points: Contour points per silhouette.
        hypotheses_per_pose: Hypotheses drawn around each annotated pose; without effect on hypotheses from a file.
        shard_size: Pairs in a shard.
        min_visible: Smallest visible fraction of an annotated pose, and smallest fraction of its box inside the image;
            other poses are left out.
        min_area_px: Smallest area of the convex hull of either silhouette, in image pixels and in patch pixels; other
            pairs are left out.
        images: Maximum number of images, evenly spaced over the dataset; 0 takes all.
        images_per_scene: Consecutive images of a BOP scene that count as one scene (training holds out whole scenes).
            0 takes the BOP scenes, or single images where there is only one BOP scene.
        window: `diameter` scales with the hypothesis' distance, so that the object has the same size in every patch, as
            for networks with such a window; `fixed` is the paper's, with one side for all poses of an object.
        scale: Side of a diameter window over the projected diameter. Larger than the network's own window, which is
            cropped from the patch around other hypotheses.
        padding: Margin of the fixed window, as a fraction of the object's largest silhouette box at its nearest pose.
        perturbation: Distance of drawn hypotheses from the ground truth.
    """

    seed: Annotated[int, Range(0, 2**63 - 1)] = 0
    patch_px: Annotated[int, Range(16, MAX_PATCH_PX)] = 224
    contour_points: Annotated[int, Range(1, 100_000)] = 100
    hypotheses_per_pose: Annotated[int, Range(1, 4096)] = 8
    shard_size: Annotated[int, Range(1, 1_000_000)] = 64
    min_visible: Annotated[float, Range(0, 1)] = 0.1
    min_area_px: Annotated[float, Range(1)] = 150.0
    images: Annotated[int, Range(0)] = 0
    images_per_scene: Annotated[int, Range(0)] = 0
    window: Literal["diameter", "fixed"] = "diameter"
    scale: Annotated[float, Range(1, 8)] = 2.0
    padding: Annotated[float, Range(0, 4)] = 0.3
    perturbation: PerturbationConfig = field(default_factory=PerturbationConfig)

    def __post_init__(self) -> None:
        check_ranges(self)


def load_cut_config(overrides: Sequence[str] = (), values: Mapping[str, Any] | None = None) -> CutConfig:
    """Resolve `key=value` overrides and option values (in rising priority) to a configuration.

    Args:
        overrides: Assignments such as `perturbation.max_angle_deg=20`.
        values: Top-level values from command-line options; None entries are left out.

    Raises:
        ConfigError: Unknown key or value, or a key with a new name; the message names it.
    """
    mapping = config_tools.apply_overrides({}, overrides)
    refuse_renamed_keys(mapping, RENAMED_KEYS, "--set")
    mapping.update({k: v for k, v in (values or {}).items() if v is not None})
    return config_tools.build(CutConfig, mapping, "settings")
