"""Hundreds of cases whose errors are known without computing them: each says why beside it.

Objects are regular polygons of points and square plates: their distances, projections and silhouettes have formulas.
"""

import numpy as np
import pytest
from evalkit.evaluation.evaluator import Evaluator
from evalkit.inputs.pairing import MatchedPose
from evalkit.pose_errors import metrics
from evalkit.scores import scores
from posecore import se3
from posecore.bop import (
    BopDataset,
    BopWriter,
    Estimate,
    FrameRecord,
    GroundTruth,
    ModelInfo,
    symmetry_transforms,
    write_models,
)
from posecore.camera import Camera
from posecore.mesh import Mesh, load_mesh
from posecore.symmetry import ContinuousSymmetry, rotations_about_axis

from ..conftest import BOBBIN, IMAGES, TUG, write_dataset
from .test_metrics import moved, pose

K = np.array([[400.0, 0, 100], [0, 400.0, 60], [0, 0, 1]])
Z_AXIS, ORIGIN = np.array([0.0, 0.0, 1.0]), np.zeros(3)


def turn_z(*angles_rad):
    return rotations_about_axis(Z_AXIS, np.array(angles_rad), ORIGIN)


def polygon(corners, radius_m):
    angles = 2 * np.pi * np.arange(corners) / corners
    return radius_m * np.stack([np.cos(angles), np.sin(angles), np.zeros(corners)], -1)


@pytest.mark.parametrize("seed", range(60))
def test_a_translation_is_its_length_in_add_mssd_and_te(seed):
    """Every point moves by the same vector; none gets nearer to another true point than that, so ADI is no larger."""
    rng = np.random.default_rng(seed)
    points_m, t = rng.uniform(-0.05, 0.05, (30, 3)), rng.normal(size=3) * 0.02
    gt = pose(seed)
    estimate = moved(gt, *t)
    length = pytest.approx(np.linalg.norm(t), abs=1e-12)
    assert metrics.add(estimate, gt, points_m) == length
    assert metrics.mssd(estimate, gt, points_m, np.eye(4)[None]) == length
    assert metrics.te(estimate, gt) == length
    assert metrics.adi(estimate, gt, points_m) <= np.linalg.norm(t) + 1e-12
    assert metrics.te_axes(estimate, gt) == pytest.approx(t, abs=1e-12)


@pytest.mark.parametrize("seed", range(60))
def test_a_rotation_moves_points_along_chords(seed):
    """About an axis through the origin a point at distance r from it moves along a chord of 2 r sin(angle / 2)."""
    rng = np.random.default_rng(seed)
    points_m, axis, angle = rng.uniform(-0.05, 0.05, (30, 3)), se3.random_direction(rng), rng.uniform(0, np.pi)
    gt = pose(seed)
    estimate = gt @ rotations_about_axis(axis, np.array([angle]), ORIGIN)[0]
    chords = 2 * np.linalg.norm(np.cross(axis, points_m), axis=1) * np.sin(angle / 2)
    assert metrics.add(estimate, gt, points_m) == pytest.approx(chords.mean(), abs=1e-12)
    assert metrics.mssd(estimate, gt, points_m, np.eye(4)[None]) == pytest.approx(chords.max(), abs=1e-12)
    assert metrics.re(estimate, gt) == pytest.approx(angle, abs=1e-7)
    assert metrics.te(estimate, gt) == pytest.approx(0, abs=1e-12)


@pytest.mark.parametrize("corners", range(3, 13))
@pytest.mark.parametrize("steps", [0, 1, 2])
@pytest.mark.parametrize("rest", [0.0, 0.1, -0.1])
def test_a_regular_polygon_turned_in_its_plane(corners, steps, rest):
    """Corners come to lie `rest` past the next ones but `steps`: symmetric errors see `rest` alone, ADD the whole turn.

    The nearest true corner is one `rest` away, as half of the angle between corners, at least 0.26, is larger.
    """
    step = 2 * np.pi / corners
    points_m = polygon(corners, 0.05)
    symmetries = turn_z(*(step * np.arange(corners)))
    gt = pose(corners)
    angle = steps * step + rest
    estimate = gt @ turn_z(angle)[0]
    chord = 2 * 0.05 * np.sin(abs(rest) / 2)
    assert metrics.add(estimate, gt, points_m) == pytest.approx(2 * 0.05 * abs(np.sin(angle / 2)), abs=1e-12)
    assert metrics.adi(estimate, gt, points_m) == pytest.approx(chord, abs=1e-12)
    assert metrics.mssd(estimate, gt, points_m, symmetries) == pytest.approx(chord, abs=1e-12)
    assert metrics.re_symmetric(estimate, gt, symmetries) == pytest.approx(abs(rest), abs=1e-7)
    assert metrics.re(estimate, gt) == pytest.approx(abs((angle + np.pi) % (2 * np.pi) - np.pi), abs=1e-7)


