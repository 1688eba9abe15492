"""Plots as inline SVG: scalable, without other files, and with a description in words."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from html import escape

import numpy as np
from jaxtyping import Float
from posecore.html import figure, ticks

ToDrawing = Callable[[float, float], tuple[float, float]]
"""From data coordinates to the drawing's."""
WIDTH, HEIGHT = 460, 290
LEFT, RIGHT, TOP, BOTTOM = 60, 16, 14, 46
INITIAL_COLOUR = "#6b7280"
COLOURS = ("#1f5fd0", "#d9730d", "#0b8f6a", "#a13fb8", "#c22f4b", "#5b6b00")
"""Distinct with every common colour blindness, and dark enough on white."""
DASHES = ("", "9 3", "2 3", "9 3 2 3")
MARKERS = ("circle", "square", "triangle", "diamond", "cross")
MARKERS_ALONG = 7
"""Number of markers on a long line, so that lines are distinct without colours too."""


@dataclass(frozen=True, kw_only=True)
class LineStyle:
    """Colour, dashes and marker of a result file's line, the same in every plot.

    Attributes:
        colour: of line and markers.
        dash: SVG dash array, empty for a solid line.
        marker: one of `MARKERS`.
    """

    colour: str
    dash: str
    marker: str


@dataclass(frozen=True, kw_only=True, eq=False)
class Series:
    """One line.

    Attributes:
        name: of the result file.
        look: see there.
        x: rising.
        y: NaN where there is no point.
        low: lower ends of intervals, drawn as whiskers; None for none.
        high: upper ends.
        is_measured: whether every point is a measurement with a marker, not one of many along a curve.
    """

    name: str
    style: LineStyle
    x: Float[np.ndarray, " n"]
    y: Float[np.ndarray, " n"]
    low: Float[np.ndarray, " n"] | None = None
    high: Float[np.ndarray, " n"] | None = None
    is_measured: bool = False


