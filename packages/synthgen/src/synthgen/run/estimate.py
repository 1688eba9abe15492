"""Time and size of a dataset, estimated from a few scenes that are rendered and encoded in a process of their own."""

import os
import pickle
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass
from typing import Any

from posecore import shard
from posecore.errors import PoseError, RenderError
from posecore.processes import die_with_parent

from synthgen.pairs.pair_maker import concatenate
from synthgen.run.shard_job import ShardJob, ShardRenderer, scenes_in

_START_S = 900.0  # for Blender to start and the first scene to compile its kernels, on a busy machine too
_MANIFEST_BYTES = 700  # of a shard's line


@dataclass(frozen=True, kw_only=True)
class RunEstimate:
    """Measured time and size of pairs.

    Attributes:
        pairs: Measured pairs.
        seconds: Rendering time of the measured pairs, without the start of processes and engines.
        bytes_per_pair: Size on disk.
        memory_bytes: Memory of all processes at the end; 0 where it is not measured.
    """

    pairs: int
    seconds: float
    bytes_per_pair: float
    memory_bytes: int = 0

    @property
    def seconds_per_pair(self) -> float:
        """Time per pair."""
        return self.seconds / self.pairs

    def size_bytes(self, n: int) -> int:
        """Size of n pairs."""
        return round(n * self.bytes_per_pair)

    def duration_s(self, n: int, workers: int = 1) -> float:
        """Time of n pairs on so many workers at the measured speed, each with its own core or GPU."""
        return n * self.seconds_per_pair / max(1, workers)


def estimate(job: ShardJob, *, scenes: int = 4, most_seconds: float = 20.0) -> RunEstimate:
    """Render and encode the first scenes of a job, on one worker; nothing is written.

    The first scene is not timed: it holds the start of the engine. Workers that share cores take longer each.

    Args:
        job: The dataset.
        scenes: Scenes to measure beside the first.
        most_seconds: Time after which no further scene is begun.

    Raises:
        PoseError: These settings cannot be rendered here.
        RenderError: The renderer crashed or gave no result in time.
    """
    return in_own_process(measure_scenes, job, scenes, most_seconds, timeout_s=_START_S + most_seconds)


def measure_scenes(job: ShardJob, scenes: int, most_seconds: float) -> RunEstimate:
    """The estimate, rendered in this process. See `estimate`."""
    renderer = ShardRenderer(job)
    try:
        first, *others = list(scenes_in(job, 0))[: scenes + 1]
        parts = [renderer.scene(0, first)]
        began = time.perf_counter()
        for index in others or [first]:
            parts.append(renderer.scene(0, index))
            if time.perf_counter() - began > most_seconds:
                break
        rendered = time.perf_counter() - began
    finally:
        renderer.close()
    timed = sum(len(part["obj_id"]) for part in parts[1:])
    arrays = concatenate(parts)
    count = len(arrays["obj_id"])
    began = time.perf_counter()
    encoded = shard.encode({**job.card, "n": count, "shard_size": count}, 0, arrays)
    seconds = count * rendered / timed + time.perf_counter() - began
    line = _MANIFEST_BYTES / job.config.shard_size
    return RunEstimate(
        pairs=count, seconds=seconds, bytes_per_pair=sum(map(len, encoded.files.values())) / count + line
    )


def in_own_process(function: Callable[..., Any], *arguments: Any, timeout_s: float) -> Any:
    """Result of a module's function, called in a new process: nothing is imported or started in this one.

    Args:
        function: Function at the top of a module.
        arguments: Its arguments, picklable.
        timeout_s: Time after which the process and its children are killed.

    Raises:
        PoseError: Raised by the function.
        RenderError: The process died, as a crashing renderer does, or gave no result in time.
    """
    # Not multiprocessing: its parent waits for ever for a process that is killed while it starts.
    process = subprocess.Popen(
        [sys.executable, "-c", "from synthgen.run.estimate import main; main()"],
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        stderr=subprocess.DEVNULL,
        start_new_session=True,  # its children are in its process group
    )
    try:
        answer, _ = process.communicate(pickle.dumps((function, arguments)), timeout=timeout_s)
    except subprocess.TimeoutExpired as error:
        raise RenderError(f"the renderer gave no result in {timeout_s:.0f} s") from error
    finally:
        with suppress(ProcessLookupError):
            os.killpg(process.pid, signal.SIGKILL)
        process.wait()
    if process.returncode:
        raise RenderError(f"the renderer died at the first scenes, exit code {process.returncode}")
    result = pickle.loads(answer)
    if isinstance(result, PoseError):
        raise result
    return result


def main() -> None:
    """Body of the new process: a pickled call on stdin; its result, or the PoseError that it raised, on stdout."""
    die_with_parent()
    with os.fdopen(os.dup(1), "wb") as out:
        os.dup2(2, 1)  # Blender writes to stdout
        function, arguments = pickle.load(sys.stdin.buffer)
        try:
            result = function(*arguments)
        except PoseError as error:
            result = error
        out.write(pickle.dumps(result))
