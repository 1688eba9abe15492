"""Refinement tables: the paper's totals from its own columns, names from sidecars, missing poses."""

from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from error_tables import errors_table
from evalkit.inputs.result_files import ResultFile, method_names
from evalkit.tables.model import Interval, best_cells
from evalkit.tables.paper_refinement import (
    Method,
    ablation_table,
    before_after_table,
    error_table,
    score_by_group_table,
)

# Table 1 of the paper: VSS of 13 LINEMOD objects, and the printed total.
LINEMOD_VSS = {
    "no refinement": (0.64, 0.65, 0.71, 0.72, 0.63, 0.62, 0.65, 0.64, 0.64, 0.69, 0.71, 0.63, 0.69),
    "2D edge-based ICP": (0.73, 0.67, 0.73, 0.76, 0.68, 0.67, 0.72, 0.73, 0.72, 0.71, 0.74, 0.67, 0.70),
    "ours": (0.83, 0.83, 0.75, 0.87, 0.79, 0.85, 0.87, 0.88, 0.85, 0.82, 0.85, 0.80, 0.83),
}
LINEMOD_TOTAL = {"no refinement": 0.66, "2D edge-based ICP": 0.71, "ours": 0.83}
# Table 2b: VSS of the six Tejani sequences for two losses and two trackers, and the printed totals.
TEJANI_VSS = {
    "ours": (0.803, 0.848, 0.850, 0.828, 0.766, 0.804),
    "MSE loss": (0.562, 0.717, 0.746, 0.613, 0.721, 0.700),
    "Kehl": (0.493, 0.747, 0.773, 0.523, 0.580, 0.648),
    "Tjaden": (0.385, 0.170, 0.298, 0.205, 0.514, 0.250),
}
TEJANI_TOTAL = {"ours": 0.817, "MSE loss": 0.676, "Kehl": 0.627, "Tjaden": 0.304}
TEJANI_FRAMES = (377, 501, 838, 556, 288, 604)  # as the table of SSD-6D (ICCV 2017) gives them


def file(name, **sidecar):
    return ResultFile(name=name, path=Path(f"{name}.csv"), sha256="", sidecar=sidecar, estimates=[])


def method_with(vss_by_object, poses, key="obj_id"):
    parts = [
        errors_table(count, vss=vss, **{key: number})
        for number, (vss, count) in enumerate(zip(vss_by_object, poses, strict=True), 1)
    ]
    return pd.concat(parts, ignore_index=True)


def test_totals_of_table_1_are_means_over_objects_whatever_their_number_of_poses():
    poses = range(5, 18)
    methods = [Method(name=name, table=method_with(vss, poses)) for name, vss in LINEMOD_VSS.items()]
    table = score_by_group_table(methods)
    for row in table.rows:
        name = row.cells["method"]
        assert round(row.cells["vss_mean_total"], 2) == LINEMOD_TOTAL[name]
        shown = [row.cells[f"vss_mean_{number}"] for number in range(1, 14)]
        assert shown == pytest.approx(LINEMOD_VSS[name])
    assert [column.heading for column in table.columns[:3]] == ["method", "object 1", "object 2"]
    assert {place for place, key in best_cells(table) if key == "vss_mean_total"} == {2}


def test_totals_of_table_2b_are_means_over_sequences_and_not_over_frames():
    methods = [Method(name=name, table=method_with(vss, TEJANI_FRAMES, "scene_id")) for name, vss in TEJANI_VSS.items()]
    table = ablation_table(methods)
    total = table.rows[-1]
    assert total.total
    for place, name in enumerate(TEJANI_VSS):
        # The printed sequences are rounded to three digits, so their mean is within half a digit of the printed total.
        assert total.cells[f"vss_mean_{place}"] == pytest.approx(TEJANI_TOTAL[name], abs=0.00101)
    by_pose = ablation_table(methods, mean_over="poses").rows[-1]
    weighted = np.average(TEJANI_VSS["ours"], weights=TEJANI_FRAMES)
    assert by_pose.cells["vss_mean_0"] == pytest.approx(weighted)
    assert abs(weighted - TEJANI_TOTAL["ours"]) > 0.006
    assert [row.cells["group"] for row in table.rows] == ["1", "2", "3", "4", "5", "6", "total"]
    assert best_cells(table) == {(place, "vss_mean_0") for place in range(7)}


def two_objects(**columns):
    """Three poses of object 1 and one of object 2."""
    return errors_table(4, obj_id=[1, 1, 1, 2], **columns)


