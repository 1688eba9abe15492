"""Images refined one after the other, or side by side by processes that each make the method for themselves."""

import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

from posecore.bop import BopDataset
from posecore.processes import behave_as_worker, in_order, spawned

from refinenet.data.loader import prepare_worker
from refinenet.models import checkpoint as checkpoints
from refinenet.models.checkpoint import Checkpoint
from refinenet.refine.bop_results import ImageStarts, Results, load_frame
from refinenet.refine.multi_hypothesis import PooledRefiner, PoolScorer
from refinenet.refine.network_refiner import Refiner
from refinenet.refiner import NETWORK, PoseRefiner, make_baseline

AHEAD = 2
"""Images a process that are refined before they are asked for."""


@dataclass(frozen=True, kw_only=True)
class MethodSettings:
    """What `refinenet refine` makes its method from.

    Attributes:
        dataset: BOP dataset with the meshes and images.
        split: Its split folder.
        obj_ids: Objects that are asked for.
        method: `network`, or a name of `BASELINES`.
        checkpoint: Network, or None.
        iterations: See `Refiner` and `make_baseline`, as for the next four.
        device: Of the network.
        batch: Most poses in a forward pass.
        allow_other_mesh: Whether a mesh of the same size will do.
        min_confidence: Under it a pose failed; None leaves it to the method.
        hypotheses: See `PooledRefiner`, as for the next two.
        scorer: Of the pool.
        seed: Of the pool.
        threads: Torch threads of each process.
    """

    dataset: Path
    split: str
    obj_ids: tuple[int, ...]
    method: str
    checkpoint: Path | None
    iterations: int
    device: str
    batch: int
    allow_other_mesh: bool
    min_confidence: float | None
    hypotheses: int
    scorer: PoolScorer
    seed: int
    threads: int

    def make(self, bop: BopDataset, loaded: Checkpoint | None) -> PoseRefiner:
        """The method, with the dataset and the checkpoint that were named; see `Refiner` for errors."""
        meshes = {i: bop.mesh(i) for i in self.obj_ids}
        network: Refiner | None = None
        if loaded is not None:
            network = Refiner(
                loaded, meshes, iterations=self.iterations, device=self.device, batch=self.batch,
                allow_other_mesh=self.allow_other_mesh,
                min_confidence=(self.min_confidence or 0.0) if self.method == NETWORK else 0.0,
            )  # fmt: skip
        if network is None or self.method != NETWORK:
            return make_baseline(
                self.method, meshes, self.iterations, network=network, min_confidence=self.min_confidence
            )
        return network if self.hypotheses == 1 else PooledRefiner(network, self.hypotheses, self.scorer, self.seed)


def refined_here(bop: BopDataset, method: PoseRefiner, images: Sequence[ImageStarts]) -> Iterator[Results]:
    """Results of image after image, as they are asked for."""
    for image in images:
        frame = load_frame(bop, image.scene_id, image.im_id, method)
        begun = time.perf_counter()
        found = method.refine_batch(frame, image.requests)
        yield Results(found=tuple(found), taken_s=time.perf_counter() - begun)


@contextmanager
def refined_by_workers(
    settings: MethodSettings, images: Sequence[ImageStarts], workers: int
) -> Iterator[Iterator[Results]]:
    """The same, in the same order, from processes.

    Raises:
        RenderError: One died.
    """
    died = (
        f"{settings.dataset}: a process that refined its images died (out of memory, or a crash in the renderer); "
        "start again with fewer --workers"
    )
    with spawned(workers, _start_worker, (settings,), died) as pool:
        yield in_order(pool, _in_worker, images, AHEAD * workers)


class _Worker:
    """What a process holds: the settings, and what it makes of them for its first image."""

    settings: MethodSettings
    made: tuple[BopDataset, PoseRefiner] | None = None


def _start_worker(settings: MethodSettings) -> None:
    behave_as_worker()
    prepare_worker(max(settings.threads, 1))
    _Worker.settings = settings


def _in_worker(image: ImageStarts) -> Results:
    if _Worker.made is None:  # here, and not at the start, for here an error reaches the user
        settings = _Worker.settings
        bop = BopDataset(settings.dataset, settings.split)
        loaded = None if settings.checkpoint is None else checkpoints.load(settings.checkpoint)
        _Worker.made = (bop, settings.make(bop, loaded))
    (results,) = refined_here(*_Worker.made, [image])
    return results
