"""Tracking scores of made-up sequences whose residuals are known: offsets, wraps, symmetries, resets, jitter."""

from types import SimpleNamespace

import numpy as np
import pytest
from evalkit.tables.model import Interval, best_cells
from evalkit.tracking import (
    SequenceTrack,
    TrackedFile,
    axis_table,
    changes,
    euler_deg,
    residuals,
    run_with_resets,
    sequence_table,
    track_scores,
)
from posecore import se3
from posecore.bop import ModelInfo
from posecore.errors import ConfigError
from posecore.symmetry import ContinuousSymmetry
from scipy.spatial.transform import Rotation


def about(axis, degrees):
    return se3.rotation_from_rotvec(np.deg2rad(degrees) * np.asarray(axis, np.float64))


X, Y, Z = np.eye(3)
ORIGIN = np.zeros(3)


def moving(frames, seed=0):
    """True poses of an object that turns and drifts."""
    rng = np.random.default_rng(seed)
    first = se3.make_T(se3.random_rotation(rng), np.array([0.02, -0.01, 0.6]))
    turn, drift = se3.rotation_from_rotvec(rng.normal(size=3) * 0.03), rng.normal(size=3) * 0.002
    poses = [first]
    for _ in range(frames - 1):
        poses.append(se3.apply_update(poses[-1], turn, drift))
    return np.stack(poses)


def off(T_gt, R=None, t_m=(0.0, 0.0, 0.0)):
    """Estimates with this residual in every frame."""
    R = np.eye(3) if R is None else R
    return se3.apply_update(T_gt, np.broadcast_to(R, (len(T_gt), 3, 3)), np.broadcast_to(np.array(t_m), (len(T_gt), 3)))


def track(T_est, T_gt, info=None, was_initialised=None, frame=None, time_s=None, name="scene 1, object 5"):
    n = len(T_gt)
    return SequenceTrack(
        scene_id=1,
        obj_id=5,
        instance=0,
        name=name,
        im_id=np.arange(n),
        frame=np.arange(n) if frame is None else np.array(frame),
        T_est=np.array(T_est, np.float64),
        T_gt=T_gt,
        time_s=np.full(n, -1.0) if time_s is None else np.array(time_s, np.float64),
        was_initialised=None if was_initialised is None else np.array(was_initialised, bool),
        info=info,
    )


def lost(T, *frames):
    T = T.copy()
    T[list(frames)] = np.nan
    return T


def symmetric(*discrete, axes=()):
    return SimpleNamespace(symmetries_discrete=tuple(discrete), symmetries_continuous=tuple(axes))


def half_turn(axis):
    return se3.make_T(about(axis, 180.0), np.zeros(3))


def test_a_constant_offset_is_the_rms_of_its_axes_and_has_no_jitter():
    T_gt = moving(20)
    R = about(Z, 3.0) @ about(Y, -2.0) @ about(X, 1.0)
    scores = track_scores(track(off(T_gt, R, (0.001, -0.002, 0.007)), T_gt))
    rms = [scores[f"{name}_rms_mm"] for name in "xyz"] + [
        scores[f"{name}_rms_deg"] for name in ("roll", "pitch", "yaw")
    ]
    assert rms == pytest.approx([1.0, 2.0, 7.0, 1.0, 2.0, 3.0])
    assert [scores[f"jitter_{key}"] for key in ("mm_median", "mm_p95", "deg_median", "deg_p95")] == pytest.approx(
        [0.0] * 4, abs=1e-5
    )
    assert (scores["frames"], scores["lost"], scores["success_5cm5deg"]) == (20.0, 0.0, 1.0)


def test_rms_is_the_root_of_the_mean_square_about_zero():
    T_gt = moving(4)
    T_est = T_gt.copy()
    T_est[:, 0, 3] += np.array([0.003, 0.003, -0.004, 0.004])
    # sqrt((9 + 9 + 16 + 16) / 4) = sqrt(12.5), while the spread about the mean of 1.5 would be smaller
    assert track_scores(track(T_est, T_gt))["x_rms_mm"] == pytest.approx(np.sqrt(12.5))


