"""The three commands of the README in an empty folder: as written they need no more, and they end in a report."""

import json
import shutil
import sys
from contextlib import chdir
from importlib import import_module
from pathlib import Path

import numpy as np
import pytest
from children import run as run_command
from click.testing import CliRunner
from evalkit.cli import main as evalkit
from made_once import made_once
from posecore.bop import BopDataset, read_results, read_sidecar, write_results
from posecore.shard import ShardReader
from refinenet.cli import main as refinenet
from refinenet.refine.test_set import TestSetJob, refine_test_set

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
SHORT = "--steps 2 --batch 4 --set validation.pairs=4 --set loader.workers=0 --threads 1"


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


def run(line, folder):
    program, *arguments = line.split()
    module = {"synthgen": "synthgen.cli", "refinenet": "refinenet", "evalkit": "evalkit.cli"}[program]
    done = run_command([sys.executable, "-m", module, *arguments], cwd=folder)
    assert done.returncode == 0, done.stdout + done.stderr
    return done.stdout, done.stderr


def run_all(made):
    """The three commands in an empty folder, then the second one again without its refined poses.

    Beside the folder: those poses, and what each command printed, standard output and errors.
    """
    folder = made / "empty"
    folder.mkdir()
    shutil.copy(REPOSITORY / "examples" / "objects" / "tug.ply", folder / "mesh.ply")
    (folder / "small.yaml").write_text(SMALL)
    lines = (RENDER.replace("200000", "32") + " --preset small.yaml --workers 1", f"{TRAIN} {SHORT}", REPORT)
    printed = [run(line, folder) for line in lines]
    (folder / "results/compact.csv").replace(made / "first.csv")
    with chdir(folder):
        done = CliRunner().invoke(refinenet, [*f"{TRAIN} {SHORT} --resume --quiet".split()[1:]])
    assert done.exit_code == 0, done.output
    (made / "printed.json").write_text(json.dumps([*printed, (done.stdout, done.stderr)]))


@pytest.fixture(scope="module")
def work(tmp_path_factory):
    """The folder after the commands, and what each printed."""
    made = made_once(tmp_path_factory, "three_commands", run_all)
    return made / "empty", json.loads((made / "printed.json").read_text())


@pytest.mark.slow
def test_they_end_in_a_report_of_refined_beside_initial_poses(work):
    folder, ((_, rendered), (trained, _), *_) = work
    lines = rendered.splitlines()
    assert lines[0] == "mesh.ply: diameter 118.9 mm (--units mm)"
    assert lines[1].startswith("shards: 0 of 32 pairs are there")
    assert lines[-2:] == ["shards: complete, 32 pairs, 3 test images", "next: refinenet train shards"]
    assert trained.splitlines()[-1] == "next: evalkit report"
    summary = json.loads((folder / "report/summary.json").read_text())
    (compared,) = summary["against_initial"]
    assert (compared["name"], compared["reference"]) == ("compact", "initial")
    assert (compared["poses"], compared["missing"]) == (3, 0)
    page = (folder / "report/index.html").read_text()
    order = [page.index(text) for text in ("<img", '<div class="plots">', '<div class="words">', "<table")]
    assert order == sorted(order)


@pytest.mark.slow
def test_the_images_show_poses_that_no_pair_has(work):
    reader, dataset = ShardReader(str(work[0] / "shards")), BopDataset(work[0] / "shards/test_bop")
    pairs = np.concatenate([reader.read(i, ["T_cam_obj"])["T_cam_obj"] for i in reader.committed])
    shown = [gt.T_cam_obj for im_id in dataset.im_ids(1) for gt in dataset.gt(1, im_id)]
    assert len(shown) == 3
    assert min(np.abs(pair - T).max() for pair in pairs for T in shown) > 1e-3


@pytest.mark.slow
def test_initial_poses_are_those_of_evalkit_perturb(work, tmp_path):
    again = tmp_path / "again.csv"
    amounts = ["--random-up-to", "20", "--random-translation", "0.2"]
    images = str(work[0] / "shards/test_bop")
    done = CliRunner().invoke(evalkit, ["perturb", "--dataset", images, *amounts, "--out", str(again)])
    assert done.exit_code == 0, done.output
    assert again.read_bytes() == (work[0] / "results/initial.csv").read_bytes()
    ours, theirs = (read_sidecar(file) for file in (work[0] / "results/initial.csv", again))
    assert {key for key in ours if ours[key] != theirs[key]} == {"settings"}


@pytest.mark.slow
def test_a_resumed_run_that_is_complete_refines_its_test_images_again(work):
    folder, (*_, (resumed, _)) = work
    assert resumed.splitlines()[-1] == "next: evalkit report"
    again, before = (folder / "results/compact.csv"), (folder.parent / "first.csv")
    assert without_times(again.read_text()) == without_times(before.read_text())


def without_times(text):
    return [line.rpartition(",")[0] for line in text.splitlines()]


@pytest.mark.slow
@pytest.mark.parametrize("case", ["empty", "other dataset", "other poses", "a file of one's own"])
def test_poses_of_other_images_are_not_mixed(work, tmp_path, monkeypatch, case):
    """`results/` of the working folder, or that of the run where a report of both would compare what differs."""
    monkeypatch.chdir(tmp_path)
    run_folder = shutil.copytree(work[0] / "runs/compact", tmp_path / "runs/mine")
    if case != "empty":
        shutil.copytree(work[0] / "results", tmp_path / "results")
        changed = "mine" if case.startswith("a file") else "initial"
        sidecar = read_sidecar(work[0] / "results/initial.csv")
        poses = read_results(work[0] / "results/initial.csv")
        other = {"dataset": str(tmp_path)} if case == "other dataset" else {}
        count = 2 if case == "other poses" else 3
        write_results(tmp_path / f"results/{changed}.csv", poses[:count], sidecar | other)
    before = {file: file.read_bytes() for file in tmp_path.glob("results/*")}
    job = TestSetJob(dataset=work[0] / "shards/test_bop", run=Path("runs/mine"), device="cpu", threads=1)
    done = refine_test_set(job)
    folder = Path("results") if case == "empty" else Path("runs/mine/results")
    assert (done.initial, done.refined) == (folder / "initial.csv", folder / "mine.csv")
    assert done.text.splitlines()[-1] == (
        "next: evalkit report"
        if case == "empty"
        else f"next: evalkit report --results {done.initial} --results {done.refined}"
    )
    assert {file: file.read_bytes() for file in before} == before
    assert run_folder.is_dir()