def test_errors_are_means_along_each_axis_and_recall_is_at_a_tenth_of_the_diameter():
    start = two_objects(
        re_rad=np.deg2rad([10.0, 20.0, 30.0, 40.0]),
        re_sym_rad=np.deg2rad([10.0, 20.0, 30.0, 4.0]),
        dx_m=[0.001, -0.002, 0.003, -0.010],
        dy_m=[0.0, 0.0, 0.0, 0.004],
        dz_m=[-0.030, 0.030, 0.030, 0.050],
        add_m=[0.0099, 0.0100, 0.0101, 0.009],
        adi_m=[0.0099, 0.0100, 0.0101, 0.009],
    )
    cells = error_table([Method(name="a", table=start)]).rows[0].cells
    # Means over objects: object 1 has 20 degrees, object 2 has 40.
    assert cells["re_deg_mean"] == pytest.approx(30.0)
    assert cells["re_sym_deg_mean"] == pytest.approx(12.0)
    assert cells["tx_mm_mean"] == pytest.approx((2.0 + 10.0) / 2)
    assert cells["ty_mm_mean"] == pytest.approx(2.0)
    assert cells["tz_mm_mean"] == pytest.approx(40.0)
    assert cells["add_recall_0.1d"] == pytest.approx((1 / 3 + 1) / 2)
    cells = error_table([Method(name="a", table=start)], mean_over="poses").rows[0].cells
    assert cells["re_deg_mean"] == pytest.approx(25.0)
    assert cells["add_recall_0.1d"] == pytest.approx(0.5)


def test_a_missing_pose_fails_and_has_no_part_in_mean_errors():
    refined = two_objects(found=[True, True, False, True], re_rad=np.deg2rad([2.0, 4.0, 0.0, 6.0]), add_m=0.001)
    cells = error_table([Method(name="a", table=refined)], mean_over="poses").rows[0].cells
    assert (cells["expected"], cells["missing"]) == (4, 1)
    assert cells["re_deg_mean"] == pytest.approx(4.0)
    assert cells["add_recall_0.1d"] == pytest.approx(0.75)
    assert cells["vss_mean"] == pytest.approx(0.75)


def test_before_and_after_stand_together_for_each_object_and_in_both_totals():
    start, refined = two_objects(vss=[0.4, 0.5, 0.6, 0.9]), two_objects(vss=[0.7, 0.8, 0.9, 0.2])
    table = before_after_table([Method(name="no refinement", table=start), Method(name="ours", table=refined)])
    shown = {(row.cells["group"], row.cells["method"]): row.cells["vss_mean"] for row in table.rows}
    assert shown == {
        ("1", "no refinement"): pytest.approx(0.5),
        ("1", "ours"): pytest.approx(0.8),
        ("2", "no refinement"): pytest.approx(0.9),
        ("2", "ours"): pytest.approx(0.2),
        ("mean of objects", "no refinement"): pytest.approx(0.7),
        ("mean of objects", "ours"): pytest.approx(0.5),
        ("all poses", "no refinement"): pytest.approx(0.6),
        ("all poses", "ours"): pytest.approx(0.65),
    }
    better = {(table.rows[place].cells["group"], key) for place, key in best_cells(table) if key == "vss_mean"}
    assert better == {("1", "vss_mean"), ("2", "vss_mean"), ("mean of objects", "vss_mean"), ("all poses", "vss_mean")}


def test_an_object_that_a_method_did_not_do_is_empty():
    methods = [Method(name="a", table=two_objects(vss=0.5)), Method(name="b", table=errors_table(2, obj_id=1, vss=0.7))]
    rows = score_by_group_table(methods).rows
    assert np.isnan(rows[1].cells["vss_mean_2"])
    assert rows[1].cells["vss_mean_total"] == pytest.approx(0.7)


def test_intervals_of_totals_resample_whole_scenes():
    # Ten scenes, all poses of a scene alike: resampling poses would promise a third of this width.
    values = np.repeat(np.linspace(0.1, 1.0, 10), 10)
    table = errors_table(100, scene_id=np.repeat(np.arange(10), 10), vss=values)
    (row,) = error_table([Method(name="a", table=table)], resamples=1000).rows
    interval = row.cells["vss_mean"]
    assert isinstance(interval, Interval)
    assert interval.value == pytest.approx(0.55)
    # Standard error of a mean of ten such scenes: std / sqrt(9); t with 9 degrees of freedom at 97.5 %: 2.262.
    expected = 2 * 2.262 * np.linspace(0.1, 1.0, 10).std() / 3.0
    assert interval.high - interval.low == pytest.approx(expected, rel=0.12)


def test_names_come_from_sidecars():
    files = [
        file("init", method="initial"),
        file("a", method="refinenet", loss="contour"),
        file("b", method="refinenet", settings={"loss": "mse"}),
        file("c"),
        file("d", method="other"),
        file("e", method="other"),
    ]
    assert method_names(files) == [
        "no refinement",
        "refinenet, contour loss",
        "refinenet, mse loss",
        "c",
        "other (d)",
        "other (e)",
    ]


def test_sidecars_of_another_shape_do_not_break_names():
    assert method_names([file("a", method=5, settings=[1], loss=None), file("b", method="", settings=None)]) == [
        "a",
        "b",
    ]
