"""Pools of processes that end at once when something goes wrong."""

import os
import signal
import sys
import time
from concurrent.futures.process import BrokenProcessPool
from contextlib import contextmanager

import pytest
from children import run
from posecore import processes
from posecore.errors import RenderError
from posecore.processes import behave_as_worker, in_order, map_unordered, spawned, unordered


def test_results_come_in_order_and_few_ahead():
    with spawned(2, behave_as_worker, (), "died") as pool:
        assert list(in_order(pool, abs, range(-9, 1), ahead=3)) == list(range(9, -1, -1))
        results = in_order(pool, len, ("ab", 5, "c"), ahead=1)
        assert next(results) == 2
        with pytest.raises(TypeError, match="has no len"):
            next(results)


def interrupted():
    """Ends while two tasks run and two wait."""
    with spawned(2, behave_as_worker, (), "died") as pool:
        assert pool.submit(abs, -1).result() == 1
        for _ in range(4):
            pool.submit(time.sleep, 7200)
        raise ValueError("enough")


def test_an_error_does_not_wait_for_tasks_that_run():
    with pytest.raises(ValueError, match="enough"):
        interrupted()  # would not end within the time limit of a test


ENDS = """
import time
from posecore.processes import behave_as_worker, spawned
with spawned(2, behave_as_worker, (), "died") as pool:
    pool.submit(abs, -1).result()
    for _ in range(6):
        pool.submit(bytes, 300_000_000)
    time.sleep({})
    raise SystemExit(3)
"""


@pytest.mark.parametrize("seconds", [0.05, 0.2, 0.4])
def test_nor_for_the_rest_of_a_result_that_is_being_sent(seconds):
    ended = run([sys.executable, "-c", ENDS.format(seconds)])
    assert (ended.returncode, ended.stderr) == (3, "")


STOPPED = """
import os, signal, sys
from multiprocessing import resource_tracker, util
from posecore.processes import behave_as_worker, spawned

def interrupt(number, frame):
    raise KeyboardInterrupt

signal.signal(signal.SIGINT, interrupt)
signal.signal(signal.SIGTERM, interrupt)
module, name, turn, number = {"tracker": resource_tracker, "util": util}[sys.argv[1]], *sys.argv[2:]
inner, calls = getattr(module, name), []

def then_stopped(*arguments):
    result = inner(*arguments)
    calls.append(result)
    if len(calls) == int(turn):
        os.kill(os.getpid(), int(number))
    return result

setattr(module, name, then_stopped)
try:
    with spawned(2, behave_as_worker, (), "died"):
        print("went on")
except KeyboardInterrupt:
    raise SystemExit(130)
"""


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
@pytest.mark.parametrize(("module", "name", "turn"), [("tracker", "register", 1), ("util", "spawnv_passfds", 2)])
def test_a_signal_while_a_pool_starts_leaves_nothing_and_is_not_lost(module, name, turn, number):
    """After a semaphore is registered, and after the first process is launched, which is the second launch."""
    ended = run([sys.executable, "-c", STOPPED, module, name, turn, int(number)])
    assert (ended.returncode, ended.stdout, ended.stderr) == (130, "", "")


def test_a_process_that_dies_is_reported():
    with pytest.raises(RenderError, match=r"^it died$"), spawned(1, behave_as_worker, (), "it died") as pool:
        pool.submit(os._exit, 1).result()


def named_when_due(path):
    """A file's name; that of the last one, once it is there."""
    while path.name == "last" and not path.exists():
        time.sleep(0.01)
    return path.name


@pytest.mark.slow
def test_results_come_as_they_finish_each_with_its_task(tmp_path):
    with spawned(2, behave_as_worker, (), "died") as pool:
        assert list(unordered(pool, abs, [], ahead=3)) == []
        last, *others = (tmp_path / name for name in ("last", "a", "b"))
        results = unordered(pool, named_when_due, (last, *others), ahead=3)
        assert {next(results) for _ in others} == {(path, path.name) for path in others}
        last.touch()
        assert list(results) == [(last, "last")]


def test_items_are_taken_as_processes_become_free():
    taken = []
    results = map_unordered(abs, (taken.append(i) or -i for i in range(9)), 1, died=str, ahead=2)
    assert next(results) in {(0, 0), (-1, 1)}  # both may have ended
    assert taken == [0, 1]
    results.close()
    assert sorted(map_unordered(abs, range(-9, 0), 2, died=str)) == [(-i, i) for i in range(9, 0, -1)]


def touch_then_die(path):
    if path.name == "deadly" or (path.name == "once" and not path.exists()):
        path.touch()
        os._exit(1)
    return path.name


@pytest.mark.slow
def test_processes_that_die_are_replaced_and_their_items_done_again(tmp_path):
    crashes = []
    items = [tmp_path / name for name in ("a", "once", "b", "c")]
    results = map_unordered(
        touch_then_die, items, 2, died=str, attempts=3, on_crash=lambda: crashes.append((tmp_path / "once").exists())
    )
    assert sorted(results) == [(item, item.name) for item in sorted(items)]
    assert crashes == [True]


@pytest.mark.parametrize("attempts", [1, 2])
def test_processes_that_die_at_their_start_are_counted_too(monkeypatch, attempts):
    crashes = []

    @contextmanager
    def dying_once(*settings):
        with spawned(*settings) as pool:
            if not crashes:
                raise BrokenProcessPool
            yield pool

    monkeypatch.setattr(processes, "spawned", dying_once)
    results = map_unordered(abs, [-1], 1, died=str, attempts=attempts, on_crash=lambda: crashes.append(1))
    if attempts == 1:
        with pytest.raises(RenderError, match=r"^a worker process died at its start$"):
            list(results)
    else:
        assert list(results) == [(-1, 1)]
    assert crashes == [1]


@pytest.mark.slow
def test_items_that_kill_every_process_end_the_run(tmp_path):
    crashes = []
    results = map_unordered(
        touch_then_die,
        [tmp_path / "deadly", tmp_path / "a"],
        1,
        died=lambda path: f"died at {path.name}",
        attempts=3,
        on_crash=lambda: crashes.append(1),
    )
    with pytest.raises(RenderError, match=r"^died at deadly$"):
        list(results)
    assert len(crashes) == 3


def test_an_error_of_the_job_is_raised_itself():
    with pytest.raises(TypeError, match="has no len"):
        list(map_unordered(len, ("ab", 5), 1, died=str, attempts=3))


def math_threads(_):
    return [os.environ.get(name) for name in ("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS", "MKL_NUM_THREADS")]


def test_pool_processes_have_one_math_thread_unless_the_environment_says_otherwise(monkeypatch):
    for name in ("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS"):
        monkeypatch.delenv(name, raising=False)
    monkeypatch.setenv("MKL_NUM_THREADS", "3")
    with spawned(1, behave_as_worker, (), "died") as pool:
        assert pool.submit(math_threads, 0).result() == ["1", "1", "3"]
    assert math_threads(0) == [None, None, "3"]