def test_truth_against_itself_is_zero_everywhere():
    T_gt = moving(10)
    scores = track_scores(track(T_gt, T_gt))
    assert all(abs(value) < 1e-5 for name, value in scores.items() if "rms" in name or "jitter" in name)
    assert scores["success_5cm5deg"] == 1.0


def test_euler_angles_are_those_of_rz_ry_rx():
    angles = np.array([[10.0, 20.0, 30.0], [-170.0, 80.0, 175.0]])
    R = np.stack([about(Z, yaw) @ about(Y, pitch) @ about(X, roll) for roll, pitch, yaw in angles])
    np.testing.assert_allclose(euler_deg(R), angles, atol=1e-9)
    np.testing.assert_allclose(euler_deg(R), Rotation.from_matrix(R).as_euler("xyz", degrees=True), atol=1e-9)


@pytest.mark.parametrize(("true", "estimated"), [(1.0, 359.0), (179.0, 181.0)])
def test_359_degrees_against_1_and_181_against_179_are_errors_of_2(true, estimated):
    T_gt = np.stack([se3.make_T(about(Z, true), np.array([0, 0, 0.5]))] * 3)
    T_est = np.stack([se3.make_T(about(Z, estimated), np.array([0, 0, 0.5]))] * 3)
    scores = track_scores(track(T_est, T_gt))
    assert scores["yaw_rms_deg"] == pytest.approx(2.0)
    assert scores["roll_rms_deg"] == pytest.approx(0.0, abs=1e-6)


def test_angles_stay_small_where_the_pitch_is_near_90_degrees():
    # One degree about x, at a pitch of 89: roll and yaw of the poses run apart, the residual's angles do not.
    T_gt = np.stack([se3.make_T(about(Y, 89.0), np.array([0, 0, 0.5]))] * 2)
    T_est = off(T_gt, about(X, 1.0))
    scores = track_scores(track(T_est, T_gt))
    assert scores["roll_rms_deg"] == pytest.approx(1.0)
    assert scores["yaw_rms_deg"] == pytest.approx(0.0, abs=1e-6)
    assert np.abs(euler_deg(T_est[0, :3, :3]) - euler_deg(T_gt[0, :3, :3])).max() > 20.0  # as a plain difference


def test_residuals_are_in_camera_axes():
    T_gt = se3.make_T(about(Z, 90.0), np.array([0.0, 0.0, 0.5]))[None]
    found = residuals(off(T_gt, about(X, 7.0), (0.01, 0.0, 0.0)), T_gt)
    np.testing.assert_allclose(found.R[0], about(X, 7.0), atol=1e-12)
    np.testing.assert_allclose(found.dt_m[0], [0.01, 0.0, 0.0], atol=1e-12)


def test_annotations_that_are_orthonormal_to_two_digits_only_do_not_show_in_perfect_estimates():
    T_gt = moving(5)
    T_gt[:, :3, :3] += np.random.default_rng(1).normal(scale=3e-3, size=(5, 3, 3))
    assert residuals(T_gt, T_gt).angle_rad == pytest.approx(0.0, abs=1e-12)
    R = residuals(off(moving(5), about(X, 3.0)), T_gt).R
    np.testing.assert_allclose(R @ np.swapaxes(R, -1, -2), np.broadcast_to(np.eye(3), (5, 3, 3)), atol=1e-12)


def test_lost_frames_fail_and_have_no_part_in_the_rms():
    T_gt = moving(5)
    scores = track_scores(track(lost(off(T_gt, None, (0.002, 0, 0)), 1, 3), T_gt))
    assert (scores["lost"], scores["failed"], scores["success_5cm5deg"]) == (2.0, 2.0, pytest.approx(0.6))
    assert scores["x_rms_mm"] == pytest.approx(2.0)
    assert np.isnan(scores["jitter_mm_median"])  # no two neighbours are left


