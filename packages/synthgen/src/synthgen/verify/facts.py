"""What the checks hold samples against: the data card and the objects that lie beside the shards."""

import json
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
from jaxtyping import Bool, Float, Int
from posecore.camera import Camera, intrinsics
from posecore.contour import contour_mask
from posecore.errors import RenderError, ShardError
from posecore.mesh import Mesh
from posecore.raster import Rasteriser
from posecore.shard import BIT_OBJECT, MANIFEST, ShardReader, field_table, load_meshes

from synthgen.draw.target import hull
from synthgen.pairs.data_card import migrated_card

Array = np.ndarray

_NEEDED = {  # keys of the configuration that checks hold samples against
    "": ("hypotheses_per_scene", "hypothesis_engine"),
    "distance": ("unit", "min", "max"),
    "perturbation": ("max_angle_deg", "max_translation_diameter"),
}

_NEEDED_OF_CUT = {"": ("window", "scale")}


@dataclass(frozen=True, kw_only=True, eq=False)
class Facts:
    """A dataset's card in the form that checks use.

    Attributes:
        card: The data card.
        meshes: Objects by id, from the dataset's own `models/`.
        hulls_m: Vertices of their convex hulls.
        camera: Full image.
    """

    card: Mapping[str, Any]
    meshes: Mapping[int, Mesh]
    hulls_m: Mapping[int, Array]
    camera: Camera

    @property
    def patch_px(self) -> int:
        """Side of the patches."""
        return int(self.card["patch_px"])

    @property
    def rendered(self) -> bool:
        """Whether pairs were rendered after a recipe, not cut out of images."""
        return "config" in self.card

    @property
    def diameter_scale(self) -> float | None:
        """Side of windows that follow the hypothesis' distance over its projected diameter; None of fixed ones."""
        recipe = {} if self.rendered else self.card["cut"]
        return float(recipe["scale"]) if recipe.get("window") == "diameter" else None

    @property
    def hypotheses_per_scene(self) -> int:
        """Samples that share a scene."""
        return int(self.card["config"]["hypotheses_per_scene"])

    def step(self, field: str) -> float:
        """What one step of a stored integer is worth; for a field stored as floats, what float32 resolves there."""
        found = next(f for f in field_table() if f.name == field).step(self.card)
        return float(np.finfo(np.float32).eps) if found is None else found

    def of_objects(self, obj_id: Int[Array, " n"], key: str) -> Float[Array, " n"]:
        """A number of each sample's object from the card; NaN for an object that the card does not know."""
        objects = self.card["objects"]
        return np.array([float(objects.get(str(i), {}).get(key, np.nan)) for i in obj_id.tolist()])

    def centres_m(self, obj_id: Int[Array, " n"]) -> Float[Array, "n 3"]:
        """Box centre of each sample's object, object frame; NaN for an unknown object."""
        unknown = np.full(3, np.nan)
        return np.array([self.meshes[i].center_m if i in self.meshes else unknown for i in obj_id.tolist()])


def load_facts(reader: ShardReader) -> Facts:
    """Read the objects of a dataset.

    Raises:
        ShardError: A model is missing or broken, the dataset is merged, or the card lacks what those of
            `synthgen render` and `cut` have.
    """
    card = migrated_card(reader.card)
    if "merged" in card:
        raise ShardError(f"{reader.url}: is merged of {len(card['merged'])} datasets; verify each of those instead")
    try:
        camera = card["camera"]
        K = intrinsics(camera["fx"], camera["fy"], camera["cx"], camera["cy"])
        whole = Camera(K=K, width_px=camera["width_px"], height_px=camera["height_px"])
        needed, recipe = (_NEEDED_OF_CUT, card["cut"]) if "cut" in card else (_NEEDED, card["config"])
        for group, keys in needed.items():
            for key in keys:
                (recipe[group] if group else recipe)[key]
        meshes = load_meshes(reader)
    except (KeyError, TypeError, ValueError, AttributeError) as error:
        if isinstance(error, ShardError):
            raise
        raise ShardError(
            f"{reader.url}: the data card lacks what `synthgen render` and `synthgen cut` write "
            f"({type(error).__name__}: {error}); only datasets made by them can be verified"
        ) from error
    return Facts(
        card=card, meshes=meshes, hulls_m={obj_id: hull(mesh) for obj_id, mesh in meshes.items()}, camera=whole
    )


def manifest_lines(reader: ShardReader) -> dict[int, dict[str, Any]]:
    """The manifest's lines by shard, as the reader has checked them."""
    lines = [json.loads(text) for text in reader.file(MANIFEST).decode().splitlines()] if reader.committed else []
    return {int(line["shard"]): line for line in lines}


class Batch:
    """Some samples of one shard with what several checks need of them, computed once.

    Args:
        values: Fields by name, the sample axis in front.
        indices: Index of each sample in the dataset.
        facts: The dataset.
        rasteriser: For checks that draw the objects again; None where none is run.
    """

    def __init__(
        self, values: Mapping[str, Array], indices: Int[Array, " n"], facts: Facts, rasteriser: Rasteriser | None = None
    ) -> None:
        self.values = values
        self.indices = indices
        self.facts = facts
        self._rasteriser = rasteriser

    def __getitem__(self, name: str) -> Array:
        return self.values[name]

    def __len__(self) -> int:
        return len(self.indices)

    @cached_property
    def object_mask(self) -> Bool[Array, "n p p"]:
        """Whole silhouettes at the truth, as stored."""
        return np.asarray(self["scene_mask"] & BIT_OBJECT > 0)

    @cached_property
    def hypothesis_mask(self) -> Bool[Array, "n p p"]:
        """Silhouettes at the hypothesis, as stored."""
        return np.asarray(self["hypothesis_depth_m"] > 0)

    @cached_property
    def scene_contour(self) -> Bool[Array, "n p p"]:
        """Contour pixels of the stored true silhouettes."""
        return np.stack([contour_mask(mask) for mask in self.object_mask])

    @cached_property
    def hypothesis_contour(self) -> Bool[Array, "n p p"]:
        """Contour pixels of the stored hypothesis silhouettes."""
        return np.stack([contour_mask(mask) for mask in self.hypothesis_mask])

    @cached_property
    def truth_drawn_m(self) -> Float[Array, "n p p"]:
        """Camera z of the objects drawn again at the truth, 0 where there is nothing."""
        return self._draw("T_cam_obj")

    @cached_property
    def hypothesis_drawn_m(self) -> Float[Array, "n p p"]:
        """Camera z of the objects drawn again at the hypothesis."""
        return self._draw("T_cam_obj_hypothesis")

    def _draw(self, pose: str) -> Float[Array, "n p p"]:
        if self._rasteriser is None:
            raise RenderError("this batch has no rasteriser, so nothing can be drawn again")
        p = self.facts.patch_px
        depth_m = np.zeros((len(self), p, p), np.float32)
        rows = np.flatnonzero(np.isin(self["obj_id"], list(self.facts.meshes)))
        if len(rows):
            K, T = self["K_crop"][rows], self[pose][rows]
            depth_m[rows] = self._rasteriser.render(self["obj_id"][rows], K, T, p, p, rgb=False).depth_m
        return depth_m
