"""The quick start runs from mesh to report, with tiny numbers; and goes on where it was stopped."""

import importlib.util
import json
import shlex
import subprocess
import sys
from collections.abc import Callable
from dataclasses import replace
from functools import cache
from pathlib import Path

import pytest
from children import run

sys.path.insert(0, str(Path(__file__).resolve().parent.parent))
from experiments import chain

SCRIPT = Path(__file__).resolve().parent.parent / "examples" / "quickstart.py"


@cache
def quickstart():
    spec = importlib.util.spec_from_file_location("quickstart", SCRIPT)
    module = importlib.util.module_from_spec(spec)
    sys.modules["quickstart"] = module  # dataclasses look their module up
    spec.loader.exec_module(module)
    return module


def smoke(work: Path) -> subprocess.CompletedProcess[str]:
    command = [sys.executable, str(SCRIPT), str(work), "--smoke"]
    return run(command)


@pytest.mark.slow
def test_smoke_run_ends_in_a_report_and_is_not_repeated(tmp_path: Path) -> None:
    work = tmp_path / "quick start"  # a space, because users have them
    first = smoke(work)
    assert first.returncode == 0, first.stdout + first.stderr
    page = work / "report" / "index.html"
    assert str(page) in first.stdout
    summary = json.loads((work / "report" / "summary.json").read_text())
    names = [entry["name"] for entry in summary["against_initial"]]
    assert names == ["compact", "shipped"]
    assert all(entry["missing"] == 0 for entry in summary["against_initial"])
    shown = [shlex.split(line.split("&& ", 1)[1]) for line in first.stdout.splitlines() if line.startswith("  $ cd ")]
    assert [words[:2] for words in shown] == [
        ["synthgen", "render"], ["refinenet", "train"], ["refinenet", "refine"], ["evalkit", "report"]
    ]  # fmt: skip

    written = page.stat().st_mtime_ns
    second = smoke(work)
    assert second.returncode == 0, second.stdout + second.stderr
    assert "  $ " not in second.stdout
    assert page.stat().st_mtime_ns == written


def recorder(ran: list) -> Callable:
    """Stands in for running a command: notes it, and leaves what it would leave."""

    def record(step, work, interrupted):
        ran.append((step.name, interrupted))
        (work / step.leaves).parent.mkdir(parents=True, exist_ok=True)
        (work / step.leaves).touch()

    return record


def test_a_step_that_changed_makes_the_later_ones_run_again(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    everything, ran = list(quickstart().steps(quickstart().SMOKE)), []
    names = [step.name for step in everything]
    monkeypatch.setattr(chain, "run_step", recorder(ran))
    chain.run_all(tmp_path, everything)
    assert ran == [(name, False) for name in names]

    ran.clear()
    chain.run_all(tmp_path, everything)
    assert ran == []

    mark = tmp_path / ".steps" / "train.json"
    mark.write_text(json.dumps(json.loads(mark.read_text()) | {"command": ["refinenet", "train", "otherwise"]}))
    chain.run_all(tmp_path, everything)
    assert ran == [(name, False) for name in names[names.index("train") :]]

    ran.clear()
    (tmp_path / "report" / "summary.json").unlink()
    chain.run_all(tmp_path, everything)
    assert ran == [("report", False)]


def test_an_interrupted_step_is_told_so(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    everything, ran = list(quickstart().steps(quickstart().SMOKE)), []
    record = recorder(ran)

    def stop_in_training(step, work, interrupted):
        if step.name == "train" and not interrupted:
            raise KeyboardInterrupt
        record(step, work, interrupted)

    monkeypatch.setattr(chain, "run_step", stop_in_training)
    with pytest.raises(KeyboardInterrupt):
        chain.run_all(tmp_path, everything)
    ran.clear()
    chain.run_all(tmp_path, everything)
    assert ran[0] == ("train", True)
    assert ran[1][0] == "refine-shipped"


def train_step(command: str, size: str = "") -> chain.Step:
    """The quick start's training step with a shell command for a program."""
    (step,) = (step for step in quickstart().steps(quickstart().SMOKE) if step.name == "train")
    return replace(step, command=("sh", "-c", command, size))


def test_results_of_an_earlier_command_are_not_those_of_a_step(tmp_path: Path) -> None:
    results = [tmp_path / "results" / name for name in ("initial.csv", "compact.csv")]
    write = f"mkdir -p results runs/compact && touch {' '.join(f'results/{path.name}' for path in results)}"
    chain.run_all(tmp_path, [train_step(write)])
    # As `refinenet train`, which leaves results of other poses as they are and writes its own elsewhere.
    elsewhere = f"test -e results/initial.csv || {{ {write}; }}"
    before = results[1].stat().st_mtime_ns
    chain.run_all(tmp_path, [train_step(elsewhere, "larger")])
    assert results[1].stat().st_mtime_ns > before
    with pytest.raises(SystemExit, match=r"left no .*results/compact\.csv"):
        chain.run_all(tmp_path, [train_step("exit 0")])


def summary_with(vss_gain: float, xy: float, rotation: float, missing: int = 0) -> dict:
    ratio = {"tx_mm": xy, "ty_mm": xy, "tz_mm": 1.0, "re_sym_deg": rotation}
    entry = {
        "name": "compact",
        "missing": missing,
        "vss_mean": {"reference": 0.6, "refined": 0.6 + vss_gain},
        "medians": {name: {"ratio": value} for name, value in ratio.items()},
    }
    return {"against_initial": [entry | {"name": "shipped"}, entry]}


def test_promises_are_kept_or_missed_by_the_reports_numbers() -> None:
    kept = [promise.kept for promise in quickstart().promises(summary_with(0.1, 0.4, 0.7))]
    assert all(kept)
    for worse in (summary_with(0.05, 0.4, 0.7), summary_with(0.1, 0.6, 0.7), summary_with(0.1, 0.4, 0.9)):
        assert not all(promise.kept for promise in quickstart().promises(worse))
    assert not all(promise.kept for promise in quickstart().promises(summary_with(0.1, 0.4, 0.7, missing=1)))


@pytest.mark.parametrize(("preset", "steps"), [("compact", 16000), ("flow", 6000)])
def test_the_shipped_checkpoints_load_and_are_of_the_example_object(repository, tug_ply, preset, steps):
    from posecore.mesh import load_mesh, mesh_digest
    from refinenet.models import checkpoint

    loaded = checkpoint.load(repository / "examples" / "checkpoints" / f"tug_{preset}.safetensors", preset)
    loaded.network()
    (trained,) = loaded.provenance.objects.values()
    mesh = load_mesh(tug_ply)
    assert (trained["sha256"], trained["mesh_digest"]) == (mesh.sha256, mesh_digest(mesh))
    assert loaded.provenance.step == steps
