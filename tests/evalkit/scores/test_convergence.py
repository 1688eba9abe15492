"""Curves from perturbed starts: shares, errors and divergence at each level, counted by hand."""

import numpy as np
import pandas as pd
import pytest
from error_tables import errors_table
from evalkit.scores.convergence import by_level, by_level_and_object
from evalkit.tables.convergence import level_object_tables, level_tables
from evalkit.tables.model import Interval


def level(angle, rotation_deg, **columns):
    """Starts rotated by `angle`, with these final rotation errors (NaN: missing)."""
    rotation = np.deg2rad(np.array(rotation_deg, np.float64))
    found = ~np.isnan(rotation)
    rest = {"initial_translation_diameter": 0.0, "te_m": 0.0} | columns
    return errors_table(
        len(rotation), found=found, initial_angle_deg=angle, re_rad=rotation, re_sym_rad=rotation, **rest
    )


def moved(share, te_diameters, **columns):
    """Starts moved by `share` diameters of 0.1 m, with these final translation errors in diameters."""
    te = np.array(te_diameters, np.float64) * 0.1
    return errors_table(len(te), initial_translation_diameter=share, initial_angle_deg=0.0, te_m=te, **columns)


def test_shares_are_of_all_starts_and_means_are_of_found_ones():
    table = pd.concat([level(10.0, [1.0, 6.0, 12.0, np.nan]), level(45.0, [50.0, 2.0])])
    low, high = by_level(table)["angle"]
    assert (low["level"], low["expected"], low["found"]) == (10.0, 4, 3)
    assert [low[f"under_{limit}deg"] for limit in (5, 10, 15, 20, 30, 45)] == [0.25, 0.5, 0.75, 0.75, 0.75, 0.75]
    assert low["diverged"] == 0.25  # the missing one
    assert low["re_sym_deg_mean"] == pytest.approx(19.0 / 3.0)
    assert (high["under_5deg"], high["diverged"], high["re_sym_deg_mean"]) == (0.5, 0.5, pytest.approx(26.0))


def test_translation_thresholds_are_in_diameters_and_errors_in_both_units():
    table = pd.concat([moved(0.2, [0.04, 0.09, 0.15, 0.3]), moved(0.0, [0.0])])
    still, point = by_level(table)["translation"]
    assert still["level"] == 0.0
    assert [point[f"te_under_{limit:g}d"] for limit in (0.05, 0.1, 0.2, 0.5)] == [0.25, 0.5, 0.75, 1.0]
    assert point["te_diameter_mean"] == pytest.approx(0.145)
    assert point["te_mm_mean"] == pytest.approx(14.5)


def test_half_a_diameter_and_45_degrees_have_not_diverged_and_more_has():
    # "We define divergence if the refined rotation is above 45 degrees or the refined translation larger than half".
    table = moved(1.0, [0.5, 0.5 + 1e-9, 0.5001])
    assert by_level(table)["translation"][0]["diverged"] == pytest.approx(1 / 3)
    table = level(45.0, [45.0, 45.0 + 1e-7, 45.001])
    assert by_level(table)["angle"][0]["diverged"] == pytest.approx(1 / 3)


def test_an_error_of_exactly_the_limit_is_not_under_it():
    (point,) = by_level(level(5.0, [5.0, 5.0 - 1e-7, 4.999]))["angle"]
    assert point["under_5deg"] == pytest.approx(1 / 3)


def test_a_length_of_exactly_the_limit_is_not_under_it_either():
    (point,) = by_level(moved(0.1, [0.1, 0.1 - 1e-8, 0.0999]))["translation"]
    assert point["te_under_0.1d"] == pytest.approx(1 / 3)


def test_unperturbed_starts_lie_on_both_curves_and_random_ones_on_none():
    table = pd.concat([level(0.0, [0.0]), level(5.0, [1.0]), moved(0.1, [0.2]), errors_table(3)])
    curves = by_level(table)
    assert [(point["level"], point["expected"]) for point in curves["angle"]] == [(0.0, 1), (5.0, 1)]
    assert [(point["level"], point["expected"]) for point in curves["translation"]] == [(0.0, 1), (0.1, 1)]


