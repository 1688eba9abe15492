"""The three commands of the README in an empty folder: as written they need no more, and they end in a report."""

import json
import os
import re
import shutil
import subprocess
import sys
from pathlib import Path

import pytest
from click.testing import CliRunner
from posecore.bop import BopDataset, read_results, read_sidecar
from posecore.shard import ShardReader

REPOSITORY = Path(__file__).resolve().parent.parent
RENDER = "synthgen render --object mesh.ply --n 200000"
TRAIN = "refinenet train shards/"
REPORT = "evalkit report"
SMALL = """\
engine: raster
patch_px: 96
hypotheses_per_scene: 2
shard_size: 16
window: {padding: 0.6}
distance: {unit: diameter, min: 4.0, max: 6.0}
"""
"""A preset for the time of a test."""


@pytest.mark.parametrize("page", ["README.md", "docs/index.md"])
def test_the_pages_show_these_commands(page):
    lines = [line.split("#")[0].strip() for line in (REPOSITORY / page).read_text(encoding="utf-8").splitlines()]
    assert all(command in lines for command in (RENDER, TRAIN, REPORT))


def called(monkeypatch, target, line):
    """What a command line hands to the function behind it."""
    calls = []

    def note(*arguments, **options):
        calls.append(arguments)
        raise InterruptedError

    monkeypatch.setattr(target, note)
    program, *arguments = line.split()
    from importlib import import_module

    result = CliRunner().invoke(import_module(f"{program}.cli").main, arguments)
    assert len(calls) == 1, result.output
    return calls[0]


def test_as_written_they_lack_no_option_and_a_small_run_differs_in_size_alone(tmp_path, monkeypatch, tug_ply):
    shutil.copy(tug_ply, tmp_path / "mesh.ply")
    monkeypatch.chdir(tmp_path)
    (job,) = called(monkeypatch, "synthgen.run.render.render_dataset", RENDER)
    assert (job.out, job.n, job.test_images, job.config.engine) == ("shards", 200_000, 100, "cycles")
    (small,) = called(monkeypatch, "synthgen.run.render.render_dataset", RENDER.replace("200000", "64"))
    differing = {name for name in vars(job) if getattr(job, name) != getattr(small, name)}
    assert differing == {"n", "test_images"}
    config, url, out = called(monkeypatch, "refinenet.training.loop.train", TRAIN)
    assert (config.preset, url, out) == ("compact", "shards/", Path("runs/compact"))
    steps, *_ = called(monkeypatch, "refinenet.training.loop.train", f"{TRAIN} --steps 4")
    assert {name for name in vars(config) if getattr(config, name) != getattr(steps, name)} == {"steps"}
    report, *_ = called(monkeypatch, "evalkit.report.job.make_report", REPORT)
    assert (report.out, report.results, report.dataset) == (Path("report"), (), None)


def run(line, folder, expected=0):
    program, *arguments = line.split()
    module = {"synthgen": "synthgen.cli", "refinenet": "refinenet", "evalkit": "evalkit.cli"}[program]
    environment = os.environ | {"OMP_NUM_THREADS": "1"}
    done = subprocess.run(
        [sys.executable, "-m", module, *arguments], cwd=folder, env=environment, capture_output=True, text=True
    )
    assert done.returncode == expected, done.stdout + done.stderr
    return done


@pytest.mark.slow
def test_they_end_in_a_report_on_images_that_the_network_has_never_seen(tmp_path, tug_ply):
    shutil.copy(tug_ply, tmp_path / "mesh.ply")
    (tmp_path / "small.yaml").write_text(SMALL)
    missing = run(REPORT, tmp_path, expected=2)
    assert "synthgen render" in missing.stderr and "refinenet train shards/" in missing.stderr
    rendered = run(RENDER.replace("200000", "64") + " --preset small.yaml --workers 1", tmp_path)
    assert re.search(r"^mesh.ply: diameter 118.9 mm \(--units mm\)$", rendered.stderr, re.MULTILINE)
    assert rendered.stderr.index("diameter") < rendered.stderr.index("0 of 64 pairs")
    assert "complete, 64 pairs, 6 test images" in rendered.stderr
    assert rendered.stderr.splitlines()[-1] == "next: refinenet train shards"
    trained = run(f"{TRAIN} --steps 2 --batch 4 --set validation.pairs=4 --set loader.workers=0", tmp_path)
    assert trained.stdout.splitlines()[-1] == "next: evalkit report"
    run(f"{REPORT} --worst 3", tmp_path)
    summary = json.loads((tmp_path / "report/summary.json").read_text())
    (compared,) = summary["against_initial"]
    assert (compared["name"], compared["reference"], compared["missing"]) == ("compact", "initial", 0)
    assert compared["poses"] == 6
    page = (tmp_path / "report/index.html").read_text()
    order = [page.index(text) for text in ("<img", '<div class="plots">', '<div class="words">', "<table")]
    assert order == sorted(order)
    assert not set(scenes_of_pairs(tmp_path)) & set(poses_of_images(tmp_path))


