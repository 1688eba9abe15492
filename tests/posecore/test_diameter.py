"""The diameter of a point set: exact, and with work that grows with the set."""

import numpy as np
import pytest
import trimesh
from posecore import diameter as module
from posecore.diameter import diameter
from scipy.spatial.distance import cdist


def brute_force(points: np.ndarray) -> float:
    return float(max(cdist(points[i : i + 256], points).max() for i in range(0, len(points), 256)))


def sphere(subdivisions: int) -> np.ndarray:
    return np.asarray(trimesh.creation.icosphere(subdivisions).vertices, np.float64)


def reuleaux(n: int) -> np.ndarray:
    """Points on the arcs of a Reuleaux triangle: every one of them has another at the largest distance."""
    corners = np.array([[0.0, 0.0], [1.0, 0.0], [0.5, np.sqrt(0.75)]])
    angle = np.linspace(0, np.pi / 3, n)
    arcs = [
        c + np.stack([np.cos(a + angle), np.sin(a + angle)], -1)
        for c, a in zip(corners, (0, 2.0944, 4.1888), strict=True)
    ]
    return np.column_stack([np.concatenate(arcs), np.zeros(3 * n)])


def sets() -> dict[str, np.ndarray]:
    rng = np.random.default_rng(0)
    ball = sphere(4)
    return {
        "sphere": ball,
        "rough sphere": ball * (1 + 0.02 * rng.random((len(ball), 1))),
        "ellipsoid far off its origin": ball * [1.0, 0.7, 0.4] + [1000.0, -300.0, 20.0],
        "cloud": rng.normal(size=(3000, 3)),
        "box of many vertices": np.asarray(trimesh.creation.box().subdivide().subdivide().subdivide().vertices),
        "tetrahedron of many vertices": np.concatenate(
            [rng.dirichlet(np.ones(4), 2000) @ np.array([[1, 1, 1], [1, -1, -1], [-1, 1, -1], [-1, -1, 1]])]
        ),
        "constant width": reuleaux(400),
        "flat disc": np.column_stack([np.cos(np.arange(900.0)), np.sin(np.arange(900.0)), np.zeros(900)]),
        "line": np.column_stack([np.arange(300.0), np.zeros(300), np.zeros(300)]),
        "repeated vertices": np.repeat(sphere(2), 6, axis=0),
        "two": np.array([[0.0, 0, 0], [0, 3, 4]]),
    }


@pytest.mark.parametrize("name", list(sets()))
def test_it_is_the_largest_of_all_distances(name: str) -> None:
    points = sets()[name]
    assert diameter(points) == brute_force(points)


def test_it_is_exact_whichever_pairs_are_compared_first(monkeypatch: pytest.MonkeyPatch) -> None:
    """Few pairs of blocks at a time: the rest is left out only where its bound is below a distance that was found."""
    monkeypatch.setattr(module, "_PAIRS_AT_ONCE", 4)
    ball = sphere(3)
    for seed in range(20):
        points = ball * (1 + 0.02 * np.random.default_rng(seed).random((len(ball), 1)))
        assert diameter(points) == brute_force(points)


def test_fewer_than_two_points_have_none() -> None:
    assert diameter(np.zeros((0, 3))) == diameter(np.ones((1, 3))) == diameter(np.ones((5, 3))) == 0.0


@pytest.mark.parametrize("rough", [0.0, 0.01])
def test_work_grows_with_the_sphere_not_with_its_square(monkeypatch: pytest.MonkeyPatch, rough: float) -> None:
    """Distances and bounds of spheres, the hardest sets: four times the points are no more than six times the work."""
    work = []
    farthest2, bounds2 = module._farthest2, module._bounds2

    def counted_distances(first: np.ndarray, second: np.ndarray) -> float:
        work[-1] += first.shape[0] * first.shape[1] * second.shape[1]
        return farthest2(first, second)

    def counted_bounds(pairs: np.ndarray, *boxes: object) -> np.ndarray:
        work[-1] += len(pairs)
        return bounds2(pairs, *boxes)

    monkeypatch.setattr(module, "_farthest2", counted_distances)
    monkeypatch.setattr(module, "_bounds2", counted_bounds)
    for subdivisions in (4, 5, 6):
        points = sphere(subdivisions)
        points *= 1 + rough * np.random.default_rng(1).random((len(points), 1))
        work.append(0)
        diameter(points)
    assert work[1] < 6 * work[0] and work[2] < 6 * work[1]
    assert work[2] < 100 * len(points)
