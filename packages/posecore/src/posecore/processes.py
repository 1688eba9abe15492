"""Child processes: they exit with their parent and ignore Ctrl-C; pools for tasks."""

import ctypes
import multiprocessing
import os
import signal
import sys
import threading
from collections import deque
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import FIRST_COMPLETED, Future, ProcessPoolExecutor, wait
from concurrent.futures.process import BrokenProcessPool
from contextlib import contextmanager
from itertools import chain, islice
from multiprocessing import resource_tracker
from typing import Any, TypeVar

from posecore.errors import RenderError

T, R = TypeVar("T"), TypeVar("R")
_PR_SET_PDEATHSIG = 1
_MATH_THREADS = ("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS", "MKL_NUM_THREADS")


@contextmanager
def interrupts_ignored() -> Iterator[None]:
    """Start processes that ignore Ctrl-C: a terminal sends it to all, and only the parent may stop the run.

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


@contextmanager
def interrupts_deferred() -> Iterator[None]:
    """Put Ctrl-C and a termination signal off until the block is done, and start processes that wait with Ctrl-C too.

    An interruption between a semaphore and its registration would leave it behind, one while a process starts would
    have it print a traceback, and one in a clean-up would leave the rest undone.
    """
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    received: list[int] = []
    numbers = (signal.SIGINT, signal.SIGTERM)
    before = {number: signal.signal(number, lambda number, frame: received.append(number)) for number in numbers}
    try:
        resource_tracker.ensure_running()  # its start would clear the mask
        signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})  # processes inherit it
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_UNBLOCK, {signal.SIGINT})
        for number, handler in before.items():
            signal.signal(number, handler)
        if received:
            signal.raise_signal(received[0])


@contextmanager
def one_math_thread() -> Iterator[None]:
    """Processes that start in the block have one thread in NumPy's matrix products, unless the environment has others.

    OpenBLAS starts a thread for every core, and each waits for the next product in a busy loop. The number is read when
    the library is loaded.
    """
    added = [name for name in _MATH_THREADS if name not in os.environ]
    os.environ.update(dict.fromkeys(added, "1"))
    try:
        yield
    finally:
        for name in added:
            del os.environ[name]


def die_with_parent() -> None:
    """Have the kernel kill this process when its parent exits, also by `kill -9` and while this process hangs.

    Only Linux can do that; elsewhere nothing happens, and only multiprocessing's own watch remains.
    """
    if sys.platform != "linux":
        return
    ctypes.CDLL(None, use_errno=True).prctl(_PR_SET_PDEATHSIG, signal.SIGKILL)
    parent = multiprocessing.parent_process()
    if parent is not None and os.getppid() != parent.pid:  # the parent exited before prctl took effect
        os._exit(1)


def behave_as_worker() -> None:
    """Prepare a worker process: it exits with its parent and ignores Ctrl-C."""
    die_with_parent()
    signal.signal(signal.SIGINT, signal.SIG_IGN)


@contextmanager
def spawned(
    workers: int, start: Callable[..., None], arguments: tuple[Any, ...], died: str
) -> Iterator[ProcessPoolExecutor]:
    """A pool of spawned processes (a forked GL context is undefined); at an error they end at once.

    Args:
        workers: Number of processes.
        start: Called first in each; it begins with `behave_as_worker`.
        arguments: Its arguments.
        died: Message when a process dies.

    Raises:
        RenderError: A process died.
    """
    spawn = multiprocessing.get_context("spawn")
    others = set(multiprocessing.active_children())
    with interrupts_deferred():
        pool = ProcessPoolExecutor(workers, mp_context=spawn, initializer=start, initargs=arguments)
    with pool:
        try:
            with interrupts_deferred(), one_math_thread():
                for _ in range(workers):
                    pool.submit(os.getpid)  # starts one
            yield pool
        except BrokenProcessPool as error:
            raise RenderError(died) from error
        except BaseException:
            with interrupts_deferred():
                results: Any = pool._result_queue  # nothing public ends a task that runs
                pool.shutdown(wait=False, cancel_futures=True)
                for process in set(multiprocessing.active_children()) - others:
                    process.kill()
                    process.join()
                results._writer.close()  # else the pool would wait for the rest of a result that a process was writing
            raise


def in_order(pool: ProcessPoolExecutor, function: Callable[[T], R], tasks: Iterable[T], ahead: int) -> Iterator[R]:
    """Results in the order of the tasks; at most `ahead` are computed in advance, as they take memory."""
    waiting: deque[Future[R]] = deque()
    for task in tasks:
        waiting.append(pool.submit(function, task))
        if len(waiting) >= ahead:
            yield waiting.popleft().result()
    while waiting:
        yield waiting.popleft().result()


def unordered(
    pool: ProcessPoolExecutor, function: Callable[[T], R], tasks: Iterable[T], ahead: int
) -> Iterator[tuple[T, R]]:
    """Tasks with their results, as they finish; at most `ahead` are submitted at once."""
    numbered = ((number, task) for number, task in enumerate(tasks))
    submitted: dict[int, T] = {}
    for number, result in _finished(pool, function, numbered, submitted, ahead):
        yield submitted.pop(number), result


def map_unordered(
    job: Callable[[T], R],
    items: Iterable[T],
    workers: int,
    *,
    start: Callable[..., None] = behave_as_worker,
    arguments: tuple[Any, ...] = (),
    died: Callable[[T], str],
    ahead: int = 2,
    attempts: int = 1,
    on_crash: Callable[[], None] = lambda: None,
) -> Iterator[tuple[T, R]]:
    """Items with their results from new processes, as they finish; processes that die are replaced.

    Once the results are exhausted, the processes end; at an error, or if the iterator is closed, they end at once.

    Args:
        job: A function of a module, called with an item in a process.
        items: Taken from the iterable as processes become free; any picklable values.
        workers: Number of processes.
        start: Called first in each process; it begins with `behave_as_worker`.
        arguments: Its arguments.
        died: The message, from the first item without a result, when too many processes die.
        ahead: Items submitted at once for each process.
        attempts: Crashes in a row, without a result in between, that end the run; each lesser number is retried.
        on_crash: Called after a crash with no process running, for example to delete partial files.

    Raises:
        RenderError: Processes died `attempts` times in a row.
    """
    numbered = enumerate(items)
    submitted: dict[int, T] = {}
    crashes = 0
    while True:
        try:
            with spawned(workers, start, arguments, "a worker process died at its start") as pool:
                again = tuple(sorted(submitted.items()))
                for number, result in _finished(pool, job, chain(again, numbered), submitted, ahead * workers):
                    crashes = 0
                    yield submitted.pop(number), result
            return
        except RenderError as error:
            if not isinstance(error.__cause__, BrokenProcessPool):
                raise
            crash = error
        crashes += 1
        on_crash()
        if crashes == attempts:
            raise RenderError(died(submitted[min(submitted)]) if submitted else str(crash)) from crash.__cause__


def _finished(
    pool: ProcessPoolExecutor,
    function: Callable[[T], R],
    numbered: Iterable[tuple[int, T]],
    submitted: dict[int, T],
    ahead: int,
) -> Iterator[tuple[int, R]]:
    """Numbers of finished tasks with results; `submitted` also gets each task before it runs."""
    waiting = iter(numbered)
    running: dict[Future[R], int] = {}
    while True:
        for number, task in islice(waiting, ahead - len(running)):
            submitted[number] = task
            running[pool.submit(function, task)] = number
        if not running:
            return
        for future in wait(running, return_when=FIRST_COMPLETED).done:
            yield running.pop(future), future.result()
