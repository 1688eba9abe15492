"""Conversion of posecore meshes to Blender's mesh and image datablocks."""

import bpy
import numpy as np
from jaxtyping import Float
from posecore.errors import MeshError
from posecore.mesh import Mesh
from posecore.srgb import linear_from_display

COLOUR_ATTRIBUTE = "colour"
UV_LAYER = "uv"


def make_mesh(key: int, mesh: Mesh) -> bpy.types.Mesh:
    """Make Blender's mesh: geometry in metres, smooth normals, linear vertex colours and texture coordinates.

    Args:
        key: Names the datablock.
        mesh: Triangles.

    Raises:
        MeshError: No faces, or a face names a vertex that is not there.
    """
    check_mesh(mesh)
    mesh = mesh.drawn
    vertices, faces = np.asarray(mesh.vertices_m, np.float32), np.ascontiguousarray(mesh.faces, np.int32)
    block = bpy.data.meshes.new(f"mesh_{key}")
    block.vertices.add(len(vertices))
    block.vertices.foreach_set("co", vertices.ravel())
    block.loops.add(faces.size)
    block.loops.foreach_set("vertex_index", faces.ravel())
    block.polygons.add(len(faces))
    block.polygons.foreach_set("loop_start", np.arange(0, faces.size, 3, dtype=np.int32))
    block.update(calc_edges=True)
    block.shade_smooth()
    block.normals_split_custom_set_from_vertices(_outward_normals(mesh))
    colours = block.color_attributes.new(COLOUR_ATTRIBUTE, "FLOAT_COLOR", "POINT")
    rgba = np.ones((len(vertices), 4), np.float32)
    # Beside a texture they are a factor on it.
    rgba[:, :3] = linear_from_display((mesh.colours if mesh.vertex_rgb is None else mesh.vertex_rgb) / 255.0)
    colours.data.foreach_set("color", rgba.ravel())
    if mesh.uv is not None:
        layer = block.uv_layers.new(name=UV_LAYER)
        layer.uv.foreach_set("vector", np.asarray(mesh.uv, np.float32)[faces.ravel()].ravel())
    return block


def make_texture(key: int, mesh: Mesh) -> bpy.types.Image | None:
    """Make Blender's image of the mesh's texture, or nothing where it has none.

    The texture's row 0 is the top; Blender's own rows start at the bottom.

    Args:
        key: Names the datablock.
        mesh: A texture without texture coordinates counts as none.
    """
    if mesh.uv is None or mesh.texture_rgb is None:
        return None
    height, width = mesh.texture_rgb.shape[:2]
    image = bpy.data.images.new(f"texture_{key}", width, height, alpha=False)
    image.colorspace_settings.name = "sRGB"
    rgba = np.ones((height, width, 4), np.float32)
    rgba[..., :3] = mesh.texture_rgb[::-1] / 255.0
    image.pixels.foreach_set(rgba.ravel())
    image.pack()  # an unpacked generated image is drawn anew, black, when Blender frees its buffer
    return image


def check_mesh(mesh: Mesh) -> None:
    """Refuse a mesh without faces, or whose faces name a vertex that is not there, or is not finite.

    Raises:
        MeshError: There is such a fault.
    """
    name, vertices, faces = mesh.path or "mesh", mesh.vertices_m, mesh.faces
    if len(faces) == 0 or len(vertices) == 0:
        raise MeshError(f"{name}: got {len(vertices)} vertices and {len(faces)} faces, expected at least one triangle")
    if faces.min() < 0 or faces.max() >= len(vertices):
        raise MeshError(f"{name}: got vertex indices {faces.min()} to {faces.max()}, expected 0 to {len(vertices) - 1}")
    if not np.isfinite(vertices).all():
        raise MeshError(f"{name}: got vertices that are not finite, expected finite metres")


def _outward_normals(mesh: Mesh) -> Float[np.ndarray, "v 3"]:
    """Return vertex normals on the side that the winding faces.

    Cycles takes the side from the winding alone: a stored normal against it would shade the face black.
    """
    corners = mesh.vertices_m[mesh.faces]
    face_normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    total = np.zeros_like(mesh.vertices_m)
    for corner in range(3):
        np.add.at(total, mesh.faces[:, corner], face_normals)
    normals = np.asarray(mesh.normals, np.float64)
    agree = np.where((normals * total).sum(axis=1, keepdims=True) < 0.0, -1.0, 1.0)
    return (normals * agree).astype(np.float32)
