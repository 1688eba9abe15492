"""Triangle meshes with vertex colours or a texture, in metres."""

import hashlib
import json
import logging
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Any, Literal
from urllib.parse import unquote

import cv2
import numpy as np
import trimesh
from jaxtyping import Float, Int, UInt8
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from posecore.diameter import diameter
from posecore.errors import MeshError, TextureError
from posecore.files import write_atomic
from posecore.ply import refuse_broken_ply

logging.getLogger("trimesh").setLevel(logging.CRITICAL)  # it logs tracebacks of what is refused here in one line

Units = Literal["mm", "cm", "m"]
METRES_PER_UNIT: dict[str, float] = {"mm": 1e-3, "cm": 1e-2, "m": 1.0}
DIAMETER_RANGE_M = (2e-3, 10.0)


@dataclass(frozen=True, kw_only=True, eq=False)
class DetailLevel:
    """A mesh with fewer faces, relative to the box centre and the diameter of the mesh that it stands for.

    Attributes:
        offsets: (w, 3) vertices, from the box centre, in diameters.
        sources: (w,) the mesh's vertex that has each vertex's colour and normal.
        faces: (f, 3) vertex indices.
        rms_error: Distance between the two surfaces, root mean square over both, in diameters.
        max_error: The largest distance, in diameters.
        spacing: Length of an edge, root mean square, in diameters: colours are as fine as that.
        is_closed: See `Mesh.is_closed`.
    """

    offsets: Float[np.ndarray, "w 3"]
    sources: Int[np.ndarray, " w"]
    faces: Int[np.ndarray, "f 3"]
    rms_error: float
    max_error: float
    spacing: float
    is_closed: bool


@dataclass(frozen=True, kw_only=True, eq=False)
class Mesh:
    """A triangle mesh in object coordinates.

    Attributes:
        vertices_m: (v, 3) metres.
        faces: (f, 3) vertex indices.
        normals: (v, 3) unit vertex normals.
        vertex_rgb: (v, 3) display (sRGB) colours, or None.
        uv: (v, 2) texture coordinates, origin at the texture's bottom left, or None.
        texture_rgb: (h, w, 3) display colours, row 0 at the top, or None.
        path: Source file.
        sha256: Hash of that file's bytes.
        levels: Levels of detail, finer ones first, that the rasteriser draws where they suffice; none unless they were
            made (`posecore.detail.with_levels`). They serve copies that are shifted, scaled or of other colours too.
    """

    vertices_m: Float[np.ndarray, "v 3"]
    faces: Int[np.ndarray, "f 3"]
    normals: Float[np.ndarray, "v 3"]
    vertex_rgb: UInt8[np.ndarray, "v 3"] | None = None
    uv: Float[np.ndarray, "v 2"] | None = None
    texture_rgb: UInt8[np.ndarray, "h w 3"] | None = None
    path: str = ""
    sha256: str = ""
    levels: tuple[DetailLevel, ...] = ()

    @cached_property
    def diameter_m(self) -> float:
        """Largest distance between two vertices (BOP's definition), metres."""
        return diameter(self.vertices_m)

    @cached_property
    def center_m(self) -> Float[np.ndarray, "3"]:
        """Centre of the axis-aligned bounding box in object coordinates, metres."""
        return np.asarray((self.vertices_m.min(axis=0) + self.vertices_m.max(axis=0)) / 2)

    def center_cam_m(self, T_cam_obj: Float[np.ndarray, "*b 4 4"]) -> Float[np.ndarray, "*b 3"]:
        """Centre of the bounding box in camera coordinates at each pose, metres."""
        return np.asarray(T_cam_obj[..., :3, :3] @ self.center_m + T_cam_obj[..., :3, 3])

    def level(self, number: int) -> "Mesh":
        """The mesh itself for 0, else with the vertices and faces of `levels[number - 1]`."""
        if number == 0:
            return self
        level = self.levels[number - 1]
        return Mesh(
            vertices_m=self.center_m + self.diameter_m * level.offsets.astype(np.float64),
            faces=level.faces,
            normals=self.normals[level.sources],
            vertex_rgb=self.colours[level.sources],
        )

    def scaled(self, factor: float) -> "Mesh":
        """The mesh about its box centre, scaled. It keeps its hash."""
        copy = replace(self, vertices_m=(self.vertices_m - self.center_m) * factor)
        copy.__dict__["is_closed"] = self.is_closed
        return copy

    def recoloured(self, rgb: tuple[int, int, int]) -> "Mesh":
        """The mesh in one display colour."""
        vertex_rgb = np.tile(np.array(rgb, np.uint8), (len(self.vertices_m), 1))
        copy = replace(self, vertex_rgb=vertex_rgb, uv=None, texture_rgb=None)
        for name in ("diameter_m", "center_m", "is_closed"):
            if name in self.__dict__:
                copy.__dict__[name] = self.__dict__[name]
        return copy

    @cached_property
    def colours(self) -> UInt8[np.ndarray, "v 3"]:
        """Vertex colours; sampled from the texture where there is one, mid grey without either."""
        if self.vertex_rgb is not None:
            return self.vertex_rgb
        if self.uv is not None and self.texture_rgb is not None:
            h, w = self.texture_rgb.shape[:2]
            column = np.floor((self.uv[:, 0] % 1.0) * w).astype(int).clip(0, w - 1)
            row = np.floor((1.0 - self.uv[:, 1] % 1.0) * h).astype(int).clip(0, h - 1)
            return np.asarray(self.texture_rgb[row, column])
        return np.full((len(self.vertices_m), 3), 160, np.uint8)

    @cached_property
    def is_closed(self) -> bool:
        """Whether the surface is closed and oriented outwards, so that no back face is visible from outside.

        Vertices at the same position count as one. Every directed edge must have its opposite, and every connected
        piece must enclose a positive volume.
        """
        _, first, merged = np.unique(self.vertices_m.round(9), axis=0, return_index=True, return_inverse=True)
        return encloses_volume(self.vertices_m[first], merged.reshape(-1)[self.faces])


