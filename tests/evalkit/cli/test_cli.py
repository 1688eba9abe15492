"""The commands as a user types them: reports, perturbations, and one line for every mistake."""

import csv
import importlib
import json
import re
import shutil
from dataclasses import replace

import numpy as np
import pytest
from click.testing import CliRunner
from evalkit.cli import main
from posecore import se3
from posecore.bop import BopDataset, read_results, read_sidecar, write_results


def run(*arguments):
    return CliRunner().invoke(main, [str(argument) for argument in arguments], catch_exceptions=False)


def refined_from(initial_poses, dataset, share):
    """Start poses with their rotation and translation error multiplied by `share`."""
    better = []
    for start in initial_poses:
        gt = next(gt for gt in dataset.gt(start.scene_id, start.im_id) if gt.obj_id == start.obj_id)
        dR, dt = se3.update_between(gt.T_cam_obj, start.T_cam_obj)
        R = se3.rotation_from_rotvec(se3.rotvec_from_rotation(dR) * share)
        better.append(replace(start, T_cam_obj=se3.apply_update(gt.T_cam_obj, R, dt * share)))
    return better


@pytest.fixture
def work(tmp_path, monkeypatch, dataset_path):
    """A working folder as the quick start makes it: a dataset, start poses, refined poses with one missing."""
    shutil.copytree(dataset_path, tmp_path / "test_bop")
    monkeypatch.chdir(tmp_path)
    options = ("--random-up-to", 20, "--random-translation", 0.2, "--seed", 3)
    assert run("perturb", "--dataset", "test_bop", "--out", "results/start.csv", *options).exit_code == 0
    dataset = BopDataset("test_bop")
    better = refined_from(read_results("results/start.csv"), dataset, 0.25)
    sidecar = {"dataset": "test_bop", "method": "refine <b>", "checkpoint": "ab12"}
    write_results("results/quick.csv", better[:-1], sidecar)
    return tmp_path


@pytest.mark.slow
def test_report_without_arguments(work):
    result = run("report")
    assert result.exit_code == 0, result.output
    summary = json.loads((work / "report/summary.json").read_text())
    assert [file["name"] for file in summary["files"]] == ["start", "quick"]
    (against,) = summary["against_initial"]
    assert (against["poses"], against["missing"]) == (5, 1)
    assert against["medians"]["re_sym_deg"]["ratio"] == pytest.approx(0.25, rel=0.2)
    assert against["medians"]["tz_mm"]["ratio"] == pytest.approx(0.25, rel=1e-3)
    assert all(f"\n  {change}\n" in result.output for change in against["changes"])
    assert "1 pose is missing in quick" in against["words"]
    assert "z error down to 0.25 of the initial one" in against["words"]


@pytest.mark.slow
def test_the_page_stands_alone_and_says_what_it_measured(work):
    assert run("report", "--worst", 3).exit_code == 0
    page = (work / "report/index.html").read_text()
    assert not re.search(r'(src|href)="(?!data:|#)', page)
    assert "http" not in page.replace("http-equiv", "")
    assert page.count("data:image/jpeg;base64,") == 10  # three worst and the two other cases, in two files
    assert "1 - cus of bop_toolkit" in page
    assert "&lt;b&gt;" in page
    assert "refine <b>" not in page
    summary = json.loads((work / "report/summary.json").read_text())
    for digest in (summary["dataset"]["sha256"], *(file["sha256"] for file in summary["files"])):
        assert re.fullmatch("[0-9a-f]{64}", digest)
        assert digest in page
    assert summary["versions"]["evalkit"] in page


@pytest.mark.slow
def test_the_table_has_a_line_for_each_pose(work):
    assert run("report").exit_code == 0
    with (work / "report/estimates.csv").open() as stream:
        rows = list(csv.DictReader(stream))
    assert len(rows) == 12
    missing = [row for row in rows if row["found"] == "0"]
    assert [(row["results"], row["add_m"], row["vss"]) for row in missing] == [("quick", "", "0")]
    assert all(float(row["add_m"]) >= 0 for row in rows if row["found"] == "1")


@pytest.mark.slow
def test_reports_are_reproducible(work):
    assert run("report", "--out", "a").exit_code == 0
    assert run("report", "--out", "b").exit_code == 0
    for name in ("index.html", "estimates.csv", "summary.json"):
        assert (work / "a" / name).read_bytes() == (work / "b" / name).read_bytes()


@pytest.mark.slow
def test_visible_vss_is_said(work):
    assert run("report", "--vss", "visible").exit_code == 0
    summary = json.loads((work / "report/summary.json").read_text())
    assert summary["vss"] == "visible"
    assert "tau infinite" in (work / "report/index.html").read_text()


