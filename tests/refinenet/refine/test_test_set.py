"""Names and places of what a training run leaves for a report."""

import shutil
from pathlib import Path

import pytest
from posecore.bop import read_sidecar
from posecore.errors import ConfigError
from refinenet.models import checkpoint
from refinenet.refine.bop_results import RefineJob, refine_result_file
from refinenet.refine.registry import MethodSettings
from refinenet.refine.test_set import TestSetJob, find_test_set, refine_test_set, run_name


@pytest.mark.parametrize(
    ("run", "name"),
    [
        ("runs/compact", "compact"),
        ("runs/a/b", "a-b"),
        ("runs", "runs"),
        ("./run", "run"),
        ("a/run", "a-run"),
        ("/data/a/run", "data-a-run"),
        ("../run", "up-run"),
        ("runs/initial", "run-initial"),
        (".", "run"),
        ("runs/..", "run"),
        ("/", "run"),
    ],
)
def test_every_run_has_a_name_of_its_own(run, name):
    assert run_name(Path(run)) == name


def test_test_images_are_in_local_datasets_alone(tmp_path):
    assert find_test_set(str(tmp_path)) == find_test_set("s3://bucket/shards") == "no test images"
    (tmp_path / "test_bop").mkdir()
    assert "not complete" in find_test_set(str(tmp_path))
    (tmp_path / "test_bop/test_targets_bop19.json").write_text("[]")
    assert find_test_set(f"{tmp_path}/") == tmp_path / "test_bop"


@pytest.fixture
def refined_into(bop, trained, tmp_path, monkeypatch):
    """Refine the test images for a run in a folder of that name; working folder is one of its own."""
    work = tmp_path / "work"
    work.mkdir()
    monkeypatch.chdir(work)

    def refine(run):
        Path(run).mkdir(parents=True, exist_ok=True)
        shutil.copy(trained, Path(run, "best.safetensors"))
        return refine_test_set(TestSetJob(dataset=bop[0], run=Path(run), device="cpu", threads=1))

    return refine


def files():
    return {path: path.read_bytes() for path in Path().rglob("*") if path.is_file() and path.suffix != ".safetensors"}


def test_the_working_folder_as_run_keeps_what_it_holds(refined_into):
    Path("results").mkdir()
    Path("results/initial.csv").write_text("mine\n")
    before = files()
    done = refined_into(".")
    assert {path: data for path, data in files().items() if path in before} == before
    assert (str(done.initial), str(done.refined)) == ("test_results/initial.csv", "test_results/run.csv")
    assert done.text.splitlines()[-1].endswith(f"--results {done.initial} --results {done.refined}")
    again = refined_into(str(Path.cwd()))
    assert again.initial.resolve() == done.initial.resolve()
    assert {path: data for path, data in files().items() if path in before} == before


def test_a_file_in_the_run_s_own_folder_that_is_not_the_run_s_is_left(refined_into):
    for folder in ("results", "test_results"):
        Path(folder).mkdir()
        Path(folder, "run.csv").write_text("mine\n")
    before = files()
    with pytest.raises(ConfigError, match=r"^test_results/run.csv: is not of this run; move it, and --resume refines"):
        refined_into(".")
    assert files() == before


@pytest.mark.parametrize(("first", "second"), [("runs/compact", "compact"), ("a/b", "a-b")])
def test_a_second_run_of_one_name_leaves_the_first_one_s_file(refined_into, first, second):
    done = refined_into(first)
    before = done.refined.read_bytes()
    other = refined_into(second)
    assert (other.refined.name, other.refined.parent) == (done.refined.name, Path(second, "results"))
    assert done.refined.read_bytes() == before
    assert refined_into(first).refined == done.refined


def test_a_refinement_of_one_s_own_is_left(refined_into, bop):
    done = refined_into("runs/compact")
    method = MethodSettings(checkpoint=Path("runs/compact/best.safetensors"), device="cpu")
    refine_result_file(RefineJob(method=method, dataset=bop[0], init=done.initial, out=done.refined, threads=1))
    before = done.refined.read_bytes()
    assert refined_into("runs/compact").refined == Path("runs/compact/results/compact.csv")
    assert done.refined.read_bytes() == before


def test_initial_poses_of_another_processor_are_the_same(refined_into):
    done = refined_into("runs/compact")
    lines = done.initial.read_text().splitlines()
    ids, score, R, t, time = lines[1].rsplit(",", 4)
    x, *rest = t.split()
    lines[1] = ",".join([ids, score, R, " ".join([repr(float(x) + 1e-12), *rest]), time])
    done.initial.write_text("\n".join(lines) + "\n")
    assert refined_into("runs/other").initial == done.initial


def test_a_refused_folder_is_not_made(refined_into, bop, monkeypatch):
    shutil.copy(bop[1], "mine.csv")
    Path("mine.csv.json").write_text('{"dataset": "elsewhere"}')
    assert refined_into("runs/compact").initial.parent == Path("runs/compact/results")
    assert not Path("results").exists()


def test_the_sidecar_names_the_run(refined_into):
    done = refined_into("runs/compact")
    assert read_sidecar(done.refined)["run"] == str(Path("runs/compact").resolve())
    assert "run" not in read_sidecar(done.initial)
    assert (
        checkpoint.load(Path("runs/compact/best.safetensors")).sha256 == read_sidecar(done.refined)["checkpoint_sha256"]
    )
