"""Scores: worked by hand, against a plain twin of BOP's rules, and against numbers that bop_toolkit printed."""

import numpy as np
import pandas as pd
import pytest
from error_tables import errors_table
from evalkit.pose_errors.metrics import VSD_COLUMNS
from evalkit.scores import (
    DEFINITIONS,
    AllErrors,
    bop19_recalls,
    bop24_precision,
    by_object,
    scores,
    solved,
    with_bop19,
)
from evalkit.scores.bop_matching import average_precision, greedy_matches, ranks, target_instances
from evalkit.scores.definitions import MSPD_PX, MSSD_DIAMETERS, VSD_LIMITS
from evalkit.scores.per_pose import under

NAN = float("nan")


def everything(instances, estimates, errors):
    """`AllErrors` from short rows: truths (scene, image, object, visible, asked), estimates (scene, image, object,
    score), errors (estimate, truth, MSSD in diameters of 0.1 m, MSPD in px of an image 640 wide)."""
    ids = ["scene_id", "im_id", "obj_id"]
    truth_table = pd.DataFrame(instances, columns=[*ids, "visib_fract", "inst_count"])
    truth_table["gt_index"] = truth_table.groupby(["scene_id", "im_id"]).cumcount()
    truth_table["diameter_m"], truth_table["image_width_px"] = 0.1, 640
    estimate_table = pd.DataFrame(estimates, columns=[*ids, "score"])
    estimate_table["line"] = np.arange(len(estimate_table)) + 2
    error_table = pd.DataFrame(errors, columns=["estimate", "instance", "mssd_m", "mspd_px"])
    error_table["mssd_m"] *= 0.1
    return AllErrors(estimates=estimate_table, instances=truth_table, errors=error_table)


# Plain means and shares


def test_truth_against_itself_is_perfect():
    result = scores(errors_table(3, **dict.fromkeys(VSD_COLUMNS, 0.0)))
    best = ("recall", "auc", "ar", "vss", "5cm5deg", "proj_5px")
    for name, value in result.items():
        if name.startswith(best) or any(part in name for part in ("recall", "auc")):
            assert value == (0.0 if name.startswith("proj_px") else 1.0), name
    assert result["diverged"] == 0.0
    assert result["missing"] == 0


def test_missing_estimates_fail_in_every_share_and_have_no_errors():
    table = errors_table(4, found=[True, True, False, False], re_rad=np.deg2rad(3.0), dz_m=-0.002)
    for name in VSD_COLUMNS:
        table[name] = np.where(table.found, 0.0, np.nan)
    result = scores(table)
    assert (result["expected"], result["found"], result["missing"]) == (4, 2, 2)
    halves = [name for name in result if any(part in name for part in ("recall", "auc", "ar_")) or name == "ar"]
    assert len(halves) == 14
    for name in (*halves, "vss_mean", "5cm5deg", "proj_5px", "diverged"):
        assert result[name] == pytest.approx(0.5, abs=1e-12), name
    assert result["vss_mean_found"] == 1.0
    assert result["re_deg_mean"] == pytest.approx(3.0)
    assert result["tz_mm_median"] == pytest.approx(2.0)


def test_nothing_found_leaves_errors_without_a_value():
    result = scores(errors_table(2, found=False))
    assert result["add_s_recall_0.1d"] == 0.0
    assert np.isnan(result["re_deg_mean"])
    assert np.isnan(result["add_mm_median"])
    assert np.isnan(scores(errors_table(0))["vss_mean"])


def test_recall_means_strictly_under_a_tenth_of_the_diameter():
    table = errors_table(3, diameter_m=0.1, add_m=[0.00999, 0.01, 0.011])  # 10 of 100 mm are not under
    assert scores(table)["add_recall_0.1d"] == pytest.approx(1 / 3)
    assert solved(table).tolist() == [True, False, False]
    assert solved(table, limit_diameters=0.2).all()


