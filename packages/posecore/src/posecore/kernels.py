"""Compiled loops over triangles."""

from typing import no_type_check

import numpy as np

from posecore.numba_jit import compiled


@compiled
@no_type_check
def nearest_distances2(points, triangles, candidates):
    """Squared distance of each point (n, 3) to the nearest of its candidates (n, k) among the triangles (f, 3, 3).

    Source: Ericson, Real-Time Collision Detection, 2005, 5.1.5.
    """
    least = np.full(len(points), np.inf)
    for i in range(len(points)):
        for j in candidates[i]:
            a, b, c = triangles[j, 0], triangles[j, 1], triangles[j, 2]
            ab, ac, ap, bp, cp = b - a, c - a, points[i] - a, points[i] - b, points[i] - c
            d1, d2, d3 = (ab * ap).sum(), (ac * ap).sum(), (ab * bp).sum()
            d4, d5, d6 = (ac * bp).sum(), (ab * cp).sum(), (ac * cp).sum()
            va, vb, vc = d3 * d6 - d5 * d4, d5 * d2 - d1 * d6, d1 * d4 - d3 * d2
            if d1 <= 0 and d2 <= 0:
                v, w = 0.0, 0.0
            elif d3 >= 0 and d4 <= d3:
                v, w = 1.0, 0.0
            elif d6 >= 0 and d5 <= d6:
                v, w = 0.0, 1.0
            elif vc <= 0 and d1 >= 0 and d3 <= 0:
                v, w = d1 / (d1 - d3), 0.0
            elif vb <= 0 and d2 >= 0 and d6 <= 0:
                v, w = 0.0, d2 / (d2 - d6)
            elif va <= 0 and d4 >= d3 and d5 >= d6:
                w = (d4 - d3) / ((d4 - d3) + (d5 - d6))
                v = 1.0 - w
            else:
                v, w = vb / (va + vb + vc), vc / (va + vb + vc)
            gap = ap - v * ab - w * ac
            least[i] = min(least[i], (gap * gap).sum())
    return least
