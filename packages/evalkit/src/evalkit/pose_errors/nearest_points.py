"""Exact nearest neighbours among a model's points, for ADI.

The Delaunay graph took ADI from 9.0 to 0.78 ms an estimate on the 349 initial poses of LM-O: `adi_trees` and `adi` of
`python benchmarks/eval_speed.py --dataset lmo --results initial.csv`.
"""

import numpy as np
from jaxtyping import Float, Int
from posecore import se3
from scipy.spatial import Delaunay, QhullError, cKDTree

from evalkit.pose_errors import kernels

GRAPH_FROM = 32
"""Number of poses from which a Delaunay graph, slow to build and fast to walk, costs less than a tree for each."""

SKEW = 0.02
"""Largest entry of R^T R - I of an estimate for which the graph, built in the object frame, is used."""

ORDER_BITS = 10


class NearestPoints:
    """A model's points under pairs of poses: the distance of each from the nearest point of the other pose.

    A few pairs of poses get a k-d tree each. For more, the points' Delaunay graph is built once: a point without a
    neighbour nearer to the query is the nearest point, in every pose. Points are ordered along a space-filling curve,
    so a walk along the graph from the previous point's result takes two steps. For a pose that is only nearly rigid, as
    annotations are, the walk may stop at a point that is as near up to that flaw; poses further from rigid than `SKEW`
    get a tree.

    Args:
        points_m: Vertices in the object frame, metres.
    """

    def __init__(self, points_m: Float[np.ndarray, "n 3"]) -> None:
        points = np.asarray(points_m, np.float64)
        self._points_m = points[_curve_order(points)]
        self._different = np.sort(np.unique(self._points_m, axis=0, return_index=True)[1])
        self._graph: tuple[Int[np.ndarray, " p1"], Int[np.ndarray, " e"]] | None = None
        self._poses_seen = 0

    def mean_distance_m(
        self, T_est: Float[np.ndarray, "b 4 4"], T_gt: Float[np.ndarray, "b 4 4"]
    ) -> Float[np.ndarray, " b"]:
        """Average distance from each point at the ground-truth pose to the nearest point at the estimated one, metres.

        Args:
            T_est: Estimates `T_cam_obj`, metres.
            T_gt: As many ground-truth poses.
        """
        before, self._poses_seen = self._poses_seen, self._poses_seen + len(T_est)
        if before < GRAPH_FROM <= self._poses_seen:
            self._graph = _delaunay_graph(self._points_m[self._different])
        result = np.empty(len(T_est))
        for i, (estimate, gt) in enumerate(zip(T_est, T_gt, strict=True)):
            # In the camera frame, not the object's: annotations are not exactly orthonormal.
            points, query = se3.apply(estimate, self._points_m)[self._different], se3.apply(gt, self._points_m)
            if self._graph is None or np.abs(estimate[:3, :3].T @ estimate[:3, :3] - np.eye(3)).max() > SKEW:
                tree = cKDTree(points, leafsize=64, balanced_tree=False, compact_nodes=False)
                nearest = tree.query(query)[1]
            else:
                nearest = kernels.nearest_points(query, points, *self._graph)
            offset_m = points[nearest] - query
            result[i] = np.sqrt(np.einsum("ij,ij->i", offset_m, offset_m)).mean()
        return result


def _curve_order(points_m: Float[np.ndarray, "n 3"]) -> Int[np.ndarray, " n"]:
    """Order of points along a Morton curve."""
    low = points_m.min(axis=0)
    span = float((points_m.max(axis=0) - low).max()) or 1.0
    cell = ((points_m - low) / span * (2**ORDER_BITS - 1)).astype(np.int64)
    code = np.zeros(len(points_m), np.int64)
    for bit in range(ORDER_BITS):
        for axis in range(3):
            code |= ((cell[:, axis] >> bit) & 1) << (3 * bit + axis)
    return np.argsort(code, kind="stable")


def _delaunay_graph(points_m: Float[np.ndarray, "p 3"]) -> tuple[Int[np.ndarray, " p1"], Int[np.ndarray, " e"]] | None:
    """Start of each point's neighbours in a list, and that list; None where all points lie in a plane."""
    try:
        delaunay = Delaunay(points_m)
    except (QhullError, ValueError):
        return None
    firsts, links = delaunay.vertex_neighbor_vertices
    ends = [np.stack([np.repeat(np.arange(len(points_m)), np.diff(firsts)), links], axis=1)]
    # Points that Qhull left out as too near to another point get that point's neighbours, the point and each other.
    left_out = np.unique(delaunay.coplanar[:, 0])
    kept = np.setdiff1d(np.arange(len(points_m)), left_out)
    owners = kept[cKDTree(points_m[kept]).query(points_m[left_out])[1]]
    for owner in np.unique(owners):
        crowd = left_out[owners == owner]
        beside = np.concatenate([links[firsts[owner] : firsts[owner + 1]], crowd, [owner]])
        ends.append(np.stack([np.repeat(crowd, len(beside)), np.tile(beside, len(crowd))], axis=1))
        ends.append(np.stack([np.full(len(crowd), owner), crowd], axis=1))
    pairs = np.concatenate(ends).astype(np.int64)
    pairs = pairs[np.argsort(pairs[:, 0], kind="stable")]
    first = np.searchsorted(pairs[:, 0], np.arange(len(points_m) + 1))
    return first, np.ascontiguousarray(pairs[:, 1])