def test_add_s_takes_the_nearest_point_for_symmetric_objects_only():
    table = errors_table(2, symmetric=[True, False], add_m=0.05, adi_m=0.001)
    result = scores(table)
    assert (result["add_recall_0.1d"], result["adi_recall_0.1d"], result["add_s_recall_0.1d"]) == (0.0, 1.0, 0.5)


def test_areas_are_exact_integrals():
    # Recall rises by a third at 20 and at 50 mm, never for 150 mm: (80 + 50) / 3 of 100. Of 10 mm (0.1 diameter of
    # 100 mm): none is below.
    result = scores(errors_table(3, add_m=[0.02, 0.05, 0.15], diameter_m=0.1))
    assert result["add_auc_100mm"] == pytest.approx(1.3 / 3)
    assert result["add_auc_0.1d"] == 0.0
    # 5 mm of 20 mm leave 0.75.
    assert scores(errors_table(1, adi_m=0.005, diameter_m=0.2))["adi_auc_0.1d"] == pytest.approx(0.75)


def test_an_area_is_the_limit_of_fine_sums_over_thresholds():
    errors = np.random.default_rng(0).gamma(2.0, 0.03, size=50)
    recall = [(errors < limit).mean() for limit in (np.arange(20000) + 0.5) * 0.1 / 20000]
    assert scores(errors_table(50, add_m=errors))["add_auc_100mm"] == pytest.approx(np.mean(recall), abs=1e-6)


def test_average_recalls_count_thresholds_strictly_under():
    # MSSD 0.12 diameter is under 0.15 ... 0.50: 8 of 10. MSPD 20 px at width 1280 is 10 px: under 15 ... 50: 8 of 10.
    result = scores(errors_table(1, mssd_m=0.012, diameter_m=0.1, mspd_px=20.0, image_width_px=1280))
    assert result["ar_mssd"] == pytest.approx(0.8)
    assert result["ar_mspd"] == pytest.approx(0.8)
    assert result["ar_without_vsd"] == pytest.approx(0.8)
    assert np.isnan(result["ar"])
    assert np.isnan(result["ar_vsd"])


def test_average_recall_of_vsd_has_ten_tolerances_and_ten_limits():
    # VSD 0.32 for the first four tolerances is under 4 limits (0.35 ... 0.50), 0 for the other six under 10: 76 of 100.
    columns = {name: 0.32 if index < 4 else 0.0 for index, name in enumerate(VSD_COLUMNS)}
    result = scores(errors_table(1, **columns))
    assert result["ar_vsd"] == pytest.approx(0.76)
    assert result["ar"] == pytest.approx((0.76 + 1.0 + 1.0) / 3)
    assert len(VSD_COLUMNS) == len(VSD_LIMITS) == 10


def test_vsd_of_a_part_of_the_images_gives_no_average():
    columns = {name: [0.0, NAN] for name in VSD_COLUMNS}
    result = scores(errors_table(2, **columns))
    assert np.isnan(result["ar_vsd"])
    assert result["ar_without_vsd"] == 1.0


def test_under_counts_like_comparing():
    errors = np.array([0.0, 0.05, 0.1 - 1e-12, 0.1, 0.5, 0.499, 7.0, np.inf, NAN])
    np.testing.assert_allclose(under(errors, MSSD_DIAMETERS), (errors[:, None] < MSSD_DIAMETERS).mean(axis=1))
    np.testing.assert_allclose(under(errors * 100, MSPD_PX), (errors[:, None] * 100 < MSPD_PX).mean(axis=1))


def test_diverged_is_over_45_degrees_or_half_a_diameter():
    table = errors_table(4, re_sym_rad=np.deg2rad([45.0, 46.0, 0.0, 0.0]), te_m=[0.0, 0.0, 0.05, 0.051])
    assert scores(table)["diverged"] == 0.5


