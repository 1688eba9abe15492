"""Whole camera images with ground truth in BOP's layout, for evaluation or training."""

import json
import os
from collections.abc import Callable, Generator, Iterator, Mapping, Sequence
from contextlib import closing, suppress
from dataclasses import asdict, dataclass
from functools import partial
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
from posecore.errors import ConfigError, DatasetError
from posecore.files import storage_error, write_atomic
from posecore.mesh import Mesh
from posecore.processes import behave_as_worker, map_unordered
from posecore.text import printable

from synthgen import lock
from synthgen.bop.card import CARD, read_card
from synthgen.bop.frame_maker import FrameMaker, FramePlan
from synthgen.config import SynthConfig, migrate
from synthgen.draw.target import TargetObject, make_targets
from synthgen.engines.blender import scratch
from synthgen.engines.blender.paths import forget_blenders_paths
from synthgen.inputs.assets import Assets
from synthgen.pairs.data_card import DEPTH_STEPS_A_DIAMETER, versions
from synthgen.pairs.pair_maker import limit_threads

_MAX_DEPTH_STEP = 65535
_JPG_SPLITS = ("train_pbr",)  # BOP's training images are JPEG, its test images PNG
_CRASHES = 3  # consecutive deaths of worker processes, without a frame in between, that end the run
_AHEAD = 2  # frames queued per worker

Address = tuple[int, int]


@dataclass(frozen=True, kw_only=True, eq=False)
class FrameJob:
    """Input of a process that renders frames; it can be pickled.

    Attributes:
        root: Dataset folder.
        config: Configuration.
        meshes: Meshes by object id.
        assets: Photographs, panoramas, occluder meshes.
        plan: Images of the dataset.
        depth_scale: Millimetres per step of the depth images.
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
        """File extension of the colour images."""
        return "jpg" if self.plan.split in _JPG_SPLITS else "png"


class FrameRenderer:
    """Renders frames of a job and writes their files; the engines live as long as the renderer."""

    def __init__(self, job: FrameJob) -> None:
        self._job = job
        limit_threads(job.threads)
        self._maker = FrameMaker(
            job.config, make_targets(job.meshes, job.config, job.assets), job.assets, job.plan, threads=job.threads
        )

    def write(self, scene_id: int, im_id: int) -> FrameEntry:
        """Render a frame and write its files; the caller commits the returned entry."""
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
            gts=frame.gts,
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
    """Render a BOP dataset; a folder with a part of its frames is continued.

    Frames follow the same configuration as training pairs (camera, distance, lights, occluders, backgrounds) but no
    frame is a scene of a pair. The bytes depend neither on the number of workers nor on interruptions.

    Args:
        root: Dataset folder.
        config: Configuration; its patch and hypothesis settings are without effect.
        meshes: Meshes by object id.
        plan: Images of the dataset.
        assets: Photographs, panoramas, occluder meshes.
        infos: Symmetries for models_info.json.
        workers: Number of processes that render; 1 renders in this process.
        on_frame: Called with scene and image id of every frame on disk.

    Raises:
        ConfigError: No acceptable scene exists, or `frames.objects` exceeds the number of objects.
        DatasetError: The folder holds another dataset or other files.
        StorageError: The folder cannot be written, or another process writes it.
        RenderError: An engine cannot start, or worker processes die repeatedly.
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
        _write_scenes(job, workers, on_frame)
        if plan.split not in _JPG_SPLITS:
            write_targets(folder, plan.split, _targets(folder, config, plan))


def _write_scenes(job: FrameJob, workers: int, on_frame: Callable[[int, int], None]) -> None:
    """Render the missing frames; a scene's JSON files are written with its last frame, or when the run ends early."""
    writers: dict[int, BopWriter] = {}
    remaining: dict[int, int] = {}

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
                writers[scene_id], remaining[scene_id] = writer, len(addresses)
                yield from addresses
            else:
                writer.close()

    try:
        with closing(_rendered(job, missing(), workers)) as frames:
            for (scene_id, im_id), entry in frames:
                writers[scene_id].commit(im_id, entry)
                remaining[scene_id] -= 1
                if not remaining[scene_id]:
                    writers.pop(scene_id).close()
                on_frame(scene_id, im_id)
    finally:
        for writer in writers.values():
            writer.close()


