"""What worker processes have in common: they end with their parent and leave ctrl-C to it."""

import ctypes
import multiprocessing
import os
import signal
import sys
from collections.abc import Callable, Iterator
from concurrent.futures import ProcessPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from posecore.errors import RenderError

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


def behave_as_worker() -> None:
    """What a worker process does first: it ends with its parent, and leaves ctrl-C to it."""
    die_with_parent()
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # a terminal sends ctrl-C to all; the parent ends the work


@contextmanager
def spawned(
    workers: int, start: Callable[..., None], arguments: tuple[Any, ...], died: str
) -> Iterator[ProcessPoolExecutor]:
    """A pool of processes, spawned because a forked GL context is undefined. What has not begun at an error is dropped.

    Args:
        workers: How many.
        start: Called first in each; it begins with `behave_as_worker`.
        arguments: Its arguments.
        died: What to say when one dies.

    Raises:
        RenderError: One died.
    """
    spawn = multiprocessing.get_context("spawn")
    with ProcessPoolExecutor(workers, mp_context=spawn, initializer=start, initargs=arguments) as pool:
        try:
            yield pool
        except BrokenProcessPool as error:
            raise RenderError(died) from error
        except BaseException:
            pool.shutdown(cancel_futures=True)  # else it would go on to the last task
            raise
