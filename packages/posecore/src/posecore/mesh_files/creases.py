"""Hard edges of meshes without normals: vertices split where faces meet at a large angle."""

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

CREASE_DEG = 30.0
"""Faces that meet at a larger angle keep a hard edge between them; Blender's default."""
_ROUNDING = 2 * float(np.finfo(np.float32).eps)
"""Height, over the largest coordinate, of a needle whose corners lie on a line up to the rounding of float32 files."""
_NEEDLES = 4
"""Needles in a row, each at the longest edge of the one before, at least, that are followed to a face."""


def split_creases(
    vertices: Float[np.ndarray, "v 3"], faces: Int[np.ndarray, "f 3"]
) -> tuple[Int[np.ndarray, " w"], Int[np.ndarray, "f 3"], Bool[np.ndarray, " f"]] | None:
    """The vertex of each split vertex, in the order of the vertices; the faces with split vertices; which are needles.

    Corners at a vertex stay together where their faces share a smooth edge. None where every edge is smooth. A needle
    (T-junctions have them) has the direction of the face at its longest edge; without such a face its edges are smooth.
    """
    n = len(faces)
    a, b, c = (vertices[faces[:, i]] for i in range(3))
    normals = np.cross(b - a, c - a)
    length = np.linalg.norm(normals, axis=1, keepdims=True)
    normals = np.divide(normals, length, out=np.zeros_like(normals), where=length > 0)
    edges2 = np.stack([((end - start) ** 2).sum(axis=1) for start, end in ((a, b), (b, c), (c, a))])
    is_needle = length[:, 0] <= _ROUNDING * np.abs(vertices).max(initial=0.0) * np.sqrt(edges2.max(axis=0))
    first, second = (np.concatenate([faces[:, i] for i in order]).astype(np.int64) for order in ((0, 1, 2), (1, 2, 0)))
    key = np.minimum(first, second) * len(vertices) + np.maximum(first, second)
    order = np.argsort(key, kind="stable")
    is_pair = key[order][1:] == key[order][:-1]
    near, far = order[:-1][is_pair], order[1:][is_pair]  # half edges: side * n + face
    across = np.tile(np.arange(n), 3)  # face at the other side of each half edge
    across[near], across[far] = far % n, near % n
    weights = edges2 + ~is_needle[across].reshape(3, n) * edges2.sum(axis=0)  # a needle is no direction either
    source = np.where(is_needle, across[weights.argmax(axis=0) * n + np.arange(n)], np.arange(n))
    for _ in range(_NEEDLES.bit_length()):
        source = source[source]
    normals, has_none = normals[source], is_needle[source]
    cosine = np.einsum("ei,ei->e", normals[near % n], normals[far % n])
    has_no_angle = has_none[near % n] | has_none[far % n]
    smooth = (cosine > np.cos(np.radians(CREASE_DEG + 0.1))) | has_no_angle
    if smooth.all():
        return None
    # A corner is side * n + face. Half edge (side, face) has the corners (side, face) and (side + 1, face).
    ends = []
    for near_side, far_side in ((0, 0), (0, 1), (1, 0), (1, 1)):
        x = (near[smooth] + near_side * n) % (3 * n)
        y = (far[smooth] + far_side * n) % (3 * n)
        same = faces[x % n, x // n] == faces[y % n, y // n]
        ends.append((x[same], y[same]))
    x, y = (np.concatenate(column) for column in zip(*ends, strict=True))
    graph = coo_array((np.ones(len(x), bool), (x, y)), shape=(3 * n, 3 * n))
    n_groups, group = connected_components(graph, directed=False)
    groups = faces.astype(np.int64) * n_groups + group.reshape(3, n).T
    unique, inverse = np.unique(groups.reshape(-1), return_inverse=True)
    return unique // n_groups, inverse.reshape(n, 3), is_needle
