"""The error table: a pandas DataFrame with one row for each expected pose, found or missing."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import pandas as pd
from jaxtyping import Float


@dataclass(frozen=True, kw_only=True)
class ErrorColumn:
    """A column: its dtype, and its quantity with the unit."""

    dtype: str
    text: str


def _columns(dtype: str, **texts: str) -> dict[str, ErrorColumn]:
    return {name: ErrorColumn(dtype=dtype, text=text) for name, text in texts.items()}


COLUMNS: Mapping[str, ErrorColumn] = {
    **_columns(
        "int64",
        scene_id="scene",
        im_id="image",
        obj_id="object",
        gt_index="index of the instance in the image's ground truth",
    ),
    **_columns(
        "float64", visib_fract="visible fraction of the ground-truth silhouette, NaN where the dataset has none"
    ),
    **_columns("bool", found="whether there is an estimate; where there is none, errors are NaN and `vss` is 0"),
    **_columns("int64", line="the estimate's line in its file, 0 where it is missing"),
    **_columns(
        "float64",
        score="the estimate's confidence",
        time_s="run time of its image in seconds, negative where unknown",
        initial_angle_deg="rotation of an initial pose perturbed by steps, NaN for others",
        initial_translation_diameter="its translation, object diameters",
        diameter_m="largest distance between two points of the model",
    ),
    **_columns("bool", symmetric="whether the object has symmetries"),
    **_columns("int64", image_width_px="width of the image"),
    **_columns(
        "float64",
        distance_m="camera z of the object's centre (middle of its bounding box) at the ground truth",
        view_azimuth_deg="direction of the camera seen from the object: angle about its z from x, -180 to 180",
        view_elevation_deg="the same: angle over its xy plane, -90 to 90",
        other_mssd_m="smallest MSSD to another instance of the object in the image, NaN without one",
        vss="visual surface similarity, 0 to 1",
        add_m="average distance of corresponding model points",
        adi_m="average distance to the nearest model point (ADD-S)",
        mssd_m="maximum surface distance at the best symmetry",
        mspd_px="maximum projected distance at the best symmetry",
        proj_px="average projected distance",
        proj_sym_px="average projected distance at the best symmetry",
        re_rad="angle between estimated and ground-truth rotation",
        re_sym_rad="the same at the best symmetry",
        te_m="distance of the centres",
        dx_m="estimated minus ground-truth centre along the camera's right",
        dy_m="along the camera's down",
        dz_m="along the camera's forward axis",
    ),
}

RENAMED_COLUMNS: Mapping[str, str] = {
    "start_angle_deg": "initial_angle_deg",
    "start_translation_diameter": "initial_translation_diameter",
}
"""New name of columns that error tables of earlier versions have under another one."""


def table_of(columns: Mapping[str, Sequence[Any] | np.ndarray]) -> pd.DataFrame:
    """A table from its columns, all of `COLUMNS` and maybe others (VSD's); an empty one from none."""
    table = pd.DataFrame(dict(columns) if columns else {name: [] for name in COLUMNS})
    return table.astype({name: column.dtype for name, column in COLUMNS.items()})


def column(table: pd.DataFrame, name: str) -> Float[np.ndarray, " n"]:
    """One column as float64; booleans are 0 and 1."""
    return np.asarray(table[name].to_numpy(), dtype=np.float64)
