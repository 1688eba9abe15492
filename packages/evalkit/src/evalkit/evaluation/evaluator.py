"""From a dataset and result files to the error table: one row for every expected pose, found or missing."""

from collections import defaultdict
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import FIRST_COMPLETED, Future, ProcessPoolExecutor, wait
from concurrent.futures.process import BrokenProcessPool
from contextlib import ExitStack
from pathlib import Path
from types import TracebackType
from typing import Any, Literal

import numpy as np
import pandas as pd
from jaxtyping import Float
from posecore.bop import BopDataset, Estimate, GroundTruth
from posecore.camera import Camera
from posecore.errors import RenderError
from posecore.mesh import Mesh
from posecore.processes import behave_as_worker, spawned
from posecore.raster import Rasteriser

from evalkit.error_table import table_of
from evalkit.inputs.pairing import MatchedPose, pair_up
from evalkit.inputs.result_files import load_result_files
from evalkit.pose_errors.metrics import VSD_COLUMNS
from evalkit.pose_errors.scorer import Scorer
from evalkit.scores.bop_matching import AllErrors, with_bop19

VssKind = Literal["full", "visible"]
Progress = Callable[[int], None]
BLOCK = 1024
"""Number of pairs in a block: the renders held at once, and one task of a worker."""

INSTANCE_COLUMNS = (
    *("scene_id", "im_id", "obj_id", "gt_index", "visib_fract"),
    *("inst_count", "diameter_m", "image_width_px"),
)


def evaluate(
    dataset: str | Path, results: str | Path, *, vss: VssKind = "full", with_vsd: bool = True, workers: int = 1
) -> pd.DataFrame:
    """Errors of the poses in a result file: one row for each expected pose, found or missing.

    `evalkit.scores.scores(table)` gives means, medians and recalls; `evalkit.error_table.COLUMNS` describes each column
    with its unit. Further columns are `vsd_0.05` ... `vsd_0.50` where images have depth (VSD at these tolerances in
    diameters, NaN for images without), and `bop19_mssd`, `bop19_mspd` and, where all images have depth, `bop19_vsd`:
    the fraction of BOP19's thresholds at which BOP's matching assigns an estimate to the instance. Files of perturbed
    initial poses have no `bop19_*` columns.

    Args:
        dataset: folder in BOP format with ground truth.
        results: BOP result file (CSV), translations in millimetres.
        vss: whole silhouettes, or their visible parts, which needs depth images.
        with_vsd: whether VSD is computed where there is depth.
        workers: number of processes; the values do not depend on it. They import the calling script, which therefore
            has to call this function under `if __name__ == "__main__":`.

    Raises:
        PoseError: a file or the dataset is not usable; the message names it.
    """
    opened = BopDataset(dataset)
    (file,) = load_result_files([Path(results)], opened)
    with Evaluator(opened, vss, with_vsd=with_vsd, workers=workers) as evaluator:
        pairs = pair_up(opened, file).pairs
        table = evaluator.evaluate(pairs)
        if "perturbation" in file.sidecar:
            return table
        return with_bop19(table, evaluator.all_errors(file.estimates, scored=(pairs, table)))


