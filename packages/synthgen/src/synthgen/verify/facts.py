"""Reference data of the checks: the data card, the objects beside the shards, and samples with derived masks."""

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from typing import Annotated, Any, Literal

import numpy as np
from jaxtyping import Bool, Float, Int
from msgspec import Meta, Struct
from posecore.camera import Camera, intrinsics
from posecore.contour import contour_mask
from posecore.detail import with_levels
from posecore.errors import RenderError, ShardError
from posecore.mesh import Mesh
from posecore.raster import Rasteriser
from posecore.schema import check
from posecore.shard import BIT_OBJECT, ShardReader, field_table, load_meshes
from posecore.shard.card_schema import Name

from synthgen.draw.target import hull
from synthgen.pairs.data_card import migrated_card

_ADVICE = "only datasets made by `synthgen render` and `synthgen cut` can be verified"
_Positive = Annotated[float, Meta(gt=0, le=1e6)]


class _Distance(Struct):
    unit: Literal["m", "diameter"]
    min: _Positive
    max: _Positive


class _Perturbation(Struct):
    max_angle_deg: Annotated[float, Meta(ge=0, le=180)]
    max_translation_diameter: Annotated[float, Meta(ge=0, le=100)]


class _Recipe(Struct):
    """Keys of a recipe that checks compare samples with."""

    hypotheses_per_scene: Annotated[int, Meta(ge=1, le=1_000_000)]
    hypothesis_engine: Name
    engine: Name
    distance: _Distance
    perturbation: _Perturbation


class _Cut(Struct):
    """The same of pairs that were cut from images."""

    window: Name
    scale: _Positive


@dataclass(frozen=True, kw_only=True, eq=False)
class Facts:
    """Data card and objects of a dataset.

    Attributes:
        card: The data card.
        meshes: Objects by id, from the dataset's own `models/`.
        hulls_m: Vertices of their convex hulls.
        camera: Full image.
    """

    card: Mapping[str, Any]
    meshes: Mapping[int, Mesh]
    hulls_m: Mapping[int, np.ndarray]
    camera: Camera

    @property
    def patch_px(self) -> int:
        """Side of the patches."""
        return int(self.card["patch_px"])

    @property
    def rendered(self) -> bool:
        """Whether pairs were rendered from a recipe, not cut from images."""
        return "config" in self.card

    @property
    def diameter_scale(self) -> float | None:
        """Window side over the projected diameter of the hypothesis; None for fixed windows."""
        recipe = {} if self.rendered else self.card["cut"]
        return float(recipe["scale"]) if recipe.get("window") == "diameter" else None

    @property
    def hypotheses_per_scene(self) -> int:
        """Samples that share a scene."""
        return int(self.card["config"]["hypotheses_per_scene"])

    def step(self, field: str) -> float:
        """Quantisation step of a field; for a field stored as floats, the resolution of float32."""
        step = next(f for f in field_table() if f.name == field).step(self.card)
        return float(np.finfo(np.float32).eps) if step is None else step

    def object_values(self, obj_id: Int[np.ndarray, " n"], key: str) -> Float[np.ndarray, " n"]:
        """A number of each sample's object from the card; NaN for an object that is not in the card."""
        objects = self.card["objects"]
        return np.array([float(objects.get(str(i), {}).get(key, np.nan)) for i in obj_id.tolist()])

    def centres_m(self, obj_id: Int[np.ndarray, " n"]) -> Float[np.ndarray, "n 3"]:
        """Box centre of each sample's object, object frame, metres; NaN for an object that is not in the card."""
        unknown = np.full(3, np.nan)
        return np.array([self.meshes[i].center_m if i in self.meshes else unknown for i in obj_id.tolist()])


