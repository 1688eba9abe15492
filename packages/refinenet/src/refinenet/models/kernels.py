"""Compiled loops of networks on a processor, in the operations and the order of torch's: the same bits."""

from typing import no_type_check

import numpy as np
from posecore.numba_jit import compiled


@compiled
@no_type_check
def window_similarity(render, image, amounts, floor, out):
    """Loop of `GradientCorrelation`: shift by shift in a core's cache, where whole tensors pass through memory often.

    `image` is padded by the radius; `out` has a channel of each kind and shift.
    """
    b, _, n, _ = render.shape
    m, side = n // 2, image.shape[2] - n + 1
    row, means = np.empty(n, np.float32), np.empty((m, m), np.float32)
    nothing, quarter, ninth = np.float32(0.0), np.float32(4.0), np.float32(9.0)
    for i in range(b):
        for kind in range(2):
            r0, r1 = render[i, 2 * kind], render[i, 2 * kind + 1]
            s0, s1 = image[i, 2 * kind], image[i, 2 * kind + 1]
            for down in range(side):
                for right in range(side):
                    for y in range(m):
                        top, low = 2 * y, 2 * y + 1
                        for x in range(n):
                            upper = s0[top + down, x + right] * r0[top, x] + s1[top + down, x + right] * r1[top, x]
                            lower = s0[low + down, x + right] * r0[low, x] + s1[low + down, x + right] * r1[low, x]
                            row[x] = upper + lower
                        for x in range(m):
                            means[y, x] = (row[2 * x] + row[2 * x + 1]) / quarter
                    channel = out[i, (kind * side + down) * side + right]
                    for y in range(m):
                        for x in range(m):
                            above = means[y - 1, x] if y > 0 else nothing
                            below = means[y + 1, x] if y + 1 < m else nothing
                            row[x] = above + means[y, x] + below
                        for x in range(m):
                            left = row[x - 1] if x > 0 else nothing
                            beside = row[x + 1] if x + 1 < m else nothing
                            channel[y, x] = (left + row[x] + beside) / ninth / (amounts[i, kind, y, x] + floor)
