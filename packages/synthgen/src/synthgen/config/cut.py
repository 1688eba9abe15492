"""Configuration of pairs that are cut out of annotated images."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, Literal

from posecore import config as config_tools

from synthgen.config.geometry import PerturbationConfig
from synthgen.config.ranges import MAX_PATCH_PX, check
from synthgen.config.renamed_keys import refuse_renamed


@dataclass(frozen=True, kw_only=True)
class CutConfig:
    """How pairs are cut out of annotated images; with the images it decides every byte.

    Attributes:
        seed: Of hypotheses.
        patch_px: Side of the patches.
        contour_points: Contour points per silhouette.
        hypotheses_per_pose: Drawn around each annotated pose; without effect on hypotheses from a file.
        shard_size: Pairs in a shard.
        min_visible: Annotated poses that are visible by less are left out, and those whose box the image shows less of.
        min_area_px: So are pairs of which the convex hull of one silhouette covers fewer pixels of image or patch.
        images: Most images to cut, evenly spread over those that are there; 0 cuts all.
        images_per_scene: So many images of a BOP scene, one after the other, count as one scene (training holds out
            whole ones). 0: all of them where there are several BOP scenes, else each by itself.
        window: `diameter` follows the hypothesis' distance and shows every pose as large, for networks whose own window
            does so; `fixed` is the paper's, of one side for all poses of an object.
        scale: Side of a diameter window over the projected diameter. Larger than the network's own, which is cut out
            of it around other hypotheses.
        padding: Added to an object's largest silhouette box at its nearest pose, as a share of it: its fixed window.
        perturbation: How far drawn hypotheses lie from the truth.
    """

    seed: int = 0
    patch_px: int = 224
    contour_points: int = 100
    hypotheses_per_pose: int = 8
    shard_size: int = 64
    min_visible: float = 0.1
    min_area_px: float = 150.0
    images: int = 0
    images_per_scene: int = 0
    window: Literal["diameter", "fixed"] = "diameter"
    scale: float = 2.0
    padding: float = 0.3
    perturbation: PerturbationConfig = field(default_factory=PerturbationConfig)

    def __post_init__(self) -> None:
        check("seed", self.seed, 0, 2**63 - 1)
        check("patch_px", self.patch_px, 16, MAX_PATCH_PX)
        check("contour_points", self.contour_points, 1, 100_000)
        check("hypotheses_per_pose", self.hypotheses_per_pose, 1, 4096)
        check("shard_size", self.shard_size, 1, 1_000_000)
        check("min_visible", self.min_visible, 0.0, 1.0)
        check("min_area_px", self.min_area_px, 1.0)
        check("images", self.images, 0)
        check("images_per_scene", self.images_per_scene, 0)
        check("scale", self.scale, 1.0, 8.0)
        check("padding", self.padding, 0.0, 4.0)


def load_cut_config(overrides: Sequence[str] = (), values: Mapping[str, Any] | None = None) -> CutConfig:
    """Resolve `key=value` overrides and option values (in rising priority) to a configuration.

    Args:
        overrides: Assignments such as `perturbation.max_angle_deg=20`.
        values: Top-level values from command-line options; None entries are left out.

    Raises:
        ConfigError: Unknown key or value, or a key with a new name; the message names it.
    """
    mapping = config_tools.apply_overrides({}, overrides)
    refuse_renamed(mapping, "--set")
    mapping.update({k: v for k, v in (values or {}).items() if v is not None})
    return config_tools.build(CutConfig, mapping, "settings")
