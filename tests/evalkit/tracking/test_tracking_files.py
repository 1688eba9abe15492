"""`evalkit tracking` on a small sequence: pairing, resets from the sidecar, several files, files written."""

import json

import numpy as np
import pytest
from click.testing import CliRunner
from evalkit.cli.tracking import tracking
from evalkit.inputs.result_files import load_result_files
from evalkit.tracking import frames_of, track_scores, tracks_of
from posecore import se3
from posecore.bop import (
    BopDataset,
    BopWriter,
    Estimate,
    FrameRecord,
    GroundTruth,
    write_models,
    write_results,
    write_targets,
)
from posecore.bop.annotations import BopTarget
from posecore.camera import Camera
from posecore.command_line import ErrorReportingGroup
from posecore.errors import ResultFileError
from posecore.mesh import load_mesh

TUG, BOBBIN = 1, 5
FRAMES = tuple(range(10, 30, 2))  # ten frames with gaps in their numbers, which are no gaps in time
CAMERA = Camera(K=np.array([[100.0, 0, 16], [0, 100, 12], [0, 0, 1]]), width_px=32, height_px=24)
GROUP = ErrorReportingGroup(commands={"tracking": tracking})


def pose(frame, x_m):
    R = se3.rotation_from_rotvec(np.array([0.0, 0.02 * frame, 0.01 * frame]))
    return se3.make_T(R, np.array([x_m, 0.001 * frame, 0.6]))


def write_sequence(root, tug_ply, bobbin_ply):
    """Scene 3: one tug and two bobbins, which always stand left and right."""
    write_models(root, {TUG: load_mesh(tug_ply), BOBBIN: load_mesh(bobbin_ply)})
    mask = np.ones((24, 32), bool)
    with BopWriter(root, "test", 3) as writer:
        for frame in FRAMES:
            poses = [(BOBBIN, -0.1), (TUG, 0.0), (BOBBIN, 0.1)]
            gts = [GroundTruth(obj_id=obj_id, T_cam_obj=pose(frame, x_m)) for obj_id, x_m in poses]
            writer.add_frame(
                frame,
                FrameRecord(
                    rgb=np.zeros((24, 32, 3), np.uint8),
                    depth_m=None,
                    camera=CAMERA,
                    gts=gts,
                    masks=[mask] * 3,
                    masks_visib=[mask] * 3,
                ),
            )
    return root


@pytest.fixture(scope="module")
def sequence(tmp_path_factory, tug_ply, bobbin_ply):
    return write_sequence(tmp_path_factory.mktemp("bop") / "video", tug_ply, bobbin_ply)


def estimate(frame, obj_id, x_m, t_m=(0.0, 0.0, 0.0), score=1.0):
    T = se3.apply_update(pose(frame, x_m), np.eye(3), np.array(t_m))
    return Estimate(scene_id=3, im_id=frame, obj_id=obj_id, T_cam_obj=T, score=score, time_s=0.02)


def tugs(t_m=(0.002, 0.0, 0.0), without=()):
    return [estimate(frame, TUG, 0.0, t_m) for frame in FRAMES if frame not in without]


def read(path, root, **options):
    dataset = BopDataset(root)
    (file,) = load_result_files([path], dataset)
    return tracks_of(dataset, file, *frames_of(dataset, file, **options))


def run(*arguments):
    return CliRunner().invoke(GROUP, ["tracking", *map(str, arguments)], catch_exceptions=False)


def test_every_object_and_instance_of_a_scene_is_a_sequence(sequence, tmp_path):
    # The right bobbin's estimates come first in the file and have the higher score: places decide, not order.
    estimates = [
        estimate(frame, BOBBIN, x_m, (0, 0, t_m), score)
        for frame in FRAMES
        for x_m, t_m, score in ((0.1, 0.003, 0.9), (-0.1, 0.001, 0.5))
    ]
    write_results(tmp_path / "r.csv", [*estimates, *tugs()])
    tracks = read(tmp_path / "r.csv", sequence)
    assert [track.name for track in tracks] == [
        "scene 3, object 1",
        "scene 3, object 5, instance 1",
        "scene 3, object 5, instance 2",
    ]
    assert [track_scores(track)["z_rms_mm"] for track in tracks] == pytest.approx([0.0, 1.0, 3.0], abs=1e-5)
    assert tracks[0].im_id.tolist() == list(FRAMES)
    assert tracks[0].frame.tolist() == list(range(10))
    assert track_scores(tracks[0])["time_ms_mean"] == pytest.approx(20.0)


def test_frames_without_an_estimate_are_lost_and_objects_without_any_are_lost_throughout(sequence, tmp_path):
    write_results(tmp_path / "r.csv", tugs(without=(14, 28)))
    tug, *bobbins = read(tmp_path / "r.csv", sequence)
    assert track_scores(tug)["lost"] == 2.0
    assert [track_scores(track)["lost"] for track in bobbins] == [10.0, 10.0]


def test_of_several_estimates_the_best_scored_counts(sequence, tmp_path):
    worse = [estimate(frame, TUG, 0.0, (0.02, 0, 0), score=0.5) for frame in FRAMES]
    write_results(tmp_path / "r.csv", worse + tugs())
    assert track_scores(read(tmp_path / "r.csv", sequence)[0])["x_rms_mm"] == pytest.approx(2.0)


def test_targets_say_what_is_expected_unless_all_frames_are_wanted(sequence, tmp_path, tug_ply, bobbin_ply):
    root = write_sequence(tmp_path / "video", tug_ply, bobbin_ply)
    write_targets(root, "test", [BopTarget(scene_id=3, im_id=frame, obj_id=TUG) for frame in FRAMES[::5]])
    write_results(tmp_path / "r.csv", tugs())
    (tug,) = read(tmp_path / "r.csv", root)
    assert tug.im_id.tolist() == [10, 20]
    assert tug.frame.tolist() == [0, 5]  # so that no jitter is taken across four frames
    assert np.isnan(track_scores(tug)["jitter_mm_median"])
    everything = read(tmp_path / "r.csv", root, all_frames=True)
    assert [len(track.im_id) for track in everything] == [10, 10, 10]


