"""Parts of self-contained HTML pages: the document, lists of terms, figures of inline SVG, ticks of an axis."""

from collections.abc import Mapping
from html import escape

import numpy as np


def document(title: str, style: str, body: str, script: str = "") -> str:
    """A whole page in one file, which requests nothing else.

    Args:
        title: Plain text.
        style: CSS.
        body: HTML.
        script: JavaScript, run once the body is there.
    """
    code = f"<script>{script}</script>" if script else ""
    return (
        '<!doctype html><html lang="en"><head><meta charset="utf-8">'
        '<meta name="viewport" content="width=device-width, initial-scale=1">'
        '<link rel="icon" href="data:,">'  # no request for a favicon
        f"<title>{escape(title)}</title><style>{style}</style></head><body>{body}{code}</body></html>\n"
    )


def definitions(entries: Mapping[str, str]) -> str:
    """Terms and their definitions, plain text."""
    items = "".join(f"<dt>{escape(term)}</dt><dd>{escape(text)}</dd>" for term, text in entries.items())
    return f"<dl>{items}</dl>" if items else ""


def figure(
    title: str, description: str, drawing: str, size: tuple[float, float], *, kind: str = "", note: str = ""
) -> str:
    """A drawing with its title above, and a description for screen readers.

    Args:
        title: Plain text.
        description: Plain text.
        drawing: Content of the SVG.
        size: Width and height of the drawing's coordinates.
        kind: Class of the figure.
        note: HTML below the drawing.
    """
    mark = f' class="{kind}"' if kind else ""
    return (
        f"<figure{mark}><figcaption>{escape(title)}</figcaption>"
        f'<svg viewBox="0 0 {size[0]:g} {size[1]:g}" role="img"><title>{escape(title)}</title>'
        f"<desc>{escape(description)}</desc>{drawing}</svg>{note}</figure>"
    )


def ticks(low: float, high: float, count: int = 5) -> list[float]:
    """About `count` round numbers from `low` to `high`."""
    raw = max(high - low, 1e-12) / count
    power = 10.0 ** np.floor(np.log10(raw))
    step = next(factor * power for factor in (1, 2, 2.5, 5, 10) if factor * power >= raw * 0.999)
    first = np.ceil(low / step - 1e-9) * step
    return [float(value) + 0.0 for value in np.arange(first, high + step * 1e-6, step)]  # + 0.0: no minus zero
