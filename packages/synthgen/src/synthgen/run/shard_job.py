"""Rendering of whole shards, from a job that is sent once to every worker."""

import threading
from collections.abc import Collection, Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from posecore import shard
from posecore.errors import RenderError
from posecore.mesh import Mesh

from synthgen.config import SynthConfig
from synthgen.draw.target import make_targets
from synthgen.inputs.assets import Assets
from synthgen.pairs.pair_maker import PairMaker, concatenate, limit_threads

REPLACEMENT_ATTEMPT = 50
"""First attempt of the draws that replace a quarantined scene; its manifest line lists it under `quarantined`."""


class SceneError(RenderError):
    """A scene cannot be rendered; others may be."""


@dataclass(frozen=True, kw_only=True, eq=False)
class ShardJob:
    """Complete definition of a dataset, picklable.

    Attributes:
        config: Recipe.
        card: Data card.
        meshes: Objects by id.
        assets: Photographs, panoramas and occluder meshes.
        threads: Number of threads of a Blender engine.
    """

    config: SynthConfig
    card: Mapping[str, Any]
    meshes: Mapping[int, Mesh]
    assets: Assets = field(default_factory=Assets)
    threads: int = 1


class ShardRenderer:
    """Renders shards of a job with engines that persist between shards.

    Engines are created at the first shard, in its thread, because GL contexts and Blender are bound to a thread.
    """

    def __init__(self, job: ShardJob) -> None:
        self._job = job
        self._local = threading.local()

    def prepare(self) -> None:
        """Create the engines of this thread, unless they exist.

        Raises:
            RenderError: An engine cannot start here.
        """
        self._maker()

    def render(self, shard_id: int, quarantined: Collection[int] = ()) -> shard.Encoded:
        """Render one shard and encode it for the writer.

        Args:
            shard_id: Index of the shard.
            quarantined: Scene indices to replace by another draw; the manifest line lists the shard's own.

        Raises:
            SceneError: The renderer failed at a scene.
            RenderError: An engine cannot start here.
            ConfigError: A scene cannot be drawn.
        """
        scenes = scenes_in(self._job, shard_id)
        parts = [self.scene(shard_id, index, quarantined) for index in scenes]
        encoded = shard.encode(self._job.card, shard_id, concatenate(parts))
        if replaced := sorted(set(scenes) & set(quarantined)):
            encoded.line["quarantined"] = replaced
        return encoded

    def scene(self, shard_id: int, scene_index: int, quarantined: Collection[int] = ()) -> dict[str, np.ndarray]:
        """Render the samples of a scene. See `render`."""
        maker = self._maker()
        first_attempt = REPLACEMENT_ATTEMPT if scene_index in quarantined else 0
        try:
            return maker.samples(scene_index, scenes_in(self._job, shard_id)[scene_index], first_attempt)
        except RenderError as error:
            raise SceneError(f"scene {scene_index}: {error}") from error

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
            targets = make_targets(job.meshes, job.config, job.assets)
            self._local.maker = PairMaker(job.config, targets, job.assets, threads=job.threads)
        maker: PairMaker = self._local.maker
        return maker


def scenes_in(job: ShardJob, shard_id: int) -> dict[int, int]:
    """Scenes of a shard in their order, with their number of samples in the shard."""
    h = job.config.hypotheses_per_scene
    count = shard.samples_in(job.card, shard_id)
    first = shard_id * job.config.shard_size // h
    return {first + s: min(h, count - s * h) for s in range(-(-count // h))}
