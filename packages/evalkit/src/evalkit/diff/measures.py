"""Measures for comparing two result files: one value for each expected pose, with unit and order."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Literal

import numpy as np
import pandas as pd
from jaxtyping import Float

from evalkit.scores.definitions import AUC_LIMIT_M
from evalkit.scores.per_pose import add_s_m, area_under_recall, average_recalls, found_errors, solved


@dataclass(frozen=True, kw_only=True)
class Measure:
    """A measure.

    Attributes:
        unit: of the values, empty for fractions.
        better: order of the values.
        text: description.
        values_of: function of a table and the limit of failure in diameters, with one value a row. Fractions and VSS
            are 0 where an estimate is missing; errors are NaN and compared over the poses found in both files.
        is_binary: whether each value is 0 or 1, so that a median is meaningless.
    """

    unit: Literal["", "mm", "px", "deg"]
    better: Literal["higher", "lower"]
    text: str
    values_of: Callable[[pd.DataFrame, float], Float[np.ndarray, " n"]]
    is_binary: bool = False

    @property
    def digits(self) -> int:
        """Decimals to show."""
        return 2 if self.unit else 4


def _fraction(text: str, values_of: Callable[[pd.DataFrame, float], np.ndarray]) -> Measure:
    return Measure(unit="", better="higher", text=text, values_of=values_of)


def _error(unit: Literal["mm", "px", "deg"], key: str, text: str) -> Measure:
    return Measure(unit=unit, better="lower", text=text, values_of=lambda table, _: found_errors(table)[key])


MEASURES: Mapping[str, Measure] = {
    "vss": _fraction("visual surface similarity", lambda table, _: table.vss.to_numpy(np.float64)),
    "recall": Measure(
        unit="",
        better="higher",
        text="ADD(-S) under the limit",
        values_of=lambda table, limit: solved(table, limit).astype(np.float64),
        is_binary=True,
    ),
    "auc": _fraction(
        "area of ADD(-S) recall to 100 mm", lambda table, _: area_under_recall(add_s_m(table), AUC_LIMIT_M)
    ),
    "ar_mssd": _fraction("BOP average recall of MSSD", lambda table, _: average_recalls(table)["ar_mssd"]),
    "ar_mspd": _fraction("BOP average recall of MSPD", lambda table, _: average_recalls(table)["ar_mspd"]),
    "add": _error("mm", "add_mm", "ADD"),
    "adi": _error("mm", "adi_mm", "ADI (ADD-S)"),
    "add_s": Measure(
        unit="mm",
        better="lower",
        text="ADD(-S): ADI of symmetric objects",
        values_of=lambda table, _: add_s_m(table) * 1e3,
    ),
    "mssd": _error("mm", "mssd_mm", "maximum surface distance"),
    "mspd": _error("px", "mspd_px", "maximum projected distance"),
    "proj": _error("px", "proj_px", "average projected distance"),
    "re": _error("deg", "re_deg", "rotation error"),
    "re_sym": _error("deg", "re_sym_deg", "rotation error at the best symmetry"),
    "te": _error("mm", "te_mm", "distance of the centres"),
    "tx": _error("mm", "tx_mm", "error along camera x"),
    "ty": _error("mm", "ty_mm", "error along camera y"),
    "tz": _error("mm", "tz_mm", "error along camera z"),
}