def test_a_sequence_that_is_lost_altogether_has_no_errors():
    T_gt = moving(3)
    scores = track_scores(track(np.full_like(T_gt, np.nan), T_gt))
    assert (scores["lost"], scores["success_5cm5deg"]) == (3.0, 0.0)
    assert np.isnan([scores["x_rms_mm"], scores["yaw_rms_deg"], scores["time_ms_mean"]]).all()


@pytest.mark.parametrize(
    ("degrees", "t_m", "success"),
    [(4.99, 0.0499, 1.0), (5.01, 0.0, 0.0), (0.0, 0.0501, 0.0)],
)
def test_success_needs_both_5_cm_and_5_degrees(degrees, t_m, success):
    T_gt = moving(4)
    assert track_scores(track(off(T_gt, about(Y, degrees), (0, 0, t_m)), T_gt))["success_5cm5deg"] == success


def test_jitter_is_the_change_of_the_residual_and_not_the_motion():
    T_gt = moving(3)
    T_est = T_gt.copy()
    T_est[1] = se3.apply_update(T_gt[1], about(X, 2.0), np.array([0.003, 0.004, 0.0]))
    moved, turned = changes(T_est, T_gt)
    assert 1e3 * moved == pytest.approx([5.0, 5.0])
    assert np.rad2deg(turned) == pytest.approx([2.0, 2.0])


def test_jitter_skips_gaps_of_the_sequence():
    T_gt = moving(4)
    T_est = T_gt.copy()
    T_est[2:, 0, 3] += 0.01
    T_est[3, 0, 3] += 0.001
    whole = track_scores(track(T_est, T_gt))
    assert whole["jitter_mm_p95"] == pytest.approx(np.quantile([0.0, 10.0, 1.0], 0.95), abs=1e-6)
    gap = track_scores(track(T_est, T_gt, frame=[0, 1, 5, 6]))  # the jump lies between frames 1 and 5
    assert gap["jitter_mm_p95"] == pytest.approx(np.quantile([0.0, 1.0], 0.95), abs=1e-6)


def test_a_spinning_estimate_of_a_turned_object_neither_errs_nor_jitters():
    T_gt = moving(30)
    bobbin = symmetric(axes=[ContinuousSymmetry((0.0, 0.0, 1.0), (0.0, 0.0, 0.0))])
    spins = np.stack([se3.make_T(about(Z, 37.0 * k), np.zeros(3)) for k in range(30)])
    T_est = off(T_gt @ spins, about(X, 1.5))
    scores = track_scores(track(T_est, T_gt, bobbin))
    # The residual keeps the part of the 1.5 degrees that is not about the object's own axis: exactly, unsampled.
    axis = T_gt[:, :3, :3] @ Z
    left = residuals(T_est, T_gt, bobbin)
    assert (np.rad2deg(left.angle_rad) <= 1.5 + 1e-9).all()
    tilt = np.einsum("ni,nij,nj->n", axis, left.R, axis)
    true_tilt = np.einsum("ni,ij,nj->n", axis, about(X, 1.5), axis)
    np.testing.assert_allclose(tilt, true_tilt, atol=1e-9)
    assert scores["jitter_deg_p95"] < 0.1  # the axis itself moves by 1.7 degrees a frame, the spin by 37
    assert scores["success_5cm5deg"] == 1.0
    assert track_scores(track(T_est, T_gt))["success_5cm5deg"] < 0.2


def test_the_change_of_a_turned_object_is_the_least_over_all_turns():
    # Residuals far from the truth, where the copy nearest to the truth is not the one nearest to the frame before.
    rng = np.random.default_rng(5)
    T_gt = moving(12)
    T_est = np.stack([se3.apply_update(T, se3.random_rotation(rng), np.zeros(3)) for T in T_gt])
    bobbin = symmetric(axes=[ContinuousSymmetry((0.0, 0.0, 1.0), (0.0, 0.0, 0.0))])
    _, turned = changes(T_est, T_gt, bobbin)
    before = residuals(T_est, T_gt, bobbin).R[:-1]
    turns = np.stack([about(Z, angle) for angle in np.arange(0.0, 360.0, 0.25)])
    for k in range(11):
        copies = T_gt[k + 1, :3, :3] @ turns
        left = T_est[k + 1, :3, :3] @ np.swapaxes(copies, -1, -2)
        least = se3.rotation_angle_rad(left @ before[k].T).min()
        assert turned[k] == pytest.approx(least, abs=np.deg2rad(0.25))
        assert turned[k] <= least + 1e-9


