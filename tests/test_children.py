"""Commands that tests start leave nothing behind."""

import subprocess
import sys
from pathlib import Path

import pytest
from children import session, started

HOLDS = """
import multiprocessing, time
lock = multiprocessing.get_context("spawn").Lock()
print(lock._semlock.name, flush=True)
time.sleep(7200)
"""


@pytest.mark.skipif(not Path("/dev/shm").is_dir(), reason="semaphores are elsewhere")
def test_a_killed_command_leaves_neither_process_nor_semaphore():
    with started([sys.executable, "-c", HOLDS], stdout=subprocess.PIPE) as child:
        semaphore = Path("/dev/shm/sem." + child.stdout.readline().strip().removeprefix("/"))
        assert semaphore.exists()
    assert child.returncode == -9
    assert not semaphore.exists()
    assert session(child.pid) == []
