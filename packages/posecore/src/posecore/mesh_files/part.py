"""A part of a mesh file: triangles that share a look, before parts are joined to a mesh."""

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Literal

import numpy as np
from jaxtyping import Float, Int, UInt8

from posecore.errors import MeshError

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

    def picked(
        self, rows: Int[np.ndarray, " n"], faces: Int[np.ndarray, "f 3"], uv: Float[np.ndarray, "n 2"] | None = None
    ) -> "MeshPart":
        """The part with these of its vertices, in this order; with other texture coordinates, where they are given."""
        return replace(
            self,
            vertices=self.vertices[rows],
            faces=faces,
            normals=None if self.normals is None else self.normals[rows],
            rgb=None if self.rgb is None else self.rgb[rows],
            uv=uv if uv is not None or self.uv is None else self.uv[rows],
        )


def refuse_bad_indices(file: Path, faces: Int[np.ndarray, "f k"], n_vertices: int, first: int = 0) -> None:
    """Refuse faces that name vertices which are not there.

    Args:
        file: For the message.
        faces: Faces.
        n_vertices: Number of vertices.
        first: Number of the first face in the file.

    Raises:
        MeshError: A face names a vertex below 0 or beyond the last one.
    """
    if faces.min(initial=0) < 0 or faces.max(initial=0) >= n_vertices:
        bad = int(np.flatnonzero(((faces < 0) | (faces >= n_vertices)).any(axis=1))[0])
        raise MeshError(
            f"{file}: face {first + bad} names the vertices {faces[bad].tolist()}, expected 0 to {n_vertices - 1}; "
            "repair the mesh"
        )


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