def test_an_axis_beside_the_origin_takes_the_origin_along():
    T_gt = moving(6)
    center = np.array([0.03, 0.0, 0.0])
    info = symmetric(axes=[ContinuousSymmetry((0.0, 0.0, 1.0), (0.03, 0.0, 0.0))])
    R = about(Z, 120.0)
    T_est = T_gt @ se3.make_T(R, center - R @ center)
    found = residuals(T_est, T_gt, info)
    assert found.distance_m == pytest.approx(0.0, abs=1e-9)
    assert found.angle_rad == pytest.approx(0.0, abs=1e-7)


def test_a_ball_has_no_rotation_error():
    T_gt = moving(4)
    ball = symmetric(axes=[ContinuousSymmetry(tuple(axis), (0.0, 0.0, 0.0)) for axis in (X, Y)])
    T_est = off(T_gt @ se3.make_T(se3.random_rotation(np.random.default_rng(3)), np.zeros(3)), None, (0.004, 0, 0))
    scores = track_scores(track(T_est, T_gt, ball))
    assert [scores[f"{name}_rms_deg"] for name in ("roll", "pitch", "yaw")] == pytest.approx([0.0] * 3, abs=1e-5)
    assert scores["x_rms_mm"] == pytest.approx(4.0)


def test_the_residual_is_to_the_nearest_discrete_copy():
    T_gt = moving(5)
    box = symmetric(half_turn(Z))
    scores = track_scores(track(off(T_gt @ half_turn(Z), about(Y, 2.0)), T_gt, box))
    assert scores["pitch_rms_deg"] == pytest.approx(2.0)


def test_turning_smoothly_from_one_copy_to_the_next_is_no_jitter():
    # A box that looks alike after 180 degrees: the estimate runs away by 20 degrees a frame about its axis. At 90 the
    # nearest copy changes and the residual jumps from +80 to -80, but nothing in the estimate did.
    T_gt = np.stack([se3.make_T(np.eye(3), np.array([0, 0, 0.5]))] * 10)
    turns = np.stack([about(Z, 20.0 * k) for k in range(10)])
    T_est = se3.apply_update(T_gt, turns, np.zeros((10, 3)))
    box = symmetric(half_turn(Z))
    left = residuals(T_est, T_gt, box)
    assert np.rad2deg(left.angle_rad) == pytest.approx([0, 20, 40, 60, 80, 80, 60, 40, 20, 0], abs=1e-6)
    _, turned = changes(T_est, T_gt, box)
    assert np.rad2deg(turned) == pytest.approx([20.0] * 9)


def test_of_two_equally_near_copies_the_one_of_the_frame_before_is_kept():
    # Halfway between two copies both residuals have 90 degrees: +90 or -90. The one that continues is taken.
    T_gt = np.stack([se3.make_T(np.eye(3), np.array([0, 0, 0.5]))] * 2)
    for sign in (1, -1):
        T_est = np.stack([off(T_gt[:1], about(Z, sign * 80.0))[0], off(T_gt[:1], about(Z, 90.0))[0]])
        left = residuals(T_est, T_gt, symmetric(half_turn(Z)))
        assert euler_deg(left.R)[:, 2] == pytest.approx([sign * 80.0, sign * 90.0])


def test_given_frames_are_not_scored_and_count_as_failures_but_for_the_first():
    T_gt = moving(6)
    T_est = off(T_gt, None, (0.001, 0, 0))
    T_est[3] = T_gt[3]  # a file may hold the pose that was given ...
    T_est[0, 0, 3] += 1.0  # ... or anything else
    scores = track_scores(track(T_est, T_gt, was_initialised=[True, False, False, True, False, False]))
    assert (scores["frames"], scores["failed"], scores["resets"]) == (5.0, 1.0, 1.0)
    assert scores["success_5cm5deg"] == pytest.approx(0.8)
    assert scores["x_rms_mm"] == pytest.approx(1.0)
    assert scores["jitter_mm_p95"] == pytest.approx(0.0, abs=1e-6)


