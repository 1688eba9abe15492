"""Base colours of glTF materials: factors in linear light, textures, their coordinates and opacity."""

import logging
import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float

from posecore.errors import MeshError
from posecore.mesh_files.gltf_buffers import Buffers
from posecore.mesh_files.images import DecodedImage, decode
from posecore.mesh_files.mtl import HOLE, NEARLY_OPAQUE
from posecore.mesh_files.part import Texture, Wrap
from posecore.srgb import display_from_linear, linear_from_display, to_bytes

log = logging.getLogger(__name__)

_WRAPS: dict[int, Wrap] = {10497: "repeat", 33071: "clamp", 33648: "mirror"}


@dataclass(frozen=True, kw_only=True, eq=False)
class BaseColour:
    """Base colour of a material.

    Attributes:
        factor: Linear light.
        texture: The image times the factor, or None.
        unscaled: The image alone.
        uv_set: Number of its texture coordinates.
        offset: Of its texture coordinates.
        rotation_rad: Counter-clockwise.
        scale: Of its texture coordinates.
    """

    factor: Float[np.ndarray, "3"]
    texture: Texture | None = None
    unscaled: Texture | None = None
    uv_set: int = 0
    offset: tuple[float, float] = (0.0, 0.0)
    rotation_rad: float = 0.0
    scale: tuple[float, float] = (1.0, 1.0)

    def placed(self, uv: Float[np.ndarray, "v 2"]) -> Float[np.ndarray, "v 2"]:
        """Texture coordinates after the material's transform (KHR_texture_transform), origin at the top left."""
        c, s = math.cos(self.rotation_rad), math.sin(self.rotation_rad)
        rotated = (uv * self.scale) @ np.array([[c, -s], [s, c]])
        return np.asarray(rotated + np.array(self.offset))


@dataclass(frozen=True, kw_only=True, eq=False)
class Materials:
    """Base colours of a file's materials, each made once.

    Attributes:
        file: For messages.
        tree: Its JSON.
        buffers: Its data, which may hold images.
        allow_missing_textures: Whether a missing or broken texture is left out.
    """

    file: Path
    tree: Mapping[str, Any]
    buffers: Buffers
    allow_missing_textures: bool = False
    _base_colours: dict[int, BaseColour] = field(default_factory=dict)

    def base_colour(self, number: int | None) -> BaseColour:
        """Base colour of a material; None is the specification's default, which is white.

        Raises:
            MeshError: It is see-through, or its texture cannot be read.
            TextureError: Its texture is missing.
        """
        if number is None:
            return BaseColour(factor=np.ones(3))
        if number not in self._base_colours:
            self._base_colours[number] = self._made(number)
        return self._base_colours[number]

    def refuse_see_through(self, number: int | None, colours: Float[np.ndarray, "v d"]) -> None:
        """Refuse vertex colours whose opacity the material draws."""
        if number is not None and colours.shape[1] == 4:
            self._refuse_alpha(self.tree["materials"][number], float(colours[:, 3].min(initial=1.0)))

    def _made(self, number: int) -> BaseColour:
        material = self.tree["materials"][number]
        extensions = material.get("extensions", {})
        if extensions.get("KHR_materials_transmission", {}).get("transmissionFactor", 0.0) > 0.0:
            log.warning("%s: its material %s is see-through and drawn opaque", self.file, _name(material, number))
        specular = extensions.get("KHR_materials_pbrSpecularGlossiness")
        if specular is not None:
            factor, reference = specular.get("diffuseFactor", (1, 1, 1, 1)), specular.get("diffuseTexture")
        else:
            metallic = material.get("pbrMetallicRoughness", {})
            factor, reference = metallic.get("baseColorFactor", (1, 1, 1, 1)), metallic.get("baseColorTexture")
        colour = np.array(factor, np.float64)
        if colour.shape not in ((3,), (4,)) or not np.isfinite(colour).all():
            raise MeshError(
                f"{self.file}: its material {_name(material, number)} has the base colour {factor}; mend it"
            )
        opacity = float(colour[3]) if len(colour) == 4 else 1.0
        picture = None if reference is None else self._picture(reference["index"])
        if picture is not None and picture.alpha is not None:
            opacity *= float(picture.alpha.min()) / 255.0
        self._refuse_alpha(material, opacity)
        colour = np.clip(colour[:3], 0.0, 1.0)
        if reference is None or picture is None:
            return BaseColour(factor=colour)
        wrap = self._wrap(reference["index"])
        rgb = picture.rgb
        if (colour != 1.0).any():
            levels = to_bytes(display_from_linear(linear_from_display(np.arange(256) / 255.0)[:, None] * colour))
            rgb = np.stack([levels[rgb[..., i], i] for i in range(3)], axis=-1)
        transform = reference.get("extensions", {}).get("KHR_texture_transform", {})
        return BaseColour(
            factor=colour,
            texture=Texture(rgb=rgb, wrap=wrap),
            unscaled=Texture(rgb=picture.rgb, wrap=wrap),
            uv_set=int(transform.get("texCoord", reference.get("texCoord", 0))),
            offset=tuple(transform.get("offset", (0.0, 0.0))),
            rotation_rad=float(transform.get("rotation", 0.0)),
            scale=tuple(transform.get("scale", (1.0, 1.0))),
        )

    def _refuse_alpha(self, material: Mapping[str, Any], opacity: float) -> None:
        """Refuse holes, which cut the silhouette; what is only tinted is drawn opaque, with a warning."""
        mode, cutoff = material.get("alphaMode", "OPAQUE"), material.get("alphaCutoff", 0.5)
        if opacity < {"BLEND": HOLE, "MASK": cutoff}.get(mode, 0.0):
            raise MeshError(
                f"{self.file}: its material {_name(material)} cuts holes (alphaMode {mode}, opacity down to "
                f"{opacity:.2g}), silhouettes are opaque here; export it opaque or model the holes"
            )
        if mode == "BLEND" and opacity < NEARLY_OPAQUE:
            log.warning("%s: its material %s is see-through and drawn opaque", self.file, _name(material))

    def _picture(self, number: int) -> DecodedImage | None:
        """The image of a texture; None where it is missing and may be."""
        try:
            texture = self.tree["textures"][number]
            source = texture.get("source", texture.get("extensions", {}).get("EXT_texture_webp", {}).get("source"))
            if source is None:
                others = ", ".join(texture.get("extensions", {})) or "no source"
                raise MeshError(
                    f"{self.file}: its texture {number} is only given as {others}, which is not read; use PNG or JPEG"
                )
            image = self.tree["images"][source]
            if "bufferView" in image:
                return decode(self.file, f"image {source}", self.buffers.view(image["bufferView"]))
            data, name = self.buffers.linked(image["uri"], "texture")
            return decode(self.file, name, data)
        except MeshError:
            if not self.allow_missing_textures:
                raise
        return None

    def _wrap(self, number: int) -> tuple[Wrap, Wrap]:
        sampler = self.tree["textures"][number].get("sampler")
        entry = {} if sampler is None else self.tree["samplers"][sampler]
        return _WRAPS[entry.get("wrapS", 10497)], _WRAPS[entry.get("wrapT", 10497)]


def _name(material: Mapping[str, Any], number: int | None = None) -> str:
    return repr(material.get("name", "" if number is None else number))
