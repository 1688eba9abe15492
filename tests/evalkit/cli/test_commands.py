"""check, tables and tracking as a user types them."""

import csv
import json
import shutil

import pytest
from click.testing import CliRunner
from evalkit.cli import main
from posecore.bop import BopDataset, Estimate, write_results


def run(*arguments):
    return CliRunner().invoke(main, [str(argument) for argument in arguments], catch_exceptions=False)


@pytest.fixture
def work(tmp_path, monkeypatch, dataset_path, perfect):
    """A working folder with a dataset and its ground truth as a result file."""
    shutil.copytree(dataset_path, tmp_path / "toys")
    monkeypatch.chdir(tmp_path)
    write_results(tmp_path / "truth.csv", perfect, {"dataset": "toys", "method": "truth"})
    return tmp_path


@pytest.mark.parametrize("command", ["check", "diff", "perturb", "report", "tables", "tracking"])
def test_help_has_examples(command):
    result = run(command, "--help")
    assert result.exit_code == 0
    assert "Examples:" in result.output
    assert f"evalkit {command}" in result.output


def test_a_sound_dataset_and_file_pass(work):
    result = run("check", "--dataset", "toys", "--results", "truth.csv", "--json", "check.json")
    assert result.exit_code == 0, result.output
    assert "error" not in result.output
    assert (
        "ground-truth poses 6, images decoded 3, poses against themselves 6, result files 1, estimates 6"
        in result.output
    )
    assert json.loads((work / "check.json").read_text())["counts"] | {"hint": 0} == {
        "error": 0,
        "warning": 0,
        "hint": 0,
    }


def test_a_check_takes_the_dataset_of_the_sidecars_and_refuses_the_arguments_of_earlier_versions(work):
    result = run("check")
    assert result.exit_code == 0, result.output
    assert "result files 1, estimates 6" in result.output
    assert "result files" not in run("check", "--dataset", "toys").output
    refused = run("check", "toys", "truth.csv")
    assert refused.exit_code == 2
    assert "toys truth.csv is now --dataset toys --results truth.csv" in refused.stderr


@pytest.mark.parametrize(
    ("folders", "text"),
    [
        ((), "`synthgen render --object MESH --n N` and then `refinenet train shards/`"),
        (("shards",), "make some with `refinenet train shards/` or `refinenet refine`"),
    ],
)
def test_a_report_of_nothing_names_the_command_that_makes_what_is_missing(tmp_path, monkeypatch, folders, text):
    monkeypatch.chdir(tmp_path)
    for folder in folders:
        (tmp_path / folder).mkdir()
    result = run("report")
    assert result.exit_code == 2
    assert text in result.stderr and len(result.stderr.splitlines()) == 1


def test_a_scaled_rotation_is_named_with_its_line(work):
    lines = (work / "truth.csv").read_text().splitlines()
    fields = lines[2].split(",")
    fields[4] = "2 0 0 0 2 0 0 0 2"
    lines[2] = ",".join(fields)
    (work / "bad.csv").write_text("\n".join(lines) + "\n")
    result = run("check", "--dataset", "toys", "--results", "bad.csv")
    assert result.exit_code == 1
    assert "bad.csv:3: R is scaled by 2" in result.output


def test_metres_are_recognised(work):
    head, *lines = (work / "truth.csv").read_text().splitlines()
    rows = [line.split(",") for line in lines]
    for fields in rows:
        fields[5] = " ".join(str(float(value) / 1000) for value in fields[5].split())
    (work / "bad.csv").write_text("\n".join([head, *(",".join(fields) for fields in rows)]) + "\n")
    result = run("check", "--dataset", "toys", "--results", "bad.csv")
    assert "metres" in result.output


def test_tables_of_the_truth_are_perfect(work):
    result = run("tables", "--out", "tables.tex", "--out", "tables.json")
    assert result.exit_code == 0, result.output
    assert "truth" in result.output
    assert (work / "tables.tex").read_text().count("\\begin{table") >= 4
    tables = {table["name"]: table for table in json.loads((work / "tables.json").read_text())}
    (row,) = tables["refinement"]["rows"]
    assert row["cells"]["method"] == "truth"
    assert (row["cells"]["expected"], row["cells"]["missing"]) == (6, 0)
    assert row["cells"]["vss_mean"] == row["cells"]["add_recall_0.1d"] == 1.0
    assert row["cells"]["re_deg_mean"] < 1e-6  # a result file's nine decimals
    (row,) = tables["refinement-vss-mean-objects"]["rows"]
    assert row["cells"]["vss_mean_1"] == row["cells"]["vss_mean_5"] == 1.0


def test_tracking_of_the_truth_has_no_error(work):
    dataset = BopDataset("toys")
    frames = [
        Estimate(scene_id=4, im_id=im_id, obj_id=gt.obj_id, T_cam_obj=gt.T_cam_obj)
        for im_id in (0, 3)
        for gt in dataset.gt(4, im_id)
    ]
    write_results(work / "track.csv", frames, {"dataset": "toys", "method": "track"})
    result = run("tracking", "--results", "track.csv", "--scene", 4, "--out", "tracking.csv")
    assert result.exit_code == 0, result.output
    with (work / "tracking.csv").open() as stream:
        rows = list(csv.DictReader(stream))
    assert [row["sequence"] for row in rows] == ["scene 4, object 1", "scene 4, object 5", "mean of sequences"]
    assert [int(row["frames"]) for row in rows] == [2, 2, 4]
    for row in rows:
        assert float(row["success_5cm5deg"]) == 1.0
        assert all(abs(float(row[name])) < 1e-6 for name in row if name.endswith(("rms_mm", "rms_deg")))


def test_a_scene_that_is_not_tracked_is_one_line(work):
    result = run("tracking", "--results", "truth.csv", "--scene", 77)
    assert result.exit_code == 2
    assert result.stderr.count("\n") == 1
    assert "--scene" in result.stderr
