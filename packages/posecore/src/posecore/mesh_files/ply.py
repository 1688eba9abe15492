"""PLY files: trimesh reads their tables; colours of any name and type, textures, polygons and cuts are seen to here."""

import io
import logging
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float, Int, UInt8
from trimesh.exchange.ply import load_ply
from trimesh.grouping import unique_rows
from trimesh.visual import texture as trimesh_texture

from posecore.errors import MeshError
from posecore.mesh_files.images import beside, decode, linked_bytes, missing
from posecore.mesh_files.part import MeshPart, Texture, refuse_bad_indices
from posecore.mesh_files.polygons import triangles_of
from posecore.ply import refuse_broken_ply
from posecore.srgb import to_bytes

log = logging.getLogger(__name__)

TIMES_COLOURS = "comment TextureTimesVertexColours"
"""Header line of a PLY whose vertex colours are a factor on its texture; elsewhere a texture stands for them."""
MIP_LEVELS = "comment TextureMipLevels"
"""Header line of a PLY with the number of halvings after which materials would mix in its texture."""
_COLOURS = (("red", "green", "blue"), ("diffuse_red", "diffuse_green", "diffuse_blue"), ("r", "g", "b"))
_UV = (("texture_u", "texture_v"), ("u", "v"), ("s", "t"), ("texture_s", "texture_t"))
_BINARY = {
    "char": "i1", "uchar": "u1", "short": "i2", "ushort": "u2", "int": "i4", "uint": "u4", "float": "f4",
    "double": "f8", "int8": "i1", "uint8": "u1", "int16": "i2", "uint16": "u2", "int32": "i4", "uint32": "u4",
    "float32": "f4", "float64": "f8", "int64": "i8", "uint64": "u8",
}  # fmt: skip


def read_ply(file: Path, data: bytes, *, allow_missing_textures: bool = False) -> list[MeshPart]:
    """Parts of a PLY file, one for each texture.

    A texture (`comment TextureFile`) stands for the colours; without one the colours of the vertices count, else those
    of the faces. Opacity is left out, as PLY gives it no meaning for a surface.

    Args:
        file: The file.
        data: Its bytes.
        allow_missing_textures: Whether a missing or broken texture is left out.

    Raises:
        MeshError: The file is cut off, or holds what cannot be drawn as it is described.
        TextureError: Its texture is missing.
    """
    refuse_broken_ply(file, data)
    header = data.split(b"end_header", 1)[0].decode("utf-8", "replace").splitlines()
    data = _equal_lists(file, header, data)
    loaded = load_ply(io.BytesIO(data), skip_materials=True, fix_texture=False)
    raw = loaded["metadata"]["_ply_raw"]
    count = len(loaded.get("vertices", ()))
    if "face" not in raw or not raw["face"].get("length") or loaded.get("faces") is None:
        raise MeshError(f"{file}: {count} vertices and no faces; a triangle mesh is needed, not a point cloud")
    vertices = np.asarray(loaded["vertices"], np.float64)
    table, face_table = raw["vertex"]["data"], raw["face"]["data"]
    faces, polygon = _triangles(loaded["faces"], face_table, vertices)
    refuse_bad_indices(file, faces, len(vertices))
    part = MeshPart(
        vertices=vertices,
        faces=faces,
        normals=None if loaded.get("vertex_normals") is None else np.asarray(loaded["vertex_normals"], np.float64),
        rgb=_colours(file, table),
    )
    textures = _textures(file, header, allow_missing_textures)
    if textures:
        parts = _textured(file, part, textures, _columns(table, _UV), face_table, polygon)
        keeps_colours = any(line.strip() == TIMES_COLOURS for line in header)
        if parts:
            return [item if keeps_colours else replace(item, rgb=None) for item in parts]
        if part.rgb is None and not allow_missing_textures:
            raise MeshError(
                f"{file}: names a texture and has no texture coordinates; export them (texture_u, texture_v)"
            )
    if part.rgb is None:
        face_rgb = _colours(file, face_table)
        if face_rgb is not None:
            part = _unshared(part, face_rgb[polygon])
    return [part]


def _equal_lists(file: Path, header: list[str], data: bytes) -> bytes:
    """The data, as text where a binary file holds lists of several lengths, which trimesh cannot read.

    Raises:
        MeshError: The file is cut off.
    """
    kind = next((line.split()[1] for line in header if line.startswith("format ") and len(line.split()) > 1), "")
    if kind not in ("binary_little_endian", "binary_big_endian"):
        return data
    end = data.find(b"end_header")
    start = data.find(b"\n", end) + 1
    order = "<" if kind == "binary_little_endian" else ">"
    elements: list[tuple[str, int, list[list[str]]]] = []
    for line in header:
        words = line.split()
        if len(words) == 3 and words[0] == "element" and words[2].isdigit():
            elements.append((words[1], int(words[2]), []))
        elif words and words[0] == "property" and elements:
            elements[-1][2].append(words[1:])
    is_complete = all(kind in _BINARY for _, _, rows in elements for row in rows for kind in row[:-1] if kind != "list")
    if not elements or not is_complete:
        return data
    rows: list[str] = []
    position, is_ragged = start, False
    for name, count, properties in elements:
        lists = [row for row in properties if row[0] == "list"]
        if not lists:
            size = sum(np.dtype(_BINARY[row[0]]).itemsize for row in properties)
            if position + count * size > len(data):
                whole = max(len(data) - position, 0) // max(size, 1)
                raise MeshError(f"{file}: is cut off, it has {whole} of {count} rows of '{name}'; copy it again")
            position += count * size
            continue
        position, lengths = _walk(file, data, position, name, count, properties, order)
        is_ragged |= any(len(set(column)) > 1 for column in lengths)
    if not is_ragged:
        return data
    position = start
    for _, count, properties in elements:
        for _ in range(count):
            words, position = _row(data, position, properties, order)
            rows.append(" ".join(words))
    head = [line for line in header if line.strip() and not line.startswith("format ")]
    head.insert(1, "format ascii 1.0")
    return "\n".join([*head, "end_header", *rows, ""]).encode()