def test_five_centimetres_and_five_degrees_need_both():
    table = errors_table(3, te_m=[0.049, 0.051, 0.0], re_sym_rad=np.deg2rad([4.9, 0.0, 5.1]))
    assert scores(table)["5cm5deg"] == pytest.approx(1 / 3)


def test_time_is_averaged_over_images_as_bop_does():
    table = errors_table(4, im_id=[0, 0, 0, 1], time_s=[0.3, 0.3, 0.3, 0.9])
    assert scores(table)["time_s_mean"] == pytest.approx(0.45)
    assert scores(table)["time_s_per_image"] == pytest.approx(0.6)
    assert np.isnan(scores(errors_table(2, time_s=-1.0))["time_s_per_image"])


def test_scores_by_object_are_scores_of_their_rows():
    table = errors_table(4, obj_id=[1, 1, 5, 5], vss=[0.2, 0.4, 0.6, 0.8])
    assert {obj_id: values["vss_mean"] for obj_id, values in by_object(table).items()} == pytest.approx(
        {1: 0.3, 5: 0.7}
    )


def test_every_definition_is_a_sentence():
    assert {"AUC", "AR", "AR without VSD", "AP", "missing", "interval"} <= set(DEFINITIONS)
    assert all(len(text) > 20 for text in DEFINITIONS.values())


# BOP19: several instances of an object


def test_matching_starts_anew_for_every_threshold():
    # Two instances A, B; the better-scored estimate 0 is 0.30 from A and 0.32 from B, estimate 1 is 0.10 from A only.
    # Under 0.15 ... 0.30: estimate 1 takes A (1 of 2). Under 0.35 and more: estimate 0 takes A, estimate 1 nothing.
    # Greedy matching keeps estimate 0 on A although B would serve both: that is BOP's rule.
    data = everything(
        [(1, 0, 1, 1.0, 2), (1, 0, 1, 0.9, 2)],
        [(1, 0, 1, 0.9), (1, 0, 1, 0.5)],
        [(0, 0, 0.30, 99), (0, 1, 0.32, 99), (1, 0, 0.10, 99), (1, 1, 0.9, 99)],
    )
    shares = bop19_recalls(data)
    # Of equal decimals 0.30 is under: the limit is six times 0.05 in floating point, 0.30000000000000004.
    assert shares.bop19_mssd.tolist() == [0.8, 0.0]
    assert shares.bop19_mspd.tolist() == [0.0, 0.0]


def test_errors_are_matched_apart():
    # By surface distance the estimates belong crosswise, by projection they belong straight: both score fully.
    data = everything(
        [(1, 0, 1, 1.0, 2), (1, 0, 1, 1.0, 2)],
        [(1, 0, 1, 0.9), (1, 0, 1, 0.5)],
        [(0, 0, 0.6, 1), (0, 1, 0.01, 60), (1, 0, 0.01, 60), (1, 1, 0.6, 1)],
    )
    shares = bop19_recalls(data)
    assert shares.bop19_mssd.tolist() == [1.0, 1.0]
    assert shares.bop19_mspd.tolist() == [1.0, 1.0]


def test_only_the_most_visible_instances_and_best_scored_estimates_count():
    # One instance is asked for: the second is the more visible. The best-scored estimate misses it; the other would
    # not, but only one estimate may be given.
    data = everything(
        [(1, 0, 1, 0.3, 1), (1, 0, 1, 0.8, 1)],
        [(1, 0, 1, 0.5), (1, 0, 1, 0.9)],
        [(0, 0, 0.9, 90), (0, 1, 0.01, 1), (1, 0, 0.01, 1), (1, 1, 0.9, 90)],
    )
    shares = bop19_recalls(data)
    assert shares.gt_index.tolist() == [1]
    assert shares.bop19_mssd.tolist() == [0.0]


def test_equally_visible_instances_count_in_the_images_order():
    instances = everything(
        [(1, 0, 1, 0.5, 2), (1, 0, 1, 0.7, 2), (1, 0, 1, 0.5, 2), (1, 0, 2, NAN, 1)], [], []
    ).instances
    assert target_instances(instances).tolist() == [True, True, False, True]


