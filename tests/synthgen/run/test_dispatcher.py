"""Whole runs of the command: the same bytes whatever the workers, and whatever kills it."""

import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import children
import dask
import numpy as np
import psutil
import pytest
from click.testing import CliRunner
from distributed import Client
from made_once import made_once
from posecore.shard import Encoded, ShardReader, ShardWriter, field_table
from synthgen.cli import main
from synthgen.run import cluster, dispatcher, worker
from synthgen.run.shard_job import ShardJob, ShardRenderer


def command(tug_ply, out, small_set, *extra):
    return [
        *(sys.executable, "-m", "synthgen.cli", "render", "--object", str(tug_ply), "--out", str(out), "--quiet"),
        *("--test-images", "0", *small_set),
        *extra,
    ]


def run(*arguments):
    """The command in this process; its workers are others."""
    return CliRunner().invoke(main, command(*arguments)[3:])


def tree(folder: Path) -> dict[str, bytes]:
    files = (p for p in sorted(folder.rglob("*")) if p.is_file())
    return {str(p.relative_to(folder)): p.read_bytes() for p in files}


def finished(folder: Path) -> dict[str, bytes]:
    """The dataset's files without what a killed writer left under temporary names."""
    return {name: data for name, data in tree(folder).items() if not name.endswith(".tmp")}


@pytest.fixture(scope="module")
def reference(tmp_path_factory, tug_ply, small_set):
    def render(folder):
        result = run(tug_ply, folder / "shards", small_set, "--n", "22", "--workers", "1")
        assert result.exit_code == 0, result.output

    return made_once(tmp_path_factory, "dispatched", render) / "shards"


