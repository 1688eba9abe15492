"""Reading of mesh files: PLY, OBJ, glTF, GLB, STL and OFF, each with its materials, as one surface with one look."""

import logging
from collections.abc import Callable
from pathlib import Path

from posecore.errors import MeshError
from posecore.files import read_regular
from posecore.mesh_files.gltf import read_gltf
from posecore.mesh_files.images import refuse_pointer
from posecore.mesh_files.obj import read_obj
from posecore.mesh_files.off import read_off
from posecore.mesh_files.part import GREY, MeshPart
from posecore.mesh_files.ply import MIP_LEVELS, TIMES_COLOURS, read_ply
from posecore.mesh_files.stl import read_stl
from posecore.mesh_files.surface import Surface, joined

__all__ = ["GREY", "METRE_SUFFIXES", "MIP_LEVELS", "SUFFIXES", "TIMES_COLOURS", "Surface", "mesh_bytes", "read_surface"]

logging.getLogger("trimesh").setLevel(logging.CRITICAL)  # it logs tracebacks of what is refused here in one line

SUFFIXES = (".ply", ".obj", ".gltf", ".glb", ".stl", ".off")
METRE_SUFFIXES = (".gltf", ".glb")
"""Formats that are in metres by their specification."""


def mesh_bytes(file: Path) -> bytes:
    """Bytes of a mesh file.

    Raises:
        MeshError: Missing, of a suffix that is not read, not a regular file, empty or a Git LFS pointer.
    """
    kinds = f"{', '.join(SUFFIXES[:-1])} or {SUFFIXES[-1]}"
    if not file.exists():
        raise MeshError(f"{file}: no such mesh file; give the path of a {kinds} file")
    if file.suffix.lower() not in SUFFIXES and not file.is_dir():
        kind = f"a {file.suffix} file" if file.suffix else "a file without a suffix"
        raise MeshError(f"{file}: {kind} cannot be read as a mesh; convert it to {kinds}")
    try:
        data = read_regular(file)
    except OSError as error:
        raise MeshError(f"{file}: {error.strerror or error}; give the path of a {kinds} file") from error
    if not data:
        raise MeshError(f"{file}: the file is empty (0 bytes), expected a mesh; export it again")
    refuse_pointer(file, "it", data)
    return data


def read_surface(file: Path, data: bytes, *, allow_missing_textures: bool = False) -> Surface:
    """The surface that a mesh file describes, in its unit.

    Args:
        file: The file; materials and textures lie beside it.
        data: Its bytes.
        allow_missing_textures: Whether faces whose texture or material is missing or broken get their vertex colours or
            their material's plain colour.

    Raises:
        MeshError: It cannot be read, or not drawn as it is described.
        TextureError: A file that its materials name is missing.
    """
    try:
        return joined(file, _parts(file, data, allow_missing_textures))
    except MeshError:
        raise
    except Exception as error:  # readers raise whatever they stumble over
        reason = f"{type(error).__name__}: {str(error) or 'no reason given'}".splitlines()[0][:200]
        raise MeshError(
            f"{file}: cannot be read as a mesh ({reason}); expected a valid {file.suffix.lower()} file"
        ) from error


def _parts(file: Path, data: bytes, allow_missing_textures: bool) -> list[MeshPart]:
    suffix = file.suffix.lower()
    if suffix == ".stl":
        return read_stl(file, data)
    if suffix == ".off":
        return read_off(file, data)
    readers: dict[str, Callable[..., list[MeshPart]]] = {
        ".ply": read_ply,
        ".obj": read_obj,
        ".gltf": read_gltf,
        ".glb": read_gltf,
    }
    return readers[suffix](file, data, allow_missing_textures=allow_missing_textures)
