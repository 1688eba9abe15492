"""How a mesh comes to rest on a plane."""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float
from posecore.mesh import Mesh
from posecore.se3 import even_directions
from scipy.spatial import ConvexHull, QhullError

Array = np.ndarray

_DROPS = 2048  # directions that a mesh is dropped in, spread evenly
_MOST_HULL_POINTS = 600  # a hull with more vertices is taken at those that are extreme in one of as many directions
_SAME = 1e-6  # planes and heights nearer than this share of the diameter are one


@dataclass(frozen=True, kw_only=True, eq=False)
class Rest:
    """Stable poses of one mesh.

    Attributes:
        hull_m: (h, 3) vertices of the convex hull, object coordinates.
        down: (k, 3) unit directions, object coordinates: pointing down, the mesh rests.
        weights: (k,) chance of each when the mesh is dropped in a random orientation; they sum to 1.
    """

    hull_m: Float[Array, "h 3"]
    down: Float[Array, "k 3"]
    weights: Float[Array, " k"]


def find_rest(mesh: Mesh) -> Rest:
    """Find the facets of the convex hull that a mesh comes to rest on, and how often.

    Quasi-static: from the facet hit by a ray down from the centre of mass the mesh rolls over the edge that its centre
    of mass hangs over, facet by facet, until it hangs over none. The rolling goes downhill, so it ends. No random
    number is drawn. The centre of mass is that of the mesh where it encloses a volume, of its hull where it does not.

    A mesh without volume rests on either of its two sides.

    Source: Goldberg et al., "Part pose statistics: estimators and experiments", 1999 (the quasi-static estimator).
    """
    scale = max(mesh.diameter_m, 1e-12)
    try:
        points = mesh.vertices_m[ConvexHull(mesh.vertices_m).vertices]
        hull = ConvexHull(_extreme(points) if len(points) > _MOST_HULL_POINTS else points)
    except QhullError:
        _, _, axes = np.linalg.svd(mesh.vertices_m - mesh.vertices_m.mean(axis=0), full_matrices=False)
        return Rest(hull_m=mesh.vertices_m, down=np.stack([axes[2], -axes[2]]), weights=np.array([0.5, 0.5]))
    planes = np.unique((hull.equations / [1, 1, 1, scale] / _SAME).round() * _SAME, axis=0) * [1, 1, 1, scale]
    normals = planes[:, :3] / np.linalg.norm(planes[:, :3], axis=1, keepdims=True)
    height = np.maximum(-planes[:, 3] - normals @ _centre_of_mass(mesh, hull), 1e-9 * scale)
    follower = _hit(normals, height, normals)
    downhill = height[follower] < height * (1.0 - _SAME)
    follower = np.where(downhill, follower, np.arange(len(height)))
    landed = _hit(normals, height, even_directions(_DROPS))
    for _ in range(len(height)):
        onward = follower[landed]
        if np.array_equal(onward, landed):
            break
        landed = onward
    facets, counts = np.unique(landed, return_counts=True)
    return Rest(hull_m=points, down=normals[facets], weights=counts / counts.sum())


class Rests(dict[int, Rest]):
    """Stable poses by mesh key, found at their first use.

    Args:
        meshes: Meshes by key.
    """

    def __init__(self, meshes: Mapping[int, Mesh]) -> None:
        super().__init__()
        self._meshes = meshes

    def __missing__(self, key: int) -> Rest:
        self[key] = find_rest(self._meshes[key])
        return self[key]


def _hit(normals: Float[Array, "f 3"], height: Float[Array, " f"], rays: Float[Array, "r 3"]) -> Array:
    """Facet that each ray from the centre of mass leaves the hull through."""
    slope = rays @ normals.T
    with np.errstate(divide="ignore"):
        return np.asarray(np.where(slope > 1e-9, height / np.maximum(slope, 1e-9), np.inf).argmin(axis=1))


def _extreme(points: Float[Array, "p 3"]) -> Float[Array, "q 3"]:
    return np.asarray(points[np.unique((points @ even_directions(_MOST_HULL_POINTS).T).argmax(axis=0))])


def _centre_of_mass(mesh: Mesh, hull: ConvexHull) -> Float[Array, "3"]:
    middle = hull.points[hull.vertices].mean(axis=0)
    if mesh.is_closed:
        corners = mesh.vertices_m[mesh.faces] - middle
    else:
        corners = hull.points[hull.simplices] - middle
        outwards = np.einsum("fi,fi->f", np.cross(corners[:, 1], corners[:, 2]), corners[:, 0]) > 0
        corners = np.where(outwards[:, None, None], corners, corners[:, ::-1])
    volume = np.einsum("fi,fi->f", corners[:, 0], np.cross(corners[:, 1], corners[:, 2]))
    return np.asarray(middle + (volume[:, None] * corners.sum(axis=1)).sum(axis=0) / 4 / volume.sum())