def test_a_run_without_resets_has_none_rather_than_zero():
    T_gt = moving(3)
    assert np.isnan(track_scores(track(T_gt, T_gt))["resets"])
    assert track_scores(track(T_gt, T_gt, was_initialised=[True, False, False]))["resets"] == 0.0


def test_time_is_the_mean_of_the_known_ones():
    T_gt = moving(4)
    scores = track_scores(track(T_gt, T_gt, time_s=[0.02, -1.0, 0.04, np.nan]))
    assert scores["time_ms_mean"] == pytest.approx(30.0)


class FakeTracker:
    """Follows the truth perfectly but fails in chosen frames, and remembers where it was set to the truth."""

    def __init__(self, T_gt, fails):
        self.T_gt, self.fails, self.set_at = T_gt, fails, []

    def initialise(self, frame, T_cam_obj):
        np.testing.assert_array_equal(T_cam_obj, self.T_gt[frame])
        self.set_at.append(frame)

    def track(self, frame):
        return self.fails.get(frame, self.T_gt[frame])


def test_a_tracker_that_fails_is_set_to_the_truth_of_that_frame_and_goes_on():
    T_gt = moving(10)
    fails = {3: se3.apply_update(T_gt[3], about(X, 6.0), np.zeros(3)), 7: None}
    tracker = FakeTracker(T_gt, fails)
    run = run_with_resets(tracker, iter(range(10)), T_gt, center_m=ORIGIN)
    assert tracker.set_at == [0, 3, 7]
    assert np.flatnonzero(run.was_initialised).tolist() == [0, 3, 7]
    assert run.success == pytest.approx(7 / 9)
    np.testing.assert_array_equal(run.T_est[3], fails[3])
    assert np.isnan(run.T_est[[0, 7]]).all()
    assert np.isnan(run.time_s[0]) and (run.time_s[1:] >= 0).all()


def test_a_result_file_of_a_reset_run_scores_as_the_run_did():
    T_gt = moving(10)
    run = run_with_resets(FakeTracker(T_gt, {4: None, 5: None}), range(10), T_gt, center_m=ORIGIN)
    scores = track_scores(track(run.T_est, T_gt, was_initialised=run.was_initialised))
    assert scores["success_5cm5deg"] == pytest.approx(run.success) == pytest.approx(7 / 9)
    assert (scores["resets"], scores["failed"]) == (2.0, 2.0)
    assert run.resets(2, 5, range(100, 110)) == [
        {"scene_id": 2, "im_id": im_id, "obj_id": 5} for im_id in (100, 104, 105)
    ]


def test_a_symmetric_copy_is_no_failure():
    T_gt = moving(4)
    copies = {frame: T_gt[frame] @ half_turn(Z) for frame in range(4)}
    info = ModelInfo(diameter_m=0.1, symmetries_discrete=(half_turn(Z),))
    assert run_with_resets(FakeTracker(T_gt, copies), range(4), T_gt, center_m=ORIGIN, info=info).success == 1.0
    assert run_with_resets(FakeTracker(T_gt, copies), range(4), T_gt, center_m=ORIGIN).success == 0.0


def test_sequences_that_cannot_be_tracked_are_refused():
    T_gt = moving(3)
    with pytest.raises(ConfigError, match="without frames"):
        run_with_resets(FakeTracker(T_gt, {}), [], [], center_m=ORIGIN)
    T_gt[1] = np.nan
    with pytest.raises(ConfigError, match="frame 1 has no ground-truth pose"):
        run_with_resets(FakeTracker(T_gt, {}), range(3), T_gt, center_m=ORIGIN)
    with pytest.raises(ValueError, match="zip"):
        run_with_resets(FakeTracker(T_gt, {}), range(1), T_gt, center_m=ORIGIN)


