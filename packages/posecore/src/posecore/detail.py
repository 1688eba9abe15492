"""Levels of detail: the same mesh with fewer faces, each with the error that this makes."""

from typing import Any

import fast_simplification  # type: ignore[import-untyped]
import numpy as np
import trimesh
from jaxtyping import Float, Int
from scipy.spatial import cKDTree

from posecore.kernels import nearest_distances2
from posecore.mesh import METRES_PER_UNIT, DetailLevel, Mesh, encloses_volume

FEWEST_FACES = 4096
"""A mesh of no more faces has no further levels: drawing them all costs a millisecond."""
LEVEL_FACES = tuple(2**k for k in range(17, 7, -1))
_LARGEST_LEVEL = 0.7
"""Faces of the finest level, over the mesh's own: at least so much less work, or it is not worth its memory."""
MEASURED_POINTS = 2**13
"""Points of each surface, evenly taken, at which its distance to the other is measured."""
_CANDIDATES = 6


def with_levels(mesh: Mesh) -> Mesh:
    """The mesh with its levels of detail: 2^k faces for every k under the number it has, down to 256.

    Edges are collapsed where the surface moves least. Colours and normals are those of the nearest vertex; where
    several lie at one position (hard edges, files without shared vertices), each face takes the one whose normal is
    nearest to its own. A mesh and its copy in a dataset, in float32 millimetres, have the same levels. A textured mesh
    has none: its texture coordinates would be torn at seams.

    Source: Garland and Heckbert, Surface Simplification Using Quadric Error Metrics, SIGGRAPH 1997.
    """
    if len(mesh.faces) <= FEWEST_FACES or mesh.texture_rgb is not None or mesh.levels:
        return mesh
    positions = _Positions(mesh.drawn)
    original = _Surface(positions.points_mm, positions.faces)
    points, faces = positions.points_mm.astype(np.float32), positions.faces.astype(np.int32)
    diameter_mm = mesh.diameter_m / METRES_PER_UNIT["mm"]
    levels: list[DetailLevel] = []
    for count in LEVEL_FACES:
        if count > _LARGEST_LEVEL * len(mesh.faces):
            continue
        points, faces = fast_simplification.simplify(points, faces, target_count=count)
        if not len(faces):
            break
        surface = _Surface(points.astype(np.float64), faces)
        distances_mm = np.concatenate([surface.distances(original.samples), original.distances(surface.samples)])
        vertices, corners = positions.with_sources(points, faces)
        edges = points[faces] - points[np.roll(faces, 1, axis=1)]
        levels.append(
            DetailLevel(
                offsets=points[vertices[:, 0]] / diameter_mm,
                sources=vertices[:, 1],
                faces=corners.astype(np.int32),
                rms_error=float(np.sqrt((distances_mm**2).mean())) / diameter_mm,
                max_error=float(distances_mm.max()) / diameter_mm,
                spacing=float(np.sqrt((edges**2).sum(axis=2).mean())) / diameter_mm,
                is_closed=encloses_volume(points, faces),
            )
        )
    return mesh.with_levels(tuple(levels))


class _Positions:
    """Vertices of a mesh about its `center_m`, float32 millimetres; those at one position are one point.

    Vertices that no face uses are left out.
    """

    def __init__(self, mesh: Mesh) -> None:
        stored_mm = (mesh.vertices_m / METRES_PER_UNIT["mm"]).astype(np.float32).astype(np.float64)
        used = np.unique(mesh.faces)
        order = used[np.lexsort(stored_mm[used].T)]
        is_first = np.concatenate([[True], (np.diff(stored_mm[order], axis=0) != 0).any(axis=1)])
        point = np.zeros(len(stored_mm), np.int64)
        point[order] = np.cumsum(is_first) - 1
        self._members = order  # vertices by point
        self._begin = np.append(np.flatnonzero(is_first), len(order))
        self._normals = mesh.normals
        points_mm = stored_mm[order[is_first]]
        self.points_mm = points_mm - (points_mm.min(axis=0) + points_mm.max(axis=0)) / 2
        faces = point[mesh.faces]
        self.faces = faces[(faces != np.roll(faces, 1, axis=1)).all(axis=1)]
        self._tree = cKDTree(self.points_mm, compact_nodes=False, balanced_tree=False)

    def with_sources(
        self, points: Float[np.ndarray, "v 3"], faces: Int[np.ndarray, "f 3"]
    ) -> tuple[Int[np.ndarray, "w 2"], Int[np.ndarray, "f 3"]]:
        """Vertices of a simplified mesh with the vertex of this one whose colour and normal each has.

        Returns:
            Point and source of each vertex, and the faces over these vertices.
        """
        nearest = np.asarray(self._tree.query(points)[1])[faces]
        edges = points[faces[:, 1:]] - points[faces[:, :1]]
        normals = np.cross(edges[:, 0], edges[:, 1])
        source = self._members[self._fitting(nearest.reshape(-1), np.repeat(normals, 3, axis=0))].reshape(faces.shape)
        pairs = np.stack([faces, source], axis=-1).reshape(-1, 2)
        _, first, corner = np.unique(pairs @ [len(self._normals), 1], return_index=True, return_inverse=True)
        return pairs[first], corner.reshape(-1, 3)

    def _fitting(self, point: Int[np.ndarray, " c"], normal: Float[np.ndarray, "c 3"]) -> Int[np.ndarray, " c"]:
        """Of the members of each point, the index of the first whose normal is nearest to the one given."""
        index: Int[np.ndarray, " c"] = self._begin[point]
        count = np.diff(self._begin)[point]
        several = np.flatnonzero(count > 1)
        count = count[several]
        if not len(several):
            return index
        start = np.cumsum(count) - count  # of each point's members in the list of all
        owner = np.repeat(several, count)
        member = np.arange(len(owner)) + np.repeat(index[several] - start, count)
        fit = np.einsum("mi,mi->m", self._normals[self._members[member]], normal[owner])
        best = np.flatnonzero(fit == np.repeat(np.maximum.reduceat(fit, start), count))
        index[several] = member[best[np.searchsorted(best, start)]]
        return index


class _Surface:
    """Triangles whose distance to points is measured.

    The nearest triangles are found among samples of the surface, evenly apart; the distance to them is exact, so what
    is returned is never too small.
    """

    def __init__(self, points: Float[np.ndarray, "v 3"], faces: Int[np.ndarray, "f 3"]) -> None:
        self._triangles = points[faces]
        self._triangle = np.arange(len(faces))  # of each sample
        if len(faces) <= LEVEL_FACES[0]:  # those of larger meshes are small, and would take seconds
            edges = self._triangles - np.roll(self._triangles, 1, axis=1)
            spacing = 2 * float(np.sqrt((edges**2).sum(axis=2).mean()))
            subdivide: Any = trimesh.remesh.subdivide_to_size
            points, faces, self._triangle = subdivide(points, faces, spacing, max_iter=20, return_index=True)
        middles = (points[faces[:, 0]] + points[faces[:, 1]] + points[faces[:, 2]]) / 3
        self._tree = cKDTree(middles, compact_nodes=False, balanced_tree=False)
        samples = np.concatenate([points, middles])
        self.samples = samples[:: -(-len(samples) // MEASURED_POINTS)]

    def distances(self, points: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, " n"]:
        """Distance of each point to the surface."""
        count = min(_CANDIDATES, len(self._triangle))
        nearest = self._triangle[self._tree.query(points, k=count)[1].reshape(len(points), count)]
        return np.asarray(np.sqrt(nearest_distances2(points, self._triangles, nearest)))
