"""Which device Cycles traces on, with machines that are made up."""

import os
import subprocess
import sys

import pytest
from click.testing import CliRunner
from posecore.errors import RenderError
from synthgen.cli import main
from synthgen.config import load_config
from synthgen.engines import devices
from synthgen.inputs.sources import Sources
from synthgen.run import cluster, render
from synthgen.run.shard_job import ShardJob
from synthgen.run.worker import RendererPlugin


def test_auto_takes_the_fastest_that_is_there():
    assert devices.choose_device("auto", {"optix": 2, "cuda": 2}) == "optix"
    assert devices.choose_device("auto", {"cuda": 1}) == "cuda"
    assert devices.choose_device("auto", {}) == "cpu"
    assert devices.choose_device("cuda", {"optix": 2, "cuda": 2}) == "cuda"
    assert devices.choose_device("cpu", {"optix": 2}) == "cpu"


def test_a_device_that_is_not_there_is_named():
    with pytest.raises(RenderError, match=r"device optix: Cycles finds no such GPU here \(it finds 1 cuda\)"):
        devices.choose_device("optix", {"cuda": 1})


def test_gpus_keep_the_names_that_the_environment_gives(monkeypatch):
    monkeypatch.delenv("CUDA_VISIBLE_DEVICES", raising=False)
    assert devices.visible_gpus(3) == ("0", "1", "2")
    monkeypatch.setenv("CUDA_VISIBLE_DEVICES", "2, 5")
    assert devices.visible_gpus(2) == ("2", "5")


@pytest.mark.slow
def test_the_card_names_a_device_and_never_auto(monkeypatch, tug_ply):
    monkeypatch.setattr(render, "list_gpus", lambda: {"optix": 2, "cuda": 2})
    monkeypatch.delenv("CUDA_VISIBLE_DEVICES", raising=False)
    for wish, engine, chosen, gpus in (
        ("auto", "cycles", "optix", ("0", "1")),
        ("cuda", "cycles", "cuda", ("0", "1")),
        ("cpu", "cycles", "cpu", ()),
        ("auto", "raster", "cpu", ()),
    ):
        config = load_config("default", [f"device={wish}", f"engine={engine}"])
        job = render.RenderJob(out="out", n=4, config=config, sources=Sources(objects=(tug_ply,)))
        shards, names = render._loaded(job)
        assert (shards.config.device, shards.card["config"]["device"], names) == (chosen, chosen, gpus)


def test_auto_needs_this_machine(tug_ply, tmp_path):
    arguments = ["--object", str(tug_ply), "--n", "4", "--out", str(tmp_path / "out"), "--device", "auto"]
    result = CliRunner().invoke(main, ["render", *arguments, "--scheduler", "tcp://node0:8786"])
    assert result.exit_code == 2
    assert "--device auto" in result.stderr


@pytest.mark.slow
def test_each_worker_sees_one_gpu(config_of, tug):
    with cluster.connect(2, None) as client:
        client.register_plugin(RendererPlugin(ShardJob(config=config_of(), card={}, meshes={1: tug}), ("4", "7")))
        seen = client.run(lambda: os.environ["CUDA_VISIBLE_DEVICES"])
    assert sorted(seen.values()) == ["4", "7"]


def test_a_blender_that_does_not_start_is_one_line(monkeypatch):
    monkeypatch.setattr(sys, "executable", "/nowhere/python")
    with pytest.raises(RenderError, match=r"Blender cannot list its GPUs .*use --device cpu"):
        devices.list_gpus()
    failed = subprocess.CalledProcessError(1, "python", stderr="Traceback\nImportError: libGL.so")
    monkeypatch.setattr(subprocess, "run", lambda *_, **__: (_ for _ in ()).throw(failed))
    with pytest.raises(RenderError, match=r"\(ImportError: libGL.so\)"):
        devices.list_gpus()


@pytest.mark.blender
def test_this_machine_without_gpu_says_so(tug_ply, tmp_path, monkeypatch):
    gpus = devices.list_gpus()
    if gpus:
        pytest.skip("this machine has a GPU")
    monkeypatch.setattr(render, "list_gpus", lambda: gpus)
    arguments = ["--object", str(tug_ply), "--n", "4", "--out", str(tmp_path / "out"), "--device", "optix"]
    result = CliRunner().invoke(main, ["render", *arguments])
    assert result.exit_code == 1
    assert "Error: device optix: Cycles finds no such GPU here (it finds none)" in result.stderr
    assert not (tmp_path / "out").exists()
