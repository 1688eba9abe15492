"""`refinenet refine --workers`: the same result from several processes."""

import os
import signal
import subprocess
import sys
from contextlib import contextmanager
from pathlib import Path

import psutil
import pytest
from children import interruptible, started, wait_until
from posecore.bop import read_sidecar


def columns(path):
    """A result file's lines without their times."""
    return [line.rsplit(",", 1)[0] for line in path.read_text().splitlines()]


@pytest.mark.slow
@pytest.mark.parametrize("what", [("--hypotheses", 3), ("--iterations", 2, "--keep-failed")])
def test_any_number_of_processes_writes_the_same(cli, two_images, trained, tmp_path, what):
    root, start, _ = two_images
    rest = ["--checkpoint", trained, "--dataset", root, "--init", start, "--threads", 1, "--quiet", *what]
    outs = [tmp_path / "results" / f"{workers}.csv" for workers in (1, 2)]
    for workers, out in zip((1, 2), outs, strict=True):
        more = ["--overlay", tmp_path / f"pictures{workers}"]
        result = cli("refine", *rest, "--workers", workers, "--out", out, *more)
        assert result.exit_code == 0, result.output
        assert "4 initial poses, 3 refined" in result.stdout
    one, two = outs
    assert columns(one) == columns(two)
    assert read_sidecar(one) == read_sidecar(two)
    pictures = sorted((tmp_path / "pictures1").iterdir())
    assert len(pictures) == 2
    assert all(picture.read_bytes() == (tmp_path / "pictures2" / picture.name).read_bytes() for picture in pictures)


@pytest.mark.slow
def test_search_too(cli, two_images, tmp_path):
    root, start, _ = two_images
    rest = ["--method", "search", "--dataset", root, "--init", start, "--iterations", 1, "--quiet"]
    paths = []
    for workers in (1, 2):
        paths.append((tmp_path / f"{workers}.csv", tmp_path / f"{workers}-weighed.csv"))
        more = ["--workers", workers, "--out", paths[-1][0], "--candidates", paths[-1][1]]
        result = cli("refine", *rest, *more)
        assert result.exit_code == 0, result.output
    assert columns(paths[0][0]) == columns(paths[1][0])
    assert columns(paths[0][1]) == columns(paths[1][1])
    assert len(columns(paths[0][1])) > 10


@pytest.mark.slow
def test_what_was_finished_before_a_damaged_image_is_kept(cli, two_images, trained, tmp_path):
    root, start, second = two_images
    second.write_bytes(second.read_bytes()[:200])
    out = tmp_path / "x.csv"
    rest = ["--checkpoint", trained, "--dataset", root, "--init", start, "--out", out, "--iterations", 1, "--quiet"]
    result = cli("refine", *rest, "--workers", 2)
    assert result.exit_code == 1
    assert f"Stopped: 1 initial poses were not reached, {out} holds the others" in result.stderr
    assert result.stderr.splitlines()[-1].startswith(f"Error: {second}")
    assert read_sidecar(out)["initial_lines"] == [3, 4]


def ignores_interrupts(pid):
    """As the command does while it starts processes."""
    (line,) = (line for line in Path(f"/proc/{pid}/status").read_text().splitlines() if line.startswith("SigIgn:"))
    return bool(int(line.split()[1], 16) & 1 << (signal.SIGINT - 1))


def is_worker(child):
    try:
        return "spawn_main" in " ".join(child.cmdline())
    except psutil.Error:  # it ended meanwhile
        return False


@contextmanager
def begun(arguments):
    """The command in a process of its own, once both of its workers are there."""
    command = [sys.executable, "-m", "refinenet", "refine", *arguments]

    def both():
        workers = [child for child in psutil.Process(process.pid).children() if is_worker(child)]
        return len(workers) == 2 and not ignores_interrupts(process.pid) and workers

    with started(command, stderr=subprocess.PIPE, preexec_fn=interruptible) as process:
        yield process, wait_until(both, process)


@pytest.mark.slow
def test_ctrl_c_and_a_worker_that_dies_end_all_with_one_line(two_images, tmp_path):
    root, start, _ = two_images
    rest = ["--method", "search", "--dataset", root, "--init", start, "--quiet", "--workers", 2, "--out"]
    with begun([*rest, tmp_path / "x.csv"]) as (process, workers):
        os.killpg(process.pid, signal.SIGINT)  # as a terminal does
        _, said = process.communicate()
        assert process.returncode == 130
        assert said.splitlines() == ["Stopped: nothing was finished, nothing is written"]
        psutil.wait_procs(workers)

    with begun([*rest, tmp_path / "y.csv"]) as (process, workers):
        workers[0].kill()
        _, said = process.communicate()
        assert process.returncode == 1
        assert said.splitlines()[-1].startswith(f"Error: {root}: a process that refined its images died")
        assert "fewer --workers" in said
        psutil.wait_procs(workers)
