"""Commands that tests start: no time limit of their own, and no process that outlives its test.

The only limit is that of pytest for the whole test, a guard against hanging far above what any machine needs.
"""

import os
import signal
import subprocess
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, suppress
from typing import Any

import psutil

POLL_S = 0.01


def run(command: Sequence[object], **settings: Any) -> subprocess.CompletedProcess[str]:
    """Run a command to its end and keep what it printed."""
    words = [str(word) for word in command]
    with started(words, **{"stdout": subprocess.PIPE, "stderr": subprocess.PIPE, **settings}) as child:
        output, errors = child.communicate()
    return subprocess.CompletedProcess(words, child.returncode, output, errors)


@contextmanager
def started(command: Sequence[object], **settings: Any) -> Iterator[subprocess.Popen[str]]:
    """Start a command in a session of its own; what is left of the session at the end is killed."""
    child = subprocess.Popen([str(word) for word in command], text=True, start_new_session=True, **settings)
    try:
        yield child
    finally:
        kill_session(child)


def interruptible() -> None:
    """Let Ctrl-C end a child (`preexec_fn`): a job in the background inherits the signal ignored."""
    signal.signal(signal.SIGINT, signal.SIG_DFL)


def wait_until(condition: Callable[[], Any], child: subprocess.Popen[str]) -> Any:
    """Wait for a condition for as long as a child runs, and return its value.

    Raises:
        AssertionError: The child ended first.
    """
    while not (value := condition()):
        assert child.poll() is None, f"the command ended first, with {child.returncode}"
        time.sleep(POLL_S)
    return value


def kill_session(child: subprocess.Popen[str]) -> None:
    """Kill a child and its descendants, and wait for them.

    Python's resource trackers are left to end by themselves: they remove the semaphores of the killed.
    """
    while members := session(child.pid):
        for process in members:
            with suppress(psutil.Error):
                if process.pid == child.pid or not (is_tracker(process) or is_copy(process)):
                    process.kill()
        child.poll()
        time.sleep(POLL_S)
    child.wait()
    for pipe in (child.stdin, child.stdout, child.stderr):
        if pipe:
            pipe.close()


def session(leader: int) -> list[psutil.Process]:
    """The processes of a session that still run."""
    found = []
    for process in psutil.process_iter():
        with suppress(psutil.Error, OSError):
            if os.getsid(process.pid) == leader and process.status() != psutil.STATUS_ZOMBIE:
                found.append(process)
    return found


def is_copy(process: psutil.Process) -> bool:
    """Whether a process has its parent's command line: it may be a tracker that is about to start.

    Others are killed once their parent is dead.
    """
    parent = process.parent()
    return parent is not None and parent.status() != psutil.STATUS_ZOMBIE and parent.cmdline() == process.cmdline()


def is_tracker(process: psutil.Process) -> bool:
    """Whether a process is the resource tracker of `multiprocessing`."""
    return "resource_tracker" in " ".join(process.cmdline())
