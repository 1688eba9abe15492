"""Line plots as inline SVG: they scale with the page and need no other file."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from html import escape

import numpy as np
from jaxtyping import Float

Array = np.ndarray
Place = Callable[[float, float], tuple[float, float]]
"""A point of the data to a point of the drawing."""
WIDTH, HEIGHT = 460, 290
LEFT, RIGHT, TOP, BOTTOM = 60, 16, 14, 46
DASH = ' stroke-dasharray="6 4"'
START_COLOUR = "#7a808c"
COLOURS = ("#1f5fd0", "#d9730d", "#0b8f6a", "#a13fb8", "#c22f4b", "#5b6b00")
"""Told apart with every common colour blindness, and dark enough on white."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Series:
    """One line: its name, colour, points, and whether it is dashed (start poses are)."""

    name: str
    colour: str
    x: Float[Array, " n"]
    y: Float[Array, " n"]
    dashed: bool = False
    markers: bool = False


def series_colours(starts: Sequence[bool]) -> list[str]:
    """A colour for each result file: grey for start poses, one after the other for the rest."""
    others = [index for index, is_start in enumerate(starts) if not is_start]
    return [
        START_COLOUR if is_start else COLOURS[others.index(index) % len(COLOURS)]
        for index, is_start in enumerate(starts)
    ]


def cumulative(values: Float[Array, " n"], limit: float, steps: int = 121) -> tuple[Array, Array]:
    """Share of values at or under each of `steps` thresholds from 0 to `limit`; NaN is never under."""
    thresholds = np.linspace(0.0, limit, steps)
    ordered = np.sort(values[np.isfinite(values)])
    return thresholds, np.searchsorted(ordered, thresholds, side="right") / max(1, len(values))


def ticks(low: float, high: float, count: int = 5) -> list[float]:
    """Round numbers from `low` to `high`, about `count` of them."""
    span = max(high - low, 1e-12)
    raw = span / count
    power = 10.0 ** np.floor(np.log10(raw))
    step = next(factor * power for factor in (1, 2, 2.5, 5, 10) if factor * power >= raw * 0.999)
    first = np.ceil(low / step - 1e-9) * step
    return [float(value) + 0.0 for value in np.arange(first, high + step * 1e-6, step)]  # + 0.0: no minus zero


def line_plot(
    title: str, x_label: str, y_label: str, series: Sequence[Series], *, share: bool, y_high: float | None = None
) -> str:
    """A figure with a title, axes and one line for each series.

    Args:
        title: what the plot shows.
        x_label: with its unit.
        y_label: with its unit.
        series: lines; points with NaN are left out.
        share: whether y runs from 0 to 100 %.
        y_high: upper end of y where it is no share; by default the largest value, and at least 1.
    """
    x_low = min((float(np.nanmin(line.x)) for line in series if len(line.x)), default=0.0)
    x_high = max((float(np.nanmax(line.x)) for line in series if len(line.x)), default=1.0)
    x_high = x_high if x_high > x_low else x_low + 1.0
    if share:
        top = 1.0
    else:
        finite = [line.y[np.isfinite(line.y)] for line in series]
        largest = max((float(values.max()) for values in finite if len(values)), default=1.0)
        top = y_high or max(1.06 * largest, 1.0)

    def place(x: float, y: float) -> tuple[float, float]:
        across = LEFT + (x - x_low) / (x_high - x_low) * (WIDTH - LEFT - RIGHT)
        return across, HEIGHT - BOTTOM - y / top * (HEIGHT - TOP - BOTTOM)

    parts = [_grid(ticks(x_low, x_high), ticks(0.0, top), place, share)]
    parts += [_line(line, place) for line in series]
    middle_x, middle_y = (LEFT + WIDTH - RIGHT) / 2, (TOP + HEIGHT - BOTTOM) / 2
    parts.append(f'<text x="{middle_x:.0f}" y="{HEIGHT - 6}" text-anchor="middle">{escape(x_label)}</text>')
    parts.append(
        f'<text transform="translate(14 {middle_y:.0f}) rotate(-90)" text-anchor="middle">{escape(y_label)}</text>'
    )
    svg = f'<svg viewBox="0 0 {WIDTH} {HEIGHT}" role="img" aria-label="{escape(title)}">{"".join(parts)}</svg>'
    return f"<figure><figcaption>{escape(title)}</figcaption>{svg}</figure>"


def _grid(x_ticks: Sequence[float], y_ticks: Sequence[float], place: Place, share: bool) -> str:
    parts = []
    for value in y_ticks:
        _, y = place(x_ticks[0] if x_ticks else 0.0, value)
        text = f"{value * 100:.0f}%" if share else f"{value:g}"
        parts.append(f'<path class="grid" d="M{LEFT} {y:.1f}H{WIDTH - RIGHT}"/>')
        parts.append(f'<text x="{LEFT - 6}" y="{y + 3.5:.1f}" text-anchor="end">{text}</text>')
    for value in x_ticks:
        x, _ = place(value, 0.0)
        parts.append(f'<path class="tick" d="M{x:.1f} {HEIGHT - BOTTOM}v4"/>')
        parts.append(f'<text x="{x:.1f}" y="{HEIGHT - BOTTOM + 17}" text-anchor="middle">{value:g}</text>')
    parts.append(f'<path class="axis" d="M{LEFT} {HEIGHT - BOTTOM}H{WIDTH - RIGHT}"/>')
    return "".join(parts)


def _line(line: Series, place: Place) -> str:
    kept = np.isfinite(line.x) & np.isfinite(line.y)
    points = [place(float(x), float(y)) for x, y in zip(line.x[kept], line.y[kept], strict=True)]
    if not points:
        return ""
    joined = " ".join(f"{x:.1f},{y:.1f}" for x, y in points)
    name = f"<title>{escape(line.name)}</title>"
    stroke = f'fill="none" stroke="{line.colour}" stroke-width="2"{DASH * line.dashed}'
    drawn = f'<polyline points="{joined}" {stroke}>{name}</polyline>'
    if line.markers or len(points) == 1:
        drawn += "".join(f'<circle cx="{x:.1f}" cy="{y:.1f}" r="3" fill="{line.colour}"/>' for x, y in points)
    return drawn


def legend(names: Sequence[str], colours: Sequence[str], dashed: Sequence[bool]) -> str:
    """One legend for all plots of a page."""
    items = [
        f'<span><svg viewBox="0 0 26 10"><path d="M1 5H25" stroke="{colour}" stroke-width="2.5"{DASH * is_dashed}/>'
        f"</svg>{escape(name)}</span>"
        for name, colour, is_dashed in zip(names, colours, dashed, strict=True)
    ]
    return f'<p class="legend">{"".join(items)}</p>'
