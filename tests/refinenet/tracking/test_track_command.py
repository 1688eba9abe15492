"""`refinenet track` through files: a BOP scene, a folder of images, a video."""

import csv
import itertools
import json
import os
import shutil
from contextlib import closing
from dataclasses import replace

import cv2
import numpy as np
import pytest
from posecore import se3
from posecore.bop import (
    BopDataset,
    Estimate,
    ModelInfo,
    read_results,
    read_sidecar,
)
from posecore.bop import write_results as write
from posecore.errors import CameraError, DatasetError
from posecore.mesh import load_mesh, save_ply
from posecore.symmetry import ContinuousSymmetry
from refinenet.baselines.global_search import GradientSearch
from refinenet.refine.network_refiner import Refiner
from refinenet.refine.registry import MethodSettings, make_refiner
from refinenet.refiner import Refinement, Status
from refinenet.tracking import tracker
from refinenet.tracking.frame_sources import FileCamera, ImageFolder, VideoFile, read_camera
from refinenet.tracking.state import GRADIENT_TRACKING, LEARNED_TRACKING, SEARCH_TRACKING, UNSCORED_TRACKING
from refinenet.tracking.tracker import Tracker, default_config
from refinenet.tracking.video import VideoWriter

from ..conftest import HEIGHT_PX, WIDTH_PX, K
from .conftest import BACK, FRAMES, GONE, still_checkpoint, write_scene


@pytest.mark.slow
def test_a_bop_scene_with_a_gap(cli, scene, still, tmp_path, monkeypatch):
    root, truths = scene
    monkeypatch.setattr(tracker, "DEPTH_MARGIN", 0.015)  # a step of 3 % gains 0.02 here, at the edge of the default
    out, video = tmp_path / "track.csv", tmp_path / "track.mp4"
    result = cli(
        "track", "--dataset", root, "--checkpoint", still, "--init", root / "start.csv", "--out", out, "--video", video,
        "--patience", 3, "--quiet",
    )  # fmt: skip
    assert result.exit_code == 0, result.output
    assert "14 frames, 9 tracking, 2 uncertain, 3 lost; 2 starts from an initial pose" in result.stdout
    assert "frames/s tracking" in result.stdout
    found = {estimate.im_id: estimate for estimate in read_results(out, BopDataset(root))}
    assert sorted(found) == [i for i in range(FRAMES) if i not in GONE]
    for im_id, estimate in found.items():  # the network moves nothing: it is the depths tried that follow the object
        assert abs(estimate.T_cam_obj[2, 3] / truths[im_id][2, 3] - 1) < 0.021
        assert estimate.time_s > 0
    sidecar = read_sidecar(out)
    assert sidecar["states"] == {"tracking": 9, "uncertain": 2, "lost": 3}
    assert sidecar["resets"] == [{"scene_id": 1, "im_id": i, "obj_id": 1} for i in (0, BACK)]
    assert [miss["im_id"] for miss in sidecar["misses"]] == list(GONE)
    assert frames_of(video) == FRAMES


def frames_of(video):
    opened, count = cv2.VideoCapture(str(video)), 0
    while opened.read()[0]:
        count += 1
    return count


