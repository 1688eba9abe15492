"""Histograms and maps of coverage as inline SVG, scalable and without other files."""

from collections.abc import Mapping, Sequence
from html import escape
from itertools import pairwise

import numpy as np
from jaxtyping import Float, Int
from posecore.html import figure, ticks

from synthgen.verify.coverage import sectors_in

WIDTH, HEIGHT = 460, 250
LEFT, RIGHT, TOP, BOTTOM = 52, 14, 12, 46
BAR = "#1f5fd0"
EMPTY = "#d9730d"
_LOW, _HIGH = np.array([226.0, 236.0, 250.0]), np.array([12.0, 52.0, 130.0])  # few to many samples


def histogram(
    title: str, x_label: str, values: Float[np.ndarray, " n"], low: float, high: float, bins: int = 24
) -> str:
    """Fractions of samples by value; the axis' label counts values outside [low, high]."""
    high = high if high > low else low + 1.0
    finite = values[np.isfinite(values)]
    counts, edges = np.histogram(finite, bins=bins, range=(low, high))
    outside = int(((finite < low) | (finite > high)).sum()) + len(values) - len(finite)
    label = x_label + (f" ({outside} samples outside of the axis)" if outside else "")
    names = [f"{a:.4g} to {b:.4g}" for a, b in pairwise(edges.tolist())]
    marks = [((value - low) / (high - low), f"{value:.4g}") for value in ticks(low, high)]
    return _figure(title, label, counts, names, marks)


