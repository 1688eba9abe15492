"""Stable poses of a mesh on a plane."""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float
from posecore.mesh import Mesh
from posecore.se3 import even_directions
from scipy.spatial import ConvexHull, QhullError

_DROPS = 2048  # evenly spaced directions in which a mesh is dropped
_MAX_HULL_POINTS = 600  # a hull with more vertices is reduced to those extreme in one of as many directions
_TOLERANCE = 1e-6  # fraction of the diameter within which planes and heights are equal


@dataclass(frozen=True, kw_only=True, eq=False)
class StablePoses:
    """Stable poses of a mesh.

    Attributes:
        hull_m: (h, 3) vertices of the convex hull, object coordinates.
        down: (k, 3) unit directions, object coordinates, that point down when the mesh is at rest.
        weights: (k,) probability of each after a drop in a random orientation; they sum to 1.
    """

    hull_m: Float[np.ndarray, "h 3"]
    down: Float[np.ndarray, "k 3"]
    weights: Float[np.ndarray, " k"]


def find_stable_poses(mesh: Mesh) -> StablePoses:
    """Facets of the convex hull that a mesh comes to rest on, with their probabilities.

    Quasi-static: from the facet hit by a downward ray from the centre of mass, the mesh rolls over the edge beyond
    which its centre of mass lies, facet by facet, until there is no such edge. The rolling goes downhill, so it ends.
    No random number is drawn. The centre of mass is that of the mesh if it encloses a volume, else of its hull.

    A mesh without volume rests on either of its two sides.

    Source: Goldberg et al., "Part pose statistics: estimators and experiments", 1999 (the quasi-static estimator).
    """
    center_m = mesh.center_m
    mesh = mesh.with_origin_at(center_m)  # planes are rounded: about the centre, equally wherever the origin lies
    scale = max(mesh.diameter_m, 1e-12)
    try:
        points = mesh.vertices_m[ConvexHull(mesh.vertices_m).vertices]
        hull = ConvexHull(_extreme(points) if len(points) > _MAX_HULL_POINTS else points)
    except QhullError:
        _, _, axes = np.linalg.svd(mesh.vertices_m - mesh.vertices_m.mean(axis=0), full_matrices=False)
        hull_m = mesh.vertices_m + center_m
        return StablePoses(hull_m=hull_m, down=np.stack([axes[2], -axes[2]]), weights=np.array([0.5, 0.5]))
    planes = np.unique((hull.equations / [1, 1, 1, scale] / _TOLERANCE).round() * _TOLERANCE, axis=0) * [1, 1, 1, scale]
    normals = planes[:, :3] / np.linalg.norm(planes[:, :3], axis=1, keepdims=True)
    height = np.maximum(-planes[:, 3] - normals @ _centre_of_mass(mesh, hull), 1e-9 * scale)
    follower = _hit(normals, height, normals)
    downhill = height[follower] < height * (1.0 - _TOLERANCE)
    follower = np.where(downhill, follower, np.arange(len(height)))
    landed = _hit(normals, height, even_directions(_DROPS))
    for _ in range(len(height)):
        onward = follower[landed]
        if np.array_equal(onward, landed):
            break
        landed = onward
    facets, counts = np.unique(landed, return_counts=True)
    return StablePoses(hull_m=points + center_m, down=normals[facets], weights=counts / counts.sum())


class StablePosesByKey(dict[int, StablePoses]):
    """Stable poses by mesh key, computed at their first use.

    Args:
        meshes: Meshes by key.
    """

    def __init__(self, meshes: Mapping[int, Mesh]) -> None:
        super().__init__()
        self._meshes = meshes

    def __missing__(self, key: int) -> StablePoses:
        self[key] = find_stable_poses(self._meshes[key])
        return self[key]


def _hit(
    normals: Float[np.ndarray, "f 3"], height: Float[np.ndarray, " f"], rays: Float[np.ndarray, "r 3"]
) -> np.ndarray:
    """Facet through which each ray from the centre of mass leaves the hull."""
    slope = rays @ normals.T
    with np.errstate(divide="ignore"):
        return np.asarray(np.where(slope > 1e-9, height / np.maximum(slope, 1e-9), np.inf).argmin(axis=1))


def _extreme(points: Float[np.ndarray, "p 3"]) -> Float[np.ndarray, "q 3"]:
    return np.asarray(points[np.unique((points @ even_directions(_MAX_HULL_POINTS).T).argmax(axis=0))])


def _centre_of_mass(mesh: Mesh, hull: ConvexHull) -> Float[np.ndarray, "3"]:
    middle = hull.points[hull.vertices].mean(axis=0)
    if mesh.is_closed:
        corners = mesh.vertices_m[mesh.faces] - middle
    else:
        corners = hull.points[hull.simplices] - middle
        outwards = np.einsum("fi,fi->f", np.cross(corners[:, 1], corners[:, 2]), corners[:, 0]) > 0
        corners = np.where(outwards[:, None, None], corners, corners[:, ::-1])
    volume = np.einsum("fi,fi->f", corners[:, 0], np.cross(corners[:, 1], corners[:, 2]))
    return np.asarray(middle + (volume[:, None] * corners.sum(axis=1)).sum(axis=0) / 4 / volume.sum())