@pytest.mark.slow
def test_a_folder_and_a_video_give_the_scenes_poses(cli, scene, still, mesh, tmp_path):
    root, truths = scene
    folder = shutil.copytree(root / "test" / "000001" / "rgb", tmp_path / "images")
    writer = cv2.VideoWriter(str(tmp_path / "clip.avi"), cv2.VideoWriter.fourcc(*"MJPG"), 30, (WIDTH_PX, HEIGHT_PX))
    for file in sorted(folder.iterdir()):
        writer.write(cv2.imread(str(file)))
    writer.release()
    save_ply(mesh, tmp_path / "part.ply", units="m")
    (tmp_path / "models_info.json").write_text('{"part": {"diameter": 100.0}, "other": {"diameter": -1}}')
    rest = ["--camera", root / "cam.json", "--mesh", tmp_path / "part.ply", "--pose", root / "pose.json"]
    options = ["--checkpoint", still, "--out", tmp_path / "x.csv"]
    assert "--units m " in cli("track", folder, *rest, *options).stderr
    rest += ["--units", "m"]
    for source in (folder, tmp_path / "clip.avi"):
        out = tmp_path / f"{source.name}.csv"
        result = cli("track", source, "--checkpoint", still, *rest, "--out", out, "--quiet", "--motion-model")
        assert result.exit_code == 0, result.output
        found = {row["im_id"]: row for row in csv.DictReader(out.open())}
        assert set(found) >= {"0", "1", "2", "3"}
        assert {row["scene_id"] for row in found.values()} == {"0"}
        t_mm = np.array(found["3"]["t"].split(), float)
        # the network moves nothing, and a depth step is not taken before it is clearly better
        np.testing.assert_allclose(t_mm, 1e3 * truths[3][:3, 3], rtol=0.035)


@pytest.mark.slow
@pytest.mark.parametrize("method", ["edge-icp", "depth-icp"])
def test_a_baseline_tracks_without_a_checkpoint(cli, scene, tmp_path, method):
    root, truths = scene
    out = tmp_path / "track.csv"
    options = ["--method", method, "--init", root / "start.csv", "--out", out, "--iterations", 2, "--quiet"]
    result = cli("track", "--dataset", root, *options)
    assert result.exit_code == 0, result.output
    found = {estimate.im_id: estimate.T_cam_obj for estimate in read_results(out, BopDataset(root))}
    assert set(range(4)) <= set(found)
    for im_id in range(4):
        assert np.linalg.norm(found[im_id][:3, 3] - truths[im_id][:3, 3]) < 0.01
    sidecar = read_sidecar(out)
    assert sidecar["method"] == f"{method}, tracking"
    assert "checkpoint" not in sidecar
    assert sidecar["settings"]["depth_step"] == 0


def test_search_is_believed_where_it_does_not_fail(cli, scene, tmp_path, monkeypatch):
    def found(self, frame, T_cam_obj, target):
        return Refinement(T_cam_obj=T_cam_obj, status=Status.STOPPED, iterations=1, confidence=0.42)

    monkeypatch.setattr(GradientSearch, "_refine", found)
    root, _ = scene
    out = tmp_path / "track.csv"
    result = cli(
        "track", "--dataset", root, "--method", "search", "--init", root / "start.csv", "--out", out, "--quiet"
    )
    assert result.exit_code == 0, result.output
    assert read_sidecar(out)["states"]["tracking"] == FRAMES
    result = cli(
        "track",
        "--dataset",
        root,
        "--method",
        "search",
        "--init",
        root / "start.csv",
        "--out",
        out,
        "--tracking-threshold",
        0.5,
    )
    assert read_sidecar(out)["states"]["lost"] == FRAMES
    assert "No pose, 3 times: the best pose has a confidence of 0.42" in result.stderr


