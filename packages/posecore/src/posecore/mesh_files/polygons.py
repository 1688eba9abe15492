"""Polygons to triangles: a fan where the polygon is convex, ear clipping where it is not."""

from collections.abc import Sequence

import mapbox_earcut
import numpy as np
from jaxtyping import Bool, Float, Int, UInt64
from trimesh.geometry import triangulate_quads


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


def fingerprints(points: Float[np.ndarray, "c 3"]) -> UInt64[np.ndarray, " c"]:
    """A number for each point that only depends on its position; a polygon's is the sum, whatever the order."""
    bits = np.ascontiguousarray(points + 0.0).view(np.uint64)  # + 0.0 makes -0.0 a 0.0
    weights = np.array([3, 5, 7], np.uint64)
    return _mixed((_mixed(bits) * weights).sum(axis=1, dtype=np.uint64))


def polygon_fingerprints(corners: Float[np.ndarray, "c 3"], sizes: Int[np.ndarray, " p"]) -> UInt64[np.ndarray, " p"]:
    """A number for each polygon that only depends on the positions of its corners, not on their order."""
    starts = np.concatenate([[0], np.cumsum(sizes)[:-1]]).astype(np.int64)
    return np.asarray(np.add.reduceat(fingerprints(corners), starts))


def _mixed(x: UInt64[np.ndarray, "*n"]) -> UInt64[np.ndarray, "*n"]:
    """Each bit of a number spread over all (splitmix64, Steele et al., OOPSLA 2014): round floats have few bits."""
    x = (x ^ (x >> np.uint64(30))) * np.uint64(0xBF58476D1CE4E5B9)
    x = (x ^ (x >> np.uint64(27))) * np.uint64(0x94D049BB133111EB)
    return np.asarray(x ^ (x >> np.uint64(31)))


def repeated(numbers: UInt64[np.ndarray, " p"]) -> Int[np.ndarray, "r 2"]:
    """Rows whose number an earlier row has, each with the first such row."""
    ordered = np.sort(numbers)
    if (ordered[1:] != ordered[:-1]).all():
        return np.zeros((0, 2), np.int64)
    order = np.argsort(numbers, kind="stable")
    is_new = np.concatenate([[True], numbers[order][1:] != numbers[order][:-1]])
    first = order[np.flatnonzero(is_new)[np.cumsum(is_new) - 1]]
    return np.stack([order[~is_new], first[~is_new]], axis=1)


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
    vertices: Float[np.ndarray, "v 3"], polygons: Sequence[np.ndarray]
) -> tuple[Int[np.ndarray, "f 3"], Int[np.ndarray, " f"]]:
    """Triangles of polygons, and each triangle's polygon.

    Polygons of fewer than three corners give none, and neither do those of four or more that lie on an earlier one: the
    same polygon the other way round would be cut along another diagonal.

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
    copies = set(repeated(polygon_fingerprints(vertices[corners], sizes))[:, 0].tolist())
    if not is_concave.any() and not any(sizes[copy] > 3 for copy in copies):
        return _in_trimesh_order([np.asarray(polygons[i], np.int64) for i in whole], np.array(whole))
    faces, sources = [], []
    for number, (i, needs_ears) in enumerate(zip(whole, is_concave, strict=True)):
        if number in copies and sizes[number] > 3:
            continue
        polygon = np.asarray(polygons[i], np.int64)
        local = ears(vertices[polygon]) if needs_ears else fan(len(polygon))
        faces.append(polygon[local])
        sources.append(np.full(len(local), i))
    return np.concatenate(faces), np.concatenate(sources)


def _in_trimesh_order(
    polygons: Sequence[np.ndarray], numbers: Int[np.ndarray, " p"]
) -> tuple[Int[np.ndarray, "f 3"], Int[np.ndarray, " f"]]:
    """Triangles of convex polygons as trimesh orders them, so that meshes keep the hash that they always had."""
    sizes = np.array([len(polygon) for polygon in polygons])
    fans = [np.full(size - 2, number) for size, number in zip(sizes, numbers, strict=True) if size > 4]
    quads = numbers[sizes == 4]
    faces = np.asarray(triangulate_quads(polygons), np.int64).reshape(-1, 3)
    return faces, np.concatenate([numbers[sizes == 3], quads, quads, *fans])