def encloses_volume(points_m: Float[np.ndarray, "v 3"], faces: Int[np.ndarray, "f 3"]) -> bool:
    """Whether every directed edge has its opposite, and every connected piece encloses a positive volume.

    Args:
        points_m: (v, 3) metres, all different.
        faces: (f, 3) indices; faces with a repeated one do not count.
    """
    faces = faces[(faces != np.roll(faces, 1, axis=1)).all(axis=1)]
    corners_m = points_m[faces]
    edges = np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]]).astype(np.int64)
    n = len(points_m)
    if not np.array_equal(np.sort(edges @ [n, 1]), np.sort(edges @ [1, n])):
        return False
    links = coo_array((np.ones(len(edges)), (edges[:, 0], edges[:, 1])), shape=(n, n))
    _, piece = connected_components(links, directed=False)
    volumes = np.einsum("fi,fi->f", corners_m[:, 0], np.cross(corners_m[:, 1], corners_m[:, 2])) / 6.0
    of_piece = np.bincount(piece[faces[:, 0]], weights=volumes)
    return bool((of_piece[np.unique(piece[faces[:, 0]])] > 0).all())


def mesh_digest(mesh: Mesh) -> str:
    """Hash of geometry and appearance: vertices (float32 millimetres), faces, colours, texture.

    Unlike the file's hash it stays the same when the mesh is written anew, as BOP datasets do.
    """
    digest = hashlib.sha256((1e3 * mesh.vertices_m).astype("<f4").tobytes())
    digest.update(mesh.faces.astype("<i4").tobytes())
    for colours in (mesh.vertex_rgb, mesh.texture_rgb):
        digest.update(b"-" if colours is None else np.ascontiguousarray(colours).tobytes())
    return digest.hexdigest()


def load_mesh(path: str | Path, *, units: Units = "mm", allow_missing_textures: bool = False) -> Mesh:
    """Read a PLY, OBJ, glTF, GLB, STL or OFF file.

    Args:
        path: The file. Several geometries in one file are merged.
        units: Unit of the file's coordinates. glTF is in metres by its specification: give `m`.
        allow_missing_textures: Whether a mesh whose texture or material file is missing or broken has its vertex
            colours or its material's plain colour instead.

    Raises:
        MeshError: Missing, unreadable, without faces, with NaN vertices, with a face that names a vertex that is not
            there, or of an absurd size in these units.
    """
    file = Path(path)
    if not file.is_file():
        raise MeshError(f"{file}: no such mesh file; give the path of a .ply, .obj, .gltf, .glb or .stl file")
    data = file.read_bytes()
    if not data:
        raise MeshError(f"{file}: the file is empty (0 bytes), expected a mesh; export it again")
    if file.suffix.lower() == ".ply":
        refuse_broken_ply(file, data)
    geometry = _read(file)
    vertices, faces = np.asarray(geometry.vertices, np.float64), np.asarray(geometry.faces, np.int32)
    if not np.isfinite(vertices).all():
        bad = int(np.flatnonzero(~np.isfinite(vertices).all(axis=1))[0])
        raise MeshError(f"{file}: vertex {bad} is {vertices[bad].tolist()}, expected finite numbers; repair the mesh")
    if faces.min() < 0 or faces.max() >= len(vertices):
        bad = int(np.flatnonzero(((faces < 0) | (faces >= len(vertices))).any(axis=1))[0])
        raise MeshError(
            f"{file}: face {bad} names the vertices {faces[bad].tolist()}, expected 0 to {len(vertices) - 1}; "
            "repair the mesh"
        )
    if not allow_missing_textures:
        _refuse_missing_texture(file)
    vertex_rgb, uv, texture_rgb = _appearance(file, geometry, allow_missing_textures)
    mesh = Mesh(
        vertices_m=vertices * METRES_PER_UNIT[units],
        faces=faces,
        normals=_unit(np.asarray(geometry.vertex_normals, np.float64)),
        vertex_rgb=vertex_rgb,
        uv=uv,
        texture_rgb=texture_rgb,
        path=str(file),
        sha256=hashlib.sha256(data).hexdigest(),
    )
    _check_diameter(file, mesh.diameter_m, units)
    return mesh