@pytest.mark.slow
def test_files_named_alike_stay_apart(work):
    shutil.copy("results/start.csv", "start.csv")
    result = run("report", "--dataset", "test_bop", "--results", "start.csv", "--results", "results/start.csv")
    assert result.exit_code == 0
    assert "results/start:" in result.output


def test_perturbation_levels_are_exact_and_recorded(work):
    options = ("--angles", "5,30,180", "--translations", "0,0.1,1")
    assert run("perturb", "--dataset", "test_bop", "--out", "curve.csv", *options).exit_code == 0
    dataset = BopDataset("test_bop")
    rows = read_sidecar("curve.csv")["perturbation"]["rows"]
    estimates = read_results("curve.csv", dataset)
    assert len(estimates) == len(rows) == 6 * 6
    for row, estimate in zip(rows, estimates, strict=True):
        assert row["line"] == estimate.line
        gt = dataset.gt(estimate.scene_id, estimate.im_id)[row["gt_index"]]
        dR, dt = se3.update_between(gt.T_cam_obj, estimate.T_cam_obj)
        diameter_m = dataset.models_info[estimate.obj_id].diameter_m
        assert np.rad2deg(se3.rotation_angle_rad(dR)) == pytest.approx(row["angle_deg"], abs=1e-4)
        assert np.linalg.norm(dt) == pytest.approx(row["translation_diameter"] * diameter_m, abs=1e-8)


def test_perturbation_depends_on_the_seed_only(work):
    for name, seed in (("a", 1), ("b", 1), ("c", 2)):
        run("perturb", "--dataset", "test_bop", "--out", f"{name}.csv", "--random-up-to", 20, "--seed", seed)
    assert (work / "a.csv").read_bytes() == (work / "b.csv").read_bytes()
    assert (work / "a.csv").read_bytes() != (work / "c.csv").read_bytes()


@pytest.mark.slow
def test_curves_by_level(work):
    """The refined file says nothing of levels: it takes them from the starts, line by line."""
    options = ("--angles", "10,40,45,60", "--translations", "0.1,0.5,0.8")
    run("perturb", "--dataset", "test_bop", "--out", "curve/start.csv", *options)
    refined = refined_from(read_results("curve/start.csv"), BopDataset("test_bop"), 0.5)
    write_results("curve/refined.csv", refined, {"dataset": "test_bop", "method": "refine"})
    files = ("--results", "curve/refined.csv", "--results", "curve/start.csv")
    result = run("report", "--dataset", "test_bop", *files)
    assert result.exit_code == 0, result.output
    start, refined = json.loads((work / "report/summary.json").read_text())["files"]
    assert start["is_initial"]
    angle = {point["level"]: point for point in refined["by_level"]["angle"]}
    assert [angle[level]["under_10deg"] for level in (10.0, 40.0, 60.0)] == [1.0, 0.0, 0.0]
    assert angle[10.0]["re_sym_deg_mean"] <= 5.0 + 1e-3
    unmoved = {point["level"]: point for point in start["by_level"]["angle"]}
    # Part of a random turn is about the bobbin's own axis, so only the tug is a whole 10 degrees off.
    assert [unmoved[level]["under_10deg"] for level in (10.0, 40.0)] == [0.5, 0.0]
    translation = {point["level"]: point for point in start["by_level"]["translation"]}
    assert [translation[level]["diverged"] for level in (0.1, 0.5, 0.8)] == [0.0, 0.0, 1.0]
    page = (work / "report/index.html").read_text()
    assert "From perturbed initial poses" in page
    assert page.count("<figure><figcaption>Diverged") == 2


@pytest.mark.parametrize(
    ("arguments", "code", "message"),
    [
        (["report", "--dataset", "nowhere", "--results", "results/quick.csv"], 1, "nowhere: no such folder"),
        (["report", "--results", "absent.csv"], 2, "absent.csv: no such file; give a BOP result file"),
        (["report", "--dataset", "test_bop", "--results", "absent.csv"], 1, "absent.csv: cannot be read"),
        (
            ["report", "--dataset", "test_bop", "--results", "results/quick.csv", "--results", "results/quick.csv"],
            1,
            "is named twice",
        ),
        (["report", "--split", "val"], 1, "no scene folder"),
        (["perturb", "--dataset", "test_bop", "--out", "x.csv"], 2, "no levels: give --angles"),
        (["perturb", "--dataset", "test_bop", "--out", "x.csv", "--angles", "200"], 2, "expected degrees from 0 to"),
        (["perturb", "--dataset", "test_bop", "--out", "x.csv", "--translations", "-1"], 2, "0 or more"),
    ],
)
def test_mistakes_are_one_line(work, arguments, code, message):
    result = run(*arguments)
    assert result.exit_code == code
    assert result.stderr.startswith("Error: ")
    assert result.stderr.count("\n") == 1
    assert message in result.stderr