@pytest.mark.parametrize("angle", np.linspace(0, 2 * np.pi, 30))
def test_a_ring_turned_about_its_axis(angle):
    """A continuous symmetry is sampled at steps: half of one is left at most, as an angle and along the rim."""
    info = ModelInfo(diameter_m=0.1, symmetries_continuous=(ContinuousSymmetry((0.0, 0.0, 1.0), (0.0, 0.0, 0.0)),))
    symmetries, points_m, gt = symmetry_transforms(info), polygon(200, 0.05), pose(3)
    half_step = np.pi / len(symmetries)
    estimate = gt @ turn_z(angle)[0]
    assert metrics.re_symmetric(estimate, gt, symmetries) <= half_step + 1e-9
    assert metrics.mssd(estimate, gt, points_m, symmetries) <= 2 * 0.05 * np.sin(half_step / 2) + 1e-12


@pytest.mark.parametrize("seed", range(60))
def test_projections_of_a_plate_that_faces_the_camera(seed):
    """All corners are at depth z: sideways by d is f d / z px for each; from z to z' one at X moves f X |1/z - 1/z'|.

    X is h sqrt(2) for the corners of a square of half side h, its centre on the optical axis.
    """
    rng = np.random.default_rng(seed)
    half, z, z_other, d = rng.uniform(0.01, 0.1), rng.uniform(0.3, 2), rng.uniform(0.3, 2), rng.uniform(0, 0.1)
    corners_m = half * np.array([[1.0, 1, 0], [1, -1, 0], [-1, -1, 0], [-1, 1, 0]])
    gt = se3.make_T(np.eye(3), np.array([0, 0, z]))
    sideways, deeper = moved(gt, x=d), moved(gt, z=z_other - z)
    one = np.eye(4)[None]
    assert metrics.mspd(sideways, gt, K, corners_m, one) == pytest.approx(400 * d / z, abs=1e-9)
    assert metrics.proj(sideways, gt, K, corners_m) == pytest.approx(400 * d / z, abs=1e-9)
    out = 400 * half * np.sqrt(2) * abs(1 / z - 1 / z_other)
    assert metrics.mspd(deeper, gt, K, corners_m, one) == pytest.approx(out, abs=1e-9)
    assert metrics.proj(deeper, gt, K, corners_m) == pytest.approx(out, abs=1e-9)


def test_projections_from_behind_the_camera_are_mirrored():
    """As in bop_toolkit: at -z a point X projects to where -X would at z, so both corners at +-X swap places."""
    ends_m = np.array([[0.05, 0.0, 0.0], [-0.05, 0.0, 0.0]])
    gt, behind = (se3.make_T(np.eye(3), np.array([0, 0, z])) for z in (0.5, -0.5))
    assert metrics.mspd(behind, gt, K, ends_m, np.eye(4)[None]) == pytest.approx(2 * 400 * 0.05 / 0.5)


PLATE = 9
PLATE_CAMERA = Camera(K=K, width_px=200, height_px=120)


@pytest.fixture(scope="module")
def plates(tmp_path_factory):
    """One image of a plate, 40 by 40 pixels at depth 1 about the principal point; its edges lie between pixels."""
    half = 0.05
    corners_m = np.array([[-half, -half, 0], [half, -half, 0], [half, half, 0], [-half, half, 0]])
    normals = np.tile([0.0, 0.0, -1.0], (4, 1))
    plate = Mesh(vertices_m=corners_m, faces=np.array([[0, 1, 2], [0, 2, 3]]), normals=normals)
    root = tmp_path_factory.mktemp("plates") / "plates"
    write_models(root, {PLATE: plate}, {})
    T = se3.make_T(np.eye(3), np.array([0.0, 0.0, 1.0]))
    mask = np.zeros((120, 200), bool)
    mask[40:80, 80:120] = True
    rgb, depth_m = np.zeros((120, 200, 3), np.uint8), np.where(mask, 1.0, 2.0).astype(np.float32)
    depth_m[:, :100] = 0.5  # something stands before the plate's left half
    visible = mask & (np.arange(200) >= 100)
    with BopWriter(root, "test", 1) as writer:
        writer.add_frame(
            0,
            FrameRecord(
                rgb=rgb,
                depth_m=depth_m,
                camera=PLATE_CAMERA,
                gts=[GroundTruth(obj_id=PLATE, T_cam_obj=T)],
                masks=[mask],
                masks_visib=[visible],
            ),
        )
    return BopDataset(root)


def plate_rows(plates, poses, kind="full"):
    gt = plates.gt(1, 0)[0]
    pairs = [
        MatchedPose(scene_id=1, im_id=0, gt=gt, estimate=Estimate(scene_id=1, im_id=0, obj_id=PLATE, T_cam_obj=T))
        for T in poses
    ]
    with Evaluator(plates, kind) as evaluator:
        return evaluator.evaluate(pairs)


def at_pixels(u=0, v=0, z_m=1.0):
    """Moved by whole pixels, which are 1 / 400 m at depth 1."""
    return se3.make_T(np.eye(3), np.array([u / 400 * z_m, v / 400 * z_m, z_m]))


