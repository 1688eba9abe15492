"""The processes that render: local ones, or those of a running dask cluster."""

import logging
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import dask
from distributed import Client, LocalCluster, Nanny
from distributed.system import MEMORY_LIMIT
from posecore.errors import RenderError
from posecore.processes import interrupts_ignored

_TALKATIVE = ("distributed", "bokeh", "tornado", "asyncio")
SETTINGS = {
    "distributed.worker.multiprocessing-method": "spawn",  # a forked Blender is undefined
    # The dispatcher handles tasks that lose their worker: dask also blames tasks that only waited on that worker.
    "distributed.scheduler.allowed-failures": 0,
    "distributed.scheduler.work-stealing": False,
    # A renderer's memory is not dask's: only a restart frees it, spilling or pausing does not.
    "distributed.worker.memory.target": False,
    "distributed.worker.memory.spill": False,
    "distributed.worker.memory.pause": False,
    "distributed.worker.memory.terminate": 0.95,
    "distributed.comm.timeouts.connect": "60s",
    # By default a worker that needs more than 15 s to start again, on a busy machine, is dropped for good.
    "distributed.deploy.lost-worker-timeout": "1h",
    "distributed.logging": dict.fromkeys(_TALKATIVE, "critical"),  # for the workers, which apply it at their start
}
ANSWER_S = 30.0
"""Timeout for the scheduler's answer."""
_START_TRIES = 8
_MEMORY_FRACTION = 0.9  # of the machine, for all workers
_LEAST_BYTES = 3 << 29  # Blender with a large mesh needs 1.5 GiB; a lower limit would kill sound workers


@contextmanager
def connect(workers: int, scheduler: str | None) -> Iterator[Client]:
    """A client of a running cluster, or of local processes that live as long as the block.

    Args:
        workers: Local processes; without effect with a scheduler.
        scheduler: Address of a dask scheduler, or None.

    Raises:
        RenderError: The scheduler does not answer, or no process can be started.
    """
    for name in list(logging.root.manager.loggerDict):  # they log a traceback for each broken connection
        if name.split(".")[0] in _TALKATIVE:  # some of distributed's loggers have levels of their own
            logging.getLogger(name).setLevel(logging.CRITICAL)
    with dask.config.set(SETTINGS):
        if scheduler is not None:
            with _remote(scheduler) as client:
                yield client
            return
        with interrupts_ignored():
            cluster = _local(workers)
        with cluster, Client(cluster) as client:
            yield client


def memory_limit_bytes(workers: int) -> int:
    """Memory at which a local worker is restarted."""
    return max(int(MEMORY_LIMIT * _MEMORY_FRACTION / workers), min(_LEAST_BYTES, MEMORY_LIMIT))


def revive(local: LocalCluster, suspected: set[Any]) -> set[Any]:
    """Restart workers that the cluster has dropped, or whose nanny has given up.

    Dask does not always restart a worker that dies during its start.

    Args:
        local: The cluster.
        suspected: Names of workers without a process at the last call.

    Returns:
        Names of workers without a process now, for the next call some seconds later.
    """
    nannies = {name: nanny for name, nanny in list(local.workers.items()) if isinstance(nanny, Nanny)}
    dead = {name for name, nanny in nannies.items() if not nanny.is_alive()}
    given_up = dead & suspected
    for name in given_up:
        local.workers.pop(name, None)
        local.sync(nannies[name].close, asynchronous=False)
    if set(local.worker_spec) - set(local.workers):
        with interrupts_ignored():
            local.scale(len(local.worker_spec))
    return dead - given_up


def _local(workers: int) -> LocalCluster:
    for tries_left in reversed(range(_START_TRIES)):
        try:
            return LocalCluster(
                n_workers=workers,
                threads_per_worker=1,
                processes=True,
                dashboard_address=":0",
                silence_logs=logging.CRITICAL,
                memory_limit=memory_limit_bytes(workers),
            )
        except (OSError, RuntimeError) as error:  # a worker died during its start
            if not tries_left:
                raise RenderError(
                    f"--workers {workers}: the worker processes do not start ({_first_line(error)}); "
                    "start again with fewer"
                ) from error
    raise AssertionError("the last try returns or raises")


def _remote(scheduler: str) -> Client:
    try:
        return Client(scheduler, timeout=ANSWER_S)
    except (OSError, ValueError) as error:
        raise RenderError(
            f"--scheduler {scheduler}: no dask scheduler answers there; start one with `dask scheduler` and "
            "workers with `dask worker ADDRESS --nthreads 1`"
        ) from error


def _first_line(error: BaseException) -> str:
    return str(error).splitlines()[0] if str(error) else type(error).__name__