def test_equal_scores_keep_the_files_order():
    estimates = everything([], [(1, 0, 1, 0.5), (1, 0, 1, 0.7), (1, 0, 1, 0.5), (1, 1, 1, 0.1)], []).estimates
    assert ranks(estimates, ["scene_id", "im_id", "obj_id"]).tolist() == [1, 0, 2, 0]


def test_missing_instances_lower_the_recall():
    data = everything([(1, 0, 1, 1.0, 1), (1, 1, 1, 1.0, 1)], [(1, 0, 1, 1.0)], [(0, 0, 0.0, 0.0)])
    assert bop19_recalls(data).bop19_mssd.mean() == 0.5


def test_bop19_shares_replace_the_rows_own_recall():
    data = everything(
        [(1, 0, 1, 1.0, 2), (1, 0, 1, 1.0, 2)],
        [(1, 0, 1, 0.9), (1, 0, 1, 0.5)],
        [(0, 0, 0.6, 1), (0, 1, 0.01, 60), (1, 0, 0.01, 60), (1, 1, 0.6, 1)],
    )
    table = errors_table(2, im_id=0, gt_index=[0, 1], mssd_m=0.06, mspd_px=1.0)
    assert scores(table)["ar_mssd"] == 0.0
    assert scores(with_bop19(table, data))["ar_mssd"] == 1.0


def test_one_instance_each_scores_the_same_from_the_row_and_from_the_matching():
    rng = np.random.default_rng(5)
    mssd, mspd = rng.uniform(0, 0.6, 40), rng.uniform(0, 60, 40)
    table = errors_table(40, mssd_m=mssd * 0.1, mspd_px=mspd)
    data = everything(
        [(1, image, 1, 1.0, 1) for image in range(40)],
        [(1, image, 1, 1.0) for image in range(40)],
        [(image, image, mssd[image], mspd[image]) for image in range(40)],
    )
    plain, matched = scores(table), scores(with_bop19(table, data))
    assert plain["ar_without_vsd"] == pytest.approx(matched["ar_without_vsd"], abs=1e-15)


# BOP24: detection


def test_average_precision_by_hand():
    # Hits at places 1, 3 of three instances: recall 1/3 with precision 1, 2/3 with 2/3. Levels 0 ... 0.33 (34 of 101)
    # read 1, 0.34 ... 0.66 (33) read 2/3, the rest 0.
    value = average_precision(np.array([True, False, True, False]), 3)
    assert value == pytest.approx((34 + 33 * 2 / 3) / 101)
    assert average_precision(np.array([True, True]), 2) == 1.0
    assert average_precision(np.array([], bool), 2) == 0.0
    assert average_precision(np.array([False]), 1) == 0.0
    # A later true one lifts the precision before it: COCO reads the best precision at or beyond a level.
    assert average_precision(np.array([False, True]), 1) == pytest.approx(0.5)


def test_precision_falls_with_false_alarms_that_score_higher():
    instances = [(1, 0, 1, 1.0, 1)]
    wrong = [(0, 0, 0.9, 99), (1, 0, 0.0, 0)]
    behind = bop24_precision(everything(instances, [(1, 0, 1, 0.2), (1, 0, 1, 0.8)], wrong))
    before = bop24_precision(everything(instances, [(1, 0, 1, 0.8), (1, 0, 1, 0.2)], wrong))
    assert behind["ap"] == pytest.approx(1.0)
    assert before["ap"] == pytest.approx(0.5)


