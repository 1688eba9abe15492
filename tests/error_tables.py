"""Tables of pose errors made up by tests: everything perfect unless a column is given."""

from collections.abc import Mapping

import numpy as np
import pandas as pd
from evalkit.error_table import COLUMNS

PERFECT: Mapping[str, float | bool] = {
    "found": True,
    "line": 2,
    "score": 1.0,
    "time_s": 0.1,
    "visib_fract": 1.0,
    "initial_angle_deg": np.nan,
    "initial_translation_diameter": np.nan,
    "diameter_m": 0.1,
    "symmetric": False,
    "image_width_px": 640,
    "distance_m": 0.5,
    "obj_id": 1,
    "other_mssd_m": np.nan,
    "vss": 1.0,
}
ERRORS = (
    *("add_m", "adi_m", "mssd_m", "mspd_px", "proj_px", "proj_sym_px"),
    *("re_rad", "re_sym_rad", "te_m", "dx_m", "dy_m", "dz_m"),
)


def errors_table(rows: int, **columns) -> pd.DataFrame:
    """A table of `rows` expected poses, one an image of scene 1; rows with `found=False` lose their errors."""
    table = pd.DataFrame({name: np.zeros(rows) for name in COLUMNS})
    table["im_id"] = np.arange(rows)
    table["scene_id"] = 1
    for name, value in {**PERFECT, **columns}.items():
        table[name] = value
    missing = ~table.found.astype(bool)
    table.loc[missing, [*ERRORS, "score", "time_s", "other_mssd_m"]] = np.nan
    table.loc[missing, ["vss", "line"]] = 0
    return table.astype({name: column.dtype for name, column in COLUMNS.items()})
