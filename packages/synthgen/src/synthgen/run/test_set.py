"""Test images of a rendered dataset: a small BOP dataset of other scenes, in the dataset's folder."""

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

from posecore.errors import ConfigError
from posecore.shard.layout import TEST_SET

from synthgen.bop.dataset_writer import write_dataset
from synthgen.bop.frame_maker import FramePlan
from synthgen.config import SynthConfig
from synthgen.inputs.sources import Sources
from synthgen.run.estimate import estimate
from synthgen.run.shard_job import ShardJob

MOST_BY_DEFAULT = 100
PAIRS_PER_IMAGE = 10
SEED_DISTANCE = 1_000_000_007
"""Seed of the test images minus that of the pairs: no dataset of a nearby seed shows the same scenes."""
LARGEST_SEED = 2**63 - 1


def default_count(n: int, out: str, scheduler: str | None = None) -> int:
    """Number of test images where none is given: a tenth of n pairs, at most 100.

    None for a URL, since BOP datasets are local folders, and none with a scheduler, whose workers render pairs only.
    """
    if "://" in out or scheduler is not None:
        return 0
    return max(1, min(MOST_BY_DEFAULT, n // PAIRS_PER_IMAGE))


def render_test_set(
    out: str,
    count: int,
    shards: ShardJob,
    sources: Sources,
    *,
    workers: int,
    on_image: Callable[[int], None] = lambda count: None,
) -> None:
    """Render the test images, or the missing ones, as `synthgen bop` does with the same settings and another seed.

    Args:
        out: Dataset, a local folder.
        count: Number of images; 0 renders none.
        shards: Shards of the dataset: their configuration, meshes and assets are those of the images.
        sources: Paths of the meshes' symmetries.
        workers: Local processes. A Blender engine always runs in processes of its own.
        on_image: Called for every image on disk, with 1.

    Raises:
        PoseError: See `dataset_writer.write_dataset`.
    """
    if not count:
        return
    try:
        write_dataset(
            Path(out) / TEST_SET,
            images_config(shards.config, len(shards.meshes)),
            shards.meshes,
            FramePlan(frames=count),
            assets=shards.assets,
            infos=sources.infos(shards.meshes),
            workers=workers if shards.config.engine == "raster" else max(2, workers),
            on_frame=lambda scene_id, im_id: on_image(1),
        )
    except ConfigError as error:
        estimate(shards, scenes=1)  # pairs that cannot be drawn either name the setting to blame
        raise ConfigError(f"test images: {error}; or leave them out with --test-images 0") from error


def images_config(config: SynthConfig, objects: int) -> SynthConfig:
    """Configuration of the images: the pairs' with another seed, and no more objects in an image than there are."""
    low, high = config.frames.objects
    most = objects * config.frames.instances
    return replace(
        config,
        seed=(config.seed + SEED_DISTANCE) % LARGEST_SEED,
        frames=replace(config.frames, objects=(min(low, most), min(high, most))),
    )


def require_local(out: str, count: int) -> None:
    """Refuse test images in a URL.

    Raises:
        ConfigError: The dataset is not in a local folder.
    """
    if count < 0:
        raise ConfigError(f"--test-images {count}: expected 0 or more")
    if count and "://" in out:
        raise ConfigError(
            f"--test-images {count}: {out} is a URL, and images in BOP layout need a local folder; leave it out"
        )
