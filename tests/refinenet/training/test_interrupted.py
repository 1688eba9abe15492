"""Runs that are killed or run out of disk go on as if nothing had been."""

import errno
import itertools
import json
import logging
import math
import os
import random
import signal
import sys
from pathlib import Path

import pytest
import torch
from children import started
from posecore.errors import CheckpointError, ConfigError, StorageError
from refinenet.models import checkpoint
from refinenet.training.loop import train
from refinenet.training.setup import open_run
from safetensors.torch import load_file

from .test_training import small

ROOT = Path(__file__).parents[3]
AVERAGED = ["optimiser.ema_decay=0.9", "optimiser.accumulate=2"]


def assert_same_weights(first, second, name="last.safetensors"):
    a, b = load_file(first / name), load_file(second / name)
    assert a.keys() == b.keys()
    assert all(torch.equal(a[key], b[key]) for key in a)


@pytest.fixture(scope="module")
def undisturbed(dataset, tmp_path_factory):
    out = tmp_path_factory.mktemp("undisturbed")
    train(small(*AVERAGED), str(dataset), out)
    return out


@pytest.mark.slow
def test_the_average_is_saved_and_measured(undisturbed, dataset):
    state = checkpoint.load_state(undisturbed, 6)
    saved = checkpoint.load(undisturbed / "last.safetensors").tensors
    assert any(not torch.equal(saved[name], value) for name, value in state["weights"].items())
    resumed = open_run(small(*AVERAGED), str(dataset), undisturbed, resume=True)
    assert all(torch.equal(saved[name], value) for name, value in resumed.eval_network.state_dict().items())
    assert all(torch.equal(state["weights"][name], value) for name, value in resumed.network.state_dict().items())
    lines = [json.loads(line) for line in (undisturbed / "metrics.jsonl").read_text().splitlines()]
    assert lines[-1]["validation/add_after_mm"] == resumed.validate()["validation/add_after_mm"]


@pytest.mark.slow
@pytest.mark.parametrize("write", range(5))
def test_a_disk_full_at_any_write_of_a_checkpoint_keeps_the_one_before(
    undisturbed, dataset, tmp_path, monkeypatch, write
):
    """From the first checkpoint on, the n-th file to be written finds the disk full; later there is space again."""
    counter, sync = itertools.count(), os.fsync

    def full(descriptor):
        if (tmp_path / "last.safetensors").exists() and next(counter) == write:
            raise OSError(errno.ENOSPC, "No space left on device")
        sync(descriptor)

    with monkeypatch.context() as patch:
        patch.setattr("posecore.files.os.fsync", full)
        with pytest.raises(StorageError, match=r"the disk is full, this write of .* failed; free some space"):
            train(small(*AVERAGED), str(dataset), tmp_path)
    kept = checkpoint.load(tmp_path / "last.safetensors")
    assert kept.provenance.step in (2, 4, 6)
    assert checkpoint.load_state(tmp_path, kept.provenance.step)["optimiser"]
    assert not list(tmp_path.glob(".*.tmp"))
    train(small(*AVERAGED), str(dataset), tmp_path, resume=True)
    for name in ("last.safetensors", "best.safetensors"):
        assert_same_weights(undisturbed, tmp_path, name)


@pytest.mark.slow
def test_a_run_is_not_resumed_under_other_circumstances(undisturbed, dataset, tmp_path, monkeypatch):
    state = checkpoint.load_state(undisturbed, 6)
    monkeypatch.setattr(checkpoint, "load_state", lambda folder, step, ema: state | {"world": 4})
    with pytest.raises(ConfigError, match=r"trained by 4 processes and now there are 1; resume with torchrun"):
        open_run(small(*AVERAGED), str(dataset), undisturbed, resume=True)
    monkeypatch.undo()
    record = (undisturbed / "data.json").read_text()
    (undisturbed / "data.json").unlink()
    with pytest.raises(CheckpointError, match=r"data.json: .*start a new one"):
        open_run(small(*AVERAGED), str(dataset), undisturbed, resume=True)
    (undisturbed / "data.json").write_text(record)


