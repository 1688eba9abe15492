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


@compiled
@no_type_check
def strongest_gradient(values, half_strength2, out):
    """Loop of `orientations`; `out` has cosine and sine of each cell of two pixels."""
    b, channels, p, q = values.shape
    two, four, small = np.float32(2.0), np.float32(4.0), np.float32(1e-3)
    padded = np.empty((channels, 3, q + 2), np.float32)
    x, y, square = np.empty(q, np.float32), np.empty(q, np.float32), np.empty(q, np.float32)
    cosine, sine = np.empty((2, q), np.float32), np.empty((2, q), np.float32)
    for i in range(b):
        for v in range(p):
            for c in range(channels):
                for line in range(3):
                    source = values[i, c, min(max(v + line - 1, 0), p - 1)]
                    padded[c, line, 1 : q + 1] = source
                    padded[c, line, 0], padded[c, line, q + 1] = source[0], source[q - 1]
            for c in range(channels):
                above, here, below = padded[c, 0], padded[c, 1], padded[c, 2]
                for u in range(q):
                    across = (above[u + 2] - above[u]) + two * (here[u + 2] - here[u])
                    dx = (across + (below[u + 2] - below[u])) / four
                    down = (below[u] - above[u]) + two * (below[u + 1] - above[u + 1])
                    dy = (down + (below[u + 2] - above[u + 2])) / four
                    other = dx * dx + dy * dy
                    if c == 0 or other > square[u]:
                        x[u], y[u], square[u] = dx, dy, other
            for u in range(q):
                weight = square[u] / (square[u] + half_strength2) / (square[u] + small)
                cosine[v % 2, u] = (x[u] * x[u] - y[u] * y[u]) * weight
                sine[v % 2, u] = two * x[u] * y[u] * weight
            if v % 2:
                for u in range(q // 2):
                    a, e = 2 * u, 2 * u + 1
                    out[i, 0, v // 2, u] = (cosine[0, a] + cosine[0, e] + cosine[1, a] + cosine[1, e]) / four
                    out[i, 1, v // 2, u] = (sine[0, a] + sine[0, e] + sine[1, a] + sine[1, e]) / four


@compiled
@no_type_check
def lightness_gradient(values, half_strength2, out):
    """Loop of `directions`; `out` has cosine and sine of each cell of two pixels."""
    b, _, p, q = values.shape
    unit, two, three, four = np.float32(1.0), np.float32(2.0), np.float32(3.0), np.float32(4.0)
    grey = np.empty((p + 2, q + 2), np.float32)
    x, y = np.empty((2, q), np.float32), np.empty((2, q), np.float32)
    for i in range(b):
        for v in range(p):
            for u in range(q):
                grey[v + 1, u + 1] = (values[i, 0, v, u] + values[i, 1, v, u] + values[i, 2, v, u]) / three
            grey[v + 1, 0], grey[v + 1, q + 1] = grey[v + 1, 1], grey[v + 1, q]
        grey[0], grey[p + 1] = grey[1], grey[p]
        for v in range(p):
            above, here, below = grey[v], grey[v + 1], grey[v + 2]
            for u in range(q):
                across = (above[u + 2] - above[u]) + two * (here[u + 2] - here[u])
                dx = (across + (below[u + 2] - below[u])) / four
                down = (below[u] - above[u]) + two * (below[u + 1] - above[u + 1])
                dy = (down + (below[u + 2] - above[u + 2])) / four
                weight = unit / np.sqrt(dx * dx + dy * dy + half_strength2)
                x[v % 2, u], y[v % 2, u] = dx * weight, dy * weight
            if v % 2:
                for u in range(q // 2):
                    a, e = 2 * u, 2 * u + 1
                    out[i, 0, v // 2, u] = (x[0, a] + x[0, e] + x[1, a] + x[1, e]) / four
                    out[i, 1, v // 2, u] = (y[0, a] + y[0, e] + y[1, a] + y[1, e]) / four
