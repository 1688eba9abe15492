"""Training by two processes under torchrun, on this machine, with gloo."""

import json
import sys

import pytest
from children import run
from made_once import made_once
from refinenet.training.loop import train

from .test_training import SMALL, small

pytestmark = pytest.mark.slow


def torchrun(*words):
    return run([sys.executable, "-m", "torch.distributed.run", "--nproc-per-node", "2", *words])


def command(dataset, out, *arguments):
    """Words of a `refinenet train`."""
    return ["train", str(dataset), "--out", str(out), "--device", "cpu", "--quiet", *arguments]


SEVERAL = """
import json, os, sys
import torch
from refinenet.cli import main

def init(backend, init=torch.distributed.init_process_group):
    ranks = {"rank": int(os.environ["RANK"]), "world_size": int(os.environ["WORLD_SIZE"])}
    init(backend, init_method=f"file://{meeting}", **ranks)

torch.distributed.init_process_group = init
for number, words in enumerate(json.loads(sys.argv[1])):
    meeting = f"{sys.argv[2]}/meeting{number}"  # torchrun's own is good for one
    main(words, standalone_mode=False)
"""
"""Commands of processes that start once, one after the other."""


def settings(options):
    return [word for option in options for word in ("--set", option)]


def curve(out, key):
    return [line[key] for line in map(json.loads, (out / "metrics.jsonl").open()) if key in line]


PRECISE = [*SMALL, "precision=float32"]
DOUBLED = [*PRECISE, "optimiser.ema_decay=0.9"]
PARTS = [*PRECISE, "on_policy.fraction=0.5", "on_policy.begin=0", "on_policy.full=0", "optimiser.schedule=constant"]


@pytest.fixture(scope="module")
def trained(dataset, tmp_path_factory):
    """Folder of what two ranks trained: `doubled1` and `doubled2`, `whole`, and the same in `parts`."""
    return made_once(tmp_path_factory, "ranks", lambda folder: train_several(dataset, folder))


def train_several(dataset, folder):
    (folder / "several.py").write_text(SEVERAL)
    doubled = {f"doubled{n}": settings([*DOUBLED, f"optimiser.accumulate={n}"]) for n in (1, 2)}
    whole = settings(PARTS)
    first = [word.replace("steps=6", "steps=4") for word in whole]
    ordered = {"whole": whole, "parts": first} | doubled
    commands = [command(dataset, folder / name, *words) for name, words in ordered.items()]
    commands.append(command(dataset, folder / "parts", *whole, "--resume"))
    result = torchrun(folder / "several.py", json.dumps(commands), folder)
    assert result.returncode == 0, result.stderr[-2000:]
    assert result.stdout.count("initial  refined") == len(commands)  # rank 0 alone prints


@pytest.mark.parametrize("accumulate", [1, 2])
def test_two_ranks_learn_what_one_process_learns_with_the_doubled_batch(trained, dataset, tmp_path, accumulate):
    """The doubled batch in two halves, as two loader processes hand them out: a batch norm sees a rank's half.

    Each rank reads what one of the loader processes reads, and the gradient is the mean over all.
    """
    outs = (trained / f"doubled{accumulate}", tmp_path / "one")
    alone = [f"optimiser.accumulate={2 * accumulate}", "loader.workers=2", "precision=float32"]
    train(small(*alone, "optimiser.ema_decay=0.9"), str(dataset), outs[1])
    two, one = (curve(out, "loss_px") for out in outs)
    assert len(one) == 6
    assert two == pytest.approx(one, rel=1e-3)
    shares = [curve(out, "visible_fraction") for out in outs]
    assert shares[0] == pytest.approx(shares[1], rel=1e-5)
    norms = [curve(out, "gradient_norm") for out in outs]
    assert norms[0] == pytest.approx(norms[1], rel=1e-2)


def test_ranks_end_together_when_one_fails(dataset, tmp_path):
    options = [*SMALL, "optimiser.lr=1e30", "steps=20", "optimiser.warmup_steps=0"]
    result = torchrun("-m", "refinenet", *command(dataset, tmp_path, *settings(options)))
    assert result.returncode != 0
    assert "is not finite" in result.stderr
    assert "refinenet/" not in result.stderr  # the only traceback is torchrun's own


def test_two_ranks_resume(trained):
    """Other trainings of the same processes lie between the parts, so that all comes from the checkpoint."""
    parts, whole = (curve(trained / name, "loss_px") for name in ("parts", "whole"))
    assert len(whole) == 6
    assert parts == pytest.approx(whole, rel=1e-6)
