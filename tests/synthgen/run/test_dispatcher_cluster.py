"""A dask cluster of real processes: a scheduler and workers that were started by hand."""

import json
import os
import subprocess
import sys
from contextlib import ExitStack
from dataclasses import replace
from pathlib import Path

import psutil
import pytest
from children import kill_session, started, wait_until
from click.testing import CliRunner
from distributed import Client
from render_processes import render_command as command
from synthgen.cli import main
from synthgen.inputs.assets import Assets
from synthgen.run import cluster as dask_cluster
from synthgen.run import worker
from synthgen.run.shard_job import ShardJob


def tree(folder: Path) -> dict[str, bytes]:
    return {str(p.relative_to(folder)): p.read_bytes() for p in sorted(folder.rglob("*")) if p.is_file()}


def run(arguments):
    """The command in this process."""
    return CliRunner().invoke(main, arguments[3:])


def error_line(exit_code, errors):
    assert exit_code == 1, errors
    lines = [line for line in errors.splitlines() if line.startswith("Error: ")]
    assert len(lines) == 1, errors
    assert "Traceback" not in errors
    return lines[0]


class Cluster:
    """A scheduler and workers, as `dask scheduler` and `dask worker` start them."""

    def __init__(self, folder: Path, processes: ExitStack) -> None:
        self.file = folder / "scheduler.json"
        self.processes = processes
        self.scheduler = self.start("scheduler", "--port", "0", "--no-dashboard", "--host", "127.0.0.1")
        self.address = self.wait_for_address()

    def start(self, kind, *arguments, **environment):
        command = [sys.executable, "-m", "dask", kind, "--scheduler-file", self.file, *arguments]
        silent = {"stdout": subprocess.DEVNULL, "stderr": subprocess.DEVNULL}
        return self.processes.enter_context(started(command, env={**os.environ, **environment}, **silent))

    def worker(self, *arguments, **environment):
        return self.start("worker", "--no-dashboard", *(arguments or ("--nthreads", "1")), **environment)

    def wait_for_address(self):
        text = wait_until(lambda: self.file.exists() and self.file.read_text(), self.scheduler)
        return json.loads(text)["address"]


@pytest.fixture
def cluster(tmp_path):
    with ExitStack() as processes:
        yield Cluster(tmp_path, processes)


def renderers(process):
    """Worker processes below a nanny."""
    return [p for p in psutil.Process(process.pid).children() if "spawn_main" in " ".join(p.cmdline())]


@pytest.mark.slow
def test_a_cluster_that_loses_a_worker_makes_the_same_bytes(cluster, tmp_path, tug_ply, small_set):
    undisturbed = run(command(tug_ply, tmp_path / "local", small_set, "--workers", "1", "--test-images", "0"))
    assert undisturbed.exit_code == 0, undisturbed.output
    first, second = cluster.worker(), cluster.worker()
    out = tmp_path / "shards"
    arguments = command(tug_ply, out, small_set, "--scheduler", cluster.address)
    with started(arguments, stderr=subprocess.PIPE) as driver:
        wait_until((out / "manifest.jsonl").exists, driver)
        victims = renderers(first)
        for victim in victims:
            victim.kill()
        _, errors = driver.communicate()
    assert victims
    assert driver.returncode == 0, errors
    assert (out / "manifest.jsonl").read_text().count("\n") == 12
    assert tree(out) == tree(tmp_path / "local")
    assert first.poll() is None and second.poll() is None  # the job is gone, the cluster stays


@pytest.mark.slow
def test_a_scheduler_that_goes_away_is_one_line(cluster, tmp_path, tug_ply, small_set):
    cluster.worker()
    out = tmp_path / "shards"
    arguments = command(tug_ply, out, [*small_set, "--n", "900"], "--scheduler", cluster.address)
    with started(arguments, stderr=subprocess.PIPE) as driver:
        wait_until((out / "manifest.jsonl").exists, driver)
        cluster.scheduler.kill()
        _, errors = driver.communicate()
    assert "the scheduler is gone; start it and its workers" in error_line(driver.returncode, errors)


@pytest.mark.slow
def test_workers_without_synthgen_or_with_another_version_are_named(cluster, tmp_path, tug_ply, small_set):
    out = tmp_path / "shards"
    arguments = command(tug_ply, out, small_set, "--scheduler", cluster.address)
    hiding = tmp_path / "hiding"
    hiding.mkdir()
    (hiding / "synthgen.py").write_text("")
    old = tmp_path / "old" / "synthgen-0.0.1.dist-info"
    old.mkdir(parents=True)
    (old / "METADATA").write_text("Metadata-Version: 2.1\nName: synthgen\nVersion: 0.0.1\n")
    for folder, words in (
        (hiding, ("the workers cannot take the job", "install the same version of synthgen on every machine")),
        (old.parent, ("has synthgen 0.0.1, the command ",)),
    ):
        process = cluster.worker(PYTHONPATH=str(folder))
        with Client(cluster.address) as client:  # a job that is there first waits for other workers
            client.wait_for_workers(1)
        result = run(arguments)
        for word in words:
            assert word in error_line(result.exit_code, result.stderr)
        kill_session(process)


def test_a_worker_says_why_it_cannot_render(tug, config_of):
    job = ShardJob(config=config_of(), card={}, meshes={1: tug})
    assert worker.find_problem(job, 1) is None
    assert "has 4 threads, expected 1" in worker.find_problem(job, 4)
    lost = replace(job, assets=Assets(photos=("/nowhere/a.png", "/nowhere/b.png")))
    assert "cannot read /nowhere/a.png (2 of 2 photographs" in worker.find_problem(lost, 1)


@pytest.mark.slow
def test_a_scheduler_that_does_not_answer_is_one_line(tmp_path, tug_ply, small_set, monkeypatch):
    monkeypatch.setattr(dask_cluster, "ANSWER_S", 1.0)
    for address in ("tcp://127.0.0.1:9", "node0"):
        arguments = command(tug_ply, tmp_path / "shards", small_set, "--scheduler", address)[3:]
        result = CliRunner().invoke(main, arguments)
        assert result.exit_code == 1
        assert f"Error: --scheduler {address}: no dask scheduler answers there" in result.stderr
        assert "Traceback" not in result.output


def test_workers_and_scheduler_exclude_each_other(tmp_path, tug_ply, small_set):
    arguments = command(tug_ply, tmp_path / "shards", small_set, "--scheduler", "tcp://node0:8786", "--workers", "2")
    result = CliRunner().invoke(main, arguments[3:])
    assert result.exit_code == 2
    assert "give only one option" in result.stderr
    assert not (tmp_path / "shards").exists()