def test_hardly_visible_instances_ask_for_nothing_and_forgive_their_estimates():
    instances = [(1, 0, 1, 0.09, 0), (1, 0, 1, 0.1, 1)]
    estimates = [(1, 0, 1, 0.9), (1, 0, 1, 0.8)]
    errors = [(0, 0, 0.0, 0), (0, 1, 0.9, 99), (1, 0, 0.9, 99), (1, 1, 0.0, 0)]
    result = bop24_precision(everything(instances, estimates, errors))
    assert result["ap"] == 1.0
    assert (result["instances"], result["estimates"]) == (1, 2)
    # With a limit of 0 both instances count, and both are found.
    assert bop24_precision(everything(instances, estimates, errors), visible=0.0)["instances"] == 2
    # Without its instance the first estimate is a false alarm before the true one.
    assert bop24_precision(everything(instances[1:], estimates, [(0, 0, 0.9, 99), (1, 0, 0.0, 0)]))["ap"] == 0.5


def test_objects_without_an_instance_have_no_part():
    instances = [(1, 0, 1, 1.0, 1), (1, 0, 2, 0.05, 0)]
    result = bop24_precision(everything(instances, [(1, 0, 1, 1.0)], [(0, 0, 0.0, 0.0)]))
    assert list(result["by_object"]) == [1]
    assert result["ap"] == 1.0


def test_an_object_that_is_never_estimated_has_no_precision():
    result = bop24_precision(everything([(1, 0, 1, 1.0, 1), (1, 0, 2, 1.0, 1)], [(1, 0, 1, 1.0)], [(0, 0, 0.0, 0.0)]))
    assert result["by_object"][2]["ap"] == 0.0
    assert result["ap"] == 0.5


def test_estimates_of_absent_objects_are_left_out_and_counted_where_asked():
    instances = [(1, 0, 1, 1.0, 1), (1, 1, 2, 1.0, 1)]
    estimates = [(1, 0, 1, 0.5), (1, 0, 2, 0.9), (1, 1, 2, 0.5)]
    data = everything(instances, estimates, [(0, 0, 0.0, 0.0), (2, 1, 0.0, 0.0)])
    result = bop24_precision(data)
    assert (result["ap"], result["absent"], result["estimates"]) == (1.0, 1, 2)
    strict = bop24_precision(data, count_absent=True)
    assert (strict["ap"], strict["estimates"]) == (0.75, 3)


def test_only_the_best_scored_estimates_of_an_image_count():
    instances = [(1, 0, 1, 1.0, 1), (1, 0, 2, 1.0, 1)]
    estimates = [(1, 0, 1, 0.1), (1, 0, 2, 0.9), (1, 0, 2, 0.8)]
    data = everything(instances, estimates, [(0, 0, 0.0, 0.0), (1, 1, 0.0, 0.0), (2, 1, 0.9, 90.0)])
    assert bop24_precision(data)["ap"] == 1.0
    cut = bop24_precision(data, per_image=2)
    assert (cut["ap"], cut["outscored"]) == (0.5, 1)


def test_precision_in_millimetres():
    # 5 mm is under 6, 8, ... 20 mm: 8 of 10 thresholds.
    result = bop24_precision(everything([(1, 0, 1, 1.0, 1)], [(1, 0, 1, 1.0)], [(0, 0, 0.05, 0.0)]))
    assert result["ap_mssd_mm"] == pytest.approx(0.8)


def test_nothing_asked_for_has_no_precision():
    assert np.isnan(bop24_precision(everything([(1, 0, 1, 0.0, 0)], [(1, 0, 1, 1.0)], [(0, 0, 0.0, 0.0)]))["ap"])
    assert bop24_precision(everything([(1, 0, 1, 1.0, 1)], [], []))["ap"] == 0.0


# A seeded world of several scenes, images, objects and instances


