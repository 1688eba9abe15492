"""From a job to a dataset of rendered pairs: the application behind `synthgen render`."""

import shutil
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from functools import cache
from pathlib import Path

from posecore.detail import with_levels
from posecore.errors import ConfigError, PoseError, RenderError
from posecore.shard import Encoded
from posecore.shard.layout import MANIFEST, TEST_SET

from synthgen import lock
from synthgen.config import SynthConfig
from synthgen.engines.devices import choose_device, list_gpus, visible_gpus
from synthgen.inputs.sources import Sources
from synthgen.machine import cores, require_free_space, size_text
from synthgen.pairs import data_card
from synthgen.run import dispatcher, test_set
from synthgen.run.cluster import Certificates
from synthgen.run.estimate import estimate
from synthgen.run.shard_job import ShardJob

MOST_WORKERS = 8
MEASURED_FROM = 1000
"""Pairs; for fewer a measurement costs more than it is worth."""


@dataclass(frozen=True, kw_only=True)
class RenderJob:
    """A dataset of training pairs to render.

    Attributes:
        out: Folder or fsspec URL; an unfinished dataset of the same job there is continued.
        n: Number of pairs.
        config: Recipe; the device 'auto' is resolved on this machine.
        sources: Objects, photographs, panoramas, occluders.
        workers: Local processes; None: one per GPU that Cycles uses, else one per core, at most MOST_WORKERS.
        scheduler: Address of a running dask scheduler whose workers render; None for local processes.
        shard_timeout_s: See `dispatcher.run`.
        certificates: For a scheduler with TLS.
        dashboard: Port of dask's web page of local processes, on this machine only; None for none.
        test_images: Number of images of other scenes, in BOP layout, in the folder `test_bop` of the dataset.
    """

    out: str
    n: int
    config: SynthConfig
    sources: Sources
    workers: int | None = None
    scheduler: str | None = None
    shard_timeout_s: float | None = None
    certificates: Certificates | None = None
    dashboard: int | None = None
    test_images: int = 0

    def __post_init__(self) -> None:
        test_set.require_local(self.out, self.test_images)
        if self.workers and self.scheduler:
            raise ConfigError(
                "--workers starts local processes, --scheduler uses the workers of a cluster: give only one option"
            )
        if self.certificates and not self.scheduler:
            raise ConfigError(
                "--tls-ca and --tls-cert are for --scheduler; local processes have certificates of their own"
            )
        if self.dashboard and self.scheduler:
            raise ConfigError("--dashboard is for local processes; the scheduler of a cluster has its own")


@dataclass(frozen=True, kw_only=True)
class RenderPlan:
    """The work that a job has left.

    Attributes:
        url: Dataset.
        engine: Renderer of the scenes.
        total: Pairs of the dataset.
        present: Pairs that are committed and sound.
        damaged: Defects of committed shards, by shard; these shards are rendered again.
        forecast: Size and time of the missing pairs, in words.
        test_images: Number of test images, rendered before the pairs.
    """

    url: str
    engine: str
    total: int
    present: int
    damaged: Mapping[int, str]
    forecast: str
    test_images: int = 0

    @property
    def text(self) -> str:
        """The plan in lines to read."""
        lines = [
            f"{self.url}: shard {shard_id} is damaged ({defect}) and is rendered again"
            for shard_id, defect in sorted(self.damaged.items())[:3]
        ]
        if len(self.damaged) > 3:
            lines.append(f"{self.url}: {len(self.damaged) - 3} further shards are damaged and are rendered again")
        lines.append(
            f"{self.url}: {self.present} of {self.total} pairs are there, rendering {self.total - self.present} with "
            f"{self.engine}, {self.forecast}"
        )
        if self.test_images:
            lines.append(f"{self.url}/{TEST_SET}: {self.test_images} test images of other scenes come first")
        return "\n".join(lines)


@dataclass(frozen=True, kw_only=True)
class RenderSummary:
    """A complete dataset.

    Attributes:
        url: Dataset.
        pairs: Number of pairs.
        quarantined: Scenes that crashed the renderer and were drawn anew.
        test_images: Number of test images beside them.
    """

    url: str
    pairs: int
    quarantined: tuple[int, ...]
    test_images: int = 0

    @property
    def text(self) -> str:
        """The summary in one line."""
        scenes = self.quarantined
        replaced = f", {len(scenes)} scenes quarantined and drawn anew" if scenes else ""
        images = f", {self.test_images} test images" if self.test_images else ""
        return f"{self.url}: complete, {self.pairs} pairs{images}{replaced}"


