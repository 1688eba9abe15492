"""How fast this machine renders: a whole run for a while, into a temporary folder."""

import os
import signal
import time
from contextlib import suppress
from dataclasses import dataclass, replace
from pathlib import Path
from tempfile import TemporaryDirectory
from types import FrameType
from typing import Any

import numpy as np
import psutil
import trimesh
from posecore.errors import PoseError
from posecore.mesh import Units
from posecore.shard import Encoded

from synthgen.config import SynthConfig
from synthgen.inputs.sources import Sources
from synthgen.machine import free_bytes
from synthgen.names import EngineName
from synthgen.run.estimate import RunEstimate, in_own_process
from synthgen.run.render import RenderJob, render_dataset

_MOST_PAIRS = 20_000  # a machine that renders them all while it is measured is measured well
_ROOM_BYTES = 400_000  # of free disk for each pair: twice the size of pairs with large patches
_SHARD_SIZE = 16  # small, so that several are done in seconds
_STOP_S = 20.0
_START_S = 900.0  # for workers and engines to start and the first shards to come, on a busy machine too


@dataclass(frozen=True, kw_only=True)
class EngineSpeed:
    """Speed of the whole machine with one engine.

    Attributes:
        engine: Renderer of the scenes.
        measured: Pairs after the first shard, which holds the start of workers and engines; None without any.
        problem: Reason for no measurement.
    """

    engine: str
    measured: RunEstimate | None = None
    problem: str = ""

    def text(self, n: int) -> str:
        """Time and space of n pairs in one line."""
        if self.measured is None:
            return self.problem
        m, hours = self.measured, self.measured.duration_s(n) / 3600
        duration = f"{hours:.1f} hours" if hours >= 1 else f"{60 * hours:.0f} minutes"
        return (
            f"{n} pairs in about {duration} and {n * m.bytes_per_pair / 1e9:.3g} GB ({m.pairs / m.seconds:.3g} pairs/s "
            f"over {m.pairs} pairs, {m.bytes_per_pair / 1e3:.4g} kB a pair, {m.memory_bytes / 1e9:.2g} GB of memory)"
        )

    def as_dict(self, n: int) -> dict[str, Any]:
        """The measurement and its extrapolation to n pairs, for JSON."""
        m = self.measured or RunEstimate(pairs=0, seconds=0.0, bytes_per_pair=0.0)
        return {
            "engine": self.engine,
            "pairs": m.pairs,
            "seconds": m.seconds,
            "bytes_per_pair": m.bytes_per_pair,
            "memory_bytes": m.memory_bytes,
            "problem": self.problem,
            "pairs_per_s": m.pairs / m.seconds if m.pairs else 0.0,
            "n": n,
            "hours": m.duration_s(n) / 3600 if m.pairs else None,
        }


def measure_engine(
    engine: EngineName, config: SynthConfig, seconds: float, mesh: Path | None, units: Units
) -> EngineSpeed:
    """Render a dataset with the default number of workers for a while.

    Args:
        engine: Renderer of the scenes.
        config: Recipe; its engine and shard size are replaced.
        seconds: Duration from the first committed shard on.
        mesh: Object; None for a simple one of 2 500 triangles.
        units: Unit of the mesh.
    """
    per_scene = config.hypotheses_per_scene
    size = -(-_SHARD_SIZE // per_scene) * per_scene
    with TemporaryDirectory(prefix="synthgen_speed_") as folder:
        objects = mesh or _simple_mesh(Path(folder) / "simple.ply")
        job = RenderJob(
            out=str(Path(folder) / "shards"),
            n=max(4 * size, min(_MOST_PAIRS, free_bytes(Path(folder)) // _ROOM_BYTES)),
            config=replace(config, engine=engine, shard_size=size),
            sources=Sources(objects=(objects,), units="mm" if mesh is None else units),
        )
        try:
            measured = in_own_process(measure_run, job, seconds, timeout_s=seconds + _START_S + _STOP_S)
        except PoseError as error:
            return EngineSpeed(engine=engine, problem=str(error))
    if measured is None:
        return EngineSpeed(engine=engine, problem=f"too slow: no two shards of {size} pairs in time")
    return EngineSpeed(engine=engine, measured=measured)


class _TimeIsUp(BaseException):
    """Ends a measured run; no handler of errors that it interrupts may keep it."""


def measure_run(job: RenderJob, seconds: float) -> RunEstimate | None:
    """Run a job in this process, stopped after so many seconds from its first commit; None for less than two commits.

    Raises:
        PoseError: See `render_dataset`.
    """
    commits: list[tuple[float, Encoded]] = []
    memory_bytes = 0

    def on_shard(encoded: Encoded) -> None:
        nonlocal memory_bytes
        commits.append((time.monotonic(), encoded))
        memory_bytes = _memory_bytes()
        if commits[-1][0] - commits[0][0] >= seconds and len(commits) >= 2:
            raise _TimeIsUp

    signal.signal(signal.SIGALRM, _end)
    signal.setitimer(signal.ITIMER_REAL, seconds + _START_S)
    with suppress(_TimeIsUp):
        render_dataset(job, on_shard=on_shard)
    signal.setitimer(signal.ITIMER_REAL, 0)
    if len(commits) < 2:
        return None
    lines = [encoded.line for _, encoded in commits]
    return RunEstimate(
        pairs=sum(line["n"] for line in lines[1:]),
        seconds=commits[-1][0] - commits[0][0],
        bytes_per_pair=sum(sum(line["bytes"].values()) for line in lines) / sum(line["n"] for line in lines),
        memory_bytes=memory_bytes,
    )


def _end(signal_number: int, frame: FrameType | None) -> None:
    raise _TimeIsUp


def _memory_bytes() -> int:
    """Resident memory of this process and its workers."""
    total, this = 0, psutil.Process(os.getpid())
    for process in (this, *this.children(recursive=True)):
        with suppress(psutil.Error):  # a worker may end meanwhile
            total += process.memory_info().rss
    return total


def _simple_mesh(file: Path) -> Path:
    """A coloured object of 12 cm with 2 500 triangles, millimetres."""
    parts = [
        trimesh.creation.icosphere(subdivisions=3, radius=30),
        trimesh.creation.cylinder(radius=14, height=110, sections=96),
        trimesh.creation.box(extents=(90, 24, 16)).subdivide_loop(2),
    ]
    mesh: Any = trimesh.util.concatenate(parts)
    low, high = mesh.bounds
    mesh.visual.vertex_colors = (40 + 200 * (mesh.vertices - low) / (high - low)).astype(np.uint8)
    mesh.export(file)
    return file
