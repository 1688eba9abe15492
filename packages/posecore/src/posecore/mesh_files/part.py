"""A part of a mesh file: triangles that share a look, before parts are joined to a mesh."""

from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import numpy as np
from jaxtyping import Float, Int, UInt8

GREY = 160
"""Display value of surfaces to which a file gives no colour."""
Wrap = Literal["repeat", "clamp", "mirror"]


@dataclass(frozen=True, kw_only=True, eq=False)
class Texture:
    """A decoded image as a material uses it.

    Attributes:
        rgb: (h, w, 3) display colours, row 0 at the top.
        wrap: What follows beyond texture coordinates of [0, 1], along u and along v.
        mip_levels: How often it may be halved before materials that share it mix; None: ever.
    """

    rgb: UInt8[np.ndarray, "h w 3"]
    wrap: tuple[Wrap, Wrap] = ("repeat", "repeat")
    mip_levels: int | None = None


@dataclass(frozen=True, kw_only=True, eq=False)
class MeshPart:
    """Triangles with one look. A pixel's colour is the product of what is there of texture and vertex colours.

    Attributes:
        vertices: (v, 3) in the file's unit.
        faces: (f, 3) vertex indices.
        normals: (v, 3) of the file, of any length; None where it has none.
        rgb: (v, 3) display (sRGB) colours, or None.
        uv: (v, 2) texture coordinates, origin at the texture's bottom left, or None.
        texture: Its image, or None.
        is_flat: Whether faces without normals are flat, whatever the angle between them.
    """

    vertices: Float[np.ndarray, "v 3"]
    faces: Int[np.ndarray, "f 3"]
    normals: Float[np.ndarray, "v 3"] | None = None
    rgb: UInt8[np.ndarray, "v 3"] | None = None
    uv: Float[np.ndarray, "v 2"] | None = None
    texture: Texture | None = None
    is_flat: bool = False


def linear_from_display(values: Float[np.ndarray, "*b"]) -> Float[np.ndarray, "*b"]:
    """Linear light of display (sRGB) values in [0, 1] (IEC 61966-2-1)."""
    return np.asarray(np.where(values <= 0.04045, values / 12.92, ((values + 0.055) / 1.055) ** 2.4))


def display_from_linear(values: Float[np.ndarray, "*b"]) -> Float[np.ndarray, "*b"]:
    """Display (sRGB) values of linear light, which is clipped to [0, 1] (IEC 61966-2-1)."""
    light = np.clip(values, 0.0, 1.0)
    return np.asarray(np.where(light <= 0.0031308, light * 12.92, 1.055 * light ** (1 / 2.4) - 0.055))


def to_bytes(values: Float[np.ndarray, "*b"]) -> UInt8[np.ndarray, "*b"]:
    """8-bit values of values in [0, 1]."""
    return np.asarray(np.rint(np.clip(values, 0.0, 1.0) * 255.0).astype(np.uint8))


def two_looks(file: Path) -> str:
    """Why faces that lie on each other with different colours are refused."""
    return f"{file}: two faces lie on each other and have different colours, of which chance would show one; move one"


def decoded(data: bytes) -> str:
    """UTF-8, or Latin-1 where it is not; without a byte-order mark, with one kind of line end."""
    try:
        text = data.decode("utf-8-sig")
    except UnicodeDecodeError:
        text = data.decode("latin-1")
    return text.replace("\r\n", "\n").replace("\r", "\n")