def test_silhouettes_of_plates(plates):
    """Moved by u and v pixels, two squares of 40 share (40 - |u|) (40 - |v|) of their pixels."""
    shifts = [(u, v) for u in range(-48, 49, 6) for v in (-45, -20, -1, 0, 7, 33)]
    expected = []
    for u, v in shifts:
        shared = max(40 - abs(u), 0) * max(40 - abs(v), 0)
        expected.append(shared / (2 * 40**2 - shared))
    rows = plate_rows(plates, [at_pixels(u, v) for u, v in shifts])
    np.testing.assert_allclose(rows.vss, expected, atol=1e-12)


@pytest.mark.parametrize(
    ("pose_of_estimate", "expected"),
    [
        (at_pixels(z_m=0.5), 40**2 / 80**2),  # twice as near, twice as wide: 80 px, all inside the image
        (at_pixels(z_m=2.0), 20**2 / 40**2),  # twice as far: 20 px, inside the true 40
        (at_pixels(u=100), 0.0),  # half off the image: nothing shared
        (at_pixels(u=5000), 0.0),  # off the image: an empty silhouette
        (at_pixels(z_m=-1.0), 0.0),  # behind the camera
        (at_pixels(z_m=90.0), 0.0),  # 0.44 px about a pixel's corner: covers no pixel's centre
        (at_pixels(z_m=0.1), 40**2 / (120 * 200)),  # fills the image
    ],
)
def test_silhouettes_at_the_edges(plates, pose_of_estimate, expected):
    row = plate_rows(plates, [pose_of_estimate]).iloc[0]
    assert row.vss == pytest.approx(expected, abs=1e-12)
    assert row.te_m == pytest.approx(np.linalg.norm(pose_of_estimate[:3, 3] - [0, 0, 1]))


def test_visible_silhouettes_of_a_half_hidden_plate(plates):
    """Of the truth the right half is seen, columns 100 to 119; of the estimate, u further right, columns up to 119 + u.

    Its first is 100 or its own left edge at 80 + u: further right it is at the depth of the plate that the scene holds,
    or before the background.
    """
    for u in (0, 5, 10, 20, 30):
        row = plate_rows(plates, [at_pixels(u)], "visible").iloc[0]
        first = max(100, 80 + u)
        shared = max(120 - first, 0)
        union = len(set(range(100, 120)) | set(range(first, 120 + u)))
        assert row.vss == pytest.approx(shared / union, abs=1e-12)


def test_vsd_of_a_plate_in_depth(plates):
    """A centimetre farther is within delta, so the same half is seen, all of it wrong or right at a tolerance."""
    rows = plate_rows(plates, [at_pixels(), at_pixels(z_m=1.01)])
    diameter_m = np.sqrt(2) * 0.1
    names = [name for name in rows.columns if name.startswith("vsd_")]
    assert len(names) == 10
    assert (rows.loc[0, names] == 0).all()
    for name in names:
        tau_m = float(name.removeprefix("vsd_")) * diameter_m
        expected = 0.0 if tau_m > 0.0101 else 1.0  # at 1.01 the plate is 39.6 px wide: the same pixels
        assert rows.loc[1, name] == pytest.approx(expected, abs=1e-12), name


@pytest.mark.slow
def test_truth_under_any_of_its_symmetries_scores_perfectly(tmp_path, tug_ply, bobbin_ply):
    """Every sampled turn of the continuous one, and a discrete one: errors that know of symmetries are 0, recalls 1."""
    dataset = BopDataset(write_dataset(tmp_path / "toys", {TUG: load_mesh(tug_ply), BOBBIN: load_mesh(bobbin_ply)}))
    flip = ModelInfo(
        diameter_m=dataset.models_info[TUG].diameter_m, symmetries_discrete=(np.diag([-1.0, -1.0, 1.0, 1.0]),)
    )
    dataset.models_info[TUG] = flip
    pairs = []
    for scene_id, im_id in IMAGES:
        for gt in dataset.gt(scene_id, im_id):
            for S in symmetry_transforms(dataset.models_info[gt.obj_id]):
                estimate = Estimate(scene_id=scene_id, im_id=im_id, obj_id=gt.obj_id, T_cam_obj=gt.T_cam_obj @ S)
                pairs.append(MatchedPose(scene_id=scene_id, im_id=im_id, gt=gt, estimate=estimate))
    with Evaluator(dataset) as evaluator:
        rows = evaluator.evaluate(pairs)
    assert len(rows) > 900
    assert rows.mssd_m.max() < 1e-9
    assert rows.mspd_px.max() < 1e-6
    assert rows.proj_sym_px.max() < 1e-6
    assert rows.re_sym_rad.max() < 1e-6
    total = scores(rows)
    assert (total["ar_mssd"], total["ar_mspd"], total["5cm5deg"]) == (1.0, 1.0, 1.0)