def _walk(
    file: Path, data: bytes, start: int, name: str, count: int, properties: list[list[str]], order: str
) -> tuple[int, list[list[int]]]:
    """Position after an element with lists, and the lists' lengths; one step where all rows are alike."""
    equal = _equal_rows(data, start, count, properties, order)
    if equal is not None:
        return equal, []
    lengths: list[list[int]] = [[] for row in properties if row[0] == "list"]
    position = start
    for i in range(count):
        column = 0
        for row in properties:
            if row[0] != "list":
                position += np.dtype(_BINARY[row[0]]).itemsize
                continue
            size = np.dtype(_BINARY[row[1]]).itemsize
            item = np.dtype(order + _BINARY[row[1]])
            if position + size > len(data):
                raise MeshError(f"{file}: is cut off, it has {i} of {count} rows of '{name}'; copy it again")
            length = int(np.frombuffer(data, item, 1, position)[0])
            if length < 0:
                raise MeshError(f"{file}: row {i} of '{name}' has a list of {length} numbers; export the mesh again")
            lengths[column].append(length)
            column += 1
            position += size + length * np.dtype(_BINARY[row[2]]).itemsize
        if position > len(data):
            raise MeshError(f"{file}: is cut off, it has {i} of {count} rows of '{name}'; copy it again")
    return position, lengths


def _equal_rows(data: bytes, start: int, count: int, properties: list[list[str]], order: str) -> int | None:
    """Position after an element whose rows all have lists as long as the first row's, or None."""
    if count == 0:
        return start
    fields: list[tuple[str, Any]] = []
    position = start
    for i, row in enumerate(properties):
        if row[0] != "list":
            fields.append((f"v{i}", order + _BINARY[row[0]]))
            position += np.dtype(_BINARY[row[0]]).itemsize
            continue
        item = np.dtype(order + _BINARY[row[1]])
        if position + item.itemsize > len(data):
            return None
        length = int(np.frombuffer(data, item, 1, position)[0])
        if not 0 <= length < 1 << 16:
            return None
        fields += [(f"n{i}", item), (f"v{i}", order + _BINARY[row[2]], (length,))]  # type: ignore[list-item]
        position += item.itemsize + length * np.dtype(_BINARY[row[2]]).itemsize
    dtype = np.dtype(fields)
    if start + count * dtype.itemsize > len(data):
        return None
    table = np.frombuffer(data, dtype, count, start)
    counts = [table[name] for name, *_ in fields if name.startswith("n")]
    return start + count * dtype.itemsize if all((column == column[0]).all() for column in counts) else None


def _row(data: bytes, position: int, properties: list[list[str]], order: str) -> tuple[list[str], int]:
    words: list[str] = []
    for row in properties:
        length = 1
        if row[0] == "list":
            item = np.dtype(order + _BINARY[row[1]])
            length = int(np.frombuffer(data, item, 1, position)[0])
            words.append(str(length))
            position += item.itemsize
        item = np.dtype(order + _BINARY[row[-2]])
        words += [str(value) for value in np.frombuffer(data, item, length, position).tolist()]
        position += length * item.itemsize
    return words, position


def _triangles(
    faces: Int[np.ndarray, "f n"], table: Any, vertices: Float[np.ndarray, "v 3"]
) -> tuple[Int[np.ndarray, "t 3"], Int[np.ndarray, " t"]]:
    """Triangles, and the row of each in the file."""
    polygons = _lists(table, ("vertex_indices", "vertex_index"))
    if polygons is None or (isinstance(polygons, np.ndarray) and polygons.ndim == 2 and polygons.shape[1] == 3):
        return np.asarray(faces, np.int64), np.arange(len(faces))
    rows = [np.asarray(row, np.int64).reshape(-1) for row in polygons]
    if any(row.min(initial=0) < 0 or row.max(initial=0) >= len(vertices) for row in rows):
        return np.asarray(faces, np.int64), np.zeros(len(faces), np.int64)  # refused by the caller
    return triangles_of(vertices, rows)


