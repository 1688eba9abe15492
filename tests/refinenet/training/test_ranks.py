"""Training by two processes under torchrun, on this machine, with gloo."""

import json
import sys

import pytest
from children import run
from refinenet.training.loop import train

from .test_training import SMALL, small

pytestmark = pytest.mark.slow


def torchrun(dataset, out, *arguments):
    command = [
        sys.executable, "-m", "torch.distributed.run", "--nproc-per-node", "2", "-m", "refinenet", "train",
        str(dataset), "--out", str(out), "--device", "cpu", "--quiet", *arguments,
    ]  # fmt: skip
    return run(command)


def settings(options):
    return [word for option in options for word in ("--set", option)]


def curve(out, key):
    return [line[key] for line in map(json.loads, (out / "metrics.jsonl").open()) if key in line]


@pytest.mark.parametrize("accumulate", [1, 2])
def test_two_ranks_learn_what_one_process_learns_with_the_doubled_batch(dataset, tmp_path, accumulate):
    """The doubled batch in two halves, as two loader processes hand them out: a batch norm sees a rank's half.

    Each rank reads what one of the loader processes reads, and the gradient is the mean over all.
    """
    options = [*SMALL, "precision=float32", "optimiser.ema_decay=0.9"]
    result = torchrun(dataset, tmp_path / "two", *settings([*options, f"optimiser.accumulate={accumulate}"]))
    assert result.returncode == 0, result.stderr[-2000:]
    assert result.stdout.count("initial  refined") == 1
    alone = [f"optimiser.accumulate={2 * accumulate}", "loader.workers=2", "precision=float32"]
    train(small(*alone, "optimiser.ema_decay=0.9"), str(dataset), tmp_path / "one")
    two, one = (curve(tmp_path / name, "loss_px") for name in ("two", "one"))
    assert len(one) == 6
    assert two == pytest.approx(one, rel=1e-3)
    shares = [curve(tmp_path / name, "visible_fraction") for name in ("two", "one")]
    assert shares[0] == pytest.approx(shares[1], rel=1e-5)
    assert curve(tmp_path / "two", "gradient_norm") == pytest.approx(curve(tmp_path / "one", "gradient_norm"), rel=1e-2)


def test_ranks_end_together_when_one_fails(dataset, tmp_path):
    result = torchrun(
        dataset, tmp_path, *settings([*SMALL, "optimiser.lr=1e30", "steps=20", "optimiser.warmup_steps=0"])
    )
    assert result.returncode != 0
    assert "is not finite" in result.stderr
    assert "refinenet/" not in result.stderr  # the only traceback is torchrun's own


def test_two_ranks_resume(dataset, tmp_path):
    own = [f"on_policy.{key}" for key in ("fraction=0.5", "begin=0", "full=0")]
    options = [*settings([*SMALL, *own, "precision=float32", "optimiser.schedule=constant"])]
    assert torchrun(dataset, tmp_path / "whole", *options).returncode == 0
    first = [word.replace("steps=6", "steps=4") for word in options]
    assert torchrun(dataset, tmp_path / "parts", *first).returncode == 0
    result = torchrun(dataset, tmp_path / "parts", *options, "--resume")
    assert result.returncode == 0, result.stderr[-2000:]
    parts, whole = (curve(tmp_path / name, "loss_px") for name in ("parts", "whole"))
    assert len(whole) == 6
    assert parts == pytest.approx(whole, rel=1e-6)
