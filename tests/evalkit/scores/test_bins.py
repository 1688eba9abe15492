"""Bins: every row in at most one, counts and values by hand, intervals where there are units."""

import numpy as np
import pytest
from error_tables import errors_table
from evalkit.scores import scores
from evalkit.scores.bins import (
    AZIMUTH_EDGES_DEG,
    ELEVATION_EDGES_DEG,
    binned,
    by_azimuth,
    by_distance,
    by_elevation,
    by_viewpoint,
    by_visibility,
    round_edges,
)
from posecore.errors import ConfigError


def test_values_and_counts_by_hand():
    table = errors_table(
        5, visib_fract=[0.05, 0.31, 0.39, 0.3, np.nan], vss=[0.1, 0.5, 0.7, 0.9, 0.2], found=[True] * 3 + [False, True]
    )
    bins = by_visibility(table, scores=["vss_mean", "vss_mean_found"])
    assert bins.visib_fract_low.unique().tolist() == [0.0, 0.3]
    low, low_found, high, high_found = bins.to_dict("records")
    assert (low["expected"], low["found"], low["value"]) == (1, 1, 0.1)
    assert (high["expected"], high["found"], high["rows"]) == (3, 2, 3)
    assert high["value"] == pytest.approx(0.4)
    assert (high_found["score"], high_found["rows"]) == ("vss_mean_found", 2)
    assert high_found["value"] == pytest.approx(0.6)
    assert low_found["visib_fract_high"] == 0.1


def test_edges_belong_to_the_upper_bin_but_the_last_holds_its_own():
    table = errors_table(4, visib_fract=[0.0, 0.5, 0.7, 1.0])
    bins = by_visibility(table, edges=(0.0, 0.5, 1.0), scores=["vss_mean"])
    assert bins.expected.tolist() == [1, 3]


def test_every_row_is_in_one_bin_of_every_axis():
    rng = np.random.default_rng(0)
    rows = 300
    table = errors_table(
        rows,
        visib_fract=rng.uniform(size=rows),
        distance_m=rng.uniform(0.4, 1.7, size=rows),
        view_azimuth_deg=rng.uniform(-180, 180, size=rows),
        view_elevation_deg=np.concatenate([[-90.0, 90.0], rng.uniform(-90, 90, size=rows - 2)]),
        vss=rng.uniform(size=rows),
    )
    for by in (by_visibility, by_distance, by_azimuth, by_elevation, by_viewpoint):
        bins = by(table, scores=["vss_mean"], resamples=20)
        assert bins.expected.sum() == rows, by.__name__
        assert (bins.value * bins.expected).sum() / rows == pytest.approx(scores(table)["vss_mean"])
    grid = by_viewpoint(table, scores=["vss_mean"], resamples=0)
    assert len(grid) <= (len(AZIMUTH_EDGES_DEG) - 1) * (len(ELEVATION_EDGES_DEG) - 1)
    assert set(grid.columns) >= {"view_azimuth_deg_low", "view_elevation_deg_high", "value", "low", "high"}
    assert grid.low.isna().all()


def test_a_bin_scores_as_its_rows_alone():
    rng = np.random.default_rng(1)
    table = errors_table(60, distance_m=rng.uniform(0.5, 1.0, 60), re_sym_rad=rng.uniform(0, 1, 60))
    bins = by_distance(table, edges_m=(0.5, 0.7, 1.0), scores=["re_sym_deg_median"])
    alone = scores(table[table.distance_m < 0.7])["re_sym_deg_median"]
    assert bins.value[0] == alone
    assert bins.low[0] <= alone <= bins.high[0]
    assert bins.units[0] == (table.distance_m < 0.7).sum()


def test_a_bin_of_one_image_has_no_interval():
    table = errors_table(4, visib_fract=[0.1, 0.9, 0.9, 0.9], vss=[0.1, 0.5, 0.6, 0.7])
    bins = by_visibility(table, scores=["vss_mean"])
    assert np.isnan(bins.low[0])
    assert bins.units.tolist() == [1, 3]
    assert np.isfinite(bins.low[1])


def test_round_edges_hold_everything():
    for values in ([0.52, 1.31], [0.7, 0.7], [3.0, 95.0], [0.31, 0.3100001], [-0.2, 0.2]):
        edges = round_edges(np.array(values))
        assert edges[0] <= min(values)
        assert edges[-1] >= max(values)
        assert 2 <= len(edges) <= 9
    assert round_edges(np.array([0.52, 1.31])) == (0.4, 0.6, 0.8, 1.0, 1.2, 1.4)


def test_mistakes_are_named():
    table = errors_table(2)
    with pytest.raises(ConfigError, match=r"no score nonsense; there are vss_mean"):
        binned(table, {"visib_fract": (0.0, 1.0)}, scores=["nonsense"])
    with pytest.raises(ConfigError, match="no column weather"):
        binned(table, {"weather": (0.0, 1.0)})
    with pytest.raises(ConfigError, match="rising"):
        binned(table, {"visib_fract": (1.0, 0.5)})


def test_no_rows_give_no_bins():
    assert by_visibility(errors_table(3, visib_fract=np.nan)).empty
    assert by_distance(errors_table(0)).empty