def test_there_are_no_curves_without_perturbed_starts():
    assert by_level(errors_table(3)) == {}
    assert by_level(level(0.0, [0.0])) == {}
    assert by_level_and_object(errors_table(3)) == {}


def test_rotation_errors_are_at_the_best_symmetry():
    table = level(30.0, [179.0], symmetric=True)
    table["re_sym_rad"] = np.deg2rad(1.0)
    (point,) = by_level(table)["angle"]
    assert (point["under_5deg"], point["diverged"]) == (1.0, 0.0)
    assert point["re_deg_mean"] == pytest.approx(179.0)


def test_each_object_has_its_own_curves():
    table = pd.concat([level(10.0, [1.0, 2.0], obj_id=1), level(10.0, [8.0], obj_id=5)])
    curves = by_level_and_object(table)
    assert {obj_id: found["angle"][0]["under_5deg"] for obj_id, found in curves.items()} == {1: 1.0, 5: 0.0}
    assert by_level(table)["angle"][0]["under_5deg"] == pytest.approx(2 / 3)


def test_intervals_hold_the_value_and_come_from_whole_images():
    rng = np.random.default_rng(0)
    table = level(10.0, rng.uniform(0.0, 10.0, 200))
    (point,) = by_level(table, resamples=500)["angle"]
    low, high = point["intervals"]["under_5deg"]
    # A share p of 200 images has a standard error of sqrt(p (1 - p) / 200): about 0.035 for a half.
    p = point["under_5deg"]
    assert low < p < high
    assert high - low == pytest.approx(2 * 1.97 * np.sqrt(p * (1 - p) / 200), rel=0.15)


def test_tables_put_the_methods_of_a_level_side_by_side_and_mark_the_best():
    start = by_level(pd.concat([level(10.0, [10.0, 10.0]), level(20.0, [20.0, 20.0])]))
    refined = by_level(pd.concat([level(10.0, [1.0, 30.0]), level(20.0, [1.0, 2.0])]), resamples=50)
    (table,) = level_tables({"no refinement": start, "ours": refined})
    order = [(row.cells["level"], row.cells["method"]) for row in table.rows]
    assert order == [(10.0, "no refinement"), (10.0, "ours"), (20.0, "no refinement"), (20.0, "ours")]
    assert [row.group for row in table.rows] == [" 10", " 10", " 20", " 20"]
    assert table.best == "column"
    share = table.rows[1].cells["under_5deg"]
    assert isinstance(share, Interval)
    assert share.value == 0.5
    level_column = next(column for column in table.columns if column.key == "level")
    assert (level_column.digits, level_column.unit) == (0, "deg")


def test_a_single_method_needs_no_column_for_it_and_no_best():
    curves = by_level(pd.concat([moved(0.1, [0.1]), moved(0.25, [0.1])]))
    (table,) = level_tables({"ours": curves})
    assert "method" not in [column.key for column in table.columns]
    assert table.best == ""
    assert next(column.digits for column in table.columns if column.key == "level") == 2


def test_objects_get_a_block_each():
    table = pd.concat([level(10.0, [1.0], obj_id=5), level(20.0, [1.0], obj_id=5), level(10.0, [9.0], obj_id=1)])
    curves = {name: by_level_and_object(table) for name in ("a", "b")}
    (shown,) = level_object_tables(curves)
    blocks = [(row.cells["object"], row.cells["level"], row.cells["method"]) for row in shown.rows]
    assert blocks == [
        ("1", 10.0, "a"),
        ("1", 10.0, "b"),
        ("5", 10.0, "a"),
        ("5", 10.0, "b"),
        ("5", 20.0, "a"),
        ("5", 20.0, "b"),
    ]
