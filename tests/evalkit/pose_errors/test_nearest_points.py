"""Nearest points along the Delaunay graph against a k-d tree, on models that are hard for a triangulation."""

import numpy as np
import pytest
from evalkit.pose_errors import nearest_points
from evalkit.pose_errors.nearest_points import NearestPoints
from posecore import se3
from scipy.spatial import cKDTree

GRID = 0.01 * np.stack(np.meshgrid(*[np.arange(8.0)] * 3), -1).reshape(-1, 3)
TURNS, TILTS = (grid.ravel() for grid in np.meshgrid(np.linspace(0, 2 * np.pi, 40), np.linspace(0, np.pi, 20)))
UV_SPHERE = 0.05 * np.stack([np.cos(TURNS) * np.sin(TILTS), np.sin(TURNS) * np.sin(TILTS), np.cos(TILTS)], -1)
MODELS = {
    "cloud": np.random.default_rng(0).normal(size=(300, 3)),
    "grid: all cells are cospherical": GRID,
    "points twice": np.concatenate([GRID, GRID[:100]]),
    "points nearly twice": np.concatenate([GRID, GRID[:50] + 1e-15]),
    "sphere with many points at its poles": UV_SPHERE,
    "plane": np.concatenate([GRID[:, :2], np.zeros((len(GRID), 1))], axis=1),
    "tetrahedron": np.eye(4)[:, :3],
    "one point": np.zeros((1, 3)),
}


def poses(seed, count=40):
    rng = np.random.default_rng(seed)
    return np.stack([se3.make_T(se3.random_rotation(rng), 0.03 * rng.normal(size=3)) for _ in range(count)])


def tree_distances(T_est, T_gt, points_m):
    return [
        cKDTree(se3.apply(estimate, points_m)).query(se3.apply(gt, points_m))[0].mean()
        for estimate, gt in zip(T_est, T_gt, strict=True)
    ]


@pytest.mark.parametrize("first_graph", [1, 10_000])
@pytest.mark.parametrize("name", MODELS)
def test_distances_are_those_of_a_tree(name, first_graph, monkeypatch):
    monkeypatch.setattr(nearest_points, "GRAPH_FROM", first_graph)
    points_m, T_est, T_gt = MODELS[name], poses(1), poses(2)
    found = NearestPoints(points_m)
    np.testing.assert_allclose(found.mean_distance_m(T_est, T_gt), tree_distances(T_est, T_gt, points_m), atol=1e-15)
    assert found.mean_distance_m(T_est, T_est).max() == 0


def test_nearly_rigid_poses_as_in_annotations(monkeypatch):
    monkeypatch.setattr(nearest_points, "GRAPH_FROM", 1)
    points_m = MODELS["cloud"]
    T_est, T_gt = poses(3), poses(4)
    for skew in (0.003, 0.1):
        T_est[:, :3, :3] += np.random.default_rng(0).uniform(-skew, skew, (len(T_est), 3, 3))
        expected = tree_distances(T_est, T_gt, points_m)
        np.testing.assert_allclose(NearestPoints(points_m).mean_distance_m(T_est, T_gt), expected, rtol=1e-6)


def test_the_graph_is_made_once_it_pays(monkeypatch):
    made = []
    monkeypatch.setattr(nearest_points, "_delaunay_graph", lambda points_m: made.append(len(points_m)))
    points = NearestPoints(GRID)
    for _ in range(4):
        points.mean_distance_m(poses(5, 16), poses(6, 16))
    assert made == [len(GRID)]
