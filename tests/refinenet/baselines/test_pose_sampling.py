"""The search's evolution strategy, with scores that need no image."""

import numpy as np
import pytest
from posecore import se3
from posecore.errors import ConfigError
from refinenet.baselines.global_search import GradientSearch
from refinenet.baselines.pose_sampling import PoseSampler, sample_offsets
from refinenet.baselines.search_config import Round, SearchConfig

from .test_baselines import distances


def test_first_draws_have_the_configured_range():
    config = SearchConfig(initial_round=Round(4000, 10, 0), max_angle_rad=0.5, shift_std=0.2, log_depth_std=0.03)
    offsets = sample_offsets(config, np.random.default_rng(0))
    assert offsets.shape == (4000, 6)
    assert (offsets[0] == 0).all()
    angle_rad = np.linalg.norm(offsets[:, :3], axis=1)
    assert 0.49 < angle_rad.max() <= 0.5
    np.testing.assert_allclose(offsets[:, 3:].std(axis=0), [0.2, 0.2, 0.03], rtol=0.05)


def test_candidates_converge_to_the_maxima_of_the_score(tug):
    """Two maxima, of which the second is lower: both are candidates, in this order."""
    initial = se3.make_T(np.eye(3), np.array([0.0, 0.0, 0.7]))
    rng = np.random.default_rng(1)
    best = se3.perturb(initial, np.deg2rad(30), 0.1 * tug.diameter_m, rng)
    second = se3.perturb(initial, np.deg2rad(40), 0.1 * tug.diameter_m, rng)
    points_m = tug.vertices_m[::50]

    def score(T_cam_obj, spread_px):
        off = [
            np.linalg.norm(se3.apply(T_cam_obj, points_m) - se3.apply(T, points_m), axis=-1).mean(axis=-1)
            for T in (best, second)
        ]
        near, other = (np.exp(-d / (0.1 * tug.diameter_m)) for d in off)
        return np.maximum(near, 0.95 * other)

    found = PoseSampler(initial, tug, score, SearchConfig(), np.random.default_rng(2)).candidates()
    assert distances(tug, best, found[0]) < 0.02
    assert min(distances(tug, second, T) for T in found[1:]) < 0.05


@pytest.mark.parametrize(
    "wrong",
    [{"candidates": 0}, {"std_decay": 0.0}, {"resample_std": (0.1,)}, {"rounds": (Round(10, 20, 1),)}],
)
def test_impossible_constants_are_refused(wrong):
    with pytest.raises(ConfigError, match="expected"):
        SearchConfig(**wrong)


def test_settings_hold_the_constants_that_differ(tug):
    for config, changed in ((SearchConfig(), None), (SearchConfig(candidates=4), {"candidates": 4})):
        refiner = GradientSearch({1: tug}, config=config)
        settings = refiner.settings
        refiner.close()
        assert settings.get("search") == changed
        assert settings["min_confidence"] == 0.4
