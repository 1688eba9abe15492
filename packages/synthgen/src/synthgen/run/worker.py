"""What runs in a worker process: the job's plugin, its two tasks, and what ends a worker that hangs or bloats."""

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
_RECYCLE_S = 0.5  # a rescheduled shard bounces between scheduler and worker until the worker is marked as leaving
_FETCH_S = 60.0  # until the driver has fetched what this worker has rendered


@dataclass(frozen=True, kw_only=True, eq=False)
class Outcome:
    """What came of a task.

    Attributes:
        encoded: The shard, None for a scene tried alone and for a failure.
        failure: What the renderer said when it failed at a scene, else None.
        seconds: Wall time of the task without the start of the engines.
    """

    encoded: shard.Encoded | None = None
    failure: str | None = None
    seconds: float


class RendererPlugin(WorkerPlugin):
    """Gives every worker the job, also one that joins late or replaces one that crashed.

    Its name, and the tasks' keys with it, are the job's own: several jobs may share a cluster, where one name would
    have one job's shards rendered with another's recipe.

    Args:
        job: What to render.
        gpus: What CUDA_VISIBLE_DEVICES calls this machine's GPUs; worker k sees only the k-th, counted in a circle.
            Empty leaves the environment of each worker as it is.
    """

    def __init__(self, job: ShardJob, gpus: tuple[str, ...] = ()) -> None:
        self.name = f"synthgen-{sha256_bytes(json.dumps(dict(job.card), sort_keys=True).encode())[:16]}"
        self.job = job
        self.gpus = gpus
        self.problem: str | None = None
        self.renderer: ShardRenderer | None = None
        self.first_rss: int | None = None

    def setup(self, worker: Worker) -> None:
        """Called on the worker when it starts. It never fails, or the worker would start again for ever."""
        scratch.sweep()
        if worker.nanny is not None:
            die_with_parent()
            forget_blenders_paths()
        # A paused worker waits for memory that only a restart would free.
        worker.memory_manager.memory_pause_fraction = False
        if self.gpus:
            os.environ["CUDA_VISIBLE_DEVICES"] = self.gpus[int(worker.name) % len(self.gpus)]
        self.problem = problem_with(self.job, worker.state.nthreads)
        self.renderer = ShardRenderer(self.job)


def render_shard(plugin: str, shard_id: int, quarantined: Collection[int], timeout_s: float) -> Outcome:
    """Task: a whole shard."""
    found = _plugin(plugin)
    renderer = _ready(found, timeout_s)
    started = time.monotonic()
    try:
        with _killed_after(timeout_s):
            encoded = renderer.render(shard_id, quarantined)
    except SceneError as error:
        return Outcome(failure=str(error), seconds=time.monotonic() - started)
    if found.first_rss is None:
        found.first_rss = psutil.Process().memory_info().rss
    return Outcome(encoded=encoded, seconds=time.monotonic() - started)


def try_scene(
    plugin: str, shard_id: int, scene: int, quarantined: Collection[int], timeout_s: float, mark: str
) -> Outcome:
    """Task: one scene of a shard alone, to see whether it crashes.

    Args:
        plugin: Name of the job's plugin.
        shard_id: Shard of the scene.
        scene: Index of the scene.
        quarantined: See `ShardRenderer.render`.
        timeout_s: Seconds until the worker counts as hanging.
        mark: Event to set when all is ready and only the scene itself is left. A worker that dies before it died of
            something else.
    """
    renderer = _ready(_plugin(plugin), timeout_s)
    Event(mark).set()
    started = time.monotonic()
    try:
        with _killed_after(timeout_s):
            renderer.scene(shard_id, scene, quarantined)
    except SceneError as error:
        return Outcome(failure=str(error), seconds=time.monotonic() - started)
    return Outcome(seconds=time.monotonic() - started)


def _plugin(name: str) -> RendererPlugin:
    found = get_worker().plugins[name]
    assert isinstance(found, RendererPlugin)
    return found


def _ready(plugin: RendererPlugin, timeout_s: float) -> ShardRenderer:
    assert plugin.renderer is not None
    if plugin.problem is not None:
        raise RenderError(plugin.problem)
    _recycle_if_bloated(plugin)
    with _killed_after(timeout_s):
        plugin.renderer.prepare()
    return plugin.renderer


def _recycle_if_bloated(plugin: RendererPlugin) -> None:
    """Have the nanny start this process anew when it has grown much since its first shard; the task goes elsewhere."""
    worker = get_worker()
    limit = worker.memory_manager.memory_limit
    allowed = min(GROWTH_LIMIT_BYTES, limit // 4) if limit else GROWTH_LIMIT_BYTES
    if worker.nanny is None or plugin.first_rss is None:
        return
    if psutil.Process().memory_info().rss - plugin.first_rss > allowed:
        deadline = time.monotonic() + _FETCH_S
        while worker.data and time.monotonic() < deadline:  # a shard that is not fetched yet would be lost
            time.sleep(0.02)
        worker.loop.add_callback(worker.close_gracefully, restart=True, reason="synthgen-memory-growth")
        time.sleep(_RECYCLE_S)
        raise Reschedule


@contextmanager
def _killed_after(timeout_s: float) -> Iterator[None]:
    """End this process if the block takes longer.

    The clock is a thread of C code: it goes off also while Blender holds Python's global lock.
    """
    with Path(os.devnull).open("w") as nowhere:
        faulthandler.dump_traceback_later(timeout_s, exit=True, file=nowhere)
        try:
            yield
        finally:
            faulthandler.cancel_dump_traceback_later()


def problem_with(job: ShardJob, threads: int) -> str | None:
    """Why this worker cannot render the job, None if it can."""
    here = f"worker on {socket.gethostname()}"
    if threads != 1:
        return (
            f"{here}: has {threads} threads, expected 1 since Blender renders one scene at a time in a process; start "
            f"it with `dask worker ADDRESS --nthreads 1 --nworkers {threads}`"
        )
    wanted: Mapping[str, Any] = job.card.get("versions", {})
    found = data_card.versions(job.config) if wanted else {}
    for name in sorted(wanted):
        if found.get(name) != wanted[name]:
            return (
                f"{here}: has {name} {found.get(name)}, the command {wanted[name]}, which may make other bytes; "
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
