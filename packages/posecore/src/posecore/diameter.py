"""Largest distance between two points of a set, exact, in a time that grows with the set."""

import numpy as np
from jaxtyping import Float, Int

_BLOCK = 32
"""Points of a smallest block, at most."""
_PAIRS_AT_ONCE = 1024
"""Pairs of blocks that are compared point by point together: 25 MB."""
_HOPS = 4
_ROUNDING = 1e-12
"""Relative error of a bound, far above float64's."""

Boxes = tuple[np.ndarray, np.ndarray, np.ndarray]
"""Lowest and highest coordinates (b, 3), and largest squared radius (b) of blocks."""


def diameter(points_m: Float[np.ndarray, "v 3"]) -> float:
    """Largest distance between two points.

    Branch and bound over pairs of blocks of a kd-tree, level by level: a pair of blocks is split until its bound is
    below a distance that two points have. A pair's bound is the smaller of two. The first is the distance of the
    farthest corners. The second holds the spheres apart, where every point has one as far away as any: about a centre
    c, |p - q|^2 = 2 |p - c|^2 + 2 |q - c|^2 - |(2 c - p) - q|^2, so that q must be near to the mirror image of p.
    """
    points = np.asarray(points_m, np.float64)
    if len(points) < 2:
        return 0.0
    center = (points.min(axis=0) + points.max(axis=0)) / 2
    radius = np.linalg.norm(points - center, axis=1)
    longest2 = _two_far_points2(points, int(radius.argmax()))
    # Both ends are far from the centre: no nearer than their distance minus the largest radius.
    points = points[radius >= (1 - _ROUNDING) * (np.sqrt(longest2) - radius.max())]
    blocks = _in_blocks(points)
    pairs = np.zeros((1, 2), np.int64)
    for level, boxes in enumerate(_boxes(blocks - center)):
        pairs = pairs if level == 0 else _split(pairs)
        bounds2 = _bounds2(pairs, boxes)
        kept = bounds2 >= (1 - _ROUNDING) * longest2
        pairs, bounds2 = pairs[kept], bounds2[kept]
    order = np.argsort(-bounds2, kind="stable")
    for start in range(0, len(order), _PAIRS_AT_ONCE):
        part = order[start : start + _PAIRS_AT_ONCE]
        part = part[bounds2[part] >= (1 - _ROUNDING) * longest2]
        if not len(part):
            break
        longest2 = max(longest2, _farthest2(blocks[pairs[part, 0]], blocks[pairs[part, 1]]))
    return float(np.sqrt(longest2))


def _two_far_points2(points: Float[np.ndarray, "v 3"], start: int) -> float:
    """Squared distance of two points that are far apart: a few times from one to the farthest."""
    longest2 = 0.0
    for _ in range(_HOPS):
        distances2 = ((points - points[start]) ** 2).sum(axis=1)
        start = int(distances2.argmax())
        longest2 = max(longest2, float(distances2[start]))
    return longest2


def _in_blocks(points: Float[np.ndarray, "v 3"]) -> Float[np.ndarray, "b n 3"]:
    """Points in 2^k equally large, compact blocks: a kd-tree's leaves in order. The last point fills them up."""
    depth = max(0, int(np.ceil(np.log2(len(points) / _BLOCK))))
    size = -(-len(points) // 2**depth)
    blocks = np.concatenate([points, np.repeat(points[-1:], size * 2**depth - len(points), axis=0)])[None]
    for _ in range(depth):
        axis = np.ptp(blocks, axis=1).argmax(axis=1)
        along = np.take_along_axis(blocks, axis[:, None, None], axis=2)[..., 0]
        order = np.argpartition(along, along.shape[1] // 2, axis=1)
        blocks = np.take_along_axis(blocks, order[..., None], axis=1).reshape(2 * len(blocks), -1, 3)
    return np.asarray(blocks)


def _boxes(blocks: Float[np.ndarray, "b n 3"]) -> list[Boxes]:
    """Box and largest squared radius about the origin of each block: of the whole set first, then of its halves."""
    low, high, radius2 = blocks.min(axis=1), blocks.max(axis=1), (blocks**2).sum(axis=2).max(axis=1)
    levels = [(low, high, radius2)]
    while len(low) > 1:
        low, high = np.minimum(low[::2], low[1::2]), np.maximum(high[::2], high[1::2])
        radius2 = np.maximum(radius2[::2], radius2[1::2])
        levels.append((low, high, radius2))
    return levels[::-1]


def _bounds2(pairs: Int[np.ndarray, "p 2"], boxes: Boxes) -> Float[np.ndarray, " p"]:
    """Upper bound of the squared distance between a point of one block and one of the other; c is the origin."""
    low, high, radius2 = boxes
    first, second = pairs.T
    corners = np.maximum(high[first] - low[second], high[second] - low[first])
    gap = np.maximum(low[first] + low[second], -(high[first] + high[second]))
    mirrored = 2 * (radius2[first] + radius2[second]) - (np.maximum(gap, 0.0) ** 2).sum(axis=1)
    return np.asarray(np.minimum((corners**2).sum(axis=1), mirrored))


def _split(pairs: Int[np.ndarray, "p 2"]) -> Int[np.ndarray, "q 2"]:
    """Pairs of the halves of paired blocks, each once."""
    children = (2 * pairs[:, None] + np.array([[0, 0], [0, 1], [1, 0], [1, 1]])).reshape(-1, 2)
    return np.asarray(children[children[:, 0] <= children[:, 1]])


def _farthest2(first: Float[np.ndarray, "p n 3"], second: Float[np.ndarray, "p n 3"]) -> float:
    """Largest squared distance between points of paired blocks."""
    return float(((first[:, :, None] - second[:, None]) ** 2).sum(axis=-1).max())
