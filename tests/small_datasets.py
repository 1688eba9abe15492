"""Small shard datasets, rendered in the test's own process."""

from collections.abc import Collection, Mapping
from pathlib import Path

from posecore import shard
from posecore.mesh import Mesh
from posecore.shard import ShardWriter
from synthgen.config import SynthConfig
from synthgen.inputs.assets import Assets
from synthgen.pairs import data_card
from synthgen.run.shard_job import ShardJob, ShardRenderer


def write_dataset(
    url: str | Path,
    config: SynthConfig,
    meshes: Mapping[int, Mesh],
    n: int,
    *,
    shards: int | None = None,
    quarantined: Collection[int] = (),
) -> ShardJob:
    """Render a dataset as `synthgen render` does, all of it or its first shards."""
    card = data_card.rendered_card(config, n, meshes, Assets())
    writer = ShardWriter.create(str(url), card)
    for key, data in data_card.model_files(meshes, {}).items():
        writer.add_file(key, data)
    job = ShardJob(config=config, card=writer.card, meshes=meshes)
    renderer = ShardRenderer(job)
    for shard_id in range(shard.n_shards(writer.card) if shards is None else shards):
        writer.commit(renderer.render(shard_id, quarantined))
    renderer.close()
    return job
