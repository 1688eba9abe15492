"""Pools of processes that end at once when something goes wrong."""

import os
import subprocess
import sys
import time

import pytest
from posecore.errors import RenderError
from posecore.processes import behave_as_worker, in_order, spawned


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
            pool.submit(time.sleep, 60)
        raise ValueError("enough")


def test_an_error_does_not_wait_for_tasks_that_run():
    began = time.monotonic()
    with pytest.raises(ValueError, match="enough"):
        interrupted()
    assert time.monotonic() - began < 30


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
    ended = subprocess.run([sys.executable, "-c", ENDS.format(seconds)], timeout=60, capture_output=True, text=True)
    assert (ended.returncode, ended.stderr) == (3, "")


def test_a_process_that_dies_is_said():
    with pytest.raises(RenderError, match=r"^it died$"), spawned(1, behave_as_worker, (), "it died") as pool:
        pool.submit(os._exit, 1).result()
