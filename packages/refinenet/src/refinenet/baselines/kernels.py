"""Compiled loops of the baselines."""

from typing import no_type_check

import numpy as np
from posecore.numba_jit import compiled


@compiled
@no_type_check
def mean_response(T_cam_obj, K, nearest, points_m, normals, occluder_depth_m, responses):
    """Loop of `ViewpointModel.similarity`; `nearest` holds the index of each pose's viewpoint."""
    result = np.zeros(len(T_cam_obj))
    bins, side = responses.shape[0], responses.shape[1]
    n = points_m.shape[1]
    for i in range(len(T_cam_obj)):
        T, v = T_cam_obj[i], nearest[i]
        total, count = 0.0, 0
        for k in range(n):
            x, y, z = points_m[v, k, 0], points_m[v, k, 1], points_m[v, k, 2]
            x_cam = T[0, 0] * x + T[0, 1] * y + T[0, 2] * z + T[0, 3]
            y_cam = T[1, 0] * x + T[1, 1] * y + T[1, 2] * z + T[1, 3]
            z_cam = T[2, 0] * x + T[2, 1] * y + T[2, 2] * z + T[2, 3]
            column = np.floor(K[0, 0] * x_cam / z_cam + K[0, 2])
            row = np.floor(K[1, 1] * y_cam / z_cam + K[1, 2])
            if not (0 <= column < side and 0 <= row < side):
                count += 1
            elif z_cam < occluder_depth_m[int(row), int(column)]:
                count += 1
                x, y, z = normals[v, k, 0], normals[v, k, 1], normals[v, k, 2]
                dx = T[0, 0] * x + T[0, 1] * y + T[0, 2] * z
                dy = T[1, 0] * x + T[1, 1] * y + T[1, 2] * z
                doubled_turn = np.arctan2(2 * dx * dy, dx * dx - dy * dy) / (2 * np.pi)
                total += responses[int(np.rint(doubled_turn * bins)) % bins, int(row), int(column)]
        result[i] = total / max(count, n // 2)
    return result
