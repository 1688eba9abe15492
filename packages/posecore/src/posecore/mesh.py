"""Triangle meshes with vertex colours or a texture, in metres."""

import hashlib
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Literal

import cv2
import numpy as np
import trimesh
from jaxtyping import Float, Int, UInt8
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from posecore.diameter import diameter
from posecore.errors import MeshError
from posecore.files import write_atomic
from posecore.mesh_files import GREY, METRE_SUFFIXES, MIP_LEVELS, TIMES_COLOURS, mesh_bytes, read_surface
from posecore.mesh_files.creases import split_creases
from posecore.srgb import display_from_linear, linear_from_display, to_bytes

Units = Literal["mm", "cm", "m"]
METRES_PER_UNIT: dict[str, float] = {"mm": 1e-3, "cm": 1e-2, "m": 1.0}
DIAMETER_RANGE_M = (2e-3, 10.0)


@dataclass(frozen=True, kw_only=True, eq=False)
class DetailLevel:
    """A mesh with fewer faces, relative to the box centre and the diameter of the mesh that it stands for.

    Attributes:
        offsets: (w, 3) vertices, from the box centre, in diameters.
        sources: (w,) the vertex of `Mesh.drawn` that has each vertex's colour and normal.
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
    """A triangle mesh in object coordinates. Texture and vertex colours together count as a product in linear light.

    Attributes:
        vertices_m: (v, 3) metres.
        faces: (f, 3) vertex indices.
        normals: (v, 3) unit vertex normals.
        vertex_rgb: (v, 3) display (sRGB) colours, or None.
        uv: (v, 2) texture coordinates, origin at the texture's bottom left, or None.
        texture_rgb: (h, w, 3) display colours, row 0 at the top, or None.
        mip_levels: How often the texture may be halved before materials that share it mix; None: ever.
        has_normals: Whether the normals are the file's. Others are smooth, and hard edges come with `drawn`.
        path: Source file.
        sha256: Hash of that file's bytes; empty where the coordinates are not the file's.
        levels: Levels of detail, finer ones first, that the rasteriser draws where they suffice; none unless they were
            made (`posecore.detail.with_levels`). They serve copies that are shifted, scaled or of other colours too.
    """

    vertices_m: Float[np.ndarray, "v 3"]
    faces: Int[np.ndarray, "f 3"]
    normals: Float[np.ndarray, "v 3"]
    vertex_rgb: UInt8[np.ndarray, "v 3"] | None = None
    uv: Float[np.ndarray, "v 2"] | None = None
    texture_rgb: UInt8[np.ndarray, "h w 3"] | None = None
    mip_levels: int | None = None
    has_normals: bool = True
    path: str = ""
    sha256: str = ""
    levels: tuple[DetailLevel, ...] = ()

    @cached_property
    def diameter_m(self) -> float:
        """Largest distance between two vertices (BOP's definition), metres."""
        return diameter(self.vertices_m)

    @cached_property
    def center_m(self) -> Float[np.ndarray, "3"]:
        """The object's centre: middle of the axis-aligned bounding box over vertices that faces use, metres.

        Pivot of rotations, end of viewing rays and distances; the origin may lie anywhere.
        """
        used = np.zeros(len(self.vertices_m), bool)
        used[self.faces] = True
        points = self.vertices_m[used] if used.any() else self.vertices_m
        return np.asarray((points.min(axis=0) + points.max(axis=0)) / 2)

    def center_cam_m(self, T_cam_obj: Float[np.ndarray, "*b 4 4"]) -> Float[np.ndarray, "*b 3"]:
        """The centre in camera coordinates at each pose, metres."""
        return np.asarray(T_cam_obj[..., :3, :3] @ self.center_m + T_cam_obj[..., :3, 3])

    def with_origin_at(self, point_m: Float[np.ndarray, "3"]) -> "Mesh":
        """The mesh in the frame with the same axes and its origin at a point; `se3.with_origin_at` converts poses."""
        return self._copied(
            lambda mesh: replace(mesh, vertices_m=mesh.vertices_m - point_m, sha256=""), "diameter_m", "is_closed"
        )

    def scaled(self, factor: float) -> "Mesh":
        """The mesh about its box centre, scaled by a positive factor."""
        center_m = self.center_m
        _ = self.is_closed  # at any scale; computed here, where positions within a nanometre count as one
        return self._copied(
            lambda mesh: replace(mesh, vertices_m=(mesh.vertices_m - center_m) * factor, sha256=""), "is_closed"
        )

    def recoloured(self, rgb: tuple[int, int, int]) -> "Mesh":
        """The mesh in one display colour."""

        def change(mesh: Mesh) -> Mesh:
            vertex_rgb = np.tile(np.array(rgb, np.uint8), (len(mesh.vertices_m), 1))
            return replace(mesh, vertex_rgb=vertex_rgb, uv=None, texture_rgb=None)

        return self._copied(change, "diameter_m", "center_m", "is_closed")

    def with_levels(self, levels: tuple[DetailLevel, ...]) -> "Mesh":
        """The mesh with these levels of detail, which were made from its `drawn`."""
        return self._copied(lambda mesh: replace(mesh, levels=levels), "diameter_m", "center_m", "is_closed")

    def _copied(self, change: "Callable[[Mesh], Mesh]", *unchanged: str) -> "Mesh":
        """A changed copy whose `drawn` is changed alike.

        Splitting the copy's edges anew would number the vertices of `drawn` differently where rounding turns a needle
        into a face, and levels of detail index them.

        Args:
            change: What makes the copy, the same for the mesh and for `drawn`: the number of vertices stays.
            unchanged: Cached properties that the change leaves as they are.
        """
        copy = change(self)
        for name in unchanged:
            if name in self.__dict__:
                copy.__dict__[name] = self.__dict__[name]
        if not self.has_normals:
            copy.__dict__["drawn"] = copy if self.drawn is self else change(self.drawn)
        return copy

    def level(self, number: int) -> "Mesh":
        """The drawn mesh for 0, else one with the vertices and faces of `levels[number - 1]`."""
        drawn = self.drawn
        if number == 0:
            return drawn
        level = self.levels[number - 1]
        return Mesh(
            vertices_m=self.center_m + self.diameter_m * level.offsets.astype(np.float64),
            faces=level.faces,
            normals=drawn.normals[level.sources],
            vertex_rgb=drawn.colours[level.sources],
        )

    @cached_property
    def colours(self) -> UInt8[np.ndarray, "v 3"]:
        """Colours at the vertices: the vertex colours, the texture, or their product; mid grey without either."""
        if self.uv is not None and self.texture_rgb is not None:
            h, w = self.texture_rgb.shape[:2]
            column = np.floor((self.uv[:, 0] % 1.0) * w).astype(int).clip(0, w - 1)
            row = np.floor((1.0 - self.uv[:, 1] % 1.0) * h).astype(int).clip(0, h - 1)
            sampled = np.asarray(self.texture_rgb[row, column])
            if self.vertex_rgb is None:
                return sampled
            light = linear_from_display(sampled / 255.0) * linear_from_display(self.vertex_rgb / 255.0)
            return to_bytes(display_from_linear(light))
        if self.vertex_rgb is not None:
            return self.vertex_rgb
        return np.full((len(self.vertices_m), 3), GREY, np.uint8)

    @cached_property
    def drawn(self) -> "Mesh":
        """The mesh for a renderer: without normals of its own, it has hard edges where faces meet at a large angle.

        The vertices of the file stay as they are elsewhere, as errors are averages over them.
        """
        split = None if self.has_normals else split_creases(self.vertices_m, self.faces)
        if split is None:
            return self
        rows, faces, is_needle = split
        vertices_m = self.vertices_m[rows]
        surface = trimesh.Trimesh(vertices_m, faces[~is_needle], process=False)  # needles' normals are rounding
        return replace(
            self,
            vertices_m=vertices_m,
            faces=faces.astype(np.int32),
            normals=_unit(surface.vertex_normals),
            vertex_rgb=None if self.vertex_rgb is None else self.vertex_rgb[rows],
            uv=None if self.uv is None else self.uv[rows],
            has_normals=True,
        )

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
    """Read a PLY, OBJ, glTF, GLB, STL or OFF file with its materials, as `posecore.mesh_files` reads them.

    Several geometries in one file are merged, several textures become one, faces that lie on another are dropped, and
    so are vertices without a face. Where a file has no normals, edges of more than
    `posecore.mesh_files.creases.CREASE_DEG` are drawn hard; glTF without normals is flat, as it specifies.

    Args:
        path: The file.
        units: Unit of the file's coordinates; glTF is in metres by its specification, whatever is given here.
        allow_missing_textures: Whether a mesh whose texture or material file is missing or broken has its vertex
            colours or its material's plain colour instead.

    Raises:
        MeshError: Missing, unreadable, without faces or area, with NaN vertices, with a face that names a vertex that
            is not there, of an absurd size in these units, or with a look that cannot be drawn as the file gives it.
        TextureError: A file that a material names is missing.
    """
    file = Path(path)
    data = mesh_bytes(file)
    surface = read_surface(file, data, allow_missing_textures=allow_missing_textures)
    units = "m" if file.suffix.lower() in METRE_SUFFIXES else units
    mesh = Mesh(
        vertices_m=surface.vertices * METRES_PER_UNIT[units],
        faces=surface.faces,
        normals=_unit(surface.normals),
        vertex_rgb=surface.rgb,
        uv=surface.uv,
        texture_rgb=surface.texture_rgb,
        mip_levels=surface.mip_levels,
        has_normals=surface.has_normals,
        path=str(file),
        sha256=hashlib.sha256(data).hexdigest(),
    )
    _check_diameter(file, mesh.diameter_m, units)
    return mesh


def _unit(normals: Float[np.ndarray, "v 3"]) -> Float[np.ndarray, "v 3"]:
    """Normals of length 1, as files need not hold them (MeshLab writes sums of angles); zero stays zero."""
    length = np.linalg.norm(normals, axis=1, keepdims=True)
    return np.divide(normals, length, out=np.zeros_like(normals), where=length > 0).astype(np.float32)


def _check_diameter(file: Path, diameter_m: float, units: str) -> None:
    low, high = DIAMETER_RANGE_M
    if low <= diameter_m <= high:
        return
    fits = [u for u, s in METRES_PER_UNIT.items() if low <= diameter_m / METRES_PER_UNIT[units] * s <= high]
    meant = [f"--units {u} ({diameter_m / METRES_PER_UNIT[units] * METRES_PER_UNIT[u] * 1e3:.4g} mm)" for u in fits]
    if file.suffix.lower() in METRE_SUFFIXES:
        meant = []  # glTF has a unit
    hint = f"; did you mean {' or '.join(meant)}?" if meant else "; check the mesh's scale"
    raise MeshError(
        f"{file}: the diameter is {diameter_m * 1e3:.6g} mm when read in {units}, "
        f"expected {low * 1e3:g} mm to {high:g} m{hint}"
    )


def save_ply(mesh: Mesh, path: str | Path, *, units: Units = "mm") -> None:
    """Write a binary PLY with vertex colours, and with normals if the mesh has its own.

    A texture goes as a PNG of the same name beside it, named in the PLY as BOP's models do (`comment TextureFile`,
    texture_u, texture_v); the vertex colours are then the texture sampled at the vertices, for readers that take no
    textures. A mesh with a texture and vertex colours keeps these, and a comment that they are a factor; limited mip
    levels have a comment too.
    """
    columns = [("x", "<f4"), ("y", "<f4"), ("z", "<f4")]
    if mesh.has_normals:
        columns += [("nx", "<f4"), ("ny", "<f4"), ("nz", "<f4")]
    textured = mesh.uv is not None and mesh.texture_rgb is not None
    if textured:
        columns += [("texture_u", "<f4"), ("texture_v", "<f4")]
    columns += [("red", "u1"), ("green", "u1"), ("blue", "u1")]
    vertices = np.empty(len(mesh.vertices_m), columns)
    for axis, name in enumerate("xyz"):
        vertices[name] = mesh.vertices_m[:, axis] / METRES_PER_UNIT[units]
        if mesh.has_normals:
            vertices["n" + name] = mesh.normals[:, axis]
    colours = mesh.colours if mesh.vertex_rgb is None else mesh.vertex_rgb
    for channel, name in enumerate(("red", "green", "blue")):
        vertices[name] = colours[:, channel]
    comment = ""
    if mesh.uv is not None and mesh.texture_rgb is not None:
        vertices["texture_u"], vertices["texture_v"] = mesh.uv[:, 0], mesh.uv[:, 1]
        texture = Path(path).with_suffix(".png")
        comment = f"comment TextureFile {texture.name}\n" + ("" if mesh.vertex_rgb is None else f"{TIMES_COLOURS}\n")
        comment += "" if mesh.mip_levels is None else f"{MIP_LEVELS} {mesh.mip_levels}\n"
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
