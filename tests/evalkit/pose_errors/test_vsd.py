"""VSD: a plain twin of its definition, cases worked by hand, and BOP's recalls of whole files."""

from dataclasses import replace

import numpy as np
import pytest
from evalkit import evaluate
from evalkit.pose_errors import metrics
from evalkit.pose_errors.metrics import VSD_COLUMNS, VSD_TAUS
from evalkit.scores import scores
from posecore.bop import write_results


def plain_vsd(est, gt, scene, tau, delta=0.015):
    """The definition, pixel by pixel."""
    union = cost = 0
    for e, g, s in zip(est.ravel(), gt.ravel(), scene.ravel(), strict=True):
        sees_gt = g > 0 and (s == 0 or g - s <= delta)
        sees_est = e > 0 and (s == 0 or e - s <= delta or sees_gt)
        union += sees_gt or sees_est
        if sees_gt and sees_est:
            cost += abs(g - e) >= tau
        else:
            cost += sees_gt or sees_est
    return cost / union if union else 1.0


@pytest.mark.parametrize("seed", range(100))
def test_vsd_is_its_definition(seed):
    """Random renders before a random scene: holes in all three, occluders nearer and farther than the tolerance."""
    rng = np.random.default_rng(seed)
    est, gt = (rng.uniform(0.9, 1.1, (2, 6, 7)) * (rng.random((2, 6, 7)) < 0.6) for _ in range(2))
    scene = rng.uniform(0.9, 1.1, (2, 6, 7)) * (rng.random((2, 6, 7)) < 0.8)
    taus = 0.2 * VSD_TAUS
    values = metrics.vsd(est, gt, scene, taus)
    expected = [[plain_vsd(est[i], gt[i], scene[i], tau) for tau in taus] for i in range(2)]
    np.testing.assert_allclose(values, expected, rtol=0, atol=1e-12)


@pytest.mark.parametrize(
    ("est", "gt", "scene", "expected"),
    [
        ([1, 1, 0, 0], [1, 1, 0, 0], [1, 1, 1, 1], 0.0),  # the same
        ([0, 1, 1, 0], [1, 1, 0, 0], [1, 1, 1, 1], 2 / 3),  # moved by a pixel: one of three shared
        ([0, 0, 0, 0], [0, 0, 0, 0], [1, 1, 1, 1], 1.0),  # neither in the image
        ([0, 0, 0, 0], [1, 1, 0, 0], [1, 1, 1, 1], 1.0),  # the estimate off the image or behind the camera
        ([1, 1, 0, 0], [1, 1, 0, 0], [0.5, 1, 1, 1], 0.0),  # an occluded pixel has no part
        ([1, 1, 0, 0], [1, 1, 0, 0], [0.5, 0.5, 1, 1], 1.0),  # wholly occluded: nothing visible
        ([1, 0, 0, 0], [0, 1, 0, 0], [0, 0, 0, 0], 1.0),  # unmeasured counts as visible, one pixel each
        ([1.25, 1, 0, 0], [1, 1, 0, 0], [1, 1, 1, 1], 0.5),  # visible where the truth is; a quarter metre off
        ([1.25, 1.25, 1, 0], [1, 1, 1, 0], [0, 0, 0, 0], 2 / 3),  # an error of exactly the tolerance is an error
    ],
)
def test_vsd_by_hand(est, gt, scene, expected):
    rows = [np.array([row], np.float64) for row in (est, gt, scene)]
    assert metrics.vsd(*rows, np.array([0.25]))[0] == pytest.approx(expected, abs=1e-15)


def test_distance_along_bops_rays():
    """bop_toolkit's (j - cx) / fx at column 3 of K with fx 2, cx 1: X = Z, so the distance is Z times root two."""
    K = np.array([[2.0, 0, 1], [0, 2.0, 0], [0, 0, 1]])
    assert metrics.distance_from_depth(K, np.full((1, 4), 5.0), ray_px=metrics.BOP_RAY_PX)[0, 3] == 5.0 * np.sqrt(2.0)


def test_truth_as_a_file_scores_one(dataset, perfect, tmp_path):
    write_results(tmp_path / "r.csv", perfect)
    table = evaluate(dataset.root, tmp_path / "r.csv")
    total = scores(table)
    assert [total[name] for name in ("ar", "ar_vsd", "ar_mssd", "ar_mspd", "vss_mean")] == [1.0] * 5
    assert (table[list(VSD_COLUMNS)] == 0.0).all(axis=None)


def test_missing_and_duplicate_estimates_as_bop_counts_them(dataset, perfect, tmp_path):
    """Six targets: one is not estimated, one has a wrong duplicate of lower score, one a wrong one of higher score."""
    far = perfect[0].T_cam_obj.copy()
    far[:3, 3] += 1.0
    lower = replace(perfect[0], T_cam_obj=far, score=0.5)
    higher = replace(perfect[1], T_cam_obj=far, score=2.0)
    write_results(tmp_path / "r.csv", [lower, higher, *perfect[:5]])
    total = scores(evaluate(dataset.root, tmp_path / "r.csv"))
    assert total["missing"] == 1
    for name in ("ar", "ar_vsd", "ar_mssd", "ar_mspd"):
        assert total[name] == pytest.approx(4 / 6)