def render_dataset(
    job: RenderJob,
    *,
    on_objects: Callable[[Sequence[str]], None] = lambda lines: None,
    on_plan: Callable[[RenderPlan], None] = lambda plan: None,
    on_image: Callable[[int], None] = lambda count: None,
    on_shard: Callable[[Encoded], None] = lambda encoded: None,
) -> RenderSummary:
    """Render a dataset, or the missing shards and test images of an unfinished one.

    Args:
        job: The dataset.
        on_objects: Called once with the objects' diameters, see `Sources.diameter_lines`.
        on_plan: Called once before the first image is rendered.
        on_image: Called with 1 for every test image on disk.
        on_shard: Called after each commit; the manifest line holds the number of pairs.

    Raises:
        ConfigError: The settings contradict each other, or a scene cannot be drawn.
        MeshError: An object or occluder cannot be loaded.
        ShardError: The folder holds another dataset.
        StorageError: The disk has no room, the dataset cannot be written, or another process writes it.
        RenderError: An engine or device is missing, or workers keep dying.
    """
    shards, gpus = _loaded(job)
    on_objects(job.sources.diameter_lines(shards.meshes))
    workers = job.workers or len(gpus) or min(MOST_WORKERS, cores())
    new = "://" not in job.out and not Path(job.out).exists()
    with lock.held(job.out), _removed_if_useless(Path(job.out) if new else None):
        writer = data_card.create_writer(job.out, shards.card)
        for key, data in data_card.model_files(shards.meshes, job.sources.infos(shards.meshes)).items():
            writer.add_file(key, data)
        threads = 1 if job.scheduler else dispatcher.threads_per_worker(workers, cores())
        shards = replace(shards, card=writer.card, threads=threads)
        damaged = writer.damaged()
        present, total = dispatcher.progress(shards, writer, damaged)
        forecast = _forecast(job.out, shards, total - present, None if job.scheduler else workers)
        plan = RenderPlan(
            url=job.out, engine=shards.config.engine, total=total, present=present, damaged=damaged, forecast=forecast,
            test_images=job.test_images,
        )  # fmt: skip
        on_plan(plan)
        processes = test_set.image_workers(shards.config, workers, has_gpu=bool(gpus))
        test_set.render_test_set(job.out, job.test_images, shards, job.sources, workers=processes, on_image=on_image)
        dispatcher.run(
            shards,
            writer,
            workers=workers,
            scheduler=job.scheduler,
            on_shard=on_shard,
            redo=set(damaged),
            shard_timeout_s=job.shard_timeout_s,
            gpus=gpus,
            certificates=job.certificates,
            dashboard=job.dashboard,
        )
        return RenderSummary(
            url=job.out, pairs=total, quarantined=tuple(writer.quarantined()), test_images=job.test_images
        )


def shard_job(job: RenderJob) -> ShardJob:
    """The job with loaded meshes and assets and its data card, for one renderer on all cores.

    Raises:
        ConfigError, MeshError, RenderError: See `render_dataset`.
    """
    return _loaded(job)[0]


def _loaded(job: RenderJob) -> tuple[ShardJob, tuple[str, ...]]:
    """The job ready for one renderer, and the GPUs that it uses."""
    config, gpus = _with_device(job.config, job.scheduler)
    meshes, assets = job.sources.meshes(), job.sources.assets()
    levelled = cache(with_levels)  # once for an object that is an occluder too
    meshes = {obj_id: levelled(mesh) for obj_id, mesh in meshes.items()}
    assets = replace(assets, occluders=tuple(map(levelled, assets.occluders)))
    card = data_card.rendered_card(config, job.n, meshes, assets)
    return ShardJob(config=config, card=card, meshes=meshes, assets=assets, threads=cores()), gpus


def _with_device(config: SynthConfig, scheduler: str | None) -> tuple[SynthConfig, tuple[str, ...]]:
    """The configuration with the device that 'auto' stands for, since it goes into the card, and its GPUs."""
    if config.device == "cpu":
        return config, ()
    if "cycles" not in (config.engine, config.hypothesis_engine):  # the others draw with OpenGL
        return replace(config, device="cpu"), ()
    if scheduler is not None:
        if config.device == "auto":
            raise ConfigError(
                "--device auto: this machine's GPUs need not be the workers'; give the workers' device: optix, cuda "
                "or cpu"
            )
        return config, ()
    gpus = list_gpus()
    device = choose_device(config.device, gpus)
    return replace(config, device=device), visible_gpus(gpus.get(device, 0))


def _forecast(url: str, job: ShardJob, missing: int, workers: int | None) -> str:
    """Size and time of the missing pairs in words: measured before a long run, else the rough size alone.

    Args:
        url: Dataset.
        job: Its shards.
        missing: Pairs to render.
        workers: Local processes; None where a cluster renders, whose speed is unknown.

    Raises:
        StorageError: The disk has no room.
    """
    if missing < MEASURED_FROM:
        size = data_card.estimated_bytes(job.config.patch_px, job.config.contour_points, missing)
        require_free_space(url, size)
        return f"about {size_text(size)} more"
    try:
        measured = estimate(job)
    except RenderError as error:  # a single bad scene, or a machine that only schedules: the workers will find out
        return f"size and time unknown ({error})"
    size = measured.size_bytes(missing)
    require_free_space(url, size)
    time = "" if workers is None else f" and {_duration_text(measured.duration_s(missing, workers))}"
    return f"about {size_text(size)}{time} more, estimated from {measured.pairs} pairs"


def _duration_text(seconds: float) -> str:
    return f"{seconds / 3600:.1f} h" if seconds >= 7200 else f"{max(1.0, seconds / 60):.0f} min"


@contextmanager
def _removed_if_useless(new: Path | None) -> Iterator[None]:
    """Remove a new folder when an error ends the run before the first commit; test images that serve again keep it.

    Its data card would refuse the same command with a corrected setting. Finished test images are kept in any case.

    Args:
        new: A folder that did not exist before the run; None when it did.
    """
    try:
        yield
    except PoseError as error:
        needs_correction = isinstance(error, ConfigError)
        if new is not None and not (new / MANIFEST).exists() and not test_set.has_images(new, whole=needs_correction):
            shutil.rmtree(new, ignore_errors=True)
        raise
