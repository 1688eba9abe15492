"""Dataset and result files to a table: one row for every expected pose, found or missing."""

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
from posecore.bop import BopDataset, Estimate, GroundTruth
from posecore.camera import Camera
from posecore.errors import RenderError
from posecore.mesh import Mesh
from posecore.processes import behave_as_worker, spawned
from posecore.raster import Rasteriser

from evalkit.error_table import table_of
from evalkit.inputs.pairing import Pair, pair_up
from evalkit.inputs.result_files import load_result_files
from evalkit.pose_errors.metrics import VSD_COLUMNS
from evalkit.pose_errors.scorer import Scorer
from evalkit.scores.bop_matching import AllErrors, with_bop19

VssKind = Literal["full", "visible"]
Progress = Callable[[int], None]
BLOCK = 1024
"""Number of pairs whose renders are held at once, and that a worker gets at once."""

TRUTH_COLUMNS = (
    *("scene_id", "im_id", "obj_id", "gt_index", "visib_fract"),
    *("inst_count", "diameter_m", "image_width_px"),
)


def evaluate(
    dataset: str | Path, results: str | Path, *, vss: VssKind = "full", with_vsd: bool = True, workers: int = 1
) -> pd.DataFrame:
    """Errors of the poses in a result file: one row for each expected pose, found or missing.

    `evalkit.scores.scores(table)` sums them up; `evalkit.error_table.COLUMNS` says what each column holds, with its
    unit.
    Beside those columns stand `vsd_0.05` ... `vsd_0.50` where images have depth (VSD at these tolerances in diameters,
    NaN for images without), and `bop19_mssd`, `bop19_mspd` and, where all images have depth, `bop19_vsd`: the share of
    BOP19's thresholds at which BOP's matching gives the instance an estimate. Files of perturbed starts have none.

    Args:
        dataset: folder in BOP format with ground truth.
        results: BOP result file (CSV), translations in millimetres.
        vss: whole silhouettes, or their visible parts, which needs depth images.
        with_vsd: whether VSD is computed where there is depth.
        workers: number of processes; the values do not depend on it. They import the script that calls this, which
            therefore has to do so under `if __name__ == "__main__":`.

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
        return with_bop19(table, evaluator.all_errors(file.estimates, known=(pairs, table)))


class Evaluator:
    """Scores pairs against one dataset; true silhouettes are rendered once for all result files."""

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
        """Has the meshes of all objects asked for so far."""
        return self._scorer.rasteriser

    def evaluate(self, pairs: Sequence[Pair], advance: Progress = lambda done: None) -> pd.DataFrame:
        """Score pairs, in their order; `advance` is called with the number of pairs done since the last call.

        Memory beside the table does not grow with the number of pairs: they are scored in blocks, image by image.

        Raises:
            DatasetError: a model is missing, or VSS of visible parts is wanted and an image has no depth.
        """
        if not pairs:
            return table_of({})
        order = sorted(range(len(pairs)), key=lambda index: (pairs[index].scene_id, pairs[index].im_id))
        size = min(BLOCK, -(-len(pairs) // self.workers))
        blocks = [[pairs[index] for index in order[start : start + size]] for start in range(0, len(pairs), size)]
        parts: list[pd.DataFrame | None] = [None] * len(blocks)
        for place, part in self._scored(blocks):
            parts[place] = part
            advance(len(part))
        table = pd.concat([part for part in parts if part is not None], ignore_index=True)
        table = table.iloc[np.argsort(order)].reset_index(drop=True)
        if self.with_vsd and table[list(VSD_COLUMNS)].isna().all(axis=None):
            table = table.drop(columns=list(VSD_COLUMNS))
        return table

    def _scored(self, blocks: Sequence[Sequence[Pair]]) -> Iterator[tuple[int, pd.DataFrame]]:
        """Each block's place and its table, as they are done."""
        if self.workers == 1 or len(blocks) == 1:
            yield from ((place, self._scorer.score(block)) for place, block in enumerate(blocks))
            return
        died = (
            f"a process that scored {self.dataset.root} died (out of memory, or a crash in the renderer); "
            "start the same command again with fewer --workers"
        )
        if self._pool is None:
            given = (self.dataset.root, self.dataset.split, self.dataset.sensor, self.vss, self.with_vsd)
            self._pool = self._closing.enter_context(spawned(self.workers, _start_worker, given, died))
        waiting = dict(reversed(list(enumerate(blocks))))
        running: dict[Future[pd.DataFrame], int] = {}
        while waiting or running:
            while waiting and len(running) <= self.workers:  # one more than run, so that none waits for its pairs
                place, block = waiting.popitem()
                running[self._pool.submit(_score_in_worker, block)] = place
            for future in wait(running, return_when=FIRST_COMPLETED).done:
                try:
                    yield running.pop(future), future.result()
                except BrokenProcessPool as error:
                    raise RenderError(died) from error

    def all_errors(
        self, estimates: Sequence[Estimate], known: tuple[Sequence[Pair], pd.DataFrame] | None = None
    ) -> AllErrors:
        """Every estimate in the targets' images against every true instance of its object: what BOP19 and BOP24 match.

        Args:
            estimates: of a result file; those in other images are left out.
            known: pairs of these estimates that were scored before, and what `evaluate` returned for them.
        """
        asked = {(t.scene_id, t.im_id, t.obj_id): t.inst_count for t in self.dataset.targets}
        images = list(dict.fromkeys(key[:2] for key in asked))
        truths = [
            (*image, gt)
            for image in images
            for gt in self._scorer.gt(*image)
            if gt.has_pose and gt.obj_id in self.dataset.models_info
        ]
        wanted = set(images)
        kept = [estimate for estimate in estimates if (estimate.scene_id, estimate.im_id) in wanted]
        places: dict[tuple[int, int, int], list[int]] = defaultdict(list)
        for place, (scene_id, im_id, gt) in enumerate(truths):
            places[scene_id, im_id, gt.obj_id].append(place)
        pairs, ends = [], []
        for index, estimate in enumerate(kept):
            for place in places.get((estimate.scene_id, estimate.im_id, estimate.obj_id), []):
                scene_id, im_id, gt = truths[place]
                pairs.append(Pair(scene_id=scene_id, im_id=im_id, truth=gt, estimate=estimate))
                ends.append((index, place))
        errors = self._reusing(pairs, known)
        columns = ["mssd_m", "mspd_px", *(name for name in VSD_COLUMNS if name in errors)]
        errors = errors[columns].copy()
        if not errors.reindex(columns=list(VSD_COLUMNS)).notna().all(axis=None):
            errors = errors[["mssd_m", "mspd_px"]]  # images without depth: no recall of VSD
        errors.insert(0, "estimate", np.array([end[0] for end in ends], np.int64))
        errors.insert(1, "truth", np.array([end[1] for end in ends], np.int64))
        return AllErrors(
            estimates=pd.DataFrame(
                [(e.scene_id, e.im_id, e.obj_id, e.line, e.score) for e in kept],
                columns=["scene_id", "im_id", "obj_id", "line", "score"],
            ),
            truths=pd.DataFrame(
                [self._truth_row(scene_id, im_id, gt, asked) for scene_id, im_id, gt in truths],
                columns=list(TRUTH_COLUMNS),
            ),
            errors=errors,
        )

    def _reusing(self, pairs: Sequence[Pair], known: tuple[Sequence[Pair], pd.DataFrame] | None) -> pd.DataFrame:
        """`evaluate`, with the rows of pairs that are known taken over."""
        if known is None:
            return self.evaluate(pairs)
        rows = {(id(pair.estimate), pair.truth.gt_index): row for row, pair in enumerate(known[0]) if pair.estimate}
        found = [rows.get((id(pair.estimate), pair.truth.gt_index), -1) for pair in pairs]
        fresh = self.evaluate([pair for pair, row in zip(pairs, found, strict=True) if row < 0])
        place = np.array(found, np.int64)
        place[place < 0] = len(known[1]) + np.arange(len(fresh))
        return pd.concat([known[1], fresh], ignore_index=True).iloc[place].reset_index(drop=True)

    def _truth_row(
        self, scene_id: int, im_id: int, gt: GroundTruth, asked: Mapping[tuple[int, int, int], int]
    ) -> tuple[Any, ...]:
        visible = np.nan if gt.visib_fract is None else gt.visib_fract
        count = asked.get((scene_id, im_id, gt.obj_id), 0)
        diameter_m = self.dataset.models_info[gt.obj_id].diameter_m
        width_px = self.camera(scene_id, im_id).width_px
        return scene_id, im_id, gt.obj_id, gt.gt_index, visible, count, diameter_m, width_px

    def camera(self, scene_id: int, im_id: int) -> Camera:
        """Intrinsics of an image."""
        return self._scorer.camera(scene_id, im_id)

    def mesh(self, obj_id: int) -> Mesh:
        """The model that errors are measured on."""
        return self._scorer.model(obj_id).mesh


_worker: Scorer | None = None


def _start_worker(root: Path, split: str, sensor: str | None, vss: VssKind, with_vsd: bool) -> None:
    global _worker
    behave_as_worker()
    _worker = Scorer(BopDataset(root, split, sensor), visible=vss == "visible", with_vsd=with_vsd)


def _score_in_worker(block: Sequence[Pair]) -> pd.DataFrame:
    assert _worker is not None
    return _worker.score(block)
