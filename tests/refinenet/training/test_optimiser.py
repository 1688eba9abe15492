import copy
import json
import os
import sys

import pytest
import torch
from children import run
from refinenet.batch import Batch
from refinenet.config import OptimiserConfig, load_config
from refinenet.errors import TrainingError
from refinenet.training.finite_guard import FiniteGuard
from refinenet.training.loop import train
from refinenet.training.optimiser import EmaWeights, learning_rate, make_optimiser
from refinenet.training.setup import open_run
from torch import nn

from .test_training import SMALL, small


def toy():
    torch.manual_seed(0)
    return nn.Sequential(nn.Linear(3, 4), nn.BatchNorm1d(4), nn.Linear(4, 1))


def test_learning_rate_warms_up_and_falls():
    config = OptimiserConfig(lr=1.0, schedule="cosine", warmup_steps=10)
    rates = [learning_rate(step, 100, config) for step in range(100)]
    assert rates[0] == pytest.approx(0.1)
    assert max(rates) == rates[10] == pytest.approx(1.0)
    assert rates[10:] == sorted(rates[10:], reverse=True)
    assert rates[-1] == pytest.approx(0.01)
    assert {learning_rate(step, 100, OptimiserConfig(lr=1.0)) for step in range(100)} == {1.0}


@pytest.mark.parametrize("name", ["adam", "adamw"])
def test_the_fused_optimiser_takes_the_plain_one_s_steps(name):
    network = toy().eval()  # in training mode the bias before the batch norm has rounding for a gradient
    twin = copy.deepcopy(network)
    config = OptimiserConfig(name=name, lr=0.01, weight_decay=0.1)
    fused = make_optimiser(network, config)
    assert fused.defaults["fused"]
    plain = make_optimiser(twin, config)
    for group in plain.param_groups:
        group["fused"] = False
    x = torch.randn(8, 3)
    for _ in range(5):
        for model, optimiser in ((network, fused), (twin, plain)):
            optimiser.zero_grad()
            model(x).square().mean().backward()
            optimiser.step()
    for a, b in zip(network.parameters(), twin.parameters(), strict=True):
        torch.testing.assert_close(a, b)


def test_the_running_average_is_one():
    network = toy()
    average = EmaWeights(network, 0.75)
    wanted = {name: value.clone() for name, value in network.state_dict().items()}
    for step in range(40):
        with torch.no_grad():
            for parameter in network.parameters():
                parameter += torch.randn_like(parameter)
        network(torch.randn(8, 3))  # moves the batch norm's statistics
        average.update(step)
        keep = min(0.75, (step + 1) / (step + 10))
        for name, value in network.state_dict().items():
            real = value.is_floating_point()
            wanted[name] = keep * wanted[name] + (1 - keep) * value if real else value.clone()
    for name, value in average.network.state_dict().items():
        torch.testing.assert_close(value, wanted[name])
    assert not average.network.training
    assert not any(p.requires_grad for p in average.network.parameters())


def guarded_step(guard, optimiser, network, step, x):
    optimiser.zero_grad()
    losses = network(x)[:, 0]
    losses.mean().backward()
    norm = torch.nn.utils.get_total_norm([p.grad for p in network.parameters()])
    ids = torch.stack([torch.full((len(x),), step), torch.arange(len(x))], 1)
    guard.check(step, (Batch(None, None, ids),), [losses.detach()], norm)
    optimiser.step()


def test_a_late_guard_skips_the_step_and_all_after_it():
    """What runs on a GPU, here on a processor: the optimiser's kernel itself leaves the weights alone."""
    network = toy().eval()
    optimiser = make_optimiser(network, OptimiserConfig(lr=0.1))
    guard = FiniteGuard(optimiser, torch.device("cpu"), late=True)
    good, bad = torch.randn(4, 3), torch.randn(4, 3)
    bad[2] = torch.inf
    guarded_step(guard, optimiser, network, 0, good)
    before = copy.deepcopy(network.state_dict())
    guarded_step(guard, optimiser, network, 1, bad)
    with pytest.raises(TrainingError, match=r"loss of step 1 is not finite, samples: shard 1 row 2;"):
        guarded_step(guard, optimiser, network, 2, good)
    optimiser.step()
    assert all(torch.equal(before[name], value) for name, value in network.state_dict().items())
    guarded_step(guard := FiniteGuard(optimiser, torch.device("cpu"), late=True), optimiser, network, 3, bad)
    with pytest.raises(TrainingError, match="step 3"):
        guard.settle()


def test_a_step_on_a_batch_twice_is_a_step_on_it_once(dataset, tmp_path):
    once, twice = (
        open_run(small(*more), str(dataset), tmp_path) for more in (["precision=float32"], ["precision=float32"])
    )
    batch = next(once.stream())
    first, second = once.take_step(batch), twice.take_step(batch, batch)
    torch.testing.assert_close(first["loss_px"], second["loss_px"])
    torch.testing.assert_close(first["gradient_norm"], second["gradient_norm"], rtol=1e-4, atol=0)
    for a, b in zip(once.network.parameters(), twice.network.parameters(), strict=True):
        torch.testing.assert_close(a, b, rtol=1e-4, atol=1e-5)


@pytest.mark.slow
def test_a_compiled_network_learns_the_same(dataset, tmp_path):
    """In a process of its own: the checks of shapes that tests switch on cannot be traced."""
    plain, compiled = tmp_path / "plain", tmp_path / "compiled"
    train(small("precision=float32"), str(dataset), plain)
    command = [sys.executable, "-m", "refinenet", "train", str(dataset), "--out", str(compiled), "--quiet"]
    options = [*SMALL, "precision=float32", "compile=true"]
    one_process = {**os.environ, "TORCHINDUCTOR_COMPILE_THREADS": "1"}  # else the compiler starts a pool of them
    result = run([*command, *(word for option in options for word in ("--set", option))], env=one_process)
    assert result.returncode == 0, result.stderr[-2000:]
    curves = [
        [line["loss_px"] for line in map(json.loads, (out / "metrics.jsonl").open()) if "loss_px" in line]
        for out in (plain, compiled)
    ]
    assert len(curves[0]) == 6
    assert curves[0] != curves[1]  # other kernels round otherwise
    assert curves[0] == pytest.approx(curves[1], rel=1e-3)


def test_settings_out_of_range_are_named():
    from posecore.errors import ConfigError

    for text, message in (
        ("optimiser.accumulate=0", "accumulate is 0"),
        ("optimiser.ema_decay=1.0", "ema_decay is 1.0"),
    ):
        with pytest.raises(ConfigError, match=message):
            load_config("compact", [text])
