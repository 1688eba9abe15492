"""A result file with the errors of its poses."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import pandas as pd
from jaxtyping import Float

from evalkit.evaluation.evaluator import Evaluator, Progress
from evalkit.inputs.pairing import pair_up
from evalkit.inputs.result_files import ResultFile
from evalkit.scores import bop24_precision, with_bop19

Array = np.ndarray
NO_POSE = np.full((4, 4), np.nan)
CaseKey = tuple[int, int, int, float, float, int]
"""Scene, image, position of the truth, start angle and translation (-1 for none), and how many alike came before."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Scored:
    """A result file with the errors of its poses, all in the same order.

    Attributes:
        file: what was read.
        table: see `evalkit.error_table`.
        T_est: (n, 4, 4) estimates `T_cam_obj`, metres, NaN where missing.
        T_gt: (n, 4, 4) true poses.
        ignored: lines that belong to no expected pose.
        precision: BOP24's average precision of all lines, see `scores.bop24_precision`; empty for perturbed starts.
    """

    file: ResultFile
    table: pd.DataFrame
    T_est: Float[Array, "n 4 4"]
    T_gt: Float[Array, "n 4 4"]
    ignored: int
    precision: dict[str, Any] = field(default_factory=dict)

    def cases(self) -> dict[CaseKey, int]:
        """Row of each pose under a key that other result files share."""
        key = self.table[["scene_id", "im_id", "gt_index"]].copy()
        key["angle"] = self.table.start_angle_deg.fillna(-1.0)
        key["translation"] = self.table.start_translation_diameter.fillna(-1.0)
        nth = key.groupby(list(key.columns), sort=False).cumcount() + 1
        keys = zip(*(key[name].tolist() for name in key), nth.tolist(), strict=True)
        return {values: row for row, values in enumerate(keys)}


def score_file(
    evaluator: Evaluator, file: ResultFile, start: Callable[[int], Progress] = lambda total: lambda done: None
) -> Scored:
    """Errors of a result file's poses, with BOP's own matching beside them (but for perturbed starts).

    Args:
        evaluator: of the dataset.
        file: that was read.
        start: is told how many poses there are, and returns what is called with the number done since the last call.

    Raises:
        PoseError: the file's sidecar or the dataset is not usable; the message names it.
    """
    pairing = pair_up(evaluator.dataset, file)
    table, precision = evaluator.evaluate(pairing.pairs, start(len(pairing.pairs))), {}
    if "perturbation" not in file.sidecar:
        everything = evaluator.all_errors(file.estimates, known=(pairing.pairs, table))
        table, precision = with_bop19(table, everything), bop24_precision(everything)
    return Scored(
        file=file,
        table=table,
        T_est=_stacked([NO_POSE if pair.estimate is None else pair.estimate.T_cam_obj for pair in pairing.pairs]),
        T_gt=_stacked([pair.truth.T_cam_obj for pair in pairing.pairs]),
        ignored=pairing.ignored,
        precision=precision,
    )


def _stacked(poses: Sequence[Array]) -> Float[Array, "n 4 4"]:
    return np.array(poses, np.float64).reshape(-1, 4, 4)
