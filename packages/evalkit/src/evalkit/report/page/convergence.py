"""Curves of convergence from initial poses perturbed by steps."""

from collections.abc import Mapping, Sequence
from html import escape
from typing import Any

import numpy as np

from evalkit.report import svg_plots
from evalkit.report.svg_plots import LineStyle, Series

LEVEL_PLOTS = (
    ("Rotation error under 5°", "under_5deg", True),
    ("Rotation error under 10°", "under_10deg", True),
    ("Rotation error under 20°", "under_20deg", True),
    ("Translation error under 0.1 diameter", "te_under_0.1d", True),
    ("Diverged", "diverged", True),
    ("Mean final rotation error, deg", "re_sym_deg_mean", False),
    ("Mean final translation error, mm", "te_mm_mean", False),
)
LEVEL_LABELS = {"angle": "initial pose rotated by, degrees", "translation": "initial pose translated by, diameters"}


def plots(summary: Mapping[str, Any], styles: Sequence[LineStyle]) -> list[str]:
    """The curves; nothing without initial poses perturbed by steps."""
    shown = []
    for kind, label in LEVEL_LABELS.items():
        drawn = [
            (file, style) for file, style in zip(summary["files"], styles, strict=True) if kind in file["by_level"]
        ]
        if not drawn:
            continue
        figures = [
            svg_plots.line_plot(
                title,
                label,
                "fraction of poses" if is_fraction else title.rsplit(", ", 1)[-1],
                [_series(file["name"], style, file["by_level"][kind], key) for file, style in drawn],
                is_fraction=is_fraction,
            )
            for title, key, is_fraction in LEVEL_PLOTS
        ]
        shown.append(f'<h3>{escape(label.capitalize())}</h3><div class="plots">{"".join(figures)}</div>')
    return shown


def _series(name: str, style: LineStyle, points: Sequence[Mapping[str, Any]], key: str) -> Series:
    ends = [(point.get("intervals") or {}).get(key) or (None, None) for point in points]
    return Series(
        name=name,
        style=style,
        x=_numbers([point["level"] for point in points]),
        y=_numbers([point[key] for point in points]),
        low=_numbers([low for low, _ in ends]),
        high=_numbers([high for _, high in ends]),
        is_measured=True,
    )


def _numbers(values: Sequence[float | None]) -> np.ndarray:
    return np.array([np.nan if value is None else value for value in values], dtype=np.float64)