def _unit(normals: Float[np.ndarray, "v 3"]) -> Float[np.ndarray, "v 3"]:
    """Normals of length 1, as files need not hold them (MeshLab writes sums of angles); zero stays zero."""
    length = np.linalg.norm(normals, axis=1, keepdims=True)
    return np.divide(normals, length, out=np.zeros_like(normals), where=length > 0).astype(np.float32)


def _read(file: Path) -> trimesh.Trimesh:
    try:
        # An OBJ's vertex on a texture seam becomes one vertex for each of its texture coordinates. With maintain_order
        # it would keep a single coordinate, and the texture would smear along the seam.
        loaded = trimesh.load(file, process=False)
    except Exception as error:  # readers raise whatever they stumble over
        reason = f"{type(error).__name__}: {str(error) or 'no reason given'}".splitlines()[0][:200]
        raise MeshError(
            f"{file}: cannot be read as a mesh ({reason}); expected a valid .ply, .obj, .gltf, .glb or .stl file"
        ) from error
    if isinstance(loaded, trimesh.Scene):
        meshes = [g for g in loaded.dump() if isinstance(g, trimesh.Trimesh)]
        if not meshes:
            raise MeshError(f"{file}: holds no triangle mesh; export the surface, not points or curves")
        loaded = meshes[0] if len(meshes) == 1 else trimesh.util.concatenate(meshes)
    if not isinstance(loaded, trimesh.Trimesh) or len(loaded.faces) == 0:
        count = len(getattr(loaded, "vertices", ()))
        raise MeshError(f"{file}: {count} vertices and no faces; a triangle mesh is needed, not a point cloud")
    return loaded


def _check_diameter(file: Path, diameter_m: float, units: str) -> None:
    low, high = DIAMETER_RANGE_M
    if low <= diameter_m <= high:
        return
    fits = [u for u, s in METRES_PER_UNIT.items() if low <= diameter_m / METRES_PER_UNIT[units] * s <= high]
    meant = [f"--units {u} ({diameter_m / METRES_PER_UNIT[units] * METRES_PER_UNIT[u] * 1e3:.4g} mm)" for u in fits]
    hint = f"; did you mean {' or '.join(meant)}?" if meant else "; check the mesh's scale"
    raise MeshError(
        f"{file}: the diameter is {diameter_m * 1e3:.6g} mm when read in {units}, "
        f"expected {low * 1e3:g} mm to {high:g} m{hint}"
    )


def _appearance(
    file: Path, geometry: trimesh.Trimesh, allow_missing_textures: bool
) -> tuple[UInt8[np.ndarray, "v 3"] | None, Float[np.ndarray, "v 2"] | None, UInt8[np.ndarray, "h w 3"] | None]:
    visual: Any = geometry.visual
    material = visual.material if isinstance(visual, trimesh.visual.TextureVisuals) else None
    image = getattr(material, "baseColorTexture", None) or getattr(material, "image", None)
    if image is not None and visual.uv is not None:
        try:
            return None, np.asarray(visual.uv, np.float32), np.asarray(image.convert("RGB"), np.uint8)
        except OSError as error:
            if not allow_missing_textures:
                raise MeshError(f"{file}: its texture cannot be decoded ({error}); export it again") from error
    if material is not None:
        plain = np.asarray(material.main_color, np.uint8)[:3]
        return np.tile(plain, (len(geometry.vertices), 1)), None, None
    if visual.kind is None:
        return None, None, None
    return np.ascontiguousarray(np.asarray(visual.vertex_colors, np.uint8)[:, :3]), None, None