@pytest.mark.slow
@pytest.mark.parametrize(
    ("symmetries", "turn_deg"),
    [
        ({"symmetries_continuous": (ContinuousSymmetry((0.0, 0.0, 1.0), (0.0, 0.0, 0.0)),)}, 137.0),
        ({"symmetries_discrete": (np.diag([-1.0, -1.0, 1.0, 1.0]),)}, 180.0),
    ],
)
def test_a_symmetric_object_does_not_spin_when_it_is_found_again(cli, bobbin_ply, tmp_path, symmetries, turn_deg):
    """A detector gives any of the poses that look alike: where it is found again it is offered turned by that."""
    mesh = load_mesh(bobbin_ply)
    rng = np.random.default_rng(8)
    truth = se3.make_T(se3.random_rotation(rng), np.array([0.02, 0.01, 6 * mesh.diameter_m]))
    truths = [
        se3.apply_update(truth, se3.rotation_from_rotvec(np.array([0, 0.02 * i, 0])), np.zeros(3)) for i in range(8)
    ]
    write_scene(tmp_path / "bop", mesh, truths, range(3, 5), ModelInfo(diameter_m=mesh.diameter_m, **symmetries))
    turn = se3.make_T(se3.rotation_from_rotvec(np.array([0, 0, np.deg2rad(turn_deg)])), np.zeros(3))
    offered = {0: truths[0] @ turn, 5: truths[5]}
    write(tmp_path / "start.csv", [Estimate(scene_id=1, im_id=i, obj_id=1, T_cam_obj=T) for i, T in offered.items()])
    checkpoint_file = still_checkpoint(tmp_path / "still.safetensors", mesh)
    options = ["--init", tmp_path / "start.csv", "--out", tmp_path / "track.csv", "--patience", 1, "--quiet"]
    result = cli("track", "--dataset", tmp_path / "bop", "--checkpoint", checkpoint_file, *options)
    assert result.exit_code == 0, result.output
    assert [reset["im_id"] for reset in read_sidecar(tmp_path / "track.csv")["resets"]] == [0, 5]
    poses = [estimate.T_cam_obj for estimate in read_results(tmp_path / "track.csv")]
    assert len(poses) >= 6
    turned = [np.rad2deg(se3.rotation_angle_rad(b[:3, :3] @ a[:3, :3].T)) for a, b in itertools.pairwise(poses)]
    assert max(turned) < 10
    np.testing.assert_allclose(poses[0], offered[0], atol=1e-6)


@pytest.mark.slow
def test_the_shipped_flow_network_follows_a_turning_object(cli, repository, tug_ply, tmp_path):
    """Without the three depths that other networks need: depth neither drifts off nor is each frame done thrice."""
    mesh = load_mesh(tug_ply)
    rng = np.random.default_rng(5)
    first = se3.make_T(se3.random_rotation(rng), np.array([0.02, 0.01, 6 * mesh.diameter_m]))
    turn = se3.rotation_from_rotvec(np.deg2rad(4) * np.array([0.6, 0.0, 0.8]))
    truths = [first]
    while len(truths) < 12:
        truths.append(se3.apply_update(truths[-1], turn, np.array([0.002, -0.001, 0.004])))
    write_scene(tmp_path / "bop", mesh, truths, ())
    start = se3.perturb(first, np.deg2rad(8), 0.05 * mesh.diameter_m, rng)
    write(tmp_path / "start.csv", [Estimate(scene_id=1, im_id=0, obj_id=1, T_cam_obj=start)])
    network = repository / "examples" / "checkpoints" / "tug_flow.safetensors"
    options = ["--init", tmp_path / "start.csv", "--out", tmp_path / "track.csv", "--threads", 1, "--quiet"]
    result = cli("track", "--dataset", tmp_path / "bop", "--checkpoint", network, *options)
    assert result.exit_code == 0, result.output
    sidecar = read_sidecar(tmp_path / "track.csv")
    assert sidecar["settings"]["depth_step"] == 0
    assert sidecar["states"] == {"tracking": 12, "uncertain": 0, "lost": 0}
    for estimate, truth in zip(read_results(tmp_path / "track.csv"), truths, strict=True):
        apart = estimate.T_cam_obj[:3, :3] @ truth[:3, :3].T
        assert np.rad2deg(se3.rotation_angle_rad(apart)) < 4
        assert np.abs(estimate.T_cam_obj[:2, 3] - truth[:2, 3]).max() < 0.02 * mesh.diameter_m
        assert abs(estimate.T_cam_obj[2, 3] - truth[2, 3]) < 0.15 * mesh.diameter_m


def test_each_method_is_believed_by_its_own_rule(still, mesh, repository, tug_ply):
    flow = repository / "examples" / "checkpoints" / "tug_flow.safetensors"
    for made, usual in (
        (Refiner.load(still, {1: mesh}), GRADIENT_TRACKING),
        (Refiner.load(flow, {1: load_mesh(tug_ply)}), replace(LEARNED_TRACKING, depth_step=0.0)),
        (make_refiner(MethodSettings(method="search", iterations=5), {1: mesh}, None), SEARCH_TRACKING),
        (make_refiner(MethodSettings(method="edge-icp", iterations=5), {1: mesh}, None), UNSCORED_TRACKING),
    ):
        with closing(made):
            assert default_config(made) == usual
            assert Tracker(made, [1])._tracks[0].config == usual


