"""Compiled loops over estimates and model points, behind the functions of `metrics`.

All arrays are C-contiguous float64; poses are `T_cam_obj`, (b, 4, 4), metres; `symmetries` are (1, s, 4, 4), or
(b, s, 4, 4) where every estimate has its own, the identity first.
"""

from typing import no_type_check

import numpy as np
from posecore.numba_jit import compiled


@compiled
@no_type_check
def mean_distance(T_est, T_gt, points_m):
    """Average distance of corresponding points for each estimate, (b,)."""
    result = np.empty(len(T_est))
    for i in range(len(T_est)):
        D = T_est[i] - T_gt[i]
        total = 0.0
        for k in range(len(points_m)):
            x, y, z = points_m[k, 0], points_m[k, 1], points_m[k, 2]
            dx = D[0, 0] * x + D[0, 1] * y + D[0, 2] * z + D[0, 3]
            dy = D[1, 0] * x + D[1, 1] * y + D[1, 2] * z + D[1, 3]
            dz = D[2, 0] * x + D[2, 1] * y + D[2, 2] * z + D[2, 3]
            total += np.sqrt(dx * dx + dy * dy + dz * dz)
        result[i] = total / len(points_m)
    return result


@compiled
@no_type_check
def max_distance(T_est, T_gt, points_m, symmetries):
    """Largest distance of corresponding points at the best symmetry for each estimate, (b,)."""
    result = np.empty(len(T_est))
    for i in range(len(T_est)):
        best = np.inf
        for S in symmetries[i % len(symmetries)]:
            D = T_est[i] - T_gt[i] @ np.ascontiguousarray(S)
            largest = 0.0
            for k in range(len(points_m)):
                x, y, z = points_m[k, 0], points_m[k, 1], points_m[k, 2]
                dx = D[0, 0] * x + D[0, 1] * y + D[0, 2] * z + D[0, 3]
                dy = D[1, 0] * x + D[1, 1] * y + D[1, 2] * z + D[1, 3]
                dz = D[2, 0] * x + D[2, 1] * y + D[2, 2] * z + D[2, 3]
                largest = max(largest, dx * dx + dy * dy + dz * dz)
                if largest >= best:  # this symmetry cannot be the best one
                    break
            best = min(best, largest)
        result[i] = np.sqrt(best)
    return result


@compiled
@no_type_check
def projected_distances(T_est, T_gt, K, points_m, symmetries):
    """Distances of projected points, pixels, (b, 3): largest at the best symmetry, mean without, mean at the best.

    Infinite where a point lies in the camera's plane. K is (b, 3, 3).
    """
    result = np.empty((len(T_est), 3))
    count = len(points_m)
    estimated = np.empty((count, 2))
    for i in range(len(T_est)):
        P = K[i] @ T_est[i, :3]
        for k in range(count):
            x, y, z = points_m[k, 0], points_m[k, 1], points_m[k, 2]
            w = P[2, 0] * x + P[2, 1] * y + P[2, 2] * z + P[2, 3]
            estimated[k, 0] = (P[0, 0] * x + P[0, 1] * y + P[0, 2] * z + P[0, 3]) / w
            estimated[k, 1] = (P[1, 0] * x + P[1, 1] * y + P[1, 2] * z + P[1, 3]) / w
        transforms = symmetries[i % len(symmetries)]
        best_largest, best_total = np.inf, np.inf
        for s in range(len(transforms)):
            P = K[i] @ (T_gt[i] @ transforms[s])[:3]
            largest, total = 0.0, 0.0
            for k in range(count):
                x, y, z = points_m[k, 0], points_m[k, 1], points_m[k, 2]
                w = P[2, 0] * x + P[2, 1] * y + P[2, 2] * z + P[2, 3]
                du = (P[0, 0] * x + P[0, 1] * y + P[0, 2] * z + P[0, 3]) / w - estimated[k, 0]
                dv = (P[1, 0] * x + P[1, 1] * y + P[1, 2] * z + P[1, 3]) / w - estimated[k, 1]
                distance = np.sqrt(du * du + dv * dv)
                if np.isnan(distance):
                    distance = np.inf
                largest = max(largest, distance)
                total += distance
                if s > 0 and largest >= best_largest and total >= best_total:
                    break
            if s == 0:
                result[i, 1] = total / count
            best_largest, best_total = min(best_largest, largest), min(best_total, total)
        result[i, 0], result[i, 2] = best_largest, best_total / count
    return result


@compiled
@no_type_check
def nearest_points(query_m, points_m, first, neighbours):
    """Index of the point nearest to each query, (n,), along a Delaunay graph, see `nearest_points.NearestPoints`.

    The walk starts at the previous query's result: a point without a nearer neighbour is the nearest of all points.
    """
    result = np.empty(len(query_m), np.int64)
    here = 0
    for k in range(len(query_m)):
        x, y, z = query_m[k, 0], query_m[k, 1], query_m[k, 2]
        dx, dy, dz = points_m[here, 0] - x, points_m[here, 1] - y, points_m[here, 2] - z
        nearest = dx * dx + dy * dy + dz * dz
        before = -1
        while here != before:
            before = here
            for link in range(first[before], first[before + 1]):
                other = neighbours[link]
                dx, dy, dz = points_m[other, 0] - x, points_m[other, 1] - y, points_m[other, 2] - z
                squared = dx * dx + dy * dy + dz * dz
                if squared < nearest:
                    nearest, here = squared, other
        result[k] = here
    return result
