"""Recall by threshold: the fraction of expected poses at least as good."""

from collections.abc import Callable, Sequence

import numpy as np
import pandas as pd
from jaxtyping import Float

from evalkit.error_table import column
from evalkit.evaluation.scored_file import Scored
from evalkit.report import html, svg_plots
from evalkit.report.svg_plots import LineStyle, Series
from evalkit.scores.definitions import MSPD_WIDTH_PX
from evalkit.scores.per_pose import add_s_m

NOTE = (
    "A curve shows the fraction of all expected poses with an error of at most the threshold, a missing estimate "
    "failing. Rotation errors are at the best symmetry."
)
QUANTILE = 0.9
"""Curves of millimetres end at a round number above this quantile of the worst file's errors, within `WIDEST_MM`."""
WIDEST_MM = 300.0


def figures(scored: Sequence[Scored], styles: Sequence[LineStyle]) -> str:
    """The curves of all result files."""

    def figure(title: str, x_label: str, errors_of: Callable[[pd.DataFrame], np.ndarray], limit: float) -> str:
        lines = []
        for item, style in zip(scored, styles, strict=True):
            x, y = svg_plots.cumulative(errors_of(item.table), limit)
            lines.append(Series(name=item.file.name, style=style, x=x, y=y))
        return svg_plots.line_plot(title, x_label, "fraction of poses", lines, is_fraction=True)

    def millimetres(name: str) -> Callable[[pd.DataFrame], np.ndarray]:
        return lambda table: np.asarray(np.abs(column(table, name)) * 1e3)

    drawn = [
        figure("Rotation error at most", "degrees", lambda table: np.rad2deg(column(table, "re_sym_rad")), 45.0),
        figure("Distance of the centres at most", "mm", millimetres("te_m"), _limit_mm(scored, "te_m")),
        figure("ADD(-S) at most", "diameters", lambda table: add_s_m(table) / column(table, "diameter_m"), 0.5),
        figure("MSSD at most", "diameters", lambda table: column(table, "mssd_m") / column(table, "diameter_m"), 0.5),
        figure("MSPD at most", f"px, for images {MSPD_WIDTH_PX:g} px wide", _mspd_px, 50.0),
        _vss(scored, styles),
        *[
            figure(f"Error along camera {axis} at most", "mm", millimetres(name), _limit_mm(scored, name))
            for axis, name in (("x", "dx_m"), ("y", "dy_m"), ("z", "dz_m"))
        ],
    ]
    return f'{html.paragraph(NOTE, soft=True)}<div class="plots">{"".join(drawn)}</div>'


def _mspd_px(table: pd.DataFrame) -> Float[np.ndarray, " n"]:
    return np.asarray(column(table, "mspd_px") * (MSPD_WIDTH_PX / column(table, "image_width_px")))


def _vss(scored: Sequence[Scored], styles: Sequence[LineStyle]) -> str:
    """VSS is better where it is larger, so its curve falls."""
    lines = []
    for item, style in zip(scored, styles, strict=True):
        is_found = column(item.table, "found") > 0
        short, fraction = svg_plots.cumulative(np.where(is_found, 1.0 - column(item.table, "vss"), np.nan), 1.0)
        lines.append(Series(name=item.file.name, style=style, x=1.0 - short[::-1], y=fraction[::-1]))
    return svg_plots.line_plot("VSS at least", "VSS", "fraction of poses", lines, is_fraction=True)


def _limit_mm(scored: Sequence[Scored], name: str) -> float:
    """End of a curve in millimetres, above most errors of every file."""
    errors = [np.abs(column(item.table, name)) * 1e3 for item in scored]
    ends = [float(np.quantile(finite, QUANTILE)) for part in errors if len(finite := part[np.isfinite(part)])]
    return min(svg_plots.round_limit(max([*ends, 1.0])), WIDEST_MM)
