"""Refinement of images in parallel processes, each with its own instance of the method."""

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

from posecore.bop import BopDataset
from posecore.processes import behave_as_worker, in_order, spawned

from refinenet.data.loader import prepare_worker
from refinenet.models import checkpoint as checkpoints
from refinenet.refine.image_poses import ImagePoses, ImageResults, refine_images
from refinenet.refine.registry import MethodSettings, make_refiner
from refinenet.refiner import PoseRefiner

AHEAD = 2
"""Images per process that are refined before they are requested."""


@dataclass(frozen=True, kw_only=True)
class WorkerSettings:
    """Input of a worker process.

    Attributes:
        method: Method and settings.
        dataset: BOP dataset with the meshes and images.
        split: Split folder.
        obj_ids: Objects.
        threads: Torch threads of the process; 0 means 1.
    """

    method: MethodSettings
    dataset: Path
    split: str
    obj_ids: tuple[int, ...]
    threads: int


@contextmanager
def refine_images_in_workers(
    settings: WorkerSettings, images: Sequence[ImagePoses], workers: int
) -> Iterator[Iterator[ImageResults]]:
    """The results of `refine_images`, in the same order, from worker processes.

    Raises:
        RenderError: A process died.
    """
    died = (
        f"{settings.dataset}: a process that refined its images died (out of memory, or a crash in the renderer); "
        "start again with fewer --workers"
    )
    with spawned(workers, _start_worker, (settings,), died) as pool:
        yield in_order(pool, _refine_in_worker, images, AHEAD * workers)


class _Worker:
    """State of a worker process: settings, and the dataset and method, which the first image creates."""

    settings: WorkerSettings
    opened: tuple[BopDataset, PoseRefiner] | None = None


def _start_worker(settings: WorkerSettings) -> None:
    behave_as_worker()
    prepare_worker(max(settings.threads, 1))
    _Worker.settings = settings


def _refine_in_worker(image: ImagePoses) -> ImageResults:
    if _Worker.opened is None:  # here, not at the start of the process, so that an error reaches the user
        settings = _Worker.settings
        dataset = BopDataset(settings.dataset, settings.split)
        checkpoint = settings.method.checkpoint
        loaded = None if checkpoint is None else checkpoints.load(checkpoint)
        meshes = {i: dataset.mesh(i) for i in settings.obj_ids}
        _Worker.opened = (dataset, make_refiner(settings.method, meshes, loaded))
    (results,) = refine_images(*_Worker.opened, [image])
    return results
