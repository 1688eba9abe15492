"""What a dataset will take, from a few scenes rendered and encoded here, and whether there is room for it."""

import os
import pickle
import subprocess
import sys
import time
from dataclasses import dataclass

from posecore import shard
from posecore.errors import PoseError, RenderError
from posecore.processes import die_with_parent

from synthgen.pairs.pair_maker import concatenate
from synthgen.run.shard_job import ShardJob, ShardRenderer, scenes_in

_START_S = 300.0  # for Blender to start and the first scene to compile its kernels
_MANIFEST_BYTES = 700  # of a shard's line


@dataclass(frozen=True, kw_only=True)
class Estimate:
    """What one pair takes.

    Attributes:
        bytes_per_pair: On disk.
        seconds_per_pair: Of one worker, after its start; workers side by side on the same cores take longer each.
        pairs: How many were measured.
    """

    bytes_per_pair: float
    seconds_per_pair: float
    pairs: int

    def bytes(self, n: int) -> int:
        """Size of n pairs."""
        return round(n * self.bytes_per_pair)

    def seconds(self, n: int, workers: int) -> float:
        """Time for n pairs with so many workers, each with its own core or GPU."""
        return n * self.seconds_per_pair / max(1, workers)


def estimate(job: ShardJob, *, scenes: int = 4, most_seconds: float = 20.0) -> Estimate:
    """Render and encode the first scenes of a job in a process of their own, and throw them away.

    Nothing is imported, started or left in the calling process, and nothing is written. The first scene is not timed:
    it holds the start of the engine.

    Args:
        job: The dataset.
        scenes: How many to measure beside the first.
        most_seconds: No further scene is begun after that long.

    Raises:
        PoseError: What the renderer raised: these settings cannot be rendered here.
        RenderError: The process died, which a crashing renderer does, or gave no answer in time.
    """
    command = [sys.executable, "-c", "from synthgen.run.estimate import main; main()"]
    seconds = _START_S + most_seconds
    # Not multiprocessing: that waits for ever when its process is killed while it starts.
    try:
        done = subprocess.run(
            command,
            input=pickle.dumps((job, scenes, most_seconds)),
            stdout=subprocess.PIPE,
            stderr=subprocess.DEVNULL,
            timeout=seconds,
            check=True,
        )
    except subprocess.TimeoutExpired as error:
        raise RenderError(f"the first scenes gave no result in {seconds:.0f} s") from error
    except subprocess.CalledProcessError as error:
        raise RenderError(f"the renderer died at the first scenes, exit code {error.returncode}") from error
    answer: Estimate | PoseError = pickle.loads(done.stdout)
    if isinstance(answer, PoseError):
        raise answer
    return answer


def main() -> None:
    """The process of `estimate`: a job on stdin; on stdout an estimate, or the error that says why there is none."""
    die_with_parent()
    with os.fdopen(os.dup(1), "wb") as out:
        os.dup2(2, 1)  # Blender talks there
        answer: Estimate | PoseError
        try:
            answer = measured(*pickle.load(sys.stdin.buffer))
        except PoseError as error:
            answer = error
        out.write(pickle.dumps(answer))


def measured(job: ShardJob, scenes: int, most_seconds: float) -> Estimate:
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
    per_pair = rendered / timed + (time.perf_counter() - began) / count
    line = _MANIFEST_BYTES / job.config.shard_size
    return Estimate(
        bytes_per_pair=sum(map(len, encoded.files.values())) / count + line, seconds_per_pair=per_pair, pairs=count
    )
