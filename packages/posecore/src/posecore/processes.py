"""What processes that others start have in common: they end with their parent and leave ctrl-C to it."""

import ctypes
import multiprocessing
import os
import signal
import sys
import threading
from collections import deque
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import Future, ProcessPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from contextlib import contextmanager
from typing import Any, TypeVar

from posecore.errors import RenderError

T, R = TypeVar("T"), TypeVar("R")
_PR_SET_PDEATHSIG = 1


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


def behave_as_worker() -> None:
    """What a worker process does first: it ends with its parent, and leaves ctrl-C to it."""
    die_with_parent()
    signal.signal(signal.SIGINT, signal.SIG_IGN)


@contextmanager
def spawned(
    workers: int, start: Callable[..., None], arguments: tuple[Any, ...], died: str
) -> Iterator[ProcessPoolExecutor]:
    """A pool of processes, spawned because a forked GL context is undefined. At an error they end at once.

    Args:
        workers: How many.
        start: Called first in each; it begins with `behave_as_worker`.
        arguments: Its arguments.
        died: What to say when one dies.

    Raises:
        RenderError: One died.
    """
    spawn = multiprocessing.get_context("spawn")
    others = set(multiprocessing.active_children())
    with ProcessPoolExecutor(workers, mp_context=spawn, initializer=start, initargs=arguments) as pool:
        try:
            with interrupts_ignored():
                for _ in range(workers):
                    pool.submit(os.getpid)  # starts one
            yield pool
        except BrokenProcessPool as error:
            raise RenderError(died) from error
        except BaseException:
            results: Any = pool._result_queue  # nothing public ends a task that runs
            pool.shutdown(wait=False, cancel_futures=True)
            for process in set(multiprocessing.active_children()) - others:
                process.kill()
                process.join()
            results._writer.close()  # else the pool would wait for the rest of a result that a process was writing
            raise


def in_order(pool: ProcessPoolExecutor, function: Callable[[T], R], tasks: Iterable[T], ahead: int) -> Iterator[R]:
    """Results in the order of the tasks; at most `ahead` are made before they are asked for, as they take memory."""
    waiting: deque[Future[R]] = deque()
    for task in tasks:
        waiting.append(pool.submit(function, task))
        if len(waiting) >= ahead:
            yield waiting.popleft().result()
    while waiting:
        yield waiting.popleft().result()