def scenes_of_pairs(folder):
    reader = ShardReader(str(folder / "shards"))
    return [T.tobytes() for i in reader.committed for T in reader.read(i, ["T_cam_obj"])["T_cam_obj"].round(4)]


def poses_of_images(folder):
    dataset = BopDataset(folder / "shards/test_bop")
    poses = [gt.T_cam_obj for im_id in dataset.im_ids(1) for gt in dataset.gt(1, im_id)]
    assert len(poses) == 6
    return [T.astype("float64").round(4).tobytes() for T in poses]


@pytest.mark.slow
def test_start_poses_are_those_of_evalkit_perturb_and_results_do_not_mix(tmp_path, tug_ply):
    shutil.copy(tug_ply, tmp_path / "mesh.ply")
    (tmp_path / "small.yaml").write_text(SMALL)
    render = RENDER.replace("200000", "32") + " --preset small.yaml --workers 1"
    run(render, tmp_path)
    train = "--steps 2 --batch 4 --set validation.pairs=4 --set loader.workers=0"
    run(f"{TRAIN} {train}", tmp_path)
    run(
        "evalkit perturb --dataset shards/test_bop --random-up-to 20 --random-translation 0.2 --out again.csv", tmp_path
    )
    (tmp_path / "again.csv.json").unlink()
    assert (tmp_path / "again.csv").read_bytes() == (tmp_path / "results/initial.csv").read_bytes()
    refined = (tmp_path / "results/compact.csv").read_bytes()
    assert read_sidecar(tmp_path / "results/compact.csv")["dataset"] == str(tmp_path / "shards/test_bop")
    assert len(read_results(tmp_path / "results/compact.csv")) == 3

    resumed = run(f"{TRAIN} {train} --resume", tmp_path)  # a complete run has only the test images left
    assert resumed.stdout.splitlines()[-1] == "next: evalkit report"
    assert poses_in(tmp_path / "results/compact.csv") == poses_in_bytes(refined)

    run(f"{render} --seed 5 --out others", tmp_path)
    other = run(f"refinenet train others {train} --out runs/others", tmp_path)
    assert other.stdout.splitlines()[-1].startswith("next: evalkit report --results runs/others/results/initial.csv")
    assert not (tmp_path / "results/others.csv").exists()
    run(REPORT, tmp_path)
    run(f"{other.stdout.splitlines()[-1].removeprefix('next: ')} --out report2", tmp_path)
    assert json.loads((tmp_path / "report2/summary.json").read_text())["dataset"]["path"].endswith("others/test_bop")


def poses_in(file):
    return poses_in_bytes(file.read_bytes())


def poses_in_bytes(content):
    """Lines without their run time."""
    return [line.rpartition(",")[0] for line in content.decode().splitlines()]


@pytest.mark.slow
def test_without_test_images_one_line_takes_the_place_of_the_results(tmp_path, tug_ply):
    shutil.copy(tug_ply, tmp_path / "mesh.ply")
    (tmp_path / "small.yaml").write_text(SMALL)
    run(RENDER.replace("200000", "32") + " --preset small.yaml --workers 1 --test-images 0", tmp_path)
    assert not (tmp_path / "shards/test_bop").exists()
    trained = run(f"{TRAIN} --steps 2 --batch 4 --set validation.pairs=4 --set loader.workers=0", tmp_path)
    assert trained.stdout.splitlines()[-1].startswith("shards/: no test images, so nothing is refined for a report;")
    assert not (tmp_path / "results").exists()
