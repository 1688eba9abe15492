"""From a job to a complete dataset: shards on a cluster of processes, committed as they come back.

A shard whose worker dies is rendered again. After the second death its scenes are rendered alone, one by one. A scene
that kills its worker twice alone is quarantined: another draw replaces it. Only this search identifies the scene; a
shard that merely waited on a worker that died loses time alone.
"""

import logging
import queue
import statistics
import time
from collections import Counter, deque
from collections.abc import Callable, Collection, Iterator, Mapping
from concurrent.futures import CancelledError
from contextlib import suppress
from dataclasses import dataclass, field
from typing import Any

from distributed import Client, Event, Future, LocalCluster
from distributed.comm.core import CommClosedError
from distributed.scheduler import KilledWorker
from posecore import shard
from posecore.errors import PoseError, RenderError

from synthgen.run import cluster
from synthgen.run.shard_job import ShardJob, scenes_in
from synthgen.run.worker import RendererPlugin, TaskResult, render_shard, try_scene

log = logging.getLogger(__name__)

OnShard = Callable[[shard.Encoded], None]

MIN_TIMEOUT_S = 300.0
FIRST_TIMEOUT_S = 3600.0
TIMEOUT_MEDIANS = 20
QUARANTINE_FRACTION = 0.01
QUARANTINE_FLOOR = 3
_AHEAD = 2  # shards queued per worker, so that it never waits for the driver
_CRASHES = 2  # worker deaths at a shard before its scenes are rendered alone, and at a scene before quarantine
_SEARCHES = 5  # fruitless searches in one shard before the run stops
_DEATHS_IN_A_ROW = 10  # plus four per worker, without a result in between, before the run stops
_REGISTER_TRIES = 10
_POLL_S = 5.0  # between counts of the workers
_LOST_S = 600.0  # without any local worker before the run stops
_WAITING_S = 120.0  # without any worker of a cluster before a warning


@dataclass(kw_only=True, eq=False)
class _Shard:
    """A shard that is being rendered.

    Attributes:
        id: Index of the shard.
        crashes: Worker deaths since the last search.
        searches: Number of searches among its scenes.
        quarantined: Replaced scenes.
        suspects: Scenes still to be rendered alone in this search; the next scene is the last entry.
        scene_crashes: Worker deaths and failures by scene, rendered alone.
    """

    id: int
    crashes: int = 0
    searches: int = 0
    quarantined: set[int] = field(default_factory=set)
    suspects: list[int] = field(default_factory=list)
    scene_crashes: Counter[int] = field(default_factory=Counter)


def run(
    job: ShardJob,
    writer: shard.ShardWriter,
    *,
    workers: int,
    scheduler: str | None,
    on_shard: OnShard,
    redo: Collection[int] = (),
    shard_timeout_s: float | None = None,
    gpus: tuple[str, ...] = (),
    certificates: cluster.Certificates | None = None,
    dashboard: int | None = None,
) -> None:
    """Render every shard that is missing and commit it.

    Args:
        job: Dataset to render.
        writer: Writer of the dataset.
        workers: Local processes; without effect with a scheduler.
        scheduler: Address of a running dask scheduler, or None for local processes.
        on_shard: Called after every commit; the manifest line in it lists quarantined scenes.
        redo: Committed shards to render again, e.g. because they are damaged.
        shard_timeout_s: Seconds after which a worker without result is killed and its shard rendered again; None: 20
            times the median of the finished shards, at least 5 minutes, and an hour until three are finished.
        gpus: See `RendererPlugin`.
        certificates: See `cluster.connect`.
        dashboard: See `cluster.connect`.

    Raises:
        PoseError: A scene cannot be drawn, the dataset cannot be written, workers keep dying, or too many scenes are
            quarantined.
    """
    committed = set(writer.committed()) - set(redo)
    missing = [i for i in range(shard.n_shards(job.card)) if i not in committed]
    if not missing:
        return
    local = min(workers, len(missing))
    with cluster.connect(local, scheduler, certificates=certificates, dashboard=dashboard) as client:
        plugin = RendererPlugin(job, gpus)
        _register(client, plugin)
        Dispatcher(
            client,
            plugin,
            writer,
            on_shard,
            local=scheduler is None,
            shard_timeout_s=shard_timeout_s,
        ).render(iter(missing))
        if scheduler is not None:
            with suppress(OSError):  # the dataset is complete
                client.unregister_worker_plugin(plugin.name)


