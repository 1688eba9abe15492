"""A result file with the errors of its poses."""

from dataclasses import dataclass

import numpy as np
import pandas as pd
from jaxtyping import Float

from evalkit.files import ResultFile

Array = np.ndarray
CaseKey = tuple[int, int, int, float, float, int]
"""Scene, image, position of the truth, start angle and translation (-1 for none), and how many alike came before."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Scored:
    """A result file with the errors of its poses, all in the same order.

    Attributes:
        file: what was read.
        table: see `evalkit.table`.
        T_est: (n, 4, 4) estimates `T_cam_obj`, metres, NaN where missing.
        T_gt: (n, 4, 4) true poses.
        ignored: lines that belong to no expected pose.
    """

    file: ResultFile
    table: pd.DataFrame
    T_est: Float[Array, "n 4 4"]
    T_gt: Float[Array, "n 4 4"]
    ignored: int

    def cases(self) -> dict[CaseKey, int]:
        """Row of each pose under a key that other result files share."""
        key = self.table[["scene_id", "im_id", "gt_index"]].copy()
        key["angle"] = self.table.start_angle_deg.fillna(-1.0)
        key["translation"] = self.table.start_translation_diameter.fillna(-1.0)
        nth = key.groupby(list(key.columns), sort=False).cumcount() + 1
        keys = zip(*(key[name].tolist() for name in key), nth.tolist(), strict=True)
        return {values: row for row, values in enumerate(keys)}
