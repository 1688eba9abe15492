"""Scores by visibility, distance and viewpoint."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import Any

import numpy as np
from posecore.html import figure

from evalkit.report import html, svg_plots
from evalkit.report.svg_plots import LineStyle, Series
from evalkit.scores.bins import AZIMUTH_EDGES_DEG, ELEVATION_EDGES_DEG
from evalkit.tables.report_tables import BIN_AXES, bin_tables

Record = Mapping[str, Any]


@dataclass(frozen=True, kw_only=True)
class _Score:
    title: str
    y_label: str
    is_fraction: bool = False
    y_high: float | None = None


SCORES = {
    "vss_mean": _Score(title="Mean VSS", y_label="mean VSS", y_high=1.0),
    "add_s_recall_0.1d": _Score(title="ADD(-S) recall at 0.1 diameter", y_label="fraction of poses", is_fraction=True),
    "re_sym_deg_median": _Score(title="Median rotation error", y_label="degrees"),
    "tz_mm_median": _Score(title="Median z error", y_label="mm"),
}
SHOWN = {
    "visibility": ("vss_mean", "add_s_recall_0.1d", "re_sym_deg_median"),
    "distance": ("vss_mean", "tz_mm_median", "re_sym_deg_median"),
    "azimuth": ("vss_mean",),
    "elevation": ("vss_mean",),
}
"""Scores plotted along each axis; the tables have all scores."""
NOTE = "Whiskers are 95 % intervals. Bins without poses are left out; the numbers and counts are below the plots."


def parts(summary: Mapping[str, Any], styles: Sequence[LineStyle]) -> list[str]:
    """Plots and tables; nothing where no pose has a value."""
    figures = []
    for axis, keys in SHOWN.items():
        drawn = [
            (file["name"], style, file["bins"][axis])
            for file, style in zip(summary["files"], styles, strict=True)
            if file["bins"][axis]
        ]
        figures += [_plot(axis, key, drawn) for key in keys if drawn]
    if not figures:
        return []
    maps = [_viewpoint_map(file["name"], file["bins"]["viewpoint"]) for file in summary["files"]]
    return [
        html.paragraph(NOTE, soft=True),
        f'<div class="plots">{"".join(figures)}</div>',
        f'<div class="plots">{"".join(maps)}</div>',
        html.fold("Numbers by bin", *map(html.table, bin_tables(summary))),
    ]


def _plot(axis: str, key: str, drawn: Sequence[tuple[str, LineStyle, Sequence[Record]]]) -> str:
    label, column, factor = BIN_AXES[axis]
    score = SCORES[key]
    lines = []
    for index, (name, style, records) in enumerate(drawn):
        kept = [record for record in records if record["score"] == key]
        low, high, value, lower, upper = (
            np.array([np.nan if record[name] is None else record[name] for record in kept], np.float64)
            for name in (f"{column}_low", f"{column}_high", "value", "low", "high")
        )
        # Side by side within a bin, so that whiskers do not hide each other.
        aside = (index - (len(drawn) - 1) / 2) * min(0.08, 0.6 / len(drawn)) * (high - low)
        x = factor * ((low + high) / 2 + aside)
        lines.append(Series(name=name, style=style, x=x, y=value, low=lower, high=upper, is_measured=True))
    ends = [
        factor * record[f"{column}_{end}"] for _, _, records in drawn for record in records for end in ("low", "high")
    ]
    return svg_plots.line_plot(
        f"{score.title} by {axis}",
        label,
        score.y_label,
        lines,
        is_fraction=score.is_fraction,
        y_high=score.y_high,
        x_ends=(min(ends), max(ends)),
        x_ticks=_ticks(ends),
    )


def _ticks(ends: Sequence[float]) -> list[float]:
    """Edges of bins, every second where there are many."""
    edges = sorted(set(ends))
    return edges[:: 1 if len(edges) <= 9 else 2]


CELL_W, CELL_H, MAP_LEFT, MAP_TOP = 47, 38, 50, 16
LIGHT, DARK = np.array([240, 245, 253]), np.array([8, 48, 120])


def _viewpoint_map(name: str, records: Sequence[Record]) -> str:
    """Mean VSS over the direction of the camera as seen from the object: azimuth to the right, elevation upwards."""
    if not records:
        return ""
    azimuths = list(pairwise(AZIMUTH_EDGES_DEG))
    used = {record["view_elevation_deg_low"] for record in records}
    elevations = [(low, high) for low, high in pairwise(ELEVATION_EDGES_DEG) if min(used) <= low <= max(used)]
    drawn = []
    for record in records:
        x = MAP_LEFT + CELL_W * azimuths.index((record["view_azimuth_deg_low"], record["view_azimuth_deg_high"]))
        row = elevations.index((record["view_elevation_deg_low"], record["view_elevation_deg_high"]))
        y = MAP_TOP + CELL_H * (len(elevations) - 1 - row)
        vss = float(record["value"])
        red, green, blue = (LIGHT + (DARK - LIGHT) * vss).astype(int)
        ink = "inside" if vss > 0.65 else "dark"
        drawn.append(
            f"<g><title>{record['expected']} poses</title>"
            f'<rect x="{x}" y="{y}" width="{CELL_W - 2}" height="{CELL_H - 2}" fill="rgb({red} {green} {blue})"/>'
            f'<text class="{ink}" x="{x + CELL_W / 2 - 1:g}" y="{y + CELL_H / 2 + 3:g}" text-anchor="middle">'
            f"{vss:.2f}</text></g>"
        )
    bottom = MAP_TOP + CELL_H * len(elevations)
    drawn += [
        _text(MAP_LEFT + CELL_W * i - 1, bottom + 18, f"{edge:g}°", "middle")
        for i, edge in enumerate(AZIMUTH_EDGES_DEG)
        if i % 2 == 0
    ]
    drawn += [
        _text(MAP_LEFT - 6, bottom - CELL_H * i + (3 if i else -2), f"{edge:g}°", "end")
        for i, edge in enumerate([elevations[0][0], *(high for _, high in elevations)])
    ]
    width = MAP_LEFT + CELL_W * len(azimuths) + 24
    drawn.append(_text((MAP_LEFT + width - 24) / 2, bottom + 38, "azimuth; at the left elevation", "middle"))
    description = "; ".join(
        f"azimuth {record['view_azimuth_deg_low']:g} to {record['view_azimuth_deg_high']:g}, elevation "
        f"{record['view_elevation_deg_low']:g} to {record['view_elevation_deg_high']:g}: {record['value']:.2f}"
        for record in records
    )
    return figure(f"Mean VSS by viewpoint, {name}", description, "".join(drawn), (width, bottom + 46))


def _text(x: float, y: float, text: str, anchor: str) -> str:
    return f'<text x="{x:g}" y="{y:g}" text-anchor="{anchor}">{text}</text>'
