"""Inline SVG drawings from the fenced blocks `flow` and `bars` of a page.

A line of a `flow` block is a chain: `[file] -> command -> [file | note]`. Files are in brackets; a repeated name is the
same box. A line of a `bars` block is `label | value | text of the value`, or `label | value`.
"""

import html
import re
from collections.abc import Callable
from dataclasses import dataclass, field

CHARACTER_PX = 7.4
BOX_PX = 38
ROW_PX = 62
GAP_PX = 44
WIDEST_PX = 1000
"""A wider drawing runs downwards."""
BAR_PX = 360


@dataclass(kw_only=True)
class _Box:
    """A file or a command of a flow drawing; lengths in drawing units."""

    name: str
    note: str
    is_file: bool
    layer: int = 0
    lane: int = 0
    x: float = 0.0
    y: float = 0.0
    sources: list[str] = field(default_factory=list)

    @property
    def width(self) -> float:
        return 26 + max(CHARACTER_PX * len(self.name), 6.2 * len(self.note))


def draw(markdown: str) -> str:
    """Replace the `flow` and `bars` blocks of a page by inline SVG."""
    for kind, drawing in (("flow", flow), ("bars", bars)):
        pattern = rf"^```{kind}\n(.*?)^```$"
        markdown = re.sub(pattern, _svg_of(drawing), markdown, flags=re.MULTILINE | re.DOTALL)
    return markdown


def _svg_of(drawing: Callable[[str], str]) -> Callable[[re.Match[str]], str]:
    return lambda match: drawing(match.group(1))


def flow(text: str) -> str:
    """Return the drawing of a `flow` block: boxes in layers by their longest way from a source, arrows between them.

    The layers run to the right, or downwards where that would be wider than `WIDEST_PX`.

    Raises:
        ValueError: The arrows form a circle.
    """
    boxes = _parse(text)
    _set_layers(boxes)
    _set_lanes(boxes)
    downwards = _place_rightwards(boxes) > WIDEST_PX
    if downwards:
        _place_downwards(boxes)
    width = max(box.x + box.width for box in boxes.values()) + 8
    height = max(box.y for box in boxes.values()) + BOX_PX + 8
    arrow = _arrow_down if downwards else _arrow_right
    parts = [arrow(boxes[source], box) for box in boxes.values() for source in box.sources]
    parts += [_box(box) for box in boxes.values()]
    return _svg(width, height, parts)


def _parse(text: str) -> dict[str, _Box]:
    boxes: dict[str, _Box] = {}
    for line in filter(None, map(str.strip, text.splitlines())):
        previous = ""
        for item in line.split(" -> "):
            name, _, note = (part.strip() for part in item.strip().strip("[]").partition("|"))
            box = boxes.setdefault(name, _Box(name=name, note=note, is_file=item.strip().startswith("[")))
            if previous and previous not in box.sources:
                box.sources.append(previous)
            previous = name
    return boxes


def _set_layers(boxes: dict[str, _Box]) -> None:
    for _ in boxes:
        for box in boxes.values():
            box.layer = max((boxes[source].layer + 1 for source in box.sources), default=0)
    if max(box.layer for box in boxes.values()) >= len(boxes):
        raise ValueError("the arrows of a flow drawing form a circle")
    for box in boxes.values():  # an input stands beside its first use
        if not box.sources:
            box.layer = min((target.layer for target in boxes.values() if box.name in target.sources), default=1) - 1


def _set_lanes(boxes: dict[str, _Box]) -> None:
    """Give each box of a layer another lane, where possible that of its first source."""
    for layer in range(max(box.layer for box in boxes.values()) + 1):
        lane = -1
        for box in (box for box in boxes.values() if box.layer == layer):
            lane = box.lane = max(lane + 1, min((boxes[source].lane for source in box.sources), default=0))


def _place_rightwards(boxes: dict[str, _Box]) -> float:
    """Set the positions of a drawing with layers as columns; return its width."""
    x = 8.0
    for layer in range(max(box.layer for box in boxes.values()) + 1):
        column = [box for box in boxes.values() if box.layer == layer]
        for box in column:
            box.x, box.y = x, 8.0 + ROW_PX * box.lane
        x += max(box.width for box in column) + GAP_PX
    return x - GAP_PX + 8


