"""Parts of a mesh file joined to one surface: duplicate faces and unused vertices dropped, normals added."""

from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import trimesh
from jaxtyping import Float, Int, UInt8

from posecore.errors import MeshError
from posecore.mesh_files.atlas import needs_atlas, with_atlas
from posecore.mesh_files.part import GREY, MeshPart, refuse_bad_indices, two_looks
from posecore.mesh_files.polygons import fingerprints, repeated


@dataclass(frozen=True, kw_only=True, eq=False)
class Surface:
    """One surface in the file's unit; see `posecore.mesh.Mesh` for the fields."""

    vertices: Float[np.ndarray, "v 3"]
    faces: Int[np.ndarray, "f 3"]
    normals: Float[np.ndarray, "v 3"]
    rgb: UInt8[np.ndarray, "v 3"] | None
    uv: Float[np.ndarray, "v 2"] | None
    texture_rgb: UInt8[np.ndarray, "h w 3"] | None
    mip_levels: int | None
    has_normals: bool


def joined(file: Path, parts: list[MeshPart]) -> Surface:
    """One surface of all parts.

    Raises:
        MeshError: No faces, no area, or vertices that are not finite.
    """
    parts = [part for part in parts if len(part.faces)]
    if not parts:
        raise MeshError(f"{file}: no faces; a triangle mesh is needed, not a point cloud")
    _refuse_bad_vertices(file, parts)
    parts = [part if _has_normals(part) else replace(part, normals=None) for part in parts]
    parts = _without_duplicates(file, parts)
    if needs_atlas(parts):
        parts = with_atlas(file, parts)
    has_normals = any(part.normals is not None or part.is_flat for part in parts)
    parts = [_with_normals(part) for part in parts]
    starts = np.cumsum([0, *(len(part.vertices) for part in parts)])
    texture = next((part.texture for part in parts if part.texture is not None), None)
    vertices = np.concatenate([part.vertices for part in parts])
    faces = np.concatenate([part.faces + start for part, start in zip(parts, starts, strict=False)])
    normals = np.concatenate([part.normals for part in parts if part.normals is not None])
    rgb = _colours(parts, 255 if texture is not None else GREY)
    uv = None if texture is None else np.concatenate([part.uv for part in parts if part.uv is not None])
    used = np.zeros(len(vertices), bool)
    used[faces] = True
    if not used.all():
        renumbered = np.cumsum(used) - 1
        faces = renumbered[faces]
        vertices, normals = vertices[used], normals[used]
        rgb, uv = None if rgb is None else rgb[used], None if uv is None else uv[used]
    return Surface(
        vertices=vertices,
        faces=faces.astype(np.int32),
        normals=normals,
        rgb=rgb,
        uv=None if uv is None else uv.astype(np.float32),
        texture_rgb=None if texture is None else texture.rgb,
        mip_levels=None if texture is None else texture.mip_levels,
        has_normals=has_normals,
    )


def _refuse_bad_vertices(file: Path, parts: list[MeshPart]) -> None:
    start, has_area = 0, False
    for part in parts:
        finite = np.isfinite(part.vertices).all(axis=1)
        if not finite.all():
            bad = int(np.flatnonzero(~finite)[0])
            raise MeshError(
                f"{file}: vertex {start + bad} is {part.vertices[bad].tolist()}, expected finite numbers; "
                "repair the mesh"
            )
        refuse_bad_indices(file, part.faces, len(part.vertices))
        if part.uv is not None and not np.isfinite(part.uv).all():
            raise MeshError(f"{file}: a texture coordinate is not a finite number; export the mesh again")
        start += len(part.vertices)
        blocks = range(0, len(part.faces), 10000)  # the first holds an area, if it is a surface
        has_area = has_area or any(_has_area(part.vertices[part.faces[i : i + 10000]]) for i in blocks)
    if not has_area:
        raise MeshError(f"{file}: its faces have no area; export the surface, not points or lines")


def _has_area(corners: Float[np.ndarray, "f 3 3"]) -> bool:
    return bool(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]).any())


def _colours(parts: list[MeshPart], default: int) -> UInt8[np.ndarray, "v 3"] | None:
    if all(part.rgb is None for part in parts):
        return None
    blocks = [np.full((len(p.vertices), 3), default, np.uint8) if p.rgb is None else p.rgb for p in parts]
    return np.asarray(np.concatenate(blocks))


def _without_duplicates(file: Path, parts: list[MeshPart]) -> list[MeshPart]:
    """The parts without faces that lie exactly on an earlier one, whichever way they face.

    Cycles would draw such a pair black, and its normals would cancel out.

    Raises:
        MeshError: Faces on each other look different: which is seen would be chance.
    """
    numbers = [fingerprints(part.vertices)[part.faces].sum(axis=1, dtype=np.uint64) for part in parts]
    copies = repeated(np.concatenate(numbers))
    if not len(copies):
        return parts
    part_of = np.repeat(np.arange(len(parts)), [len(part.faces) for part in parts])
    starts = np.cumsum([0, *(len(part.faces) for part in parts)])
    for face, original in copies.tolist():
        a, b = parts[part_of[face]], parts[part_of[original]]
        if a.texture is not b.texture or not _same_colours(
            a, face - int(starts[part_of[face]]), b, original - int(starts[part_of[original]])
        ):
            raise MeshError(two_looks(file))
    kept = np.ones(starts[-1], bool)
    kept[copies[:, 0]] = False
    remaining = [
        MeshPart(**{**part.__dict__, "faces": part.faces[kept[starts[i] : starts[i + 1]]]})
        for i, part in enumerate(parts)
    ]
    return [part for part in remaining if len(part.faces)]


def _same_colours(a: MeshPart, face: int, b: MeshPart, original: int) -> bool:
    def mean(part: MeshPart, row: int) -> Float[np.ndarray, "3"]:
        return np.full(3, -1.0) if part.rgb is None else part.rgb[part.faces[row]].mean(axis=0)

    return bool(np.abs(mean(a, face) - mean(b, original)).max() < 2.0)


def _has_normals(part: MeshPart) -> bool:
    """Whether the file has normals that can be used; some exporters write zeros or NaN for none."""
    return part.normals is not None and bool(np.isfinite(part.normals).all()) and bool(part.normals.any())


def _with_normals(part: MeshPart) -> MeshPart:
    """The part with vertex normals: the file's, else of flat faces (glTF) or smooth ones."""
    if part.normals is not None:
        return part
    if part.is_flat:
        part = _flat(part)
    normals = trimesh.Trimesh(part.vertices, part.faces, process=False).vertex_normals
    return replace(part, normals=np.asarray(normals, np.float64))


def _flat(part: MeshPart) -> MeshPart:
    """The part with vertices of their own for each face."""
    corners = part.faces.reshape(-1)
    return part.picked(corners, np.arange(len(corners)).reshape(-1, 3))