def test_resets_in_the_sidecar_are_failures_but_for_the_first_frame(sequence, tmp_path):
    resets = [{"scene_id": 3, "im_id": frame, "obj_id": TUG} for frame in (10, 16, 20)]
    write_results(tmp_path / "r.csv", tugs(without=(10, 16)), {"resets": resets})
    scores = track_scores(read(tmp_path / "r.csv", sequence)[0])
    assert (scores["frames"], scores["resets"], scores["failed"]) == (9.0, 2.0, 2.0)
    assert scores["success_5cm5deg"] == pytest.approx(7 / 9)
    assert scores["x_rms_mm"] == pytest.approx(2.0)


@pytest.mark.parametrize(
    ("resets", "message"),
    [
        ({"3": [10]}, " is a dict, expected a list"),
        ([[3, 10, 1]], "entry 0: expected whole numbers scene_id, im_id, obj_id"),
        ([{"scene_id": 3, "im_id": 10}], "entry 0: expected whole numbers"),
        ([{"scene_id": 3, "im_id": 10, "obj_id": True}], "entry 0: expected whole numbers"),
        ([{"scene_id": 3, "im_id": 10.5, "obj_id": 1}], "entry 0: expected whole numbers"),
        ([{"scene_id": 3, "im_id": 10, "obj_id": 1}, {"scene_id": 3, "im_id": 11, "obj_id": 1}], "no image 11 in sc"),
        ([{"scene_id": 4, "im_id": 10, "obj_id": 1}], "there is no image 10 in scene 4"),
    ],
)
def test_broken_resets_are_named(sequence, tmp_path, resets, message):
    write_results(tmp_path / "r.csv", tugs(), {"resets": resets})
    with pytest.raises(ResultFileError, match=r"r\.csv\.json: 'resets'.*" + message):
        read(tmp_path / "r.csv", sequence)


def test_the_command_prints_a_table_and_says_that_it_is_no_reset_run(sequence, tmp_path):
    write_results(tmp_path / "r.csv", tugs(without=(14,)))
    result = run("--dataset", sequence, "--results", tmp_path / "r.csv", "--object", 1)
    assert result.exit_code == 0, result.output
    (line,) = [line for line in result.output.splitlines() if line.startswith("| scene 3")]
    cells = [cell.strip() for cell in line.strip("|").split("|")]
    assert cells[:6] == ["scene 3, object 1", "10", "1", "2.00", "0.00", "0.00"]
    assert "90.0" in cells
    assert "not RBOT's number" in result.output


def test_several_files_stand_side_by_side_and_are_written_as_asked(sequence, tmp_path):
    write_results(tmp_path / "a.csv", tugs(), {"dataset": str(sequence), "method": "ours"})
    write_results(tmp_path / "b.csv", tugs((0.0, 0.004, 0.0)), {"dataset": str(sequence), "method": "theirs"})
    files = ("--results", tmp_path / "a.csv", "--results", tmp_path / "b.csv", "--object", 1)
    out = ("--out", tmp_path / "t.json", "--out", tmp_path / "t.tex")
    result = run(*files, "--by-axis", *out)
    assert result.exit_code == 0, result.output
    (table,) = json.loads((tmp_path / "t.json").read_text())
    assert [column["heading"] for column in table["columns"]] == ["sequence", "RMS", "ours", "theirs"]
    cells = {row["cells"]["axis"]: (row["cells"]["rms_0"], row["cells"]["rms_1"]) for row in table["rows"]}
    assert cells["x, mm"] == pytest.approx((2.0, 0.0), abs=1e-5)
    assert cells["y, mm"] == pytest.approx((0.0, 4.0), abs=1e-5)
    assert r"\textbf{0.00}" in (tmp_path / "t.tex").read_text()


@pytest.mark.parametrize(
    ("arguments", "code", "message"),
    [
        (("--scene", 9), 2, "none of its targets has this --scene and --object"),
        (("--out", "t.docx"), 2, "t.docx: found suffix '.docx'"),
    ],
)
def test_mistakes_are_one_line(sequence, tmp_path, arguments, code, message):
    write_results(tmp_path / "r.csv", tugs())
    result = run("--dataset", sequence, "--results", tmp_path / "r.csv", *arguments)
    assert result.exit_code == code
    assert result.stderr.startswith("Error: ") and result.stderr.count("\n") == 1
    assert message in result.stderr


def test_the_removed_option_is_refused(sequence, tmp_path):
    write_results(tmp_path / "r.csv", tugs())
    result = run("--dataset", sequence, "--results", tmp_path / "r.csv", "--choi-legacy")
    assert result.exit_code == 2
    assert "--choi-legacy is now obsolete: angles are those of the residual rotation" in result.stderr


def test_perturbed_starts_are_no_sequence(sequence, tmp_path):
    write_results(tmp_path / "r.csv", tugs())
    dataset = BopDataset(sequence)
    (file,) = load_result_files([tmp_path / "r.csv"], dataset)
    table, T_est, T_gt = frames_of(dataset, file)
    table.loc[1, ["im_id", "obj_id", "gt_index"]] = table.loc[0, ["im_id", "obj_id", "gt_index"]]
    with pytest.raises(ResultFileError, match="has several poses of the object"):
        tracks_of(dataset, file, table, T_est, T_gt)


def test_the_help_has_examples():
    assert "Examples:" in run("--help").output
