"""STL files: trimesh reads them; files that are cut off and colours of the faces are seen to here."""

import io
import re
from pathlib import Path

import numpy as np
import trimesh
from jaxtyping import Int, UInt8
from trimesh.exchange.stl import load_stl

from posecore.errors import MeshError
from posecore.mesh_files.part import GREY, MeshPart
from posecore.srgb import to_bytes

_HEADER, _FACET = 84, 50


def read_stl(file: Path, data: bytes) -> list[MeshPart]:
    """The part of an STL file, text or binary.

    Colours are read as VisCAM and SolidView (bit 15 of the attribute set, 5 bits each of red, green and blue) or
    Materialise Magics (`COLOR=` in the header) write them.

    Raises:
        MeshError: The file is cut off.
    """
    _refuse_cut(file, data)
    loaded = load_stl(io.BytesIO(data))
    parts = []
    for entry in loaded["geometry"].values() if "geometry" in loaded else [loaded]:
        mesh = trimesh.Trimesh(**entry, process=False)
        attributes = entry.get("face_attributes", {}).get("stl")
        colours = (
            None if attributes is None else _colours(data[:80], np.asarray(attributes).reshape(-1).astype(np.int64))
        )
        parts.append(
            MeshPart(
                vertices=np.asarray(mesh.vertices, np.float64),
                faces=np.asarray(mesh.faces, np.int64),
                normals=np.asarray(mesh.vertex_normals, np.float64),
                rgb=None if colours is None else np.repeat(colours, 3, axis=0),
            )
        )
    return parts


def _refuse_cut(file: Path, data: bytes) -> None:
    stated = int.from_bytes(data[80:84], "little") if len(data) >= _HEADER else 0
    if len(data) >= _HEADER and len(data) == _HEADER + stated * _FACET:
        return
    text = data.decode("latin-1").lower()
    is_text = text.lstrip().startswith("solid") and ("facet" in text or "endsolid" in text) and "\0" not in text
    if not is_text:
        whole = max(len(data) - _HEADER, 0) // _FACET
        if len(data) < _HEADER or whole < stated:
            raise MeshError(f"{file}: is cut off, it has {whole} of {stated} triangles; copy or export it again")
        raise MeshError(f"{file}: has {len(data)} bytes, its header gives {_HEADER + stated * _FACET}; export it again")
    if not re.search(r"^\s*endsolid\b", text, re.MULTILINE) or not text.rstrip().rsplit("\n", 1)[-1].strip().startswith(
        "endsolid"
    ):
        raise MeshError(f"{file}: is cut off, it does not end with 'endsolid'; copy or export it again")
    facets, corners = text.count("facet normal"), len(re.findall(r"^\s*vertex\s", text, re.MULTILINE))
    if corners != 3 * facets:
        raise MeshError(f"{file}: has {corners} vertices in {facets} facets, expected three each; export it again")


def _colours(header: bytes, attributes: Int[np.ndarray, " f"]) -> UInt8[np.ndarray, "f 3"] | None:
    """Display colours of the facets; None where no facet has one."""
    bits = attributes
    marked = (bits & 0x8000) != 0
    low, middle, high = (to_bytes(((bits >> shift) & 31) / 31.0) for shift in (0, 5, 10))
    start = header.find(b"COLOR=")
    if 0 <= start <= 70:  # Materialise: a colour of the whole, which a set bit keeps
        whole = np.frombuffer(header[start + 6 : start + 9], np.uint8)
        return np.where(marked[:, None], whole, np.stack([low, middle, high], axis=1)).astype(np.uint8)
    if not marked.any():
        return None
    return np.where(marked[:, None], np.stack([high, middle, low], axis=1), np.uint8(GREY)).astype(np.uint8)