def load_facts(reader: ShardReader) -> Facts:
    """Read the data card and the objects of a dataset.

    Raises:
        ShardError: A model is missing or broken, the dataset is merged, or the card lacks entries of `synthgen render`
            and `cut`.
    """
    card = migrated_card(reader.card)
    if "merged" in card:
        raise ShardError(f"{reader.url}: was merged from {len(card['merged'])} datasets; verify those instead")
    reader.require("objects", "camera", *(("source",) if "cut" in card else ("config",)))
    recipe, schema = (card["cut"], _Cut) if "cut" in card else (card["config"], _Recipe)
    check(recipe, schema, f"{reader.url}: the data card's {'cut' if 'cut' in card else 'config'}", ShardError, _ADVICE)
    camera = card["camera"]
    K = intrinsics(camera["fx"], camera["fy"], camera["cx"], camera["cy"])
    whole = Camera(K=K, width_px=camera["width_px"], height_px=camera["height_px"])
    meshes = load_meshes(reader)
    if "detail" in card:  # drawn again as the dataset was
        meshes = {obj_id: with_levels(mesh) for obj_id, mesh in meshes.items()}
    return Facts(
        card=card, meshes=meshes, hulls_m={obj_id: hull(mesh) for obj_id, mesh in meshes.items()}, camera=whole
    )


class SampleBatch:
    """Samples of a shard, with the masks and renders that several checks share.

    Args:
        values: Fields by name, the sample axis in front.
        indices: Index of each sample in the dataset.
        facts: Reference data of the dataset.
        rasteriser: Renderer of the checks that render again; None without such checks.
    """

    def __init__(
        self,
        values: Mapping[str, np.ndarray],
        indices: Int[np.ndarray, " n"],
        facts: Facts,
        rasteriser: Rasteriser | None = None,
    ) -> None:
        self.values = values
        self.indices = indices
        self.facts = facts
        self._rasteriser = rasteriser

    def __getitem__(self, name: str) -> np.ndarray:
        return self.values[name]

    def __len__(self) -> int:
        return len(self.indices)

    @cached_property
    def object_mask(self) -> Bool[np.ndarray, "n p p"]:
        """Stored whole silhouettes at the ground truth."""
        return np.asarray(self["scene_mask"] & BIT_OBJECT > 0)

    @cached_property
    def hypothesis_mask(self) -> Bool[np.ndarray, "n p p"]:
        """Stored silhouettes at the hypothesis."""
        return np.asarray(self["hypothesis_depth_m"] > 0)

    @cached_property
    def scene_contour(self) -> Bool[np.ndarray, "n p p"]:
        """Contour pixels of the stored silhouettes at the ground truth."""
        return np.stack([contour_mask(mask) for mask in self.object_mask])

    @cached_property
    def hypothesis_contour(self) -> Bool[np.ndarray, "n p p"]:
        """Contour pixels of the stored silhouettes at the hypothesis."""
        return np.stack([contour_mask(mask) for mask in self.hypothesis_mask])

    @cached_property
    def gt_rendered_m(self) -> Float[np.ndarray, "n p p"]:
        """Camera z of the objects rendered at the ground truth, 0 for background."""
        return self._render("T_cam_obj")

    @cached_property
    def hypothesis_rendered_m(self) -> Float[np.ndarray, "n p p"]:
        """Camera z of the objects rendered at the hypothesis, 0 for background."""
        return self._render("T_cam_obj_hypothesis")

    def _render(self, pose: str) -> Float[np.ndarray, "n p p"]:
        if self._rasteriser is None:
            raise RenderError("this batch has no rasteriser, so nothing can be rendered again")
        p = self.facts.patch_px
        depth_m = np.zeros((len(self), p, p), np.float32)
        rows = np.flatnonzero(np.isin(self["obj_id"], list(self.facts.meshes)))
        if len(rows):
            K, T = self["K_crop"][rows], self[pose][rows]
            depth_m[rows] = self._rasteriser.render(self["obj_id"][rows], K, T, p, p, rgb=False).depth_m
        return depth_m
