"""Hard edges of meshes without normals: vertices split where faces meet at a large angle."""

import numpy as np
from jaxtyping import Float, Int
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

CREASE_DEG = 30.0
"""Faces that meet at a larger angle keep a hard edge between them; Blender's default."""


def split_creases(
    vertices: Float[np.ndarray, "v 3"], faces: Int[np.ndarray, "f 3"]
) -> tuple[Int[np.ndarray, " w"], Int[np.ndarray, "f 3"]] | None:
    """The vertex of each split vertex, in the order of the vertices, and the faces with split vertices.

    Corners at a vertex stay together where their faces share a smooth edge. None where every edge is smooth.
    """
    n = len(faces)
    a, b, c = (vertices[faces[:, i]] for i in range(3))
    normals = np.cross(b - a, c - a)
    length = np.linalg.norm(normals, axis=1, keepdims=True)
    normals = np.divide(normals, length, out=np.zeros_like(normals), where=length > 0)
    first, second = (np.concatenate([faces[:, i] for i in order]).astype(np.int64) for order in ((0, 1, 2), (1, 2, 0)))
    key = np.minimum(first, second) * len(vertices) + np.maximum(first, second)
    order = np.argsort(key, kind="stable")
    is_pair = key[order][1:] == key[order][:-1]
    near, far = order[:-1][is_pair], order[1:][is_pair]  # half edges: side * n + face
    cosine = np.einsum("ei,ei->e", normals[near % n], normals[far % n])
    has_no_angle = (length[near % n, 0] == 0) | (length[far % n, 0] == 0)
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
    return unique // n_groups, inverse.reshape(n, 3)
