"""Polygons to triangles: a fan where the polygon is convex, ear clipping where it is not."""

from collections.abc import Sequence

import mapbox_earcut
import numpy as np
from jaxtyping import Bool, Float, Int


def concave(corners: Float[np.ndarray, "c 3"], sizes: Int[np.ndarray, " p"]) -> Bool[np.ndarray, " p"]:
    """Which polygons a fan would get wrong: those with a corner that turns against the others.

    Args:
        corners: Corners of all polygons, one after the other.
        sizes: Number of corners of each polygon, at least 3.
    """
    starts = np.concatenate([[0], np.cumsum(sizes)[:-1]])
    polygon = np.repeat(np.arange(len(sizes)), sizes)
    corner = np.arange(len(corners)) - starts[polygon]
    after = corners[starts[polygon] + (corner + 1) % sizes[polygon]]
    before = corners[starts[polygon] + (corner - 1) % sizes[polygon]]
    first = corners[starts][polygon]
    normals = np.add.reduceat(np.cross(corners - first, after - first), starts, axis=0)
    turns = np.einsum("ci,ci->c", np.cross(corners - before, after - corners), normals[polygon])
    slack = 1e-9 * np.einsum("pi,pi->p", normals, normals)
    return np.asarray(np.minimum.reduceat(turns, starts) < -slack)


def ears(corners: Float[np.ndarray, "n 3"]) -> Int[np.ndarray, "t 3"]:
    """Triangles of one polygon as indices of its corners, in its sense of rotation.

    Source: mapbox/earcut, in the plane of the polygon's mean normal.
    """
    following = np.roll(corners, -1, axis=0)
    normal = np.cross(corners - corners[0], following - corners[0]).sum(axis=0)
    axis = int(np.abs(normal).argmax())
    flat = np.ascontiguousarray(np.delete(corners, axis, axis=1))
    triangles = np.asarray(mapbox_earcut.triangulate_float64(flat, np.array([len(flat)], np.uint32)), np.int64)
    triangles = triangles.reshape(-1, 3)
    if len(triangles) == 0:
        return fan(len(corners))
    a, b, c = (corners[triangles[:, i]] for i in range(3))
    reversed_ = np.cross(b - a, c - a) @ normal < 0
    triangles[reversed_] = triangles[reversed_][:, ::-1]
    return triangles


def fan(size: int) -> Int[np.ndarray, "t 3"]:
    """Triangles of a convex polygon of `size` corners."""
    i = np.arange(1, size - 1)
    return np.stack([np.zeros_like(i), i, i + 1], axis=1)


def triangles_of(
    vertices: Float[np.ndarray, "v 3"], polygons: Sequence[Int[np.ndarray, " n"]]
) -> tuple[Int[np.ndarray, "f 3"], Int[np.ndarray, " f"]]:
    """Triangles of polygons, and each triangle's polygon; polygons of fewer than three corners give none.

    Args:
        vertices: All vertices.
        polygons: Vertex indices of each, inside the vertices.
    """
    whole = [i for i, polygon in enumerate(polygons) if len(polygon) >= 3]
    if not whole:
        return np.zeros((0, 3), np.int64), np.zeros(0, np.int64)
    sizes = np.array([len(polygons[i]) for i in whole])
    corners = np.concatenate([np.asarray(polygons[i], np.int64) for i in whole])
    is_concave = concave(vertices[corners], sizes) & (sizes > 3)
    faces, sources = [], []
    for i, needs_ears in zip(whole, is_concave, strict=True):
        polygon = np.asarray(polygons[i], np.int64)
        local = ears(vertices[polygon]) if needs_ears else fan(len(polygon))
        faces.append(polygon[local])
        sources.append(np.full(len(local), i))
    return np.concatenate(faces), np.concatenate(sources)