def world(seed):
    """Ties in scores, hardly visible instances, more and fewer asked for than there are, a file in mixed order."""
    rng = np.random.default_rng(seed)
    instances, estimates = [], []
    for scene, image in ((2, 0), (2, 3), (5, 0), (5, 4), (5, 7)):
        for obj in (1, 2, 5):
            count, asked = int(rng.integers(0, 4)), int(rng.integers(1, 4))
            instances += [
                (scene, image, obj, float(rng.choice([0.02, 0.1, 0.5, 0.5, 0.9])), asked) for _ in range(count)
            ]
            estimates += [(scene, image, obj, float(rng.choice([0.2, 0.5, 0.9]))) for _ in range(rng.integers(0, 6))]
    estimates = [estimates[index] for index in rng.permutation(len(estimates))]
    pairs = [(e, g) for e, one in enumerate(estimates) for g, two in enumerate(instances) if one[:3] == two[:3]]
    errors = [(e, g, float(rng.gamma(1.0, 0.2)), float(rng.gamma(1.0, 20.0))) for e, g in pairs]
    data = everything(instances, estimates, errors)
    base = rng.uniform(size=len(pairs))
    for index, name in enumerate(VSD_COLUMNS):
        data.errors[name] = np.maximum(base - 0.05 * index, 0.0)
    return data


def plain_matches(errors, scores_of, limit):
    """BOP's rule for one image and object: {estimate: {truth: error}} to {estimate: truth}, as one would say it."""
    taken = {}
    for estimate in sorted(errors, key=lambda one: -scores_of[one]):
        free = {gt: error for gt, error in errors[estimate].items() if gt not in taken.values()}
        under_limit = {gt: error for gt, error in free.items() if error < limit}
        if under_limit:
            taken[estimate] = min(under_limit, key=under_limit.__getitem__)
    return taken


@pytest.mark.parametrize("seed", range(8))
def test_fast_matching_is_the_plain_one(seed):
    data = world(seed)
    error = np.round(data.errors.mssd_m.to_numpy() / 0.1, 1)  # many ties
    estimate, gt = data.errors.estimate.to_numpy(), data.errors.instance.to_numpy()
    limits = np.array([0.1, 0.25, 0.5])
    rank = ranks(data.estimates, ["scene_id", "im_id", "obj_id"])
    fast = greedy_matches(estimate, gt, error, rank, len(data.instances), limits)
    for level, limit in enumerate(limits):
        expected = np.full(len(data.estimates), -1)
        for _, rows in data.estimates.groupby(["scene_id", "im_id", "obj_id"]):
            listed = {
                int(e): {int(g): x for i, g, x in zip(estimate, gt, error, strict=True) if i == e} for e in rows.index
            }
            for e, g in plain_matches(listed, data.estimates.score, limit).items():
                expected[e] = g
        np.testing.assert_array_equal(fast[level], expected)


# Printed by bop_toolkit (commit cea62d6: match_poses_scene, calc_localization_scores, calc_pose_detection_scores, means
# as in eval_bop19_pose.py and eval_bop24_pose.py) for the same tables of errors.
BOP_TOOLKIT = {
    0: {
        "bop19_mssd": 0.3952380952380953,
        "bop19_mspd": 0.4523809523809524,
        "bop19_vsd": 0.3914285714285714,
        "ap_mssd": 0.3602263559689302,
        "ap_mspd": 0.403035816402153,
        "ap_mssd_mm": 0.24542511393996547,
    },
    1: {
        "bop19_mssd": 0.46499999999999997,
        "bop19_mspd": 0.5850000000000001,
        "bop19_vsd": 0.4384999999999999,
        "ap_mssd": 0.3206820682068206,
        "ap_mspd": 0.46532322279847027,
        "ap_mssd_mm": 0.19366022316517364,
    },
}


@pytest.mark.parametrize("seed", BOP_TOOLKIT)
def test_bop_scores_are_those_that_bop_toolkit_printed(seed):
    data = world(seed)
    shares, precision = bop19_recalls(data), bop24_precision(data)
    for name, expected in BOP_TOOLKIT[seed].items():
        value = precision[name] if name.startswith("ap") else shares[name].mean()
        assert value == pytest.approx(expected, abs=1e-14), name
    assert precision["ap"] == pytest.approx((precision["ap_mssd"] + precision["ap_mspd"]) / 2)