def test_empty_working_folder(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    result = run("report")
    assert result.exit_code == 2
    assert "no result file (*.csv with *.csv.json beside it that names a dataset) here or in" in result.stderr


def test_broken_inputs_are_one_line(work):
    (work / "results/quick.csv.json").write_text('{\n "dataset": "test_bop",,\n}')
    assert "quick.csv.json:2:24: invalid JSON" in run("report").stderr
    (work / "results/quick.csv.json").write_text('{"dataset": "gone"}')
    assert "its dataset gone is not a folder" in run("report").stderr
    (work / "results/quick.csv.json").write_text('{"dataset": "results"}')
    assert "several datasets" in run("report").stderr
    (work / "results/quick.csv.json").write_text('{"dataset": "test_bop"}')
    (work / "results/quick.csv").write_text("4,0,1,1,1 0 0 0 1 0 0 0 nan,0 0 500,-1\n")
    result = run("report")
    assert (result.exit_code, "quick.csv:1: R holds NaN" in result.stderr) == (1, True)
    (work / "results/quick.csv").write_text("4,0,1,1,1 0 0 0 1 0 0 0 1,0 0 500,-1\n")
    (work / "test_bop/test/000004/scene_gt.json").unlink()
    assert "no scene_gt.json" in run("report").stderr


@pytest.mark.slow
def test_report_into_a_place_that_is_a_file(work):
    (work / "report").write_text("here")
    result = run("report")
    assert result.exit_code == 1
    assert result.stderr.count("\n") == 1


@pytest.mark.parametrize("command", ["report", "perturb"])
def test_help_has_examples(command):
    result = run(command, "--help")
    assert result.exit_code == 0
    assert "Examples:" in result.output


@pytest.mark.slow
def test_real_start_poses(shared_data, tmp_path):
    """The 349 start poses of LM-O: numbers of bop_toolkit's cus and of the noise that was put in."""
    folder = shared_data / "lmo"
    results = folder / "init_ssd6d-like_lmo-test.csv"
    result = run("report", "--dataset", folder, "--results", results, "--out", tmp_path / "report")
    assert result.exit_code == 0, result.output
    total = json.loads((tmp_path / "report/summary.json").read_text())["files"][0]["total"]
    assert total["expected"] == total["found"] == 349
    assert total["vss_mean"] == pytest.approx(0.41653, abs=0.0005)
    assert total["re_deg_mean"] == pytest.approx(34.0, abs=1.0)
    assert total["tx_mm_mean"] == pytest.approx(13.7, abs=1.0)
    assert total["ty_mm_mean"] == pytest.approx(13.3, abs=1.0)
    assert total["tz_mm_mean"] == pytest.approx(77.5, abs=3.0)


def test_an_error_of_the_system_is_one_line(work, monkeypatch):
    def unreadable(*_, **__):
        raise PermissionError(13, "Permission denied", "test_bop/scene_gt.json")

    monkeypatch.setattr(importlib.import_module("evalkit.report.job"), "make_report", unreadable)
    result = run("report")
    assert result.exit_code == 1
    assert result.stderr.startswith("Error: test_bop/scene_gt.json: no permission")
    assert len(result.stderr.splitlines()) == 1


def test_starts_are_not_written_over_a_folder(work):
    result = run("perturb", "--dataset", "test_bop", "--out", "results", "--angles", "5")
    assert result.exit_code == 2
    assert "is a directory" in result.stderr


@pytest.mark.slow
def test_a_report_says_which_run_was_stopped_and_what_it_leaves_out(work, caplog):
    """Poses that were never tried are missing like those that failed; and a tracked video belongs to no dataset."""
    dataset = BopDataset("test_bop")
    poses = refined_from(read_results("results/start.csv"), dataset, 0.25)
    write_results("results/half.csv", poses[:3], {"dataset": "test_bop", "method": "half", "not_reached": 3})
    elsewhere = [replace(poses[0], scene_id=0, im_id=77)]
    write_results("results/video.csv", elsewhere, {"method": "edge-icp, tracking"})
    result = run("report")
    assert result.exit_code == 0, result.output
    assert [file["name"] for file in json.loads((work / "report/summary.json").read_text())["files"]] == [
        "start", "half", "quick",
    ]  # fmt: skip
    assert (
        "half.csv: its run was stopped early; 3 poses or frames were not reached, and count as missing" in caplog.text
    )
    assert "video.csv: left out, its sidecar names no dataset" in caplog.text