@pytest.mark.slow
def test_a_cosine_rate_that_jumps_on_resume_is_said(dataset, tmp_path, caplog):
    options = ["steps=4", "optimiser.warmup_steps=0"]
    train(small(*options), str(dataset), tmp_path)
    with caplog.at_level(logging.WARNING):
        resumed = open_run(small(*options, "steps=8"), str(dataset), tmp_path, resume=True)
    assert "steps was 4 and is now 8, so the cosine rate jumps from 1e-05 to 0.000395" in caplog.text
    values = resumed.take_step(next(resumed.stream()))
    assert values["learning_rate"] == pytest.approx(0.00039485, abs=1e-8)
    resumed.close()
    caplog.clear()
    open_run(small(*options), str(dataset), tmp_path, resume=True).close()
    assert "jumps" not in caplog.text


def test_a_best_of_other_pairs_is_forgotten(undisturbed, dataset):
    same = open_run(small(*AVERAGED), str(dataset), undisturbed, resume=True)
    other = open_run(small(*AVERAGED, "validation.pairs=4"), str(dataset), undisturbed, resume=True)
    assert same.best_mm < math.inf
    assert other.best_mm == math.inf


def test_what_a_killed_run_left_goes(undisturbed, dataset):
    left = [undisturbed / ".last.safetensors.123.tmp", undisturbed / "optimiser-0000009.pt"]
    for path in left:
        path.write_bytes(b"half")
    open_run(small(*AVERAGED), str(dataset), undisturbed, resume=True)
    assert not any(path.exists() for path in left)
    assert (undisturbed / "optimiser-0000006.pt").exists()


@pytest.mark.slow
def test_kill_9_at_random_moments_changes_nothing(dataset, tmp_path):
    """Killed in a step between two checkpoints, then while a checkpoint is written, its loader process too; then left
    to end."""
    options = [*AVERAGED, "steps=16", "checkpoint_every=4", "validation.every=8", "loader.workers=1"]
    train(small(*options), str(dataset), tmp_path / "undisturbed")
    out, rng = tmp_path / "killed", random.Random(0)
    for moment, count in (("step", 5 + rng.randrange(3)), ("write", 3 + rng.randrange(3))):
        command = [sys.executable, "-c", RUN, str(dataset), str(out), json.dumps(options), moment, str(count)]
        with started(command, cwd=ROOT) as process:
            assert process.wait() == -signal.SIGKILL
    assert 4 <= steps_logged(out) < 16
    train(small(*options), str(dataset), out, resume=True)
    for name in ("last.safetensors", "best.safetensors"):
        assert_same_weights(tmp_path / "undisturbed", out, name)
    curves = [[line for line in logged(folder) if "loss_px" in line] for folder in (tmp_path / "undisturbed", out)]
    assert [(line["step"], line["loss_px"]) for line in curves[0]] == [
        (line["step"], line["loss_px"]) for line in curves[1]
    ]


RUN = """
import json, os, signal, sys
from pathlib import Path
from refinenet.training.loop import train
from refinenet.training.run import Trainer
from tests.refinenet.training.test_training import small

def killed(function, left):
    def counted(*arguments):
        nonlocal left
        left -= 1
        result = function(*arguments)
        if left == 0:
            os.kill(os.getpid(), signal.SIGKILL)
        return result
    return counted

if __name__ == "__main__":
    url, out, options = sys.argv[1], Path(sys.argv[2]), json.loads(sys.argv[3])
    moment, count = sys.argv[4], int(sys.argv[5])
    if moment == "step":
        Trainer.take_step = killed(Trainer.take_step, count)
    else:
        os.fsync = killed(os.fsync, count)
    train(small(*options), url, out, resume=(out / "last.safetensors").exists())
"""


def logged(out):
    """Whole lines of metrics; the last may be half written."""
    lines = []
    path = out / "metrics.jsonl"
    for text in path.read_text().splitlines() if path.exists() else ():
        try:
            lines.append(json.loads(text))
        except ValueError:
            break
    return lines


def steps_logged(out):
    return max((line["step"] for line in logged(out)), default=0)