def test_names_with_numbers_are_in_their_order(tmp_path):
    for number in (10, 2, 1):
        cv2.imwrite(str(tmp_path / f"f{number}.png"), np.full((HEIGHT_PX, WIDTH_PX, 3), number, np.uint8))
    folder = ImageFolder(folder=tmp_path, camera=FileCamera(file=tmp_path / "cam.json", K=K))
    frames = list(folder.frames(make_refiner(MethodSettings(method="edge-icp", iterations=1), {}, None)))
    assert [(number, frame.image[0, 0, 0]) for number, frame in frames] == [(0, 1), (1, 2), (2, 10)]


def test_ros_stamps_are_frame_numbers_and_longer_digits_are_not(tmp_path):
    method = make_refiner(MethodSettings(method="edge-icp", iterations=1), {}, None)
    for stems, numbers in (
        (["1714129813249123450", "1714129813249123451"], [1714129813249123450, 1714129813249123451]),
        (["17141298132491234500", "17141298132491234501"], [0, 1]),
    ):
        folder = tmp_path / stems[0]
        folder.mkdir()
        for stem in stems:
            cv2.imwrite(str(folder / f"{stem}.png"), np.zeros((HEIGHT_PX, WIDTH_PX, 3), np.uint8))
        frames = ImageFolder(folder=folder, camera=FileCamera(file=tmp_path / "cam.json", K=K)).frames(method)
        assert [number for number, _ in frames] == numbers


def test_a_video_that_is_a_pipe_does_not_block(tmp_path):
    os.mkfifo(tmp_path / "pipe.avi")
    with pytest.raises(DatasetError, match=r"pipe\.avi: cannot be read \(is a pipe, expected a regular file\)"):
        VideoFile(file=tmp_path / "pipe.avi", camera=FileCamera(file=tmp_path / "cam.json", K=K))


@pytest.mark.parametrize(
    ("content", "line"),
    [
        ('{"fx": 1e308, "fy": 1, "cx": 0, "cy": 0}', "camera matrix: found"),
        ('{"fx": 0, "fy": 1, "cx": 0, "cy": 0}', "camera matrix: found"),
        ('{"fx": 1e999, "fy": 1, "cx": 0, "cy": 0}', "'fx' holds inf, expected 1 finite numbers"),
        ('{"fx": 500, "fy": 500, "cx": 0}', "has no 'cy', expected 1 numbers"),
        ('{"fx": 500, "fy": 500, "cx": 0, "cy": 0, "width": -1, "height": 2}', "'width' is -1, expected an integer"),
        (
            '{"fx": 500, "fy": 500, "cx": 0, "cy": 0, "width": 99999999, "height": 2}',
            "image size: found 99999999 x 2 px",
        ),
        ("[" * 100_000, "brackets are nested too deep"),
        ("null", "found a NoneType at the top"),
    ],
)
def test_a_camera_file_out_of_bounds_is_one_line(tmp_path, content, line):
    file = tmp_path / "camera.json"
    file.write_text(content)
    with pytest.raises(CameraError) as caught:
        read_camera(file)
    assert str(caught.value).startswith(str(file))
    assert line in str(caught.value)


