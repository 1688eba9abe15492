"""Errors: bop_toolkit's own numbers, truth against itself, symmetries, and hand-made cases."""

import json

import numpy as np
import pytest
from evalkit.evaluation.evaluator import Evaluator
from evalkit.inputs.pairing import pair_up
from evalkit.inputs.result_files import load_result_files
from evalkit.pose_errors import metrics, per_object
from hypothesis import given
from hypothesis import strategies as st
from posecore import camera, se3
from posecore.bop import BopDataset, ModelInfo
from posecore.symmetry import ContinuousSymmetry, symmetry_transforms

K = np.array([[500.0, 0, 320], [0, 500.0, 240], [0, 0, 1]])
POINTS = np.random.default_rng(0).uniform(-0.05, 0.05, (200, 3))
IDENTITY = np.eye(4)[None]


def pose(seed):
    rng = np.random.default_rng(seed)
    return se3.make_T(se3.random_rotation(rng), np.array([*rng.uniform(-0.1, 0.1, 2), rng.uniform(0.5, 1.0)]))


def moved(T, x=0.0, y=0.0, z=0.0):
    return se3.make_T(T[:3, :3], T[:3, 3] + np.array([x, y, z]))


@pytest.mark.slow
def test_every_error_agrees_with_bop_toolkit(shared_data):
    """349 start poses on LM-O; golden values: bop_toolkit cea62d6, vispy renderer, models_eval, symmetry step 0.01."""
    folder = shared_data / "lmo"
    golden = json.loads((folder / "golden_bop_toolkit.json").read_text())["estimates"]
    dataset = BopDataset(folder)
    (file,) = load_result_files([folder / "init_ssd6d-like_lmo-test.csv"], dataset)
    with Evaluator(dataset) as evaluator:
        rows = evaluator.evaluate(pair_up(dataset, file).pairs)
    rows_of = {(row.scene_id, row.im_id, row.obj_id): row for row in rows.itertuples()}
    pairs = [(rows_of[g["scene_id"], g["im_id"], g["obj_id"]], g) for g in golden]
    assert len(pairs) == len(rows) == 349
    values = {
        "add": [(row.add_m * 1e3, g["add"]) for row, g in pairs],
        "adi": [(row.adi_m * 1e3, g["adi"]) for row, g in pairs],
        "mssd": [(row.mssd_m * 1e3, g["mssd"]) for row, g in pairs],
        "mspd": [(row.mspd_px, g["mspd"]) for row, g in pairs],
        "proj": [(row.proj_px, g["proj"]) for row, g in pairs],
        "re": [(np.rad2deg(row.re_rad), g["re"]) for row, g in pairs],
        "te": [(row.te_m * 1e3, g["te"]) for row, g in pairs],
    }
    worst = {name: float(np.abs(np.subtract(*np.array(both).T)).max()) for name, both in values.items()}
    assert max(worst.values()) < 1e-4, worst
    ours, theirs = np.array([(1.0 - row.vss, g["cus"]) for row, g in pairs]).T
    assert np.abs(ours - theirs).max() < 0.005
    assert abs(ours.mean() - theirs.mean()) < 0.0005


@pytest.mark.slow
@given(st.integers(0, 10_000))
def test_truth_against_itself_is_zero(seed):
    T = pose(seed)
    assert metrics.add(T, T, POINTS) == 0
    assert metrics.adi(T, T, POINTS) == 0
    assert metrics.mssd(T, T, POINTS, IDENTITY) == 0
    assert metrics.mspd(T, T, K, POINTS, IDENTITY) == 0
    assert metrics.proj(T, T, K, POINTS) == 0
    assert metrics.te(T, T) == 0
    assert metrics.re(T, T) < 1e-7


@given(st.integers(0, 10_000), st.integers(0, 314))
def test_symmetric_poses_are_as_good_as_the_truth(seed, turn):
    info = ModelInfo(diameter_m=0.1, symmetries_continuous=(ContinuousSymmetry((0.0, 0.0, 1.0), (0.01, -0.02, 0.0)),))
    symmetries = symmetry_transforms(info)
    T_gt = pose(seed)
    T_est = T_gt @ symmetries[turn]
    assert metrics.mssd(T_est, T_gt, POINTS, symmetries) < 1e-9
    assert metrics.mspd(T_est, T_gt, K, POINTS, symmetries) < 1e-6
    assert metrics.re_symmetric(T_est, T_gt, symmetries) < 1e-6


def test_a_pure_translation_is_its_own_length():
    T = pose(1)
    shifted = moved(T, x=0.003, y=-0.004)
    assert metrics.add(shifted, T, POINTS) == pytest.approx(0.005)
    assert metrics.mssd(shifted, T, POINTS, IDENTITY) == pytest.approx(0.005)
    assert metrics.te(shifted, T) == pytest.approx(0.005)
    assert metrics.te_axes(shifted, T) == pytest.approx([0.003, -0.004, 0.0])
    assert metrics.re(shifted, T) < 1e-7


@pytest.mark.parametrize("degrees", [1e-5, 1.0, 90.0, 179.9, 180.0])
def test_rotation_error_is_the_angle(degrees):
    dR = se3.rotation_from_rotvec(np.deg2rad(degrees) * np.array([0.6, 0.0, 0.8]))
    T = pose(2)
    assert np.rad2deg(metrics.re(se3.make_T(dR @ T[:3, :3], T[:3, 3]), T)) == pytest.approx(degrees, rel=1e-6)


