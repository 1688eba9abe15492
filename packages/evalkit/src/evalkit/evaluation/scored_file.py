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

NO_POSE = np.full((4, 4), np.nan)
CaseKey = tuple[int, int, int, float, float, int]
"""Scene, image, ground-truth index, initial angle and translation (-1 for none), and the number among equal keys."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Scored:
    """A result file with the errors of its poses, all in the same order.

    Attributes:
        file: result file.
        table: see `evalkit.error_table`.
        T_est: (n, 4, 4) estimates `T_cam_obj`, metres, NaN where missing.
        T_gt: (n, 4, 4) ground-truth poses.
        center_m: (n, 3) centre of each pose's object, object frame, metres.
        ignored: number of lines without an expected pose.
        precision: BOP24's average precision of all lines, see `scores.bop24_precision`; empty for perturbed poses.
    """

    file: ResultFile
    table: pd.DataFrame
    T_est: Float[np.ndarray, "n 4 4"]
    T_gt: Float[np.ndarray, "n 4 4"]
    center_m: Float[np.ndarray, "n 3"]
    ignored: int
    precision: dict[str, Any] = field(default_factory=dict)

    def cases(self) -> dict[CaseKey, int]:
        """Row of each pose by a key that is the same in all result files."""
        key = self.table[["scene_id", "im_id", "gt_index"]].copy()
        key["angle"] = self.table.initial_angle_deg.fillna(-1.0)
        key["translation"] = self.table.initial_translation_diameter.fillna(-1.0)
        nth = key.groupby(list(key.columns), sort=False).cumcount() + 1
        keys = zip(*(key[name].tolist() for name in key), nth.tolist(), strict=True)
        return {values: row for row, values in enumerate(keys)}


def score_file(
    evaluator: Evaluator, file: ResultFile, on_file: Callable[[int], Progress] = lambda total: lambda done: None
) -> Scored:
    """Errors of a result file's poses, with BOP's own matching beside them (except for perturbed initial poses).

    Args:
        evaluator: of the dataset.
        file: result file.
        on_file: called with the number of poses; returns the function called with each number of poses done.

    Raises:
        PoseError: the file's sidecar or the dataset is not usable; the message names it.
    """
    pairing = pair_up(evaluator.dataset, file)
    table, precision = evaluator.evaluate(pairing.pairs, on_file(len(pairing.pairs))), {}
    if "perturbation" not in file.sidecar:
        errors = evaluator.all_errors(file.estimates, scored=(pairing.pairs, table))
        table, precision = with_bop19(table, errors), bop24_precision(errors)
    return Scored(
        file=file,
        table=table,
        T_est=_stacked([NO_POSE if pair.estimate is None else pair.estimate.T_cam_obj for pair in pairing.pairs]),
        T_gt=_stacked([pair.gt.T_cam_obj for pair in pairing.pairs]),
        center_m=np.array([evaluator.dataset.center_m(pair.gt.obj_id) for pair in pairing.pairs]).reshape(-1, 3),
        ignored=pairing.ignored,
        precision=precision,
    )


def _stacked(poses: Sequence[np.ndarray]) -> Float[np.ndarray, "n 4 4"]:
    return np.array(poses, np.float64).reshape(-1, 4, 4)