class Dispatcher:
    """Distributes the shards of a job to the workers of a cluster and handles their faults.

    Args:
        client: Client of the cluster.
        plugin: The job, registered with the cluster.
        writer: Writer of the dataset.
        on_shard: Called after every commit.
        local: Whether the workers are local processes, so that no new worker can join.
        shard_timeout_s: See `run`.
    """

    def __init__(
        self,
        client: Client,
        plugin: RendererPlugin,
        writer: shard.ShardWriter,
        on_shard: OnShard,
        *,
        local: bool = True,
        shard_timeout_s: float | None = None,
    ) -> None:
        self._client = client
        self._plugin = plugin
        self._writer = writer
        self._on_shard = on_shard
        self._local = local
        self._shard_timeout_s = shard_timeout_s
        self._seconds: deque[float] = deque(maxlen=101)
        self._done: queue.SimpleQueue[Future] = queue.SimpleQueue()
        self._flying: dict[str, tuple[_Shard, int | None]] = {}
        self._submitted = 0
        self._deaths_in_a_row = 0
        self._quarantined = 0
        self._dead: set[Any] = set()
        self._slots, self._polled_s, self._connected_s = 1, -_POLL_S, time.monotonic()

    def render(self, missing: Iterator[int]) -> None:
        """Render and commit these shards.

        Raises:
            PoseError: See `run`.
        """
        try:
            self._render(missing)
        except CommClosedError as error:  # from the scheduler, which handles broken workers itself
            raise self._lost() from error

    def _render(self, missing: Iterator[int]) -> None:
        while True:
            self._count_workers()
            while len(self._flying) < _AHEAD * self._slots and (shard_id := next(missing, None)) is not None:
                self._submit(_Shard(id=shard_id))
            if not self._flying:
                return
            try:
                future = self._done.get(timeout=_POLL_S)
            except queue.Empty:
                continue
            self._take(future, *self._flying.pop(str(future.key)))
            future.release()

    def timeout_s(self) -> float:
        """Current time limit of a shard, seconds."""
        if self._shard_timeout_s is not None:
            return self._shard_timeout_s
        if len(self._seconds) < 3:
            return FIRST_TIMEOUT_S
        return max(MIN_TIMEOUT_S, TIMEOUT_MEDIANS * statistics.median(self._seconds))

    def _submit(self, work: _Shard, scene: int | None = None) -> None:
        self._submitted += 1
        key = f"{self._plugin.name} shard {work.id}" + ("" if scene is None else f" scene {scene}")
        key += f" ({self._submitted})"
        common = (self._plugin.name, work.id)
        rest: tuple[Any, ...] = (frozenset(work.quarantined), self.timeout_s())
        call = (render_shard, *common, *rest) if scene is None else (try_scene, *common, scene, *rest, key)
        future = self._client.submit(*call, key=key, pure=False, priority=-work.id)
        self._flying[key] = work, scene
        future.add_done_callback(self._done.put)

    def _take(self, future: Future, work: _Shard, scene: int | None) -> None:
        try:
            outcome: TaskResult = future.result()
        except KilledWorker:
            self._worker_died(str(future.key), work, scene)
            return
        except (PoseError, CommClosedError):
            raise
        except CancelledError as error:
            raise self._lost() from error
        except Exception as error:
            text = str(error).splitlines()[0] if str(error) else ""
            raise RenderError(f"shard {work.id}: rendering failed ({type(error).__name__}: {text})") from error
        self._deaths_in_a_row = 0
        if scene is not None:
            if outcome.failure is not None:
                self._scene_crashed(work, scene, outcome.failure)
            else:
                work.suspects.pop()
            self._search_on(work)
        elif outcome.encoded is None:
            log.info("shard %d: %s; its scenes are rendered alone", work.id, outcome.failure)
            self._search(work)
        else:
            self._seconds.append(outcome.seconds)
            self._commit(outcome.encoded)

    def _commit(self, encoded: shard.Encoded) -> None:
        self._writer.commit(encoded)
        line = encoded.line
        log.info("shard %d committed: %d samples, %d draws rejected", encoded.shard_id, line["n"], line["rejected"])
        self._on_shard(encoded)

    def _worker_died(self, key: str, work: _Shard, scene: int | None) -> None:
        self._deaths_in_a_row += 1
        if self._deaths_in_a_row > _DEATHS_IN_A_ROW + 4 * self._slots:
            raise RenderError(
                f"shard {work.id}: workers die without rendering anything ({self._deaths_in_a_row} times in a row; out "
                "of memory, or a crash in the renderer); start the same command again with fewer --workers or another "
                "--engine"
            )
        if scene is None:
            work.crashes += 1
            log.info("shard %d lost its worker", work.id)
            if work.crashes < _CRASHES:
                self._submit(work)
            else:
                self._search(work)
            return
        mark = Event(key, self._client)
        if mark.is_set():
            mark.clear()
            self._scene_crashed(work, scene, "it killed its worker")
        self._search_on(work)

    def _search(self, work: _Shard) -> None:
        """Render the scenes of a shard alone, one by one."""
        work.searches += 1
        if work.searches > _SEARCHES:
            raise RenderError(
                f"shard {work.id}: its worker died {_SEARCHES * _CRASHES} times (killed, out of memory, or without a "
                f"result for {self.timeout_s():.0f} s), though each scene renders alone; start the same "
                "command again with fewer --workers or a longer --shard-timeout"
            )
        work.crashes = 0
        work.suspects = list(scenes_in(self._plugin.job, work.id))[::-1]
        self._search_on(work)

    def _search_on(self, work: _Shard) -> None:
        if work.suspects:
            self._submit(work, work.suspects[-1])
        else:
            self._submit(work)

    def _scene_crashed(self, work: _Shard, scene: int, reason: str) -> None:
        work.scene_crashes[scene] += 1
        if work.scene_crashes[scene] < _CRASHES:
            return
        if scene in work.quarantined:
            raise RenderError(
                f"scene {scene}: crashes the renderer, and so does its replacement ({reason}); use another --engine or "
                "another --seed"
            )
        work.quarantined.add(scene)
        work.scene_crashes[scene] = 0
        self._quarantined += 1
        scenes = -(-int(self._plugin.job.card["n"]) // self._plugin.job.config.hypotheses_per_scene)
        allowed = max(QUARANTINE_FLOOR, int(QUARANTINE_FRACTION * scenes))
        if self._quarantined > allowed:
            raise RenderError(
                f"scene {scene}: the renderer fails at more than {allowed} of {scenes} scenes, last with: {reason}; "
                "check the mesh, or use another --engine"
            )
        log.warning("scene %d is quarantined and drawn anew: it failed %d times (%s)", scene, _CRASHES, reason)

    def _count_workers(self) -> None:
        """Update the number of workers, every few seconds, as they join and leave."""
        now = time.monotonic()
        if now - self._polled_s < _POLL_S:
            return
        self._polled_s = now
        if self._client.status != "running":
            raise self._lost()
        try:
            threads = self._client.nthreads()
        except OSError as error:
            raise self._lost() from error
        self._slots = max(1, sum(threads.values()))
        if isinstance(self._client.cluster, LocalCluster):
            self._dead = cluster.revive(self._client.cluster, self._dead)
        if threads:
            self._connected_s = now
        elif now - self._connected_s > (_LOST_S if self._local else _WAITING_S):
            if self._local:
                raise RenderError("all worker processes are gone and do not start again; start the same command again")
            log.warning("no worker is connected to the scheduler; waiting for one")
            self._connected_s = now

    def _lost(self) -> RenderError:
        return RenderError("the scheduler is gone; start it and its workers, then the same command again")


def _register(client: Client, plugin: RendererPlugin) -> None:
    try:
        for _ in range(_REGISTER_TRIES):
            with suppress(OSError):  # a worker died during the registration
                client.register_plugin(plugin)
                return
        client.register_plugin(plugin)
    except Exception as error:  # any error of a worker that cannot unpickle the job
        text = str(error).splitlines()[0] if str(error) else ""
        raise RenderError(
            f"the workers cannot take the job ({type(error).__name__}: {text}); install the same version of synthgen "
            "on every machine"
        ) from error


def progress(job: ShardJob, writer: shard.ShardWriter, redo: Collection[int] = ()) -> tuple[int, int]:
    """Number of committed samples without the shards to redo, and number of samples of the dataset."""
    card: Mapping[str, Any] = job.card
    return sum(shard.samples_in(card, i) for i in set(writer.committed()) - set(redo)), int(card["n"])


def threads_per_worker(workers: int, cores: int) -> int:
    """Number of threads for each worker's renderer."""
    return max(1, cores // max(1, workers))
