"""OFF files (Geomview): OFF, COFF, NOFF, STOFF and their combinations, as text."""

import re
from pathlib import Path

import numpy as np
from jaxtyping import Float, UInt8

from posecore.errors import MeshError
from posecore.mesh_files.part import MeshPart, decoded, refuse_bad_indices
from posecore.mesh_files.polygons import triangles_of
from posecore.srgb import to_bytes


def read_off(file: Path, data: bytes) -> list[MeshPart]:
    """The part of an OFF file, with the colours of its vertices, else of its faces.

    Raises:
        MeshError: The file is cut off, binary, of four dimensions, or a row is not as the header gives it.
    """
    lines = [line.split("#", 1)[0].split() for line in decoded(data).split("\n")]
    rows = [words for words in lines if words]
    head = re.match(r"(ST)?(C)?(N)?(4)?(n)?OFF", rows[0][0]) if rows else None
    if head is None or head[4] or head[5] or (len(rows[0]) > 1 and rows[0][1].upper() == "BINARY"):
        raise MeshError(f"{file}: cannot be read as a mesh (starts with '{rows[0][0][:20] if rows else ''}'); "
                        "expected a text OFF file of three dimensions")  # fmt: skip
    first = [rows[0][0][head.end() :], *rows[0][1:]]
    counts = [word for word in first if word] or (rows[1] if len(rows) > 1 else [])
    body = rows[1:] if any(first) else rows[2:]
    if len(counts) < 2 or not all(word.isdigit() for word in counts[:2]):
        raise MeshError(f"{file}: cannot be read as a mesh (no counts of vertices and faces); export it again")
    n_vertices, n_faces = int(counts[0]), int(counts[1])
    if len(body) < n_vertices + n_faces:
        raise MeshError(
            f"{file}: is cut off, it has {len(body)} of {n_vertices + n_faces} rows of vertices and faces; copy it"
        )
    try:
        vertices, normals, rgb = _vertices(body[:n_vertices], has_normals=bool(head[3]))
        polygons, face_rgb = _polygons(file, body[n_vertices : n_vertices + n_faces], n_vertices)
    except ValueError as error:
        raise MeshError(f"{file}: a row is cut off or is not of numbers ({error}); export it again") from error
    if not polygons:
        raise MeshError(f"{file}: {n_vertices} vertices and no faces; a triangle mesh is needed, not a point cloud")
    faces, polygon = triangles_of(vertices, polygons)
    if rgb is None and face_rgb is not None:
        corners = faces.reshape(-1)
        return [
            MeshPart(
                vertices=vertices[corners],
                faces=np.arange(len(corners)).reshape(-1, 3),
                normals=None if normals is None else normals[corners],
                rgb=np.repeat(face_rgb[polygon], 3, axis=0),
            )
        ]
    return [MeshPart(vertices=vertices, faces=faces, normals=normals, rgb=rgb)]


def _vertices(
    rows: list[list[str]], *, has_normals: bool
) -> tuple[Float[np.ndarray, "v 3"], Float[np.ndarray, "v 3"] | None, UInt8[np.ndarray, "v 3"] | None]:
    fewest = 6 if has_normals else 3
    if any(len(row) < fewest for row in rows):
        raise ValueError(f"a vertex has fewer than {fewest} numbers")
    vertices = np.array([row[:3] for row in rows], np.float64).reshape(-1, 3)
    normals = np.array([row[3:6] for row in rows], np.float64) if has_normals else None
    colours = _colours([row[fewest:] for row in rows])
    return vertices, normals, colours


def _polygons(
    file: Path, rows: list[list[str]], n_vertices: int
) -> tuple[list[np.ndarray], UInt8[np.ndarray, "p 3"] | None]:
    polygons, colours = [], []
    for number, row in enumerate(rows):
        size = int(row[0])
        if len(row) < size + 1:
            raise MeshError(f"{file}: is cut off, face {number} has {len(row) - 1} of {size} vertices; copy it again")
        polygon = np.array(row[1 : size + 1], np.int64)
        refuse_bad_indices(file, polygon[None], n_vertices, number)
        polygons.append(polygon)
        colours.append(row[size + 1 :])
    return polygons, _colours(colours)


def _colours(rows: list[list[str]]) -> UInt8[np.ndarray, "n 3"] | None:
    """Colours of three or four numbers in every row: whole ones to 255, or fractions."""
    if not rows or not all(len(row) in (3, 4) for row in rows):
        return None
    values = np.array([row[:3] for row in rows], np.float64)
    is_whole = all(word.isdigit() for row in rows for word in row[:3])
    return to_bytes(values / 255.0 if is_whole else values)