def _lists(table: Any, names: Sequence[str]) -> Any:
    """A list property of a table, as an array of equal rows or of arrays; None where it has none."""
    available = table.dtype.names if isinstance(table, np.ndarray) else table.keys()
    for name in names:
        if available and name in available:
            column = table[name]
            return column["f1"] if isinstance(column, np.ndarray) and column.dtype.names else column
    return None


def _columns(table: Any, choices: Sequence[tuple[str, ...]]) -> np.ndarray | None:
    """Columns of the first choice whose names are all there, in the file's type."""
    available = (table.dtype.names if isinstance(table, np.ndarray) else table.keys()) or ()
    for names in choices:
        if all(name in available for name in names):
            return np.asarray(np.stack([np.asarray(table[name]).reshape(-1) for name in names], axis=1))
    return None


def _colours(file: Path, table: Any) -> UInt8[np.ndarray, "n 3"] | None:
    """Display colours of a table's rows. Whole numbers span their type, others [0, 1] or, above 1, [0, 255]."""
    values = _columns(table, _COLOURS)
    if values is None or len(values) == 0:
        return None
    if values.dtype.kind == "f":
        if not np.isfinite(values).all():
            raise MeshError(f"{file}: a colour is not a finite number; export the mesh again")
        return to_bytes(values.astype(np.float64) / (255.0 if values.max() > 1.0 else 1.0))
    if values.dtype.itemsize == 1:
        return values.astype(np.uint8)
    most = int(values.max())
    return to_bytes(values / (255.0 if values.dtype.itemsize > 2 and most <= 255 else 65535.0))


def _textures(file: Path, header: list[str], allow_missing_textures: bool) -> list[Texture]:
    textures = []
    levels = [int(word) for line in header if line.startswith(MIP_LEVELS) and (word := line.split()[-1]).isdecimal()]
    for line in header:
        if not line.lower().startswith("comment texturefile"):
            continue
        name = line[len("comment texturefile") :].strip()
        path = beside(name, [file.parent])
        try:
            if path is None:
                raise missing(file, "texture", file.parent, name)
            picture = decode(file, str(path), linked_bytes(file, path))
            textures.append(Texture(rgb=picture.rgb, mip_levels=min(levels, default=None)))
        except MeshError:
            if not allow_missing_textures:
                raise
            return []
    return textures


def _textured(
    file: Path,
    part: MeshPart,
    textures: list[Texture],
    vertex_uv: np.ndarray | None,
    face_table: Any,
    polygon: Int[np.ndarray, " f"],
) -> list[MeshPart]:
    """One part for each texture; none where there are no texture coordinates."""
    wedge = _lists(face_table, ("texcoord",))
    if wedge is not None and len(polygon) > 0:
        wedge = np.asarray(wedge)
        if wedge.ndim != 2 or wedge.shape[1] != 6 or len(wedge) != len(part.faces):
            raise MeshError(f"{file}: has texture coordinates of polygons' corners; triangulate the mesh")
        corners = wedge.reshape(-1, 2).astype(np.float64)
        unique: Any = unique_rows
        rows, inverse = unique(corners)  # trimesh orders the vertices by it, and hashes hang on that
        faces, of_vertex, of_uv = _unmerged(part.faces, inverse.reshape(part.faces.shape))
        part = part.picked(of_vertex, faces, corners[rows][of_uv])
    elif vertex_uv is not None:
        part = replace(part, uv=vertex_uv.astype(np.float64))
    else:
        return []
    if len(textures) == 1:
        return [replace(part, texture=textures[0])]
    numbers = _columns(face_table, (("texnumber",),))
    if numbers is None:
        raise MeshError(
            f"{file}: names {len(textures)} textures and no texnumber of its faces; export it with one texture"
        )
    number = numbers[:, 0].astype(np.int64)[polygon]
    if number.min() < 0 or number.max() >= len(textures):
        raise MeshError(
            f"{file}: a face has texnumber {number.max()}, expected 0 to {len(textures) - 1}; export it again"
        )
    return [
        replace(part, faces=part.faces[number == i], texture=texture)
        for i, texture in enumerate(textures)
        if (number == i).any()
    ]


def _unshared(part: MeshPart, face_rgb: UInt8[np.ndarray, "f 3"]) -> MeshPart:
    """The part with the colours of its faces: vertices are split where colours meet."""
    colours, of_face = np.unique(face_rgb, axis=0, return_inverse=True)
    key = np.repeat(of_face.reshape(-1, 1), 3, axis=1)
    faces, of_vertex, of_colour = _unmerged(part.faces, key)
    return replace(part.picked(of_vertex, faces), rgb=colours[of_colour])


def _unmerged(
    faces: Int[np.ndarray, "f 3"], numbers: Int[np.ndarray, "f 3"]
) -> tuple[Int[np.ndarray, "f 3"], Int[np.ndarray, " n"], Int[np.ndarray, " n"]]:
    """Faces whose vertices differ where their corners' numbers do, and the vertex and the number of each of these."""
    unmerge: Any = trimesh_texture.unmerge_faces
    new_faces, of_vertex, of_number = unmerge(faces, numbers)
    return np.asarray(new_faces), np.asarray(of_vertex), np.asarray(of_number)