@pytest.mark.slow
def test_the_dataset_is_complete_and_in_scene_order(reference):
    reader = ShardReader(str(reference))
    assert reader.complete
    assert reader.n == 22
    assert [reader.n_samples(i) for i in reader.committed] == [4, 4, 4, 4, 4, 2]
    scenes = np.concatenate([reader.read(i, ["scene_index"])["scene_index"] for i in reader.committed])
    assert scenes.tolist() == [i // 2 for i in range(22)]
    assert (reference / "models/obj_000001.ply").is_file()


@pytest.mark.slow
def test_two_workers_make_the_same_bytes(reference, tmp_path, tug_ply, small_set):
    result = run(tug_ply, tmp_path / "shards", small_set, "--n", "22", "--workers", "2")
    assert result.exit_code == 0, result.output
    assert tree(tmp_path / "shards") == tree(reference)


@pytest.mark.slow
def test_a_shorter_dataset_starts_with_the_same_samples(reference, tmp_path, tug_ply, small_set):
    result = run(tug_ply, tmp_path / "shards", small_set, "--n", "3", "--workers", "1")
    assert result.exit_code == 0, result.output
    short, long = (ShardReader(str(p)).read(0) for p in (tmp_path / "shards", reference))
    for name, values in short.items():
        assert np.array_equal(values, long[name][:3]), name


@pytest.mark.slow
def test_killing_it_at_random_writes_changes_no_byte(reference, tmp_path, tug_ply, small_set):
    out = tmp_path / "shards"
    arguments = command(tug_ply, out, small_set, "--n", "22", "--workers", "2")
    rng, before = np.random.default_rng(1), len(field_table())  # writes of a shard; six are to be written
    for writes in (rng.integers(before), before + rng.integers(before)):
        # its own session, so that the test can see whether workers outlive a killed parent
        killed = [sys.executable, "-c", KILLED_AT, str(writes), *arguments[3:]]
        with children.started(killed, stderr=subprocess.DEVNULL) as process:
            assert process.wait() == -signal.SIGKILL
            _wait_for_session_to_end(process.pid)
    result = CliRunner().invoke(main, arguments[3:])
    assert result.exit_code == 0, result.output
    assert finished(out) == tree(reference)


KILLED_AT = """
import os, signal, sys
left, sync = int(sys.argv.pop(1)), os.fsync
def write(descriptor):
    global left
    if left == 0:
        os.kill(os.getpid(), signal.SIGKILL)
    left -= 1
    sync(descriptor)
os.fsync = write
from synthgen.cli import main
main()
"""


@pytest.mark.slow
def test_a_worker_that_dies_is_replaced(reference, tmp_path, tug_ply, small_set):
    out = tmp_path / "shards"
    arguments = command(tug_ply, out, small_set, "--n", "22", "--workers", "1")
    with children.started(arguments, stderr=subprocess.PIPE) as process:
        children.wait_until((out / "manifest.jsonl").exists, process)
        workers = [p for p in psutil.Process(process.pid).children() if "spawn_main" in " ".join(p.cmdline())]
        for victim in workers:
            victim.kill()
        _, errors = process.communicate()
    assert workers
    assert process.returncode == 0, errors
    assert tree(out) == tree(reference)


@pytest.mark.slow
def test_ctrl_c_says_how_to_go_on(tmp_path, tug_ply, small_set):
    arguments = command(tug_ply, tmp_path / "shards", small_set, "--n", "4000", "--workers", "1")
    manifest = tmp_path / "shards" / "manifest.jsonl"
    with children.started(arguments, stderr=subprocess.PIPE, preexec_fn=children.interruptible) as process:
        children.wait_until(manifest.exists, process)  # until the workers run, the signal is ignored
        os.killpg(process.pid, signal.SIGINT)
        _, errors = process.communicate()
    assert process.returncode == 130
    assert "same command again continues" in errors
    assert "Traceback" not in errors


@pytest.mark.slow
def test_another_dataset_in_the_folder_is_refused_by_name(reference, tug_ply, small_set):
    before = tree(reference)
    for extra, named in (
        (["--n", "22", "--seed", "5"], "seed"),
        (["--n", "30"], "n is 22 there and 30 here"),
        (["--n", "22", "--set", "window.padding=0.4"], "padding"),
    ):
        result = run(tug_ply, reference, small_set, *extra)
        assert result.exit_code == 1
        assert named in result.stderr
        diameter, error = result.stderr.splitlines()
        assert error.startswith("Error: ")
        assert diameter == "tug.ply: diameter 118.9 mm (--units mm)"
    assert tree(reference) == before


class Echo(ShardRenderer):
    """Stands for a renderer: its shards say whose job they are."""

    def __init__(self, job):
        self.seed = job.card["seed"]

    def prepare(self):
        pass

    def render(self, shard_id, quarantined):
        line = {"shard": shard_id, "n": 2, "rejected": 0, "seed": self.seed, "bytes": {}, "sha256": "0" * 64}
        return Encoded(shard_id=shard_id, files=dict.fromkeys((f.name for f in field_table()), b""), line=line)


def test_jobs_that_share_a_cluster_keep_their_own_recipes(tmp_path, monkeypatch, config_of):
    monkeypatch.setattr(worker, "ShardRenderer", Echo)
    settings = {"processes": False, "n_workers": 1, "threads_per_worker": 1, "dashboard_address": None}
    with dask.config.set(cluster.SETTINGS), Client(**settings) as client:
        sizes = {"n": 6, "shard_size": 2, "patch_px": 16, "contour_points": 5, "depth_step_m": 1e-4}
        cards = [{**sizes, "seed": seed} for seed in (1, 2)]
        plugins = [worker.RendererPlugin(ShardJob(config=config_of(), card=card, meshes={})) for card in cards]
        for plugin in plugins:  # both are there before the first one's shards are asked for
            client.register_plugin(plugin)
        for card, plugin in zip(cards, plugins, strict=True):
            writer = ShardWriter.create(str(tmp_path / str(card["seed"])), card)
            dispatcher.Dispatcher(client, plugin, writer, lambda encoded: None).render(iter(range(3)))
            manifest = (tmp_path / str(card["seed"]) / "manifest.jsonl").read_text()
            assert writer.committed() == [0, 1, 2]
            assert manifest.count(f'"seed": {card["seed"]}') == 3


@pytest.mark.slow
@pytest.mark.blender
def test_cycles_makes_the_same_bytes_with_one_and_two_workers(tmp_path, tug_ply, small_set):
    for workers in ("1", "2"):
        result = run(
            *(tug_ply, tmp_path / workers, small_set, "--n", "10", "--workers", workers),
            *("--engine", "cycles", "--samples", "2"),
        )
        assert result.exit_code == 0, result.output
    assert tree(tmp_path / "1") == tree(tmp_path / "2")


def _wait_for_session_to_end(leader: int) -> None:
    """Workers notice that their parent is gone and end by themselves."""
    while children.session(leader):
        time.sleep(0.05)
