"""Worker process: the job's plugin, its two tasks, and limits on time and memory growth."""

import faulthandler
import json
import os
import socket
import time
from collections.abc import Collection, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import psutil
from distributed import Event, Reschedule, WorkerPlugin, get_worker
from distributed.worker import Worker
from posecore import shard
from posecore.errors import RenderError
from posecore.files import sha256_bytes
from posecore.processes import die_with_parent

from synthgen.engines.blender import scratch
from synthgen.engines.blender.paths import forget_blenders_paths
from synthgen.pairs import data_card
from synthgen.run.shard_job import SceneError, ShardJob, ShardRenderer

GROWTH_LIMIT_BYTES = 1 << 30
_RECYCLE_S = 0.5  # until the scheduler marks the worker as leaving; a shard rescheduled earlier would come back to it
_FETCH_S = 60.0  # until the driver has fetched the rendered shards


@dataclass(frozen=True, kw_only=True, eq=False)
class TaskResult:
    """Result of a task.

    Attributes:
        encoded: The shard; None for a scene rendered alone and for a failure.
        failure: Error message of the renderer, else None.
        seconds: Wall time of the task without the start of the engines.
    """

    encoded: shard.Encoded | None = None
    failure: str | None = None
    seconds: float


class RendererPlugin(WorkerPlugin):
    """Passes the job to every worker, including late ones and replacements.

    Its name and the tasks' keys are unique to the job: with equal names, jobs that share a cluster would render each
    other's shards.

    Args:
        job: Dataset to render.
        gpus: Names of this machine's GPUs for CUDA_VISIBLE_DEVICES; worker k uses number k modulo their count. Empty
            keeps each worker's environment.
    """

    def __init__(self, job: ShardJob, gpus: tuple[str, ...] = ()) -> None:
        self.name = f"synthgen-{sha256_bytes(json.dumps(dict(job.card), sort_keys=True).encode())[:16]}"
        self.job = job
        self.gpus = gpus
        self.problem: str | None = None
        self.renderer: ShardRenderer | None = None
        self.first_rss: int | None = None

    def setup(self, worker: Worker) -> None:
        """Called at the worker's start. It must not fail, or the worker would restart for ever."""
        scratch.sweep()
        if worker.nanny is not None:
            die_with_parent()
            forget_blenders_paths()
        # A paused worker would wait for memory that only a restart frees.
        worker.memory_manager.memory_pause_fraction = False
        if self.gpus:
            os.environ["CUDA_VISIBLE_DEVICES"] = self.gpus[int(worker.name) % len(self.gpus)]
        self.problem = find_problem(self.job, worker.state.nthreads)
        self.renderer = ShardRenderer(self.job)


def render_shard(plugin: str, shard_id: int, quarantined: Collection[int], timeout_s: float) -> TaskResult:
    """Task: a whole shard."""
    job_plugin = _plugin(plugin)
    renderer = _ready(job_plugin, timeout_s)
    started = time.monotonic()
    try:
        with _killed_after(timeout_s):
            encoded = renderer.render(shard_id, quarantined)
    except SceneError as error:
        return TaskResult(failure=str(error), seconds=time.monotonic() - started)
    if job_plugin.first_rss is None:
        job_plugin.first_rss = psutil.Process().memory_info().rss
    return TaskResult(encoded=encoded, seconds=time.monotonic() - started)


def try_scene(
    plugin: str, shard_id: int, scene: int, quarantined: Collection[int], timeout_s: float, mark: str
) -> TaskResult:
    """Task: a scene alone, to find out whether it crashes.

    Args:
        plugin: Name of the job's plugin.
        shard_id: Index of the scene's shard.
        scene: Index of the scene.
        quarantined: See `ShardRenderer.render`.
        timeout_s: Time limit, seconds.
        mark: Event to set right before the scene is rendered: a worker that dies without it died of another cause.
    """
    renderer = _ready(_plugin(plugin), timeout_s)
    Event(mark).set()
    started = time.monotonic()
    try:
        with _killed_after(timeout_s):
            renderer.scene(shard_id, scene, quarantined)
    except SceneError as error:
        return TaskResult(failure=str(error), seconds=time.monotonic() - started)
    return TaskResult(seconds=time.monotonic() - started)


def _plugin(name: str) -> RendererPlugin:
    job_plugin = get_worker().plugins[name]
    assert isinstance(job_plugin, RendererPlugin)
    return job_plugin


def _ready(plugin: RendererPlugin, timeout_s: float) -> ShardRenderer:
    assert plugin.renderer is not None
    if plugin.problem is not None:
        raise RenderError(plugin.problem)
    _recycle_if_bloated(plugin)
    with _killed_after(timeout_s):
        plugin.renderer.prepare()
    return plugin.renderer


def _recycle_if_bloated(plugin: RendererPlugin) -> None:
    """Restart this process through its nanny, and reschedule its task, when its memory has grown too much."""
    worker = get_worker()
    limit = worker.memory_manager.memory_limit
    allowed = min(GROWTH_LIMIT_BYTES, limit // 4) if limit else GROWTH_LIMIT_BYTES
    if worker.nanny is None or plugin.first_rss is None:
        return
    if psutil.Process().memory_info().rss - plugin.first_rss > allowed:
        deadline = time.monotonic() + _FETCH_S
        while worker.data and time.monotonic() < deadline:  # shards that are not fetched yet would be lost
            time.sleep(0.02)
        worker.loop.add_callback(worker.close_gracefully, restart=True, reason="synthgen-memory-growth")
        time.sleep(_RECYCLE_S)
        raise Reschedule


@contextmanager
def _killed_after(timeout_s: float) -> Iterator[None]:
    """Kill this process if the block takes longer.

    The timer is a C thread, independent of Python's global lock, which Blender may hold.
    """
    with Path(os.devnull).open("w") as nowhere:
        faulthandler.dump_traceback_later(timeout_s, exit=True, file=nowhere)
        try:
            yield
        finally:
            faulthandler.cancel_dump_traceback_later()


def find_problem(job: ShardJob, threads: int) -> str | None:
    """Reason why this worker cannot render the job, or None."""
    here = f"worker on {socket.gethostname()}"
    if threads != 1:
        return (
            f"{here}: has {threads} threads, expected 1 since Blender renders one scene at a time in a process; start "
            f"it with `dask worker ADDRESS --nthreads 1 --nworkers {threads}`"
        )
    required: Mapping[str, Any] = job.card.get("versions", {})
    installed = data_card.versions(job.config) if required else {}
    for name in sorted(required):
        if installed.get(name) != required[name]:
            return (
                f"{here}: has {name} {installed.get(name)}, the command {required[name]}, which may make other bytes; "
                "install the same versions on all machines"
            )
    pictures = (*job.assets.photos, *job.assets.hdris)
    missing = [picture for picture in pictures if not os.access(picture, os.R_OK)]
    if missing:
        return (
            f"{here}: cannot read {missing[0]} ({len(missing)} of {len(pictures)} photographs and panoramas); put them "
            "into a folder that all workers see under the same path"
        )
    return None
