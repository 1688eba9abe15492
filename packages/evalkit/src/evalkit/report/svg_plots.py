"""Plots as inline SVG: they scale with the page, need no other file, and say in words what they show."""

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
START_COLOUR = "#6b7280"
COLOURS = ("#1f5fd0", "#d9730d", "#0b8f6a", "#a13fb8", "#c22f4b", "#5b6b00")
"""Told apart with every common colour blindness, and dark enough on white."""
DASHES = ("", "9 3", "2 3", "9 3 2 3")
MARKERS = ("circle", "square", "triangle", "diamond", "cross")
MARKERS_ALONG = 7
"""So many stand on a long line, so that lines are told apart without colours too."""


@dataclass(frozen=True, kw_only=True)
class Look:
    """How a result file's line looks, the same in every plot.

    Attributes:
        colour: of line and markers.
        dash: SVG dash array, empty for a whole line.
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
        is_measured: whether each point is a measurement, drawn with a marker, or one of many along a curve.
    """

    name: str
    look: Look
    x: Float[Array, " n"]
    y: Float[Array, " n"]
    low: Float[Array, " n"] | None = None
    high: Float[Array, " n"] | None = None
    is_measured: bool = False


def looks(starts: Sequence[bool]) -> list[Look]:
    """A look for each result file: grey and dashed for start poses, another colour, dash and marker for each other."""
    found, others = [], 0
    for is_start in starts:
        if is_start:
            found.append(Look(colour=START_COLOUR, dash="6 4", marker="circle"))
        else:
            dash = DASHES[(others // len(COLOURS)) % len(DASHES)]
            found.append(Look(colour=COLOURS[others % len(COLOURS)], dash=dash, marker=MARKERS[(others + 1) % 5]))
            others += 1
    return found


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


def round_limit(value: float) -> float:
    """The next round number that is not below a positive value: 1, 1.5, 2, 3, 5 or 7.5 times a power of ten."""
    power = 10.0 ** np.floor(np.log10(value))
    return float(next(step * power for step in (1, 1.5, 2, 3, 5, 7.5, 10) if step * power >= value * (1 - 1e-9)))


def line_plot(
    title: str,
    x_label: str,
    y_label: str,
    series: Sequence[Series],
    *,
    share: bool,
    y_high: float | None = None,
    x_ends: tuple[float, float] | None = None,
    x_ticks: Sequence[float] | None = None,
) -> str:
    """A figure with a title, axes and one line for each series.

    Args:
        title: what the plot shows.
        x_label: with its unit.
        y_label: with its unit.
        series: lines; points with NaN are left out.
        share: whether y runs from 0 to 100 %.
        y_high: upper end of y where it is no share; by default the largest value.
        x_ends: ends of x; those of the lines by default.
        x_ticks: where x is marked; round numbers by default.
    """
    x_low = min((float(np.nanmin(line.x)) for line in series if len(line.x)), default=0.0)
    x_high = max((float(np.nanmax(line.x)) for line in series if len(line.x)), default=1.0)
    x_low, x_high = x_ends or (x_low, x_high)
    x_high = x_high if x_high > x_low else x_low + 1.0
    top = 1.0 if share else y_high or _top(series)

    def place(x: float, y: float) -> tuple[float, float]:
        across = LEFT + (x - x_low) / (x_high - x_low) * (WIDTH - LEFT - RIGHT)
        return across, HEIGHT - BOTTOM - min(max(y / top, 0.0), 1.02) * (HEIGHT - TOP - BOTTOM)

    marked = ticks(x_low, x_high) if x_ticks is None else list(x_ticks)
    parts = [_grid(marked, ticks(0.0, top), place, share)]
    parts += [_line(line, place, index) for index, line in enumerate(series)]
    middle_x, middle_y = (LEFT + WIDTH - RIGHT) / 2, (TOP + HEIGHT - BOTTOM) / 2
    parts.append(f'<text x="{middle_x:.0f}" y="{HEIGHT - 6}" text-anchor="middle">{escape(x_label)}</text>')
    parts.append(
        f'<text transform="translate(14 {middle_y:.0f}) rotate(-90)" text-anchor="middle">{escape(y_label)}</text>'
    )
    said = "; ".join(_said(line, x_low, x_high, share) for line in series)
    return figure(title, f"{x_label} against {y_label}. {said}", "".join(parts), HEIGHT)


def figure(title: str, description: str, parts: str, height: float, width: float = WIDTH, kind: str = "") -> str:
    """A drawing with its title above and a description for those who cannot see it."""
    mark = f' class="{kind}"' if kind else ""
    return (
        f"<figure{mark}><figcaption>{escape(title)}</figcaption>"
        f'<svg viewBox="0 0 {width:g} {height:g}" role="img"><title>{escape(title)}</title>'
        f"<desc>{escape(description)}</desc>{parts}</svg></figure>"
    )


def _top(series: Sequence[Series]) -> float:
    ends = [part for line in series for part in (line.y, line.high) if part is not None]
    finite = [float(part[np.isfinite(part)].max()) for part in ends if np.isfinite(part).any()]
    largest = max(finite, default=1.0)
    return 1.06 * largest if largest > 0 else 1.0


def _said(line: Series, x_low: float, x_high: float, share: bool) -> str:
    """Values at three or four places along the line."""
    kept = np.flatnonzero(np.isfinite(line.y))
    if not len(kept):
        return f"{line.name}: no values"
    wanted = line.x[kept] if len(kept) <= 5 else np.linspace(x_low, x_high, 5)[1:]
    places = dict.fromkeys(int(kept[np.argmin(np.abs(line.x[kept] - x))]) for x in wanted)
    values = [f"{100 * line.y[i]:.0f} %" if share else f"{line.y[i]:.3g}" for i in places]
    return f"{line.name}: " + ", ".join(f"{value} at {line.x[i]:.3g}" for i, value in zip(places, values, strict=True))


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


def _line(line: Series, place: Place, index: int) -> str:
    kept = np.flatnonzero(np.isfinite(line.x) & np.isfinite(line.y))
    points = [place(float(line.x[i]), float(line.y[i])) for i in kept]
    if not points:
        return ""
    colour = line.look.colour
    joined = " ".join(f"{x:.1f},{y:.1f}" for x, y in _corners(points))
    dash = f' stroke-dasharray="{line.look.dash}"' if line.look.dash else ""
    drawn = f'<polyline points="{joined}" fill="none" stroke="{colour}" stroke-width="2"{dash}/>'
    if line.low is not None and line.high is not None:
        drawn += "".join(
            f'<path d="M{x:.1f} {place(0, float(line.low[i]))[1]:.1f}V{place(0, float(line.high[i]))[1]:.1f}" '
            f'stroke="{colour}" stroke-width="1.2" opacity=".7"/>'
            for i, (x, _) in zip(kept, points, strict=True)
            if np.isfinite(line.low[i]) and np.isfinite(line.high[i])
        )
    if line.is_measured or len(points) == 1:
        marked = points
    else:  # shifted from line to line, so that the markers of equal lines do not hide each other
        step = max(1, len(points) // MARKERS_ALONG)
        marked = points[step // 2 + index * step // 3 % step :: step]
    drawn += "".join(marker(line.look.marker, x, y, colour) for x, y in marked)
    return f"<g><title>{escape(line.name)}</title>{drawn}</g>"


def _corners(points: Sequence[tuple[float, float]]) -> list[tuple[float, float]]:
    """Points without those inside level runs: a curve that has reached its end needs no more of them."""
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


def legend(names: Sequence[str], drawn: Sequence[Look]) -> str:
    """One legend for all plots of a section."""
    entries = []
    for name, look in zip(names, drawn, strict=True):
        dash = f' stroke-dasharray="{look.dash}"' if look.dash else ""
        entries.append(
            f'<li><svg viewBox="0 0 38 14" aria-hidden="true"><path d="M1 7H37" stroke="{look.colour}" '
            f'stroke-width="2.5"{dash}/>{marker(look.marker, 19, 7, look.colour, 3.8)}</svg>{escape(name)}</li>'
        )
    return f'<ul class="legend">{"".join(entries)}</ul>'


BAR_WIDTH, BAR_HEIGHT = 620, 34
NARROWEST_SAID = 0.07
"""Parts smaller than this are too small to write their share into."""


@dataclass(frozen=True, kw_only=True)
class Part:
    """One kind of part of stacked bars: its name, its colour, and whether dark text is read better on it."""

    name: str
    colour: str
    is_light: bool = False


def stacked_bar(title: str, parts: Sequence[Part], shares: Sequence[float]) -> str:
    """A bar cut into shares, from left to right.

    Args:
        title: what the bar shows.
        parts: of the bar.
        shares: of the parts, 0 to 1, which add up to 1 at most.
    """
    drawn, x = [], 0.0
    for part, share in zip(parts, shares, strict=True):
        if not share > 0:
            continue
        wide = share * BAR_WIDTH
        label = f"<title>{escape(part.name)}: {100 * share:.1f} %</title>"
        box = f'<rect x="{x:.1f}" width="{max(wide - 1.5, 0.8):.1f}" height="{BAR_HEIGHT}" fill="{part.colour}"/>'
        text = ""
        if share >= NARROWEST_SAID:
            ink = "dark" if part.is_light else "inside"
            text = (
                f'<text class="{ink}" x="{x + wide / 2:.1f}" y="{BAR_HEIGHT / 2 + 5:g}" text-anchor="middle">'
                f"{100 * share:.0f}%</text>"
            )
        drawn.append(f"<g>{label}{box}{text}</g>")
        x += wide
    said = [f"{part.name} {100 * share:.1f} %" for part, share in zip(parts, shares, strict=True) if share > 0]
    return figure(title, ", ".join(said), "".join(drawn), BAR_HEIGHT, BAR_WIDTH, kind="bar")


def part_legend(parts: Sequence[Part]) -> str:
    """What the colours of stacked bars mean, in their order."""
    entries = "".join(
        f'<li><svg viewBox="0 0 38 14" aria-hidden="true"><rect x="8" y="0" width="22" height="14" rx="2" '
        f'fill="{part.colour}"/></svg>{escape(part.name)}</li>'
        for part in parts
    )
    return f'<ul class="legend">{entries}</ul>'
