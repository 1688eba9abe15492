"""From a job to a complete dataset: shards on a cluster of processes, committed as they come back."""

import json
import logging
import signal
import threading
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from typing import Any

import dask
from distributed import Client, LocalCluster, WorkerPlugin, as_completed, get_worker
from distributed.scheduler import KilledWorker
from distributed.worker import Worker
from posecore import shard
from posecore.errors import PoseError, RenderError
from posecore.files import sha256_bytes

from synthgen.shardrun import ShardJob, ShardRenderer

log = logging.getLogger(__name__)

OnShard = Callable[[shard.Encoded], None]

_AHEAD = 2  # shards a worker has waiting, so that it never waits for the driver
_ALLOWED_FAILURES = 3  # times a shard may kill its worker before the run stops
_SETTINGS = {
    "distributed.worker.multiprocessing-method": "spawn",  # a forked Blender is undefined
    "distributed.scheduler.allowed-failures": _ALLOWED_FAILURES,
    "distributed.scheduler.work-stealing": False,
    "distributed.comm.timeouts.connect": "60s",
    "distributed.logging": {
        "distributed": "critical",
        "bokeh": "critical",
        "tornado": "critical",
        "asyncio": "critical",
    },
}


class RendererPlugin(WorkerPlugin):
    """Gives every worker the job, also one that joins late or replaces one that crashed.

    Its name, and the tasks' keys with it, are the job's own: several jobs may share a cluster, where one name would
    have one job's shards rendered with another's recipe.
    """

    def __init__(self, job: ShardJob) -> None:
        self.name = f"synthgen-{sha256_bytes(json.dumps(dict(job.card), sort_keys=True).encode())[:16]}"
        self.job = job
        self.renderer: ShardRenderer | None = None

    def setup(self, worker: Worker) -> None:
        """Called on the worker when it starts."""
        self.renderer = ShardRenderer(self.job)


def run(job: ShardJob, writer: shard.ShardWriter, *, workers: int, scheduler: str | None, on_shard: OnShard) -> None:
    """Render every shard that is missing and commit it.

    Args:
        job: What to render.
        writer: Where to.
        workers: Local processes; without effect with a scheduler.
        scheduler: Address of a running dask scheduler, or None for local processes.
        on_shard: Called after every commit.

    Raises:
        PoseError: A scene cannot be drawn or rendered, the place cannot be written, or workers keep dying.
    """
    committed = set(writer.committed())
    missing = [i for i in range(shard.n_shards(job.card)) if i not in committed]
    if not missing:
        return
    with _client(min(workers, len(missing)), scheduler) as client:
        plugin = RendererPlugin(job)
        client.register_plugin(plugin)
        _render_all(client, plugin.name, iter(missing), writer, on_shard)


def _render_all(
    client: Client, plugin: str, missing: Iterator[int], writer: shard.ShardWriter, on_shard: OnShard
) -> None:
    def submit(shard_id: int) -> Any:
        key = f"shard {shard_id} of {plugin}"
        return client.submit(_render, plugin, shard_id, key=key, pure=False, priority=-shard_id)

    slots = max(1, sum(client.nthreads().values()))
    waiting = as_completed([submit(i) for _, i in zip(range(_AHEAD * slots), missing, strict=False)])
    for future in waiting:
        try:
            encoded = future.result()
        except KilledWorker as error:
            raise RenderError(
                f"{future.key}: its worker process died {_ALLOWED_FAILURES + 1} times (out of memory, or a crash in "
                "the renderer); start the same command again with fewer --workers or another --engine"
            ) from error
        except PoseError:
            raise
        except Exception as error:
            text = str(error).splitlines()[0] if str(error) else ""
            raise RenderError(f"{future.key}: rendering failed ({type(error).__name__}: {text})") from error
        writer.commit(encoded)
        log.info("%s committed: %d samples, %d draws rejected", future.key, encoded.line["n"], encoded.line["rejected"])
        on_shard(encoded)
        future.release()
        following = next(missing, None)
        if following is not None:
            waiting.add(submit(following))


def _render(plugin: str, shard_id: int) -> shard.Encoded:
    found = get_worker().plugins[plugin]
    assert isinstance(found, RendererPlugin) and found.renderer is not None
    return found.renderer.render(shard_id)


@contextmanager
def _client(workers: int, scheduler: str | None) -> Iterator[Client]:
    with dask.config.set(_SETTINGS):
        if scheduler is not None:
            try:
                client = Client(scheduler, timeout="30s")
            except (OSError, ValueError) as error:
                raise RenderError(
                    f"--scheduler {scheduler}: no dask scheduler answers there; start one with `dask scheduler` and "
                    "workers with `dask worker ADDRESS --nthreads 1`"
                ) from error
            with client:
                yield client
            return
        with _interrupts_ignored():
            cluster = LocalCluster(
                n_workers=workers,
                threads_per_worker=1,
                processes=True,
                dashboard_address=":0",
                silence_logs=logging.CRITICAL,
                memory_limit="auto",
            )
        with cluster, Client(cluster) as client:
            yield client


@contextmanager
def _interrupts_ignored() -> Iterator[None]:
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


def threads_per_worker(workers: int, cores: int) -> int:
    """Threads that each worker's renderer may use."""
    return max(1, cores // max(1, workers))


def progress(job: ShardJob, writer: shard.ShardWriter) -> tuple[int, int]:
    """Samples that are committed, and all of them."""
    card: Mapping[str, Any] = job.card
    return sum(shard.samples_in(card, i) for i in writer.committed()), int(card["n"])
