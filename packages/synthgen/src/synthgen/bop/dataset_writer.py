"""Whole camera images in BOP's layout: data to try a refiner on, or to train on, with ground truth."""

import json
import multiprocessing
import os
from collections.abc import Callable, Iterable, Iterator, Mapping
from concurrent.futures import FIRST_COMPLETED, Future, ProcessPoolExecutor, wait
from concurrent.futures.process import BrokenProcessPool
from contextlib import contextmanager
from dataclasses import asdict, dataclass
from itertools import chain
from pathlib import Path
from typing import Any

from posecore import config as config_tools
from posecore.bop import (
    BopWriter,
    FrameEntry,
    FrameFiles,
    FrameRecord,
    ModelInfo,
    scene_folder,
    visible_targets,
    write_camera,
    write_models,
    write_targets,
)
from posecore.errors import ConfigError, DatasetError, RenderError
from posecore.files import storage_error, write_atomic
from posecore.mesh import Mesh
from posecore.processes import behave_as_worker, interrupts_ignored

from synthgen.bop.frame_maker import FrameMaker, FramePlan
from synthgen.config import SynthConfig, migrate
from synthgen.draw.target import Target, make_targets
from synthgen.engines.blender.paths import forget_blenders_paths
from synthgen.inputs.assets import Assets
from synthgen.pairs.data_card import versions
from synthgen.pairs.pair_maker import limit_threads
from synthgen.run import lock

CARD = "synthgen.json"
_FARTHEST_STEP = 65535
_JPG_SPLITS = ("train_pbr",)  # BOP's training images are JPEG, its test images PNG
_CRASHES = 3  # times in a row that worker processes may die without a frame in between
_AHEAD = 2  # frames a worker has waiting

Address = tuple[int, int]


@dataclass(frozen=True, kw_only=True, eq=False)
class FrameJob:
    """Everything that a process needs to render frames, ready to be pickled.

    Attributes:
        root: Dataset folder.
        config: Recipe.
        meshes: Objects by id.
        assets: Photographs, panoramas, occluder meshes.
        plan: Which images.
        depth_scale: Millimetres for one step of the depth images.
        threads: Threads of a Blender engine, 0 for all cores.
    """

    root: Path
    config: SynthConfig
    meshes: Mapping[int, Mesh]
    assets: Assets
    plan: FramePlan
    depth_scale: float
    threads: int

    @property
    def image_format(self) -> str:
        """Extension of the colour images."""
        return "jpg" if self.plan.split in _JPG_SPLITS else "png"


class FrameRenderer:
    """Renders frames of a job and writes their files, with engines that are kept between them."""

    def __init__(self, job: FrameJob) -> None:
        self._job = job
        limit_threads(job.threads)
        self._maker = FrameMaker(
            job.config, make_targets(job.meshes, job.config, job.assets), job.assets, job.plan, threads=job.threads
        )

    def write(self, scene_id: int, im_id: int) -> FrameEntry:
        """Render one frame; only its entry is left to be committed."""
        job, frame = self._job, self._maker.frame(scene_id, im_id)
        files = FrameFiles(
            scene_path=scene_folder(job.root, job.plan.split, scene_id),
            depth_scale=job.depth_scale,
            image_format=job.image_format,
        )
        record = FrameRecord(
            rgb=frame.rgb,
            depth_m=frame.depth_m,
            camera=self._maker.camera,
            gts=frame.truths,
            masks=frame.masks,
            masks_visib=frame.masks_visib,
            mask_origin_px=frame.mask_origin_px,
            T_cam_world=frame.T_cam_world if job.plan.shares_layout else None,
        )
        return files.write(im_id, record)

    def close(self) -> None:
        """Free the engines."""
        self._maker.close()


