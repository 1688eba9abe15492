"""`evalkit tables` on start poses, refined ones of two losses, and perturbed starts."""

import json
from dataclasses import replace

import numpy as np
import pytest
from click.testing import CliRunner
from evalkit.cli import main
from evalkit.cli.tables import tables
from posecore import se3
from posecore.bop import BopDataset, read_results, read_sidecar, write_results
from posecore.command_line import ErrorReportingGroup

GROUP = ErrorReportingGroup(commands={"tables": tables})


def run(*arguments):
    return CliRunner().invoke(GROUP, ["tables", *map(str, arguments)], catch_exceptions=False)


def perturb(dataset_path, out, *options):
    arguments = ["perturb", "--dataset", dataset_path, "--out", out, *options]
    assert CliRunner().invoke(main, list(map(str, arguments)), catch_exceptions=False).exit_code == 0


def moved(initial_poses, dataset, share):
    """Starts with their translation error multiplied by `share` and no rotation error."""
    better = []
    for start in initial_poses:
        gt = next(gt for gt in dataset.gt(start.scene_id, start.im_id) if gt.obj_id == start.obj_id)
        dt_m = share * (start.T_cam_obj[:3, 3] - gt.T_cam_obj[:3, 3])
        better.append(replace(start, T_cam_obj=se3.apply_update(gt.T_cam_obj, np.eye(3), dt_m)))
    return better


@pytest.fixture
def work(tmp_path, monkeypatch, dataset_path):
    monkeypatch.chdir(tmp_path)
    perturb(dataset_path, "results/start.csv", "--random-up-to", 20, "--random-translation", 0.3)
    initial_poses, dataset = read_results("results/start.csv"), BopDataset(dataset_path)
    for loss, share in (("contour", 0.25), ("mse", 0.5)):
        sidecar = {"dataset": str(dataset_path), "method": "refinenet", "loss": loss}
        write_results(f"results/{loss}.csv", moved(initial_poses, dataset, share), sidecar)
    return tmp_path


def by_name(path):
    return {table["name"]: table for table in json.loads(path.read_text())}


@pytest.mark.slow
def test_before_after_and_losses_from_a_working_folder(work):
    result = run("--out", "tables.json", "--out", "tables.tex", "--by", "scene")
    assert result.exit_code == 0, result.output
    found = by_name(work / "tables.json")
    assert list(found) == [
        "refinement",
        "refinement-vss-mean-scenes",
        "refinement-add-recall-01d-scenes",
        "refinement-scenes",
        "ablation-vss-mean",
    ]
    methods = {row["cells"]["method"]: row["cells"] for row in found["refinement"]["rows"]}
    assert list(methods) == ["no refinement", "refinenet, contour loss", "refinenet, mse loss"]
    start, contour, mse = methods.values()
    for axis in "xyz":
        assert contour[f"t{axis}_mm_mean"] == pytest.approx(0.25 * start[f"t{axis}_mm_mean"], rel=1e-3)
        assert mse[f"t{axis}_mm_mean"] == pytest.approx(0.5 * start[f"t{axis}_mm_mean"], rel=1e-3)
    assert start["re_deg_mean"] > 1.0
    assert contour["re_deg_mean"] == pytest.approx(0.0, abs=1e-4)
    losses = [column["heading"] for column in found["ablation-vss-mean"]["columns"]]
    assert losses == ["scene", "refinenet, contour loss", "refinenet, mse loss"]
    assert [row["cells"]["group"] for row in found["ablation-vss-mean"]["rows"]] == ["4", "20", "total"]
    assert (work / "tables.tex").read_text().count(r"\begin{table}") == 5
    assert "### Mean errors and recall" in result.output


@pytest.mark.slow
def test_curves_from_perturbed_starts_and_what_departs_from_the_protocol(work, dataset_path):
    perturb(dataset_path, "curve/start.csv", "--protocol", "paper")
    initial_poses, dataset = read_results("curve/start.csv"), BopDataset(dataset_path)
    sidecar = {
        "dataset": str(dataset_path),
        "method": "refinenet",
        "settings": {"iterations": 5},
        "perturbation": read_sidecar("curve/start.csv")["perturbation"],
    }
    write_results("curve/refined.csv", moved(initial_poses, dataset, 0.5), sidecar)
    result = run("--results", "curve/start.csv", "--results", "curve/refined.csv", "--out", "curve.json")
    assert result.exit_code == 0, result.output
    found = by_name(work / "curve.json")
    assert list(found) == ["curve-angle", "curve-translation", "curve-angle-objects", "curve-translation-objects"]
    points = {
        (row["cells"]["level"], row["cells"]["method"]): row["cells"] for row in found["curve-translation"]["rows"]
    }
    assert len(points) == 22
    # 0.9 diameters brought back by half are 0.45, which has not diverged; 1.0 ends at the limit and has not either.
    assert [points[level, "refinenet"]["diverged"] for level in (0.9, 1.0)] == [0.0, 0.0]
    assert [points[level, "no refinement"]["diverged"] for level in (0.5, 0.6)] == [0.0, 1.0]
    assert points[0.1, "refinenet"]["te_under_0.1d"] == 1.0
    assert points[0.2, "refinenet"]["te_under_0.1d"] == 0.0
    assert "refinenet: refined in 5 iterations, while protocol 'paper' asks for 10." in found["curve-angle"]["note"]


@pytest.mark.slow
def test_intervals_are_shown_where_asked_for(work):
    result = run("--resamples", 50)
    assert result.exit_code == 0
    assert "In brackets: 95 % bootstrap intervals, 2 scenes resampled." in result.output


def test_a_suffix_that_cannot_be_written_is_told_before_the_work(work):
    result = run("--out", "tables.xls")
    assert result.exit_code == 2
    assert result.stderr == "Error: tables.xls: found suffix '.xls', expected one of .md, .tex, .csv, .json\n"