def _place_downwards(boxes: dict[str, _Box]) -> None:
    """Set the positions of a drawing with layers as rows, boxes centred in their lanes."""
    x = 8.0
    for lane in range(max(box.lane for box in boxes.values()) + 1):
        column = [box for box in boxes.values() if box.lane == lane]
        width = max((box.width for box in column), default=0.0)
        for box in column:
            box.x, box.y = x + (width - box.width) / 2, 8.0 + ROW_PX * box.layer
        x += width + GAP_PX


def _box(box: _Box) -> str:
    kind, radius = ("file", 3) if box.is_file else ("command", 12)
    middle, base = box.x + box.width / 2, box.y + BOX_PX / 2 + 5
    parts = [
        f'<rect class="{kind}" x="{box.x:.0f}" y="{box.y:.0f}"'
        f' width="{box.width:.0f}" height="{BOX_PX}" rx="{radius}"/>'
    ]
    name_y = base - 7 if box.note else base
    parts.append(f'<text x="{middle:.0f}" y="{name_y:.0f}" text-anchor="middle">{html.escape(box.name)}</text>')
    if box.note:
        note = html.escape(box.note)
        parts.append(f'<text class="note" x="{middle:.0f}" y="{base + 8:.0f}" text-anchor="middle">{note}</text>')
    return "".join(parts)


def _arrow_right(source: _Box, target: _Box) -> str:
    x0, y0 = source.x + source.width, source.y + BOX_PX / 2
    x1, y1 = target.x - 7, target.y + BOX_PX / 2
    bend = max(18.0, (x1 - x0) / 2)
    path = f"M{x0:.0f} {y0:.0f}C{x0 + bend:.0f} {y0:.0f} {x1 - bend:.0f} {y1:.0f} {x1:.0f} {y1:.0f}"
    return f'<path class="edge" d="{path}"/><path class="head" d="M{x1 + 6:.0f} {y1:.0f}l-8 -4v8z"/>'


def _arrow_down(source: _Box, target: _Box) -> str:
    x0, y0 = source.x + source.width / 2, source.y + BOX_PX
    x1, y1 = target.x + target.width / 2, target.y - 7
    bend = max(12.0, (y1 - y0) / 2)
    path = f"M{x0:.0f} {y0:.0f}C{x0:.0f} {y0 + bend:.0f} {x1:.0f} {y1 - bend:.0f} {x1:.0f} {y1:.0f}"
    return f'<path class="edge" d="{path}"/><path class="head" d="M{x1:.0f} {y1 + 6:.0f}l-4 -8h8z"/>'


def bars(text: str) -> str:
    """Return the drawing of a `bars` block: one horizontal bar a line, as long as its value."""
    rows = [[part.strip() for part in line.split("|")] for line in text.strip().splitlines()]
    longest = max(float(row[1]) for row in rows)
    label_px = 16 + CHARACTER_PX * max(len(row[0]) for row in rows)
    parts = []
    for number, row in enumerate(rows):
        y, length = 6 + 26 * number, BAR_PX * float(row[1]) / longest
        parts.append(f'<text x="{label_px - 8:.0f}" y="{y + 14}" text-anchor="end">{html.escape(row[0])}</text>')
        parts.append(f'<rect class="bar" x="{label_px:.0f}" y="{y}" width="{length:.1f}" height="18" rx="2"/>')
        value = html.escape(row[2] if len(row) > 2 else row[1])
        parts.append(f'<text x="{label_px + length + 8:.0f}" y="{y + 14}">{value}</text>')
    value_px = 24 + CHARACTER_PX * max(len(row[-1]) for row in rows)
    return _svg(label_px + BAR_PX + value_px, 26 * len(rows) + 10, parts)


def _svg(width: float, height: float, parts: list[str]) -> str:
    size = f'viewBox="0 0 {width:.0f} {height:.0f}" width="{width:.0f}" height="{height:.0f}"'
    return f'<svg class="drawing" {size} role="img">{"".join(parts)}</svg>'