def line_styles(are_initial: Sequence[bool]) -> list[LineStyle]:
    """A style for each result file: grey and dashed for initial poses, a different one for each other file."""
    styles, others = [], 0
    for is_initial in are_initial:
        if is_initial:
            styles.append(LineStyle(colour=INITIAL_COLOUR, dash="6 4", marker="circle"))
        else:
            dash = DASHES[(others // len(COLOURS)) % len(DASHES)]
            styles.append(LineStyle(colour=COLOURS[others % len(COLOURS)], dash=dash, marker=MARKERS[(others + 1) % 5]))
            others += 1
    return styles


def cumulative(values: Float[np.ndarray, " n"], limit: float, steps: int = 121) -> tuple[np.ndarray, np.ndarray]:
    """Fraction of values at or under each of `steps` thresholds from 0 to `limit`; NaN is never under."""
    thresholds = np.linspace(0.0, limit, steps)
    ordered = np.sort(values[np.isfinite(values)])
    return thresholds, np.searchsorted(ordered, thresholds, side="right") / max(1, len(values))


def round_limit(value: float) -> float:
    """The smallest round number that is not below a positive value: 1, 1.5, 2, 3, 5 or 7.5 times a power of ten."""
    power = 10.0 ** np.floor(np.log10(value))
    return float(next(step * power for step in (1, 1.5, 2, 3, 5, 7.5, 10) if step * power >= value * (1 - 1e-9)))


def line_plot(
    title: str,
    x_label: str,
    y_label: str,
    series: Sequence[Series],
    *,
    is_fraction: bool,
    y_high: float | None = None,
    x_ends: tuple[float, float] | None = None,
    x_ticks: Sequence[float] | None = None,
) -> str:
    """A figure with a title, axes and one line for each series.

    Args:
        title: of the plot.
        x_label: with its unit.
        y_label: with its unit.
        series: lines; points with NaN are left out.
        is_fraction: whether y runs from 0 to 100 %.
        y_high: upper end of y unless it is a fraction; by default the largest value.
        x_ends: ends of x; those of the lines by default.
        x_ticks: marks of x; round numbers by default.
    """
    x_low = min((float(np.nanmin(line.x)) for line in series if len(line.x)), default=0.0)
    x_high = max((float(np.nanmax(line.x)) for line in series if len(line.x)), default=1.0)
    x_low, x_high = x_ends or (x_low, x_high)
    x_high = x_high if x_high > x_low else x_low + 1.0
    top = 1.0 if is_fraction else y_high or _top(series)

    def point_at(x: float, y: float) -> tuple[float, float]:
        across = LEFT + (x - x_low) / (x_high - x_low) * (WIDTH - LEFT - RIGHT)
        return across, HEIGHT - BOTTOM - min(max(y / top, 0.0), 1.02) * (HEIGHT - TOP - BOTTOM)

    marked = ticks(x_low, x_high) if x_ticks is None else list(x_ticks)
    parts = [_grid(marked, ticks(0.0, top), point_at, is_fraction)]
    parts += [_line(line, point_at, index) for index, line in enumerate(series)]
    middle_x, middle_y = (LEFT + WIDTH - RIGHT) / 2, (TOP + HEIGHT - BOTTOM) / 2
    parts.append(f'<text x="{middle_x:.0f}" y="{HEIGHT - 6}" text-anchor="middle">{escape(x_label)}</text>')
    parts.append(
        f'<text transform="translate(14 {middle_y:.0f}) rotate(-90)" text-anchor="middle">{escape(y_label)}</text>'
    )
    description = "; ".join(_described(line, x_low, x_high, is_fraction) for line in series)
    return figure(title, f"{x_label} against {y_label}. {description}", "".join(parts), (WIDTH, HEIGHT))


def _top(series: Sequence[Series]) -> float:
    ends = [part for line in series for part in (line.y, line.high) if part is not None]
    finite = [float(part[np.isfinite(part)].max()) for part in ends if np.isfinite(part).any()]
    largest = max(finite, default=1.0)
    return 1.06 * largest if largest > 0 else 1.0


def _described(line: Series, x_low: float, x_high: float, is_fraction: bool) -> str:
    """Values at three or four points along the line."""
    kept = np.flatnonzero(np.isfinite(line.y))
    if not len(kept):
        return f"{line.name}: no values"
    x_values = line.x[kept] if len(kept) <= 5 else np.linspace(x_low, x_high, 5)[1:]
    indices = dict.fromkeys(int(kept[np.argmin(np.abs(line.x[kept] - x))]) for x in x_values)
    values = [f"{100 * line.y[i]:.0f} %" if is_fraction else f"{line.y[i]:.3g}" for i in indices]
    return f"{line.name}: " + ", ".join(f"{value} at {line.x[i]:.3g}" for i, value in zip(indices, values, strict=True))


def _grid(x_ticks: Sequence[float], y_ticks: Sequence[float], point_at: ToDrawing, is_fraction: bool) -> str:
    parts = []
    for value in y_ticks:
        _, y = point_at(x_ticks[0] if x_ticks else 0.0, value)
        text = f"{value * 100:.0f}%" if is_fraction else f"{value:g}"
        parts.append(f'<path class="grid" d="M{LEFT} {y:.1f}H{WIDTH - RIGHT}"/>')
        parts.append(f'<text x="{LEFT - 6}" y="{y + 3.5:.1f}" text-anchor="end">{text}</text>')
    for value in x_ticks:
        x, _ = point_at(value, 0.0)
        parts.append(f'<path class="tick" d="M{x:.1f} {HEIGHT - BOTTOM}v4"/>')
        parts.append(f'<text x="{x:.1f}" y="{HEIGHT - BOTTOM + 17}" text-anchor="middle">{value:g}</text>')
    parts.append(f'<path class="axis" d="M{LEFT} {HEIGHT - BOTTOM}H{WIDTH - RIGHT}"/>')
    return "".join(parts)


def _line(line: Series, point_at: ToDrawing, index: int) -> str:
    kept = np.flatnonzero(np.isfinite(line.x) & np.isfinite(line.y))
    points = [point_at(float(line.x[i]), float(line.y[i])) for i in kept]
    if not points:
        return ""
    colour = line.style.colour
    joined = " ".join(f"{x:.1f},{y:.1f}" for x, y in _corners(points))
    dash = f' stroke-dasharray="{line.style.dash}"' if line.style.dash else ""
    drawn = f'<polyline points="{joined}" fill="none" stroke="{colour}" stroke-width="2"{dash}/>'
    if line.low is not None and line.high is not None:
        drawn += "".join(
            f'<path d="M{x:.1f} {point_at(0, float(line.low[i]))[1]:.1f}V{point_at(0, float(line.high[i]))[1]:.1f}" '
            f'stroke="{colour}" stroke-width="1.2" opacity=".7"/>'
            for i, (x, _) in zip(kept, points, strict=True)
            if np.isfinite(line.low[i]) and np.isfinite(line.high[i])
        )
    if line.is_measured or len(points) == 1:
        marked = points
    else:  # shifted from line to line, so that the markers of equal lines do not hide each other
        step = max(1, len(points) // MARKERS_ALONG)
        marked = points[step // 2 + index * step // 3 % step :: step]
    drawn += "".join(marker(line.style.marker, x, y, colour) for x, y in marked)
    return f"<g><title>{escape(line.name)}</title>{drawn}</g>"


def _corners(points: Sequence[tuple[float, float]]) -> list[tuple[float, float]]:
    """Points without those inside level runs, of which a saturated curve has many."""
    inner = range(1, len(points) - 1)
    kept = [i for i in inner if not points[i - 1][1] == points[i][1] == points[i + 1][1]]
    return [points[i] for i in sorted({0, *kept, len(points) - 1})]


def marker(kind: str, x: float, y: float, colour: str, size: float = 3.2) -> str:
    """A small shape around a point."""
    if kind == "circle":
        return f'<circle cx="{x:.1f}" cy="{y:.1f}" r="{size:g}" fill="{colour}"/>'
    if kind == "cross":
        s = size * 0.95
        d = f"M{x - s:.1f} {y - s:.1f}l{2 * s:g} {2 * s:g}m0 {-2 * s:g}l{-2 * s:g} {2 * s:g}"
        return f'<path d="{d}" stroke="{colour}" stroke-width="2"/>'
    if kind == "square":
        d = f"M{x - size:.1f} {y - size:.1f}h{2 * size:g}v{2 * size:g}h{-2 * size:g}z"
    elif kind == "triangle":
        s = size * 1.25
        d = f"M{x:.1f} {y - s:.1f}l{s:g} {1.8 * s:g}h{-2 * s:g}z"
    else:
        s = size * 1.3
        d = f"M{x:.1f} {y - s:.1f}l{s:g} {s:g}l{-s:g} {s:g}l{-s:g} {-s:g}z"
    return f'<path d="{d}" fill="{colour}"/>'


def legend(names: Sequence[str], drawn: Sequence[LineStyle]) -> str:
    """One legend for all plots of a section."""
    entries = []
    for name, style in zip(names, drawn, strict=True):
        dash = f' stroke-dasharray="{style.dash}"' if style.dash else ""
        entries.append(
            f'<li><svg viewBox="0 0 38 14" aria-hidden="true"><path d="M1 7H37" stroke="{style.colour}" '
            f'stroke-width="2.5"{dash}/>{marker(style.marker, 19, 7, style.colour, 3.8)}</svg>{escape(name)}</li>'
        )
    return f'<ul class="legend">{"".join(entries)}</ul>'


BAR_WIDTH, BAR_HEIGHT = 620, 34
NARROWEST_LABELLED = 0.07
"""Smallest part of a bar with its percentage inside."""


@dataclass(frozen=True, kw_only=True)
class Part:
    """One kind of part of stacked bars: name, colour, and whether the colour is light and needs dark text."""

    name: str
    colour: str
    is_light: bool = False


def stacked_bar(title: str, parts: Sequence[Part], fractions: Sequence[float]) -> str:
    """A bar divided into fractions, from left to right.

    Args:
        title: of the bar.
        parts: of the bar.
        fractions: of the parts, 0 to 1, with a sum of 1 at most.
    """
    drawn, x = [], 0.0
    for part, fraction in zip(parts, fractions, strict=True):
        if not fraction > 0:
            continue
        wide = fraction * BAR_WIDTH
        label = f"<title>{escape(part.name)}: {100 * fraction:.1f} %</title>"
        box = f'<rect x="{x:.1f}" width="{max(wide - 1.5, 0.8):.1f}" height="{BAR_HEIGHT}" fill="{part.colour}"/>'
        text = ""
        if fraction >= NARROWEST_LABELLED:
            ink = "dark" if part.is_light else "inside"
            text = (
                f'<text class="{ink}" x="{x + wide / 2:.1f}" y="{BAR_HEIGHT / 2 + 5:g}" text-anchor="middle">'
                f"{100 * fraction:.0f}%</text>"
            )
        drawn.append(f"<g>{label}{box}{text}</g>")
        x += wide
    description = [
        f"{part.name} {100 * fraction:.1f} %" for part, fraction in zip(parts, fractions, strict=True) if fraction > 0
    ]
    return figure(title, ", ".join(description), "".join(drawn), (BAR_WIDTH, BAR_HEIGHT), kind="bar")


def part_legend(parts: Sequence[Part]) -> str:
    """Legend of the colours of stacked bars, in their order."""
    entries = "".join(
        f'<li><svg viewBox="0 0 38 14" aria-hidden="true"><rect x="8" y="0" width="22" height="14" rx="2" '
        f'fill="{part.colour}"/></svg>{escape(part.name)}</li>'
        for part in parts
    )
    return f'<ul class="legend">{entries}</ul>'
