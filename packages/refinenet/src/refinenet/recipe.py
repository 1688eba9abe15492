"""What `refinenet refine` makes its method from, and the processes that refine images side by side with it."""

import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

from posecore.bop import BopDataset
from posecore.processes import behave_as_worker, in_order, spawned

from refinenet import checkpoint as checkpoints
from refinenet.checkpoint import Checkpoint
from refinenet.data import prepare_worker
from refinenet.estimates import OfImage, Results, load_frame
from refinenet.methods import NETWORK, PoseRefiner, make_baseline
from refinenet.pool import PooledRefiner, PoolScorer
from refinenet.refine import Refiner

AHEAD = 2
"""Images a process that are refined before they are asked for."""


@dataclass(frozen=True, kw_only=True)
class Recipe:
    """A method and its settings.

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


def refined_here(bop: BopDataset, method: PoseRefiner, images: Sequence[OfImage]) -> Iterator[Results]:
    """Results of image after image, as they are asked for."""
    for image in images:
        frame = load_frame(bop, image.scene_id, image.im_id, method)
        begun = time.perf_counter()
        found = method.refine_batch(frame, image.requests)
        yield Results(found=tuple(found), taken_s=time.perf_counter() - begun)


@contextmanager
def refined_by_workers(recipe: Recipe, images: Sequence[OfImage], workers: int) -> Iterator[Iterator[Results]]:
    """The same, in the same order, from processes that each make the method for themselves.

    Raises:
        RenderError: One died.
    """
    died = (
        f"{recipe.dataset}: a process that refined its images died (out of memory, or a crash in the renderer); "
        "start again with fewer --workers"
    )
    with spawned(min(workers, len(images)), _start_worker, (recipe,), died) as pool:
        yield in_order(pool, _in_worker, images, AHEAD * workers)


_worker: list[tuple[BopDataset, PoseRefiner]] = []


def _start_worker(recipe: Recipe) -> None:
    behave_as_worker()
    prepare_worker(max(recipe.threads, 1))
    bop = BopDataset(recipe.dataset, recipe.split)
    loaded = None if recipe.checkpoint is None else checkpoints.load(recipe.checkpoint)
    _worker[:] = [(bop, recipe.make(bop, loaded))]


def _in_worker(image: OfImage) -> Results:
    (results,) = refined_here(*_worker[0], [image])
    return results