def test_one_pixel_of_projection():
    flat = np.array([[0.0, 0.0, 0.0], [0.01, 0.0, 0.0]])
    T = se3.make_T(np.eye(3), np.array([0.0, 0.0, 1.0]))
    assert metrics.proj(moved(T, x=0.002), T, K, flat) == pytest.approx(1.0)
    assert metrics.mspd(moved(T, x=0.002), T, K, flat, IDENTITY) == pytest.approx(1.0)


def test_adi_forgives_a_flip_that_add_does_not():
    pair = np.array([[0.05, 0.0, 0.0], [-0.05, 0.0, 0.0]])
    T = se3.make_T(np.eye(3), np.array([0.0, 0.0, 1.0]))
    flipped = se3.make_T(np.diag([-1.0, -1.0, 1.0]), np.array([0.0, 0.0, 1.0]))
    assert metrics.add(flipped, T, pair) == pytest.approx(0.1)
    assert metrics.adi(flipped, T, pair) == pytest.approx(0.0)


def test_a_point_in_the_camera_plane_is_an_infinite_projection_error():
    T = se3.make_T(np.eye(3), np.zeros(3))
    assert metrics.mspd(T, moved(T, z=1.0), K, np.zeros((1, 3)), IDENTITY) == np.inf


def plain_errors(T_est, T_gt, points_m, symmetries):
    """The definitions, word for word, with all of a model's symmetric copies at once."""
    estimated, copies = se3.apply(T_est, points_m), se3.apply(T_gt @ symmetries, points_m)
    between = np.linalg.norm(copies - estimated, axis=-1)
    pixels = np.linalg.norm(camera.project(K, copies) - camera.project(K, estimated), axis=-1)
    to_all = np.linalg.norm(copies[0][:, None] - estimated[None], axis=-1)
    angles = se3.rotation_angle_rad(np.swapaxes((T_gt @ symmetries)[:, :3, :3], 1, 2) @ T_est[:3, :3])
    return {
        "add": between[0].mean(),
        "adi": to_all.min(axis=1).mean(),
        "mssd": between.max(axis=1).min(),
        "mspd": pixels.max(axis=1).min(),
        "proj": pixels[0].mean(),
        "proj_sym": pixels.mean(axis=1).min(),
        "re": angles[0],
        "re_sym": angles.min(),
        "te": np.linalg.norm(T_est[:3, 3] - T_gt[:3, 3]),
    }


@pytest.mark.slow
@pytest.mark.parametrize("symmetric", [False, True])
def test_batches_and_single_poses_follow_the_definitions(symmetric):
    axis = (ContinuousSymmetry((0.0, 1.0, 0.0), (0.01, 0.0, 0.0)),) if symmetric else ()
    symmetries = symmetry_transforms(ModelInfo(diameter_m=0.1, symmetries_continuous=axis))
    T_est, T_gt = np.stack([pose(seed) for seed in range(8)]), np.stack([pose(seed) for seed in range(50, 58)])
    T_est[0] = moved(T_gt[0] @ symmetries[-1], x=0.001)

    def errors(T_est, T_gt):
        mspd, proj, proj_sym = metrics.projection_errors(T_est, T_gt, K, POINTS, symmetries)
        return {
            "add": metrics.add(T_est, T_gt, POINTS),
            "adi": metrics.adi(T_est, T_gt, POINTS),
            "mssd": metrics.mssd(T_est, T_gt, POINTS, symmetries),
            "mspd": mspd,
            "proj": proj,
            "proj_sym": proj_sym,
            "re": metrics.re(T_est, T_gt),
            "re_sym": metrics.re_symmetric(T_est, T_gt, symmetries),
            "te": metrics.te(T_est, T_gt),
        }

    batch, hull = errors(T_est, T_gt), metrics.mssd(T_est, T_gt, per_object.hull(POINTS), symmetries)
    for index, (estimate, gt) in enumerate(zip(T_est, T_gt, strict=True)):
        expected, single = plain_errors(estimate, gt, POINTS, symmetries), errors(estimate, gt)
        for name, value in expected.items():
            assert batch[name][index] == pytest.approx(value, abs=1e-10)
            assert single[name].shape == ()
            assert single[name] == batch[name][index]
        assert hull[index] == pytest.approx(expected["mssd"], abs=1e-12)


def test_vss_of_masks():
    first, second = np.zeros((4, 4), bool), np.zeros((4, 4), bool)
    assert metrics.vss(first, second) == 0.0
    first[:2], second[1:3] = True, True
    assert metrics.vss(first, second) == pytest.approx(4 / 12)
    assert metrics.vss(first, first) == 1.0


def test_visibility_follows_bop19():
    """Rows: behind something, at the surface, unmeasured; the estimate is also visible where the truth is."""
    scene = np.array([[0.5, 1.0, 0.0]])
    gt = np.array([[1.0, 1.01, 1.0]])
    est = np.array([[1.0, 1.1, 1.0]])
    visible_est, visible_gt = metrics.visible_masks(est, gt, scene)
    assert visible_gt.tolist() == [[False, True, True]]
    assert visible_est.tolist() == [[False, True, True]]
    assert metrics.visible_masks(est, np.zeros_like(gt), scene)[0].tolist() == [[False, False, True]]


def test_distance_is_depth_on_the_axis_and_longer_beside_it():
    K_small = np.array([[10.0, 0, 1.5], [0, 10.0, 0.5], [0, 0, 1]])
    distance = metrics.distance_from_depth(K_small, np.full((1, 3), 2.0))
    assert distance[0, 1] == pytest.approx(2.0)
    assert distance[0, 0] == distance[0, 2] == pytest.approx(2.0 * np.hypot(1.0, 0.1))
    shifted = metrics.distance_from_depth(K_small, np.full((1, 2), 2.0), x0_px=1)
    assert np.allclose(shifted, distance[:, 1:])