class Evaluator:
    """Errors of pairs against one dataset; ground-truth silhouettes are rendered once for all result files."""

    def __init__(self, dataset: BopDataset, vss: VssKind = "full", *, with_vsd: bool = True, workers: int = 1) -> None:
        """Open a renderer for the dataset's models (`models_eval` where there is one).

        Args:
            dataset: with ground truth.
            vss: whole silhouettes, or their visible parts, which needs depth images.
            with_vsd: whether VSD is added where an image has depth, in columns `vsd_0.05` ... `vsd_0.50`.
            workers: number of processes that score; the values do not depend on it.
        """
        self.dataset, self.vss, self.with_vsd, self.workers = dataset, vss, with_vsd, workers
        self._scorer = Scorer(dataset, visible=vss == "visible", with_vsd=with_vsd)
        self._pool: ProcessPoolExecutor | None = None
        self._closing = ExitStack()
        self._closing.callback(self._scorer.rasteriser.close)

    def __enter__(self) -> "Evaluator":
        """Use in a with statement."""
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, at: TracebackType | None) -> None:
        """Free the renderer and end the workers."""
        self._closing.__exit__(kind, error, at)

    @property
    def rasteriser(self) -> Rasteriser:
        """Renderer with the meshes of all objects scored so far."""
        return self._scorer.rasteriser

    def evaluate(self, pairs: Sequence[MatchedPose], advance: Progress = lambda done: None) -> pd.DataFrame:
        """Score pairs, in their order; `advance` is called with the number of pairs done since the last call.

        Memory beside the table does not grow with the number of pairs: they are scored in blocks, image by image.

        Raises:
            DatasetError: a model is missing, or VSS of visible parts needs depth that an image does not have.
        """
        if not pairs:
            return table_of({})
        order = sorted(range(len(pairs)), key=lambda index: (pairs[index].scene_id, pairs[index].im_id))
        size = min(BLOCK, -(-len(pairs) // self.workers))
        blocks = [[pairs[index] for index in order[start : start + size]] for start in range(0, len(pairs), size)]
        parts: list[pd.DataFrame | None] = [None] * len(blocks)
        for number, part in self._scored(blocks):
            parts[number] = part
            advance(len(part))
        table = pd.concat([part for part in parts if part is not None], ignore_index=True)
        table = table.iloc[np.argsort(order)].reset_index(drop=True)
        if self.with_vsd and table[list(VSD_COLUMNS)].isna().all(axis=None):
            table = table.drop(columns=list(VSD_COLUMNS))
        return table

    def _scored(self, blocks: Sequence[Sequence[MatchedPose]]) -> Iterator[tuple[int, pd.DataFrame]]:
        """Each block's number and its table, in order of completion."""
        if self.workers == 1 or len(blocks) == 1:
            yield from ((number, self._scorer.score(block)) for number, block in enumerate(blocks))
            return
        died = (
            f"a process that scored {self.dataset.root} died (out of memory, or a crash in the renderer); "
            "start the same command again with fewer --workers"
        )
        if self._pool is None:
            arguments = (self.dataset.root, self.dataset.split, self.dataset.sensor, self.vss, self.with_vsd)
            self._pool = self._closing.enter_context(spawned(self.workers, _start_worker, arguments, died))
        waiting = dict(reversed(list(enumerate(blocks))))
        running: dict[Future[pd.DataFrame], int] = {}
        while waiting or running:
            while waiting and len(running) <= self.workers:  # one more than run, so that none waits for its pairs
                number, block = waiting.popitem()
                centers_m = {obj_id: self.dataset.center_m(obj_id) for obj_id in {pair.gt.obj_id for pair in block}}
                running[self._pool.submit(_score_in_worker, block, centers_m)] = number
            for future in wait(running, return_when=FIRST_COMPLETED).done:
                try:
                    yield running.pop(future), future.result()
                except BrokenProcessPool as error:
                    raise RenderError(died) from error

    def all_errors(
        self, estimates: Sequence[Estimate], scored: tuple[Sequence[MatchedPose], pd.DataFrame] | None = None
    ) -> AllErrors:
        """Every estimate in the targets' images against every instance of its object, for BOP19's and BOP24's matching.

        Args:
            estimates: of a result file; those in other images are left out.
            scored: pairs of these estimates scored before, and the table that `evaluate` returned for the pairs.
        """
        counts = {(t.scene_id, t.im_id, t.obj_id): t.inst_count for t in self.dataset.targets}
        images = list(dict.fromkeys(key[:2] for key in counts))
        instances = [
            (*image, gt)
            for image in images
            for gt in self._scorer.gt(*image)
            if gt.has_pose and gt.obj_id in self.dataset.models_info
        ]
        image_set = set(images)
        kept = [estimate for estimate in estimates if (estimate.scene_id, estimate.im_id) in image_set]
        pairs, indices = _all_pairs(kept, instances)
        errors = self._reusing(pairs, scored)
        columns = ["mssd_m", "mspd_px", *(name for name in VSD_COLUMNS if name in errors)]
        errors = errors[columns].copy()
        if not errors.reindex(columns=list(VSD_COLUMNS)).notna().all(axis=None):
            errors = errors[["mssd_m", "mspd_px"]]  # images without depth: no recall of VSD
        errors.insert(0, "estimate", np.array([estimate for estimate, _ in indices], np.int64))
        errors.insert(1, "instance", np.array([instance for _, instance in indices], np.int64))
        return AllErrors(
            estimates=pd.DataFrame(
                [(e.scene_id, e.im_id, e.obj_id, e.line, e.score) for e in kept],
                columns=["scene_id", "im_id", "obj_id", "line", "score"],
            ),
            instances=pd.DataFrame(
                [self._instance_row(scene_id, im_id, gt, counts) for scene_id, im_id, gt in instances],
                columns=list(INSTANCE_COLUMNS),
            ),
            errors=errors,
        )

    def _reusing(
        self, pairs: Sequence[MatchedPose], scored: tuple[Sequence[MatchedPose], pd.DataFrame] | None
    ) -> pd.DataFrame:
        """`evaluate`, with the rows of pairs scored before taken over."""
        if scored is None:
            return self.evaluate(pairs)
        before, table = scored
        rows = {(id(pair.estimate), pair.gt.gt_index): row for row, pair in enumerate(before) if pair.estimate}
        row_of_pair = np.array([rows.get((id(pair.estimate), pair.gt.gt_index), -1) for pair in pairs], np.int64)
        is_new = row_of_pair < 0
        new = self.evaluate([pair for pair, needed in zip(pairs, is_new.tolist(), strict=True) if needed])
        row_of_pair[is_new] = len(table) + np.arange(len(new))
        return pd.concat([table, new], ignore_index=True).iloc[row_of_pair].reset_index(drop=True)

    def _instance_row(
        self, scene_id: int, im_id: int, gt: GroundTruth, counts: Mapping[tuple[int, int, int], int]
    ) -> tuple[Any, ...]:
        visible = np.nan if gt.visib_fract is None else gt.visib_fract
        count = counts.get((scene_id, im_id, gt.obj_id), 0)
        diameter_m = self.dataset.models_info[gt.obj_id].diameter_m
        width_px = self.camera(scene_id, im_id).width_px
        return scene_id, im_id, gt.obj_id, gt.gt_index, visible, count, diameter_m, width_px

    def camera(self, scene_id: int, im_id: int) -> Camera:
        """Intrinsics of an image."""
        return self._scorer.camera(scene_id, im_id)

    def mesh(self, obj_id: int) -> Mesh:
        """The model that errors are measured on."""
        return self._scorer.model(obj_id).mesh


def _all_pairs(
    estimates: Sequence[Estimate], instances: Sequence[tuple[int, int, GroundTruth]]
) -> tuple[list[MatchedPose], list[tuple[int, int]]]:
    """Every estimate with every instance of its object in its image, and the indices of both."""
    by_target: dict[tuple[int, int, int], list[int]] = defaultdict(list)
    for index, (scene_id, im_id, gt) in enumerate(instances):
        by_target[scene_id, im_id, gt.obj_id].append(index)
    pairs, indices = [], []
    for number, estimate in enumerate(estimates):
        for index in by_target.get((estimate.scene_id, estimate.im_id, estimate.obj_id), []):
            scene_id, im_id, gt = instances[index]
            pairs.append(MatchedPose(scene_id=scene_id, im_id=im_id, gt=gt, estimate=estimate))
            indices.append((number, index))
    return pairs, indices


_worker: Scorer | None = None


def _start_worker(root: Path, split: str, sensor: str | None, vss: VssKind, with_vsd: bool) -> None:
    global _worker
    behave_as_worker()
    _worker = Scorer(BopDataset(root, split, sensor), visible=vss == "visible", with_vsd=with_vsd)


def _score_in_worker(block: Sequence[MatchedPose], centers_m: Mapping[int, Float[np.ndarray, "3"]]) -> pd.DataFrame:
    assert _worker is not None
    _worker.centers_m.update(centers_m)
    return _worker.score(block)