def _refuse_missing_texture(file: Path) -> None:
    """Refuse a material whose image is missing or no image: it would silently become grey."""
    try:
        textures = _textures(file)
        missing = [texture for texture in textures if not texture.is_file()]
    except MeshError:
        raise
    except (OSError, ValueError, TypeError, LookupError, AttributeError) as error:  # a name that no file can have
        raise MeshError(f"{file}: it names its texture in a way that cannot be read; export it again") from error
    if missing:
        raise TextureError(f"{file}: its texture {missing[0]} is missing; put it beside the mesh")
    for texture in textures:
        if not cv2.haveImageReader(str(texture)):
            raise MeshError(f"{file}: its texture {texture} is not an image; export it again")


def _textures(file: Path) -> list[Path]:
    """Image files that a mesh file names."""
    if file.suffix.lower() == ".gltf":
        images = json.loads(file.read_text(encoding="utf-8")).get("images", ())
        links = [image["uri"] for image in images if not image.get("uri", "data:").startswith("data:")]
        return [file.parent / unquote(link) for link in links]
    if file.suffix.lower() == ".ply":
        header = file.read_bytes().split(b"end_header", 1)[0].decode("ascii", "replace").splitlines()
        return [file.parent / line.split(maxsplit=2)[2].strip() for line in header if _names_texture(line)]
    if file.suffix.lower() != ".obj":
        return []
    textures = []
    for line in file.read_text(errors="replace").splitlines():
        if not line.startswith("mtllib "):
            continue
        material = file.parent / line.split(maxsplit=1)[1].strip()
        if not material.is_file():
            raise TextureError(f"{file}: its material file {material} is missing; put it beside the mesh")
        entries = material.read_text(errors="replace").splitlines()
        textures += [file.parent / e.split(maxsplit=1)[1].strip() for e in entries if e.strip().startswith("map_Kd ")]
    return textures


def _names_texture(line: str) -> bool:
    """Whether a line of a PLY's header names an image."""
    return line.startswith("comment TextureFile ")


def save_ply(mesh: Mesh, path: str | Path, *, units: Units = "mm") -> None:
    """Write a binary PLY with vertex normals and colours.

    A texture goes as a PNG of the same name beside it, named in the PLY as BOP's models do (`comment TextureFile`,
    texture_u, texture_v); the vertex colours are then the texture sampled at the vertices, for readers that take no
    textures.
    """
    columns = [("x", "<f4"), ("y", "<f4"), ("z", "<f4"), ("nx", "<f4"), ("ny", "<f4"), ("nz", "<f4")]
    textured = mesh.uv is not None and mesh.texture_rgb is not None
    if textured:
        columns += [("texture_u", "<f4"), ("texture_v", "<f4")]
    columns += [("red", "u1"), ("green", "u1"), ("blue", "u1")]
    vertices = np.empty(len(mesh.vertices_m), columns)
    for axis, name in enumerate("xyz"):
        vertices[name] = mesh.vertices_m[:, axis] / METRES_PER_UNIT[units]
        vertices["n" + name] = mesh.normals[:, axis]
    for channel, name in enumerate(("red", "green", "blue")):
        vertices[name] = mesh.colours[:, channel]
    comment = ""
    if mesh.uv is not None and mesh.texture_rgb is not None:
        vertices["texture_u"], vertices["texture_v"] = mesh.uv[:, 0], mesh.uv[:, 1]
        texture = Path(path).with_suffix(".png")
        comment = f"comment TextureFile {texture.name}\n"
        _, data = cv2.imencode(".png", mesh.texture_rgb[..., ::-1])
        write_atomic(texture, data.tobytes())  # before the PLY, which names it
    faces = np.empty(len(mesh.faces), [("count", "u1"), ("index", "<i4", (3,))])
    faces["count"], faces["index"] = 3, mesh.faces
    names = {"<f4": "float", "u1": "uchar"}
    properties = "".join(f"property {names[kind]} {name}\n" for name, kind in columns)
    header = (
        f"ply\nformat binary_little_endian 1.0\n{comment}element vertex {len(vertices)}\n{properties}"
        f"element face {len(faces)}\nproperty list uchar int vertex_indices\nend_header\n"
    )
    write_atomic(path, header.encode() + vertices.tobytes() + faces.tobytes())