def _rendered(job: FrameJob, addresses: Iterator[Address], workers: int) -> Generator[tuple[Address, FrameEntry]]:
    """Frames with their entries as they are complete; a complete dataset starts neither engine nor process."""
    first = next(addresses, None)
    if first is None:
        return
    if workers > 1:
        remove_leftovers = partial(_remove_leftovers, job.root)
        try:
            yield from map_unordered(
                _write,
                chain((first,), addresses),
                workers,
                start=_start,
                arguments=(job,),
                died=_crash_message,
                ahead=_AHEAD,
                attempts=_CRASHES,
                on_crash=remove_leftovers,
            )
        except BaseException:
            with suppress(OSError):
                remove_leftovers()  # the processes were ended at once
            raise
        return
    renderer = FrameRenderer(job)
    try:
        for address in chain((first,), addresses):
            yield address, renderer.write(*address)
    finally:
        renderer.close()


def _crash_message(address: Address) -> str:
    return (
        f"a worker process died {_CRASHES} times (out of memory, or a crash in the renderer) around scene "
        f"{address[0]}, image {address[1]}; start the same command again with fewer --workers or another --engine"
    )


class _Worker:
    """State of a worker process: the job, and the renderer from the first frame on."""

    job: FrameJob
    renderer: FrameRenderer | None = None


def _start(job: FrameJob) -> None:
    behave_as_worker()
    forget_blenders_paths()
    _Worker.job = job


def _write(address: Address) -> FrameEntry:
    if _Worker.renderer is None:
        _Worker.renderer = FrameRenderer(_Worker.job)
    return _Worker.renderer.write(*address)


def _depth_scale(config: SynthConfig, targets: Sequence[TargetObject]) -> float:
    """Depth step in millimetres: 0.1 (BOP's default), or a power of ten.

    Larger where depths may exceed 16 bits, smaller where an object is less than 200 steps wide.
    """
    extent = max(t.distance_m[1] for t in targets) * (config.frames.objects[1] > 1)
    farthest_mm = (max(t.distance_m[1] + t.reach_m for t in targets) + extent) * 1e3
    smallest_mm = min(t.mesh.diameter_m for t in targets) * 1e3
    power = -1
    while farthest_mm >= _MAX_DEPTH_STEP * 10.0**power:
        power += 1
    while smallest_mm < DEPTH_STEPS_A_DIAMETER * 10.0**power and farthest_mm < _MAX_DEPTH_STEP * 10.0 ** (power - 1):
        power -= 1
    return float(10.0**power)


def _targets(folder: Path, config: SynthConfig, plan: FramePlan) -> list[Any]:
    return [
        target
        for scene_id, _ in plan.scenes()
        for target in visible_targets(folder, plan.split, scene_id, config.frames.min_target_visible)
    ]


def _sweep(folder: Path) -> None:
    """Remove temporary files of interrupted writes."""
    for leftover in folder.rglob(".*.tmp"):
        leftover.unlink(missing_ok=True)


def _remove_leftovers(folder: Path) -> None:
    """Remove what killed processes leave: the renderers' folders and temporary files."""
    scratch.sweep()
    _sweep(folder)


def _claim(folder: Path, config: SynthConfig, meshes: Mapping[int, Mesh], plan: FramePlan, assets: Assets) -> None:
    """Write the dataset's card, or check that the folder has the same card."""
    card: dict[str, Any] = {
        **asdict(plan),
        **assets.card(),
        "objects": {
            str(i): {"name": printable(Path(m.path).name), "sha256": m.sha256} for i, m in sorted(meshes.items())
        },
        "config": config_tools.to_dict(config),
        "versions": versions(config),
    }
    file = folder / CARD
    try:
        if file.is_file():
            stored = read_card(folder)
            stored["config"] = migrate(stored["config"])
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
    write_atomic(file, (json.dumps(card, indent=2) + "\n").encode())
