"""Mesh decimation for small renders."""

from dataclasses import replace

import fast_simplification  # type: ignore[import-untyped]
import numpy as np
from scipy.spatial import cKDTree

from posecore.mesh import Mesh


def simplified(mesh: Mesh, max_faces: int) -> Mesh:
    """A mesh of about `max_faces` faces with the same appearance from a distance.

    Edges are collapsed where the surface moves least; colours and normals are those of the nearest vertex of the
    original. A mesh that is small enough is returned as it is, and so is a textured one: its texture coordinates would
    not survive. As many faces as the picture has pixels are enough: silhouettes of LM-O's meshes at 64 px
    then differ by a tenth of a pixel at most.

    Args:
        mesh: Mesh.
        max_faces: Number of faces; some more remain where nothing can be collapsed without tearing the surface.

    Source: Garland and Heckbert, Surface Simplification Using Quadric Error Metrics, SIGGRAPH 1997.
    """
    if len(mesh.faces) <= max_faces or mesh.texture_rgb is not None:
        return mesh
    # Vertices at the same position are merged: unconnected triangles would be dropped as a whole.
    about_center_m = mesh.vertices_m - mesh.center_m  # float32 has no digits to spare for an origin metres off
    _, first, merged = np.unique(about_center_m.round(9), axis=0, return_index=True, return_inverse=True)
    rank = np.argsort(np.argsort(first))  # the order of the file, which the result depends on
    vertices_m, faces = fast_simplification.simplify(
        about_center_m[np.sort(first)].astype(np.float32),
        rank[merged.reshape(-1)][mesh.faces].astype(np.int32),
        target_count=max_faces,
    )
    vertices_m = vertices_m.astype(np.float64)
    nearest = cKDTree(about_center_m).query(vertices_m)[1]
    return replace(
        mesh,
        vertices_m=vertices_m + mesh.center_m,
        faces=faces.astype(np.int32),
        normals=mesh.normals[nearest],
        vertex_rgb=None if mesh.vertex_rgb is None else mesh.vertex_rgb[nearest],
        uv=None,
        sha256="",
        levels=(),
    )