def bars(title: str, x_label: str, counts: Mapping[str, int]) -> str:
    """Samples by name; with many names only some are labelled."""
    names = list(counts)
    every = max(1, -(-len(names) // 12))
    marks = [((i + 0.5) / len(names), name) for i, name in enumerate(names) if i % every == 0]
    return _figure(title, x_label, np.array(list(counts.values())), names, marks)


def _figure(
    title: str, x_label: str, counts: Int[np.ndarray, " b"], names: Sequence[str], marks: Sequence[tuple[float, str]]
) -> str:
    total, top = max(1, int(counts.sum())), max(1, int(counts.max(initial=0)))
    across, down = WIDTH - LEFT - RIGHT, HEIGHT - TOP - BOTTOM
    width = across / max(1, len(counts))
    parts = []
    for fraction in ticks(0.0, top / total, 4):
        y = TOP + down * (1 - fraction * total / top)
        parts.append(f'<path class="grid" d="M{LEFT} {y:.1f}H{WIDTH - RIGHT}"/>')
        parts.append(f'<text x="{LEFT - 6}" y="{y + 4:.1f}" text-anchor="end">{100 * fraction:.3g}%</text>')
    for i, count in enumerate(counts.tolist()):
        height = down * count / top
        parts.append(
            f'<rect x="{LEFT + i * width:.1f}" y="{TOP + down - height:.1f}" width="{max(width - 1, 0.5):.1f}" '
            f'height="{height:.1f}" fill="{BAR}"><title>{escape(names[i])}: {count} samples</title></rect>'
        )
    for position, text in marks:
        parts.append(
            f'<text x="{LEFT + position * across:.1f}" y="{HEIGHT - BOTTOM + 16}" text-anchor="middle">'
            f"{escape(text)}</text>"
        )
    parts.append(f'<path class="axis" d="M{LEFT} {TOP + down}H{WIDTH - RIGHT}"/>')
    parts.append(f'<text x="{LEFT + across / 2:.0f}" y="{HEIGHT - 8}" text-anchor="middle">{escape(x_label)}</text>')
    full = [name for name, count in zip(names, counts.tolist(), strict=True) if count]
    description = f"{total} samples, from {full[0]} to {full[-1]}" if full else "no samples"
    return figure(title, description, "".join(parts), (WIDTH, HEIGHT))


def sphere_maps(upper: Int[np.ndarray, " c"], lower: Int[np.ndarray, " c"], rings: int) -> str:
    """Camera directions in the object's frame: both hemispheres on equal-area maps, coloured by the number of scenes.

    Args:
        upper: Scenes by cell, as `coverage.view_counts` gives them.
        lower: The same from below.
        rings: Number of rings of each map.
    """
    total, most = int(upper.sum() + lower.sum()), int(max(upper.max(), lower.max(), 1))
    radius, pad, top = 95, 26, 28
    parts = []
    for disc, (counts, name) in enumerate(((upper, "from above (+z)"), (lower, "from below (-z)"))):
        middle_x, middle_y = pad + radius + disc * 2 * (radius + pad), top + radius
        cells = []
        for ring in range(rings):
            for sector in range(sectors_in(ring)):
                count = int(counts[3 * ring**2 + sector])
                cells.append(
                    f'<path d="{_cell(ring, sector, radius / rings)}" fill="{_shade(count, most)}">'
                    f"<title>{count} scenes</title></path>"
                )
        parts.append(f'<g class="cells" transform="translate({middle_x} {middle_y})">{"".join(cells)}</g>')
        parts.append(f'<text x="{middle_x}" y="{top - 12}" text-anchor="middle">{name}</text>')
        parts.append(f'<text x="{middle_x + radius + 4}" y="{middle_y + 4}">+x</text>')
        parts.append(f'<text x="{middle_x}" y="{top + 2 * radius + 15}" text-anchor="middle">-y</text>')
    number, holes = len(upper) + len(lower), int((upper == 0).sum() + (lower == 0).sum())
    summary = f"{total} scenes in {number} cells of equal area, {holes} cells empty, at most {most} scenes a cell"
    note = (
        f'<p class="soft">{summary}. {_key(most)} A disc shows a hemisphere around its pole, '
        "the rim is the object's xy plane.</p>"
    )
    size = (4 * (radius + pad), 2 * radius + 48)
    return figure("Camera direction, object frame", summary, "".join(parts), size, kind="wide", note=note)


def _cell(ring: int, sector: int, width: float) -> str:
    """Outline of a cell around the origin, with y flipped from upwards to SVG's downwards."""
    inner, outer, count = ring * width, (ring + 1) * width, sectors_in(ring)
    a, b = 2 * np.pi * sector / count, 2 * np.pi * (sector + 1) / count

    def point(radius: float, angle: float) -> str:
        return f"{radius * np.cos(angle):.2f} {-radius * np.sin(angle):.2f}"

    start = f"M{point(inner, a)}L{point(outer, a)}A{outer:.2f} {outer:.2f} 0 0 0 {point(outer, b)}L{point(inner, b)}"
    return start + (f"A{inner:.2f} {inner:.2f} 0 0 1 {point(inner, a)}Z" if inner else "Z")


def position_map(
    u: Float[np.ndarray, " n"], v: Float[np.ndarray, " n"], width_px: int, height_px: int, cells: int = 24
) -> str:
    """Positions of the window centres in the image, with a margin for centres outside."""
    edges = np.linspace(-0.25, 1.25, cells + 1).tolist()
    finite = np.isfinite(u) & np.isfinite(v)
    counts = np.histogram2d(v[finite], u[finite], bins=[edges, edges])[0].astype(int)
    most = max(1, int(counts.max()))
    across = 420.0
    down = across * height_px / width_px
    parts = [f'<rect width="{across}" height="{down:.1f}" fill="#f5f7fa"/>']
    for row, column in zip(*np.nonzero(counts), strict=True):
        count = int(counts[row, column])
        parts.append(
            f'<rect x="{column * across / cells:.1f}" y="{row * down / cells:.1f}" width="{across / cells:.1f}" '
            f'height="{down / cells:.1f}" fill="{_shade(count, most)}"><title>{count} samples</title></rect>'
        )
    parts.append(
        f'<rect class="ring" x="{across / 6:.1f}" y="{down / 6:.1f}" width="{across / 1.5:.1f}" '
        f'height="{down / 1.5:.1f}"/>'
    )
    description = f"Image of {width_px} x {height_px} px: {int(finite.sum())} samples"
    note = f'<p class="soft">The frame is the image, {width_px} x {height_px} px.</p>'
    return figure("Window centre in the image", description, "".join(parts), (across, round(down)), note=note)


def _shade(count: int, most: int) -> str:
    if count == 0:
        return EMPTY
    red, green, blue = _LOW + (_HIGH - _LOW) * (count / most)
    return f"#{int(red):02x}{int(green):02x}{int(blue):02x}"


def _key(most: int) -> str:
    chips = ((EMPTY, "none"), (_shade(1, max(2, most)), "few"), (_shade(most, most), f"{most}"))
    return " ".join(f'<span class="chip" style="background:{colour}"></span>&nbsp;{text}' for colour, text in chips)
