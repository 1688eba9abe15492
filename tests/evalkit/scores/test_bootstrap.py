"""Bootstrap intervals: exact against plain resampling, right as often as they promise, fast, and honest about units."""

import time

import numpy as np
import pytest
from error_tables import errors_table
from evalkit.scores import scores
from evalkit.scores.bootstrap import (
    MAX_UNITS,
    outer_percentiles,
    resample,
    score_intervals,
    units_of,
)
from evalkit.scores.per_pose import Values
from posecore.errors import ConfigError


def plain(statistic, values, resampling):
    """The slow definition: write every resample out row by row."""
    result = []
    for weights in resampling.weights:
        rows = np.repeat(values, weights[resampling.units.of_row].astype(int))
        rows = rows[~np.isnan(rows)]
        result.append(statistic(rows) if len(rows) else np.nan)
    return np.array(result)


def some_table(seed, rows=400, scenes=9):
    rng = np.random.default_rng(seed)
    return errors_table(rows, scene_id=rng.integers(0, scenes, rows), vss=rng.uniform(size=rows))


def test_resampled_scores_are_those_of_the_rows_written_out():
    table = some_table(0)
    rng = np.random.default_rng(1)
    values = np.round(rng.gamma(1.0, size=len(table)), 1)  # many ties
    values[rng.uniform(size=len(table)) < 0.2] = np.nan
    values[table.scene_id.to_numpy() == 3] = np.nan
    resampling = resample(units_of(table), 60)
    np.testing.assert_allclose(resampling.means(values[None])[0], plain(np.mean, values, resampling), rtol=1e-12)
    np.testing.assert_array_equal(resampling.medians(values), plain(np.median, values, resampling))


@pytest.mark.parametrize("rows", [1, 2, 63, 64, 65, 4097])
def test_medians_are_exact_for_any_number_of_rows(rows):
    values = np.random.default_rng(rows).normal(size=rows)
    resampling = resample(units_of(errors_table(rows)), 40)
    np.testing.assert_array_equal(resampling.medians(values), plain(np.median, values, resampling))


def test_an_interval_is_deterministic_and_depends_on_the_seed():
    table = some_table(2)
    first, again, other = (score_intervals(table, seed=seed).intervals["vss_mean"] for seed in (5, 5, 6))
    assert first == again != other
    low, high = first
    assert low < scores(table)["vss_mean"] < high


def test_a_shift_of_the_rows_order_changes_nothing():
    table = some_table(3)
    shuffled = table.sample(frac=1.0, random_state=0)
    both = [score_intervals(part).intervals["vss_mean"] for part in (table, shuffled)]
    np.testing.assert_allclose(both[0], both[1], rtol=1e-12)


def test_scenes_are_resampled_and_images_where_there_is_one_scene():
    assert units_of(some_table(4)).text == "9 scenes"
    alone = units_of(errors_table(30))
    assert (alone.kind, alone.text, alone.count) == ("image", "30 images", 30)
    assert score_intervals(errors_table(30)).text == "30 images"


def test_two_objects_of_an_image_are_drawn_together():
    units = units_of(errors_table(6, im_id=[7, 7, 8, 8, 9, 9]))
    assert units.count == 3
    assert units.of_row.tolist() == [0, 0, 1, 1, 2, 2]


def test_blocks_of_a_sequence_stay_within_their_scene():
    table = errors_table(10, scene_id=[1] * 5 + [2] * 5, im_id=[0, 10, 20, 30, 40, 3, 4, 5, 6, 7])
    units = units_of(table, block_images=2)
    assert units.of_row.tolist() == [0, 0, 1, 1, 2, 3, 3, 4, 4, 5]
    assert units.text == "6 blocks of 2 images"
    with pytest.raises(ConfigError, match="block_images: found 0"):
        units_of(table, block_images=0)


def test_very_many_images_are_joined_to_blocks():
    units = units_of(errors_table(3 * MAX_UNITS + 1))
    assert units.count <= MAX_UNITS
    assert units.text == f"{units.count} blocks of 4 images"
    assert (np.diff(units.of_row) >= 0).all()


def test_one_unit_has_no_interval():
    table = errors_table(4, im_id=3, vss=[0.1, 0.2, 0.3, 0.4])
    assert score_intervals(table).intervals["vss_mean"] is None
    assert score_intervals(errors_table(0)).intervals["vss_mean"] is None


def test_a_score_known_in_one_unit_only_has_no_interval():
    table = errors_table(3, found=[True, False, False], re_rad=0.1)
    intervals = score_intervals(table).intervals
    assert intervals["re_deg_mean"] is None
    assert intervals["re_deg_median"] is None
    assert intervals["vss_mean"] is not None


def test_infinite_errors_have_no_interval_but_their_median_has():
    table = errors_table(20, mspd_px=[*range(19), np.inf])
    intervals = score_intervals(table).intervals
    assert intervals["mspd_px_mean"] is None
    assert intervals["mspd_px_median"] is not None


def test_equal_values_give_an_interval_without_width():
    table = errors_table(20, vss=0.25, re_rad=np.deg2rad(4.0))
    intervals = score_intervals(table).intervals
    assert intervals["vss_mean"] == (0.25, 0.25)
    np.testing.assert_allclose(intervals["re_deg_median"], (4.0, 4.0), rtol=1e-12)


def test_the_percentiles_are_those_of_a_t_interval():
    # t quantile 0.975 with 29 degrees of freedom is 2.0452; times sqrt(30/29) 2.0802; normal tail 0.01876.
    low, high = outer_percentiles(30)
    assert low == pytest.approx(0.01876, abs=1e-5)
    assert low + high == pytest.approx(1.0)
    assert outer_percentiles(10**6)[0] == pytest.approx(0.025, abs=1e-5)


@pytest.mark.slow
@pytest.mark.parametrize(("scenes", "least"), [(40, 0.92), (6, 0.88)])
@pytest.mark.parametrize("statistic", ["mean", "median"])
def test_intervals_hold_the_truth_as_often_as_they_promise(scenes, least, statistic):
    # Scenes differ by a normal with sd 1, poses of a scene by one with sd 1: mean and median are 0. Resampling single
    # poses instead of scenes would hold the truth in under 70 of 100 repetitions.
    rng = np.random.default_rng(11)
    each, trials = 15, 300
    units = units_of(errors_table(scenes * each, scene_id=np.repeat(np.arange(scenes), each)))
    held = 0
    for trial in range(trials):
        values = np.repeat(rng.normal(size=scenes), each) + rng.normal(size=scenes * each)
        low, high = resample(units, 300, trial).interval(Values(per_row=values, statistic=statistic))
        held += low <= 0.0 <= high
    assert least <= held / trials <= 0.985


@pytest.mark.slow
def test_two_hundred_thousand_rows_take_seconds():
    rng = np.random.default_rng(0)
    rows = 200_000
    table = errors_table(
        rows,
        im_id=np.arange(rows) // 8,
        vss=rng.uniform(size=rows),
        **{name: rng.gamma(2.0, 0.01, size=rows) for name in ("add_m", "adi_m", "mssd_m", "re_rad", "dx_m", "dz_m")},
    )
    start = time.process_time()
    intervals = score_intervals(table)
    seconds = time.process_time() - start
    assert intervals.units <= MAX_UNITS
    low, high = intervals.intervals["add_mm_median"]
    assert low < scores(table)["add_mm_median"] < high
    assert seconds < 12, f"{seconds:.1f} s of CPU"
