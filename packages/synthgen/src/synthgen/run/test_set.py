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
TARGETS = "test_targets_bop19.json"
"""The last file of finished test images, but for that of another challenge."""


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
        workers: See `image_workers`.
        on_image: Called for every image on disk, with 1.

    Raises:
        PoseError: See `dataset_writer.write_dataset`.
    """
    if not count:
        return
    meshes = {obj_id: mesh.with_levels(()) for obj_id, mesh in shards.meshes.items()}  # BOP datasets have every face
    occluders = tuple(mesh.with_levels(()) for mesh in shards.assets.occluders)
    try:
        write_dataset(
            Path(out) / TEST_SET,
            images_config(shards.config, len(meshes)),
            meshes,
            FramePlan(frames=count),
            assets=replace(shards.assets, occluders=occluders),
            infos=sources.infos(meshes),
            workers=workers,
            on_frame=lambda scene_id, im_id: on_image(1),
        )
    except ConfigError as error:
        estimate(shards, scenes=1)  # pairs that cannot be drawn either name the setting to blame
        raise ConfigError(f"test images: {error}; or leave them out with --test-images 0") from error


def image_workers(config: SynthConfig, workers: int, *, has_gpu: bool) -> int:
    """Number of processes for the test images; 1 is this process, where no Blender engine may run.

    Args:
        config: Configuration of the pairs.
        workers: Processes of the pairs.
        has_gpu: Whether Cycles renders on a GPU, which a whole image fills.
    """
    fewest = 1 if config.engine == "raster" else 2
    return fewest if has_gpu else max(fewest, workers)


def has_images(out: Path, *, whole: bool) -> bool:
    """Whether a dataset has a test image; with `whole`, whether the last one is finished."""
    folder = out / TEST_SET
    return (folder / TARGETS).exists() or (not whole and any(folder.glob("*/*/scene_gt.json")))


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