@pytest.mark.slow
def test_a_video_that_is_cut_off_is_not_taken_for_a_short_one(tmp_path):
    rng = np.random.default_rng(0)
    with VideoWriter(tmp_path / "whole.avi", 10) as writer:
        for _ in range(20):
            writer.write(rng.integers(0, 255, (HEIGHT_PX, WIDTH_PX, 3), np.uint8))
    content = (tmp_path / "whole.avi").read_bytes()
    (tmp_path / "cut.avi").write_bytes(content[: len(content) // 2])
    camera, method = (
        FileCamera(file=tmp_path / "cam.json", K=K),
        make_refiner(MethodSettings(method="edge-icp", iterations=1), {}, None),
    )
    assert len(list(VideoFile(file=tmp_path / "whole.avi", camera=camera).frames(method))) == 20
    seen = []
    with pytest.raises(DatasetError, match=r"cut\.avi: ends after frame \d+ of 20, it is damaged or cut off"):
        seen.extend(number for number, _ in VideoFile(file=tmp_path / "cut.avi", camera=camera).frames(method))


@pytest.mark.slow
def test_track_errors_are_one_line(cli, scene, still, tmp_path):
    root, _ = scene
    images = root / "test" / "000001" / "rgb"
    (tmp_path / "empty").mkdir()
    (tmp_path / "no.mp4").write_bytes(b"not a video")
    (tmp_path / "cam.json").write_text('{"fx": 1}')
    known = json.loads((root / "cam.json").read_text())
    (tmp_path / "big.json").write_text(json.dumps({**known, "width": WIDTH_PX + 1, "height": HEIGHT_PX}))
    metres = [{"obj_id": 1, "cam_R_m2c": [1, 0, 0, 0, 1, 0, 0, 0, 1], "cam_t_m2c": [0, 0, 0.5]}]
    (tmp_path / "metres.json").write_text(json.dumps(metres))
    (tmp_path / "twins").mkdir()
    for name in ("1.png", "01.png"):
        shutil.copy(next(images.iterdir()), tmp_path / "twins" / name)
    mesh_file = next((root / "models").glob("*.ply"))
    init, pose, camera = ["--init", root / "start.csv"], ["--pose", root / "pose.json"], ["--camera", root / "cam.json"]
    for arguments, code, text in (
        ([tmp_path / "none", *init], 1, "no such folder or file"),
        (["--dataset", root, *init, "--scene", 7], 1, "no scene 7"),
        (["--dataset", root, *init, "--object", 5], 2, "no pose of object 5 for scene 1"),
        ([images, *pose], 2, "need --camera"),
        ([images, *pose, "--camera", tmp_path / "cam.json"], 1, "has no 'fy', expected 1 numbers"),
        ([images, *pose, *camera], 2, "object 1 has an initial pose and no mesh; give its file with --mesh"),
        ([tmp_path / "empty", *pose, *camera], 1, "no images"),
        ([root, *init], 2, f"track {root} is now track --dataset {root}"),
        (["--dataset", images, *init], 2, "found no models folder in it, expected a BOP dataset"),
        (["--dataset", root, images, *init], 2, "give SOURCE, a folder of images or a video file, or else --dataset"),
        ([tmp_path / "no.mp4", *pose, *camera], 1, "cannot open it as a video"),
        (
            ["--dataset", root, *init, "--tracking-threshold", 0.2, "--accept-threshold", 0.4],
            2,
            "expected 0 <= accept_threshold <= tr",
        ),
        (["--dataset", root, *init, "--video", tmp_path / "film.xyz"], 1, "choose a name ending in .mp4 or .avi"),
        (["--dataset", root, *init, "--method", "edge-icp"], 2, "--method edge-icp takes no --checkpoint"),
        (["--dataset", root, *init, *camera], 2, "--camera is for images and videos"),
        (["--dataset", root, *init, "--fps", 10], 2, "--fps has no effect without --video; leave it out"),
        ([images, *pose, *camera, "--split", "test"], 2, "--split is for BOP datasets"),
        (
            [images, "--pose", tmp_path / "metres.json", *camera, "--mesh", mesh_file],
            2,
            "a t of length 0.5 is probably in metres",
        ),
        ([images, *pose, "--camera", tmp_path / "big.json", "--mesh", mesh_file], 1, f"expected {WIDTH_PX + 1} x"),
        ([tmp_path / "twins", *pose, *camera], 1, "01.png and 1.png have one number"),
        (["--dataset", root, *init, "--video", root / "start.csv"], 2, "--video and --init are both"),
    ):
        result = cli("track", *arguments, "--checkpoint", still, "--out", tmp_path / "x.csv", "--quiet")
        assert result.exit_code == code, result.output
        assert text in result.stderr, result.stderr
        assert "Traceback" not in result.output
        assert len([line for line in result.stderr.splitlines() if line.startswith("Error: ")]) == 1
    assert cli("track", "--dataset", root, "--checkpoint", still, "--out", tmp_path / "x.csv").exit_code == 2
    assert "needs a --checkpoint" in cli("track", "--dataset", root, *init, "--out", tmp_path / "x.csv").stderr
    edges = ["--method", "edge-icp", "--allow-other-mesh", "--out", tmp_path / "x.csv"]
    assert (
        "--allow-other-mesh has no effect for --method edge-icp"
        in cli("track", "--dataset", root, *init, *edges).stderr
    )
    (tmp_path / "none.json").write_text("[]")
    shutil.copy(root / "pose.json", tmp_path / "x.json")
    for arguments, text in (
        (
            ["--method", "edge-icp", *init, "--tracking-threshold", 0.9],
            "--tracking-threshold has no effect for --method edge-icp, which has no",
        ),
        (["--method", "edge-icp", *init, "--depth-step", 0.1], "--depth-step has no effect for --method edge-icp"),
        (["--method", "edge-icp", *init, "--object", 1, "--object", 9], "no pose of object 9 for scene 1"),
        (
            ["--method", "edge-icp", "--pose", tmp_path / "none.json"],
            "none.json: no pose; list the initial poses of the objects",
        ),
        (["--method", "edge-icp", "--pose", tmp_path / "x.json"], "the sidecar of --out and --pose are both"),
    ):
        result = cli("track", "--dataset", root, *arguments, "--out", tmp_path / "x", "--quiet")
        assert (result.exit_code, text in result.stderr) == (2, True), result.output
    assert json.loads((tmp_path / "x.json").read_text()) == json.loads((root / "pose.json").read_text())


def test_search_is_asked_for_what_is_found(cli, scene, tmp_path, monkeypatch):
    asked = []

    def refine(self, frame, T_cam_obj, target):
        asked.append(self._min_confidence)
        return Refinement(T_cam_obj=T_cam_obj, status=Status.STOPPED, iterations=1, confidence=0.2)

    monkeypatch.setattr(GradientSearch, "_refine", refine)
    root, _ = scene
    out = tmp_path / "track.csv"
    options = ["--method", "search", "--init", root / "start.csv", "--out", out, "--quiet", "--tracking-threshold", 0.2]
    assert cli("track", "--dataset", root, *options, "--accept-threshold", 0.1).exit_code == 0
    assert set(asked) == {0.1}
    assert read_sidecar(out)["states"]["tracking"] == FRAMES


def test_a_run_that_stops_early_says_how_much_it_did_not_reach(cli, scene, still, tmp_path):
    root, _ = scene
    copy = tmp_path / "copy"
    shutil.copytree(root, copy)
    images = sorted((copy / "test" / "000001" / "rgb").iterdir())
    images[3].write_bytes(b"damaged")
    out = tmp_path / "track.csv"
    result = cli(
        "track", "--dataset", copy, "--checkpoint", still, "--init", root / "start.csv", "--out", out, "--quiet"
    )
    assert result.exit_code == 1
    assert read_sidecar(out)["not_reached"] == FRAMES - 3


def test_depth_for_a_method_that_needs_it(cli, scene, mesh, tmp_path):
    root, _ = scene
    save_ply(mesh, tmp_path / "part.ply", units="mm")
    images = root / "test" / "000001" / "rgb"
    rest = ["--pose", root / "pose.json", "--camera", root / "cam.json", "--mesh", tmp_path / "part.ply"]
    result = cli("track", images, "--method", "depth-icp", *rest, "--out", tmp_path / "x.csv", "--quiet")
    assert result.exit_code == 1
    assert "images and videos have no depth, which depth-icp needs; give a BOP dataset" in result.stderr
