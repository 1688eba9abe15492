"""What a worker process does: whole shards, from a job that is sent once to every worker."""

import threading
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from posecore import shard
from posecore.mesh import Mesh

from synthgen.config import SynthConfig
from synthgen.pair import PairMaker, concatenate, limit_threads
from synthgen.target import make_target


@dataclass(frozen=True, kw_only=True, eq=False)
class ShardJob:
    """Everything that decides a dataset, ready to be pickled.

    Attributes:
        config: Recipe.
        card: The dataset's card.
        meshes: Objects by id.
        photos: Background photographs, readable on every worker.
        threads: Threads of a Blender engine.
    """

    config: SynthConfig
    card: Mapping[str, Any]
    meshes: Mapping[int, Mesh]
    photos: tuple[str, ...] = ()
    threads: int = 1


class ShardRenderer:
    """Renders shards of a job with engines that are kept between them.

    Engines are made at the first shard and in its thread, because GL contexts and Blender belong to the thread that
    made them.
    """

    def __init__(self, job: ShardJob) -> None:
        self._job = job
        self._local = threading.local()

    def render(self, shard_id: int) -> shard.Encoded:
        """Render one shard and encode it for the writer."""
        maker, config = self._maker(), self._job.config
        h = config.hypotheses_per_scene
        count = shard.samples_in(self._job.card, shard_id)
        first_scene = shard_id * config.shard_size // h
        scenes = [maker.samples(first_scene + s, min(h, count - s * h)) for s in range(-(-count // h))]
        return shard.encode(self._job.card, shard_id, concatenate(scenes))

    def close(self) -> None:
        """Free the engines of this thread."""
        maker: PairMaker | None = getattr(self._local, "maker", None)
        if maker is not None:
            maker.close()
            del self._local.maker

    def _maker(self) -> PairMaker:
        if not hasattr(self._local, "maker"):
            job = self._job
            limit_threads(job.threads)
            targets = [make_target(obj_id, mesh, job.config) for obj_id, mesh in sorted(job.meshes.items())]
            self._local.maker = PairMaker(job.config, targets, job.photos, threads=job.threads)
        maker: PairMaker = self._local.maker
        return maker