def two_sequences(t_m, **rest):
    T_gt = moving(5), moving(7, seed=1)
    return [track(off(T, None, t_m), T, name=f"scene {k}, object 5", **rest) for k, T in enumerate(T_gt, 1)]


def test_the_table_has_a_row_for_each_method_of_each_sequence_and_means_of_both():
    files = [
        TrackedFile(name=name, tracks=two_sequences(t)) for name, t in (("a", (0.002, 0, 0)), ("b", (0.001, 0, 0)))
    ]
    table = sequence_table(files)
    assert [(row.cells["sequence"], row.cells["method"]) for row in table.rows] == [
        ("scene 1, object 5", "a"),
        ("scene 1, object 5", "b"),
        ("scene 2, object 5", "a"),
        ("scene 2, object 5", "b"),
        ("mean of sequences", "a"),
        ("mean of sequences", "b"),
    ]
    assert [row.cells["x_rms_mm"] for row in table.rows] == pytest.approx([2.0, 1.0] * 3)
    assert table.rows[-1].cells["frames"] == 12.0
    assert {place for place, key in best_cells(table) if key == "x_rms_mm"} == {1, 3, 5}
    assert "not RBOT's number" in table.note


def test_a_single_file_has_no_column_for_its_name_and_a_single_sequence_no_mean():
    (first, _) = two_sequences((0.001, 0, 0))
    table = sequence_table([TrackedFile(name="a", tracks=[first])])
    assert "method" not in {column.key for column in table.columns}
    assert len(table.rows) == 1


def test_means_of_sequences_have_intervals_where_asked_for():
    table = sequence_table([TrackedFile(name="a", tracks=two_sequences((0.001, 0, 0)))], resamples=100)
    cell = table.rows[-1].cells["x_rms_mm"]
    assert isinstance(cell, Interval)
    assert (cell.low, cell.high) == pytest.approx((1.0, 1.0))


def test_failures_without_a_reset_are_said():
    T_gt = moving(5)
    broken = track(lost(T_gt, 2), T_gt, was_initialised=[True, False, False, False, False])
    note = sequence_table([TrackedFile(name="a", tracks=[broken])]).note
    assert "a: 1 failed frames without a reset, so RBOT's protocol was not kept" in note
    assert "not RBOT's number" not in note


def test_the_papers_layout_has_six_rows_a_sequence_and_a_column_a_method():
    files = [
        TrackedFile(name=name, tracks=two_sequences(t)) for name, t in (("a", (0.002, 0, 0)), ("b", (0, 0, 0.003)))
    ]
    table = axis_table(files)
    assert len(table.rows) == 12
    assert [row.cells["axis"] for row in table.rows[:6]] == [
        "x, mm",
        "y, mm",
        "z, mm",
        "roll, deg",
        "pitch, deg",
        "yaw, deg",
    ]
    assert [table.rows[2].cells[key] for key in ("rms_0", "rms_1")] == pytest.approx([0.0, 3.0], abs=1e-9)
    assert {(0, "rms_1"), (2, "rms_0")} <= best_cells(table)


def test_a_turn_about_the_centre_is_no_translation():
    """With the origin 2 m off, a turn of 4 degrees moves the origin by 14 cm, and is tracked all the same."""
    center_m, T_gt = np.array([2.0, 0.0, 0.0]), moving(4)
    T_gt = se3.with_origin_at(T_gt, -center_m)
    turned = se3.with_origin_at(off(se3.with_origin_at(T_gt, center_m), about(Z, 4.0)), -center_m)
    assert np.linalg.norm(turned[:, :3, 3] - T_gt[:, :3, 3], axis=1).max() > 0.05
    poses = dict(enumerate(turned))
    assert run_with_resets(FakeTracker(T_gt, poses), range(4), T_gt, center_m=center_m).success == 1.0
    assert run_with_resets(FakeTracker(T_gt, poses), range(4), T_gt, center_m=ORIGIN).success == 0.0
