"""How fast this machine renders: the real command for a while, into a temporary folder."""

import json
import os
import signal
import subprocess
import sys
import time
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np
import trimesh
from posecore.mesh import Units
from posecore.shard import MANIFEST

from synthgen.config import SynthConfig
from synthgen.machine import free_bytes

_MOST_PAIRS = 20_000  # a machine that renders them all while it is measured is measured well
_ROOM_BYTES = 400_000  # of free disk for each pair: twice what large patches take
_SHARD_SIZE = 16  # small, so that several are done in seconds
_POLL_S = 0.05
_STOP_S = 20.0
_START_S = 180.0  # for workers and engines to start and the first shards to come


@dataclass(frozen=True, kw_only=True)
class Speed:
    """What was measured with one engine.

    Attributes:
        engine: Renderer of the scenes.
        pairs: Rendered after the first shard, which is not counted: it holds the start of workers and engines.
        seconds: Between the first and the last commit.
        bytes_per_pair: On disk.
        memory_bytes: Of all processes at the end.
        problem: Why nothing could be measured.
    """

    engine: str
    pairs: int = 0
    seconds: float = 0.0
    bytes_per_pair: float = 0.0
    memory_bytes: int = 0
    problem: str = ""

    @property
    def pairs_per_s(self) -> float:
        """Rate of the whole machine, 0 when nothing was measured."""
        return self.pairs / self.seconds if self.pairs else 0.0

    def hours(self, n: int) -> float | None:
        """How long n pairs take."""
        return n / self.pairs_per_s / 3600 if self.pairs else None

    def text(self, n: int) -> str:
        """One line."""
        hours = self.hours(n)
        if hours is None:
            return self.problem
        duration = f"{hours:.1f} hours" if hours >= 1 else f"{60 * hours:.0f} minutes"
        return (
            f"{n} pairs in about {duration} and {n * self.bytes_per_pair / 1e9:.3g} GB ({self.pairs_per_s:.3g} pairs/s "
            f"over {self.pairs} pairs, {self.bytes_per_pair / 1e3:.4g} kB a pair, {self.memory_bytes / 1e9:.2g} GB of "
            "memory)"
        )


def measure(
    engine: str, config: SynthConfig, arguments: Sequence[str], seconds: float, mesh: Path | None, units: Units
) -> Speed:
    """Run `synthgen render` with its default workers for a while.

    Args:
        engine: Renderer of the scenes.
        config: What `arguments` resolve to.
        arguments: Preset and overrides for the command line.
        seconds: How long, from the first committed shard on.
        mesh: Object; None for a simple one of 2 500 triangles.
        units: Of the mesh.
    """
    with TemporaryDirectory(prefix="synthgen_speed_") as folder:
        out, log = Path(folder) / "shards", Path(folder) / "log"
        objects = mesh or _simple_mesh(Path(folder) / "simple.ply")
        per_scene = config.hypotheses_per_scene
        size = -(-_SHARD_SIZE // per_scene) * per_scene
        command = [
            sys.executable,
            "-m",
            "synthgen.cli",
            "render",
            "--object",
            str(objects),
            "--out",
            str(out),
            "--quiet",
        ]
        n = max(4 * size, min(_MOST_PAIRS, free_bytes(Path(folder)) // _ROOM_BYTES))
        command += [*arguments, "--engine", engine, "--n", str(n), "--set", f"shard_size={size}"]
        command += ["--units", "mm" if mesh is None else units]
        with log.open("wb") as errors:
            # a session of its own: whatever it starts can be found, and goes with it
            process = subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=errors, start_new_session=True)
            try:
                commits = _watch(process, out / MANIFEST, seconds)
                memory = _session_memory_bytes(process.pid)
            finally:
                _stop(process)
        lines = [line for line in log.read_text(errors="replace").splitlines() if line.startswith("Error: ")]
        if len(commits) < 2:
            problem = lines[-1].removeprefix("Error: ") if lines else f"too slow: no two shards of {size} pairs in time"
            return Speed(engine=engine, problem=problem)
        manifest = [json.loads(line) for line in (out / MANIFEST).read_text(encoding="utf-8").splitlines()]
        total = sum(sum(line["bytes"].values()) for line in manifest)
        (first_s, first), (last_s, last) = commits[0], commits[-1]
        return Speed(
            engine=engine,
            pairs=(last - first) * size,
            seconds=last_s - first_s,
            bytes_per_pair=total / sum(line["n"] for line in manifest),
            memory_bytes=memory,
        )


def _watch(process: "subprocess.Popen[bytes]", manifest: Path, seconds: float) -> list[tuple[float, int]]:
    """Times at which the manifest grew, and its lines then, until there is enough of them or no time left."""
    started = time.monotonic()
    commits: list[tuple[float, int]] = []
    while process.poll() is None:
        now = time.monotonic()
        lines = manifest.read_bytes().count(b"\n") if manifest.exists() else 0
        if lines > (commits[-1][1] if commits else 0):
            commits.append((now, lines))
        begun = commits[0][0] if commits else now
        if (now - begun >= seconds and len(commits) >= 2) or now - started > seconds + _START_S:
            break
        time.sleep(_POLL_S)
    return commits


def _stop(process: "subprocess.Popen[bytes]") -> None:
    """End the command as ctrl-C does, so that its workers clean up, and by force what is left of it."""
    process.send_signal(signal.SIGINT)
    with suppress(subprocess.TimeoutExpired):
        process.wait(_STOP_S)
    with suppress(ProcessLookupError):
        os.killpg(process.pid, signal.SIGKILL)
    process.wait()


def _session_memory_bytes(session: int) -> int:
    """Memory of all processes of a session, as the kernel counts it now."""
    total = 0
    for status in Path("/proc").glob("[0-9]*/stat"):
        with suppress(OSError, ValueError):  # processes end while one looks
            words = status.read_text(encoding="utf-8").rpartition(")")[2].split()
            if int(words[3]) == session:
                total += int(words[21]) * os.sysconf("SC_PAGE_SIZE")
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