def write_dataset(
    root: str | Path,
    config: SynthConfig,
    meshes: Mapping[int, Mesh],
    plan: FramePlan,
    *,
    assets: Assets | None = None,
    infos: Mapping[int, ModelInfo] | None = None,
    workers: int = 1,
    on_frame: Callable[[int, int], None] = lambda scene_id, im_id: None,
) -> None:
    """Render a BOP dataset; a folder that holds some of its frames already is continued.

    Frames follow the same configuration as training pairs (camera, distance, lights, occluders, backgrounds) but no
    frame is a scene of a pair. The bytes do not depend on the number of workers, nor on how often it was stopped.

    Args:
        root: Dataset folder.
        config: Recipe; its patch and hypothesis settings are without effect.
        meshes: Objects by id.
        plan: Which images.
        assets: Photographs, panoramas, occluder meshes.
        infos: Symmetries for models_info.json.
        workers: Processes that render; 1 renders in this one.
        on_frame: Called with scene and image id of every frame that is on disk.

    Raises:
        ConfigError: A scene cannot be drawn, or an image is to show more objects than there are.
        DatasetError: The folder holds something else.
        StorageError: The folder cannot be written, or another process writes it.
        RenderError: An engine cannot start, or worker processes keep dying.
    """
    folder, assets = Path(root), assets or Assets()
    fewest, instances = config.frames.objects[0], config.frames.instances
    if fewest > len(meshes) * instances:
        raise ConfigError(
            f"frames.objects starts at {fewest}, but {len(meshes)} objects at most {instances} times each are fewer; "
            "give more of --object, raise frames.instances or lower --objects-per-frame"
        )
    with lock.held(str(folder)):
        _claim(folder, config, meshes, plan, assets)
        _sweep(folder)
        write_models(folder, meshes, infos)
        targets = make_targets(meshes, config, assets)
        job = FrameJob(
            root=folder,
            config=config,
            meshes=meshes,
            assets=assets,
            plan=plan,
            depth_scale=_depth_scale(config, targets),
            threads=0 if workers == 1 else max(1, len(os.sched_getaffinity(0)) // workers),
        )
        if not (folder / "camera.json").exists():
            write_camera(folder, config.camera.camera(), job.depth_scale)
        with _rendering(job, workers) as rendered:
            _write_scenes(job, rendered, on_frame)
        if plan.split not in _JPG_SPLITS:
            write_targets(folder, plan.split, _targets(folder, config, plan))


Rendered = Callable[[Iterable[Address]], Iterator[tuple[Address, FrameEntry]]]


def _write_scenes(job: FrameJob, rendered: Rendered, on_frame: Callable[[int, int], None]) -> None:
    """Render what is missing; a scene's JSON files are written with its last frame, or when the run ends early."""
    writers: dict[int, BopWriter] = {}
    left: dict[int, int] = {}

    def missing() -> Iterator[Address]:
        for scene_id, count in job.plan.scenes():
            writer = BopWriter(
                job.root, job.plan.split, scene_id, depth_scale=job.depth_scale, image_format=job.image_format
            )
            done = set(writer.im_ids)
            for im_id in sorted(done):
                on_frame(scene_id, im_id)
            addresses = [(scene_id, im_id) for im_id in range(count) if im_id not in done]
            if addresses:
                writers[scene_id], left[scene_id] = writer, len(addresses)
                yield from addresses
            else:
                writer.close()

    try:
        for (scene_id, im_id), entry in rendered(missing()):
            writers[scene_id].commit(im_id, entry)
            left[scene_id] -= 1
            if not left[scene_id]:
                writers.pop(scene_id).close()
            on_frame(scene_id, im_id)
    finally:
        for writer in writers.values():
            writer.close()


@contextmanager
def _rendering(job: FrameJob, workers: int) -> Iterator[Rendered]:
    """A function that renders frames and yields them as they are done."""
    if workers > 1:
        with Pool(job, workers) as pool:
            yield pool.rendered
        return
    renderer: list[FrameRenderer] = []  # made at the first frame: a dataset that is complete needs none

    def rendered(addresses: Iterable[Address]) -> Iterator[tuple[Address, FrameEntry]]:
        for address in addresses:
            if not renderer:
                renderer.append(FrameRenderer(job))
            yield address, renderer[0].write(*address)

    try:
        yield rendered
    finally:
        for made in renderer:
            made.close()


class Pool:
    """Processes that render frames; ones that die are replaced, and their frames are rendered again."""

    def __init__(self, job: FrameJob, workers: int) -> None:
        self._job, self._workers = job, workers
        self._executor: ProcessPoolExecutor | None = None

    def __enter__(self) -> "Pool":
        return self

    def __exit__(self, *_: object) -> None:
        self._stop()

    def rendered(self, addresses: Iterable[Address]) -> Iterator[tuple[Address, FrameEntry]]:
        """Render frames, in any order.

        Raises:
            RenderError: Processes keep dying.
        """
        following, running = iter(addresses), list[Address]()
        crashes = 0
        while True:
            try:
                for address, entry in self._until_crash(chain(tuple(running), following), running):
                    running.remove(address)
                    crashes = 0
                    yield address, entry
                return
            except BrokenProcessPool as error:
                crashes += 1
                self._stop()
                _sweep(self._job.root)
                if crashes == _CRASHES:
                    raise RenderError(
                        f"a worker process died {_CRASHES} times (out of memory, or a crash in the renderer) around "
                        f"scene {running[0][0]}, image {running[0][1]}; start the same command again with fewer "
                        "--workers or another --engine"
                    ) from error

    def _until_crash(
        self, addresses: Iterator[Address], running: list[Address]
    ) -> Iterator[tuple[Address, FrameEntry]]:
        futures: dict[Future[FrameEntry], Address] = {}

        def submit() -> None:
            address = next(addresses, None)
            if address is not None:
                if address not in running:
                    running.append(address)
                futures[self._started().submit(_write, *address)] = address

        for _ in range(_AHEAD * self._workers):
            submit()
        while futures:
            done, _ = wait(futures, return_when=FIRST_COMPLETED)
            for future in done:
                entry = future.result()
                yield futures.pop(future), entry
                submit()

    def _started(self) -> ProcessPoolExecutor:
        if self._executor is None:
            self._executor = ProcessPoolExecutor(
                self._workers,
                mp_context=multiprocessing.get_context("spawn"),  # a forked Blender is undefined
                initializer=_start,
                initargs=(self._job,),
            )
            with interrupts_ignored():  # a terminal sends ctrl-C to all; only this process may stop the run
                for _ in range(self._workers):
                    self._executor.submit(os.getpid)
        return self._executor

    def _stop(self) -> None:
        if self._executor is not None:
            self._executor.shutdown(wait=True, cancel_futures=True)
            self._executor = None


class _Worker:
    """What a worker process holds: the job, and its renderer from the first frame on."""

    job: FrameJob
    renderer: FrameRenderer | None = None


def _start(job: FrameJob) -> None:
    behave_as_worker()
    forget_blenders_paths()
    _Worker.job = job


def _write(scene_id: int, im_id: int) -> FrameEntry:
    if _Worker.renderer is None:
        _Worker.renderer = FrameRenderer(_Worker.job)
    return _Worker.renderer.write(scene_id, im_id)


def _depth_scale(config: SynthConfig, targets: Iterable[Target]) -> float:
    """0.1 mm, BOP's usual step, unless something may lie farther than 16 bits reach with it."""
    farthest_m = max(t.distance_m[1] + t.reach_m for t in targets)
    extent = max(t.distance_m[1] for t in targets) * (config.frames.objects[1] > 1)
    return 0.1 if farthest_m + extent < 0.1e-3 * _FARTHEST_STEP else 1.0


def _targets(folder: Path, config: SynthConfig, plan: FramePlan) -> list[Any]:
    return [
        target
        for scene_id, _ in plan.scenes()
        for target in visible_targets(folder, plan.split, scene_id, config.frames.min_target_visible)
    ]


def _sweep(folder: Path) -> None:
    """Remove what writes left behind that a kill cut short."""
    for leftover in folder.rglob(".*.tmp"):
        leftover.unlink(missing_ok=True)


def _claim(folder: Path, config: SynthConfig, meshes: Mapping[int, Mesh], plan: FramePlan, assets: Assets) -> None:
    """Write what the dataset is, or check that the folder holds this very dataset."""
    card: dict[str, Any] = {
        **asdict(plan),
        **assets.card(),
        "objects": {str(i): {"name": Path(m.path).name, "sha256": m.sha256} for i, m in sorted(meshes.items())},
        "config": config_tools.to_dict(config),
        "versions": versions(config),
    }
    file = folder / CARD
    try:
        if file.is_file():
            stored = json.loads(file.read_text(encoding="utf-8"))
            stored["config"] = migrate(stored.get("config", {}))
            different = [k for k in card if stored.get(k) != json.loads(json.dumps(card[k]))]
            if different:
                raise DatasetError(
                    f"{folder}: holds another dataset (its {', '.join(different)} differ); choose another --out, or "
                    "delete that folder, or start with the same settings to continue it"
                )
            return
        if folder.is_dir() and any(not p.name.endswith(".tmp") for p in folder.iterdir()):
            raise DatasetError(
                f"{folder}: the folder is not empty and holds no dataset of synthgen; choose another --out"
            )
    except OSError as error:
        raise storage_error(folder, error) from error
    except json.JSONDecodeError as error:
        raise DatasetError(f"{file}: is damaged; delete the folder and render it again") from error
    write_atomic(file, (json.dumps(card, indent=2) + "\n").encode())
