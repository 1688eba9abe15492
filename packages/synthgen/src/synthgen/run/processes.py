"""What worker processes have in common: they end with their parent and leave ctrl-C to it."""

import ctypes
import multiprocessing
import os
import signal
import sys
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

_PR_SET_PDEATHSIG = 1


def die_with_parent() -> None:
    """Have the kernel kill this process when its parent is gone, also by `kill -9` and while this one hangs.

    Only Linux can do that; elsewhere nothing happens, and multiprocessing's own watch has to do.
    """
    if sys.platform != "linux":
        return
    ctypes.CDLL(None, use_errno=True).prctl(_PR_SET_PDEATHSIG, signal.SIGKILL)
    parent = multiprocessing.parent_process()
    if parent is not None and os.getppid() != parent.pid:  # it went before the kernel was told
        os._exit(1)


def forget_blenders_paths() -> None:
    """Undo what a parent that has Blender loaded does to the search path of the processes that it spawns.

    Blender puts its scripts on the path, where a module bpy lies that only works within Blender; a process that
    inherits the path would import that one.
    """
    sys.path[:] = [entry for entry in sys.path if not (Path(entry) / "bpy_types.py").is_file()]


@contextmanager
def interrupts_ignored() -> Iterator[None]:
    """Start processes that ignore ctrl-C: a terminal sends it to all, and only the driver may stop the run.

    A process inherits what its parent ignores. A signal mask would not do: multiprocessing clears it.
    """
    if threading.current_thread() is not threading.main_thread():  # only the main thread may set signal handlers
        yield
        return
    before = signal.signal(signal.SIGINT, signal.SIG_IGN)
    try:
        yield
    finally:
        signal.signal(signal.SIGINT, before)
