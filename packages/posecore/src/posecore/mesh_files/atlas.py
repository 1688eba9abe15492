"""Several textures as one: each material's piece of its texture, tiled as its coordinates go, in a common image."""

import logging
from dataclasses import dataclass, replace
from pathlib import Path

import cv2
import numpy as np
from jaxtyping import Float, Int, UInt8

from posecore.errors import MeshError
from posecore.mesh_files.part import GREY, MeshPart, Texture, Wrap

log = logging.getLogger(__name__)

LARGEST_ATLAS_PX = 8192
"""Side; larger textures are halved until all fit."""
_MARGIN = 4
"""Fewest pixels around a piece that go on as the texture does, so that interpolation never reaches the neighbour."""
_MARGIN_PART = 8
"""Side of the largest piece over the margin, where there is room: mip levels down to as many pixels are usable."""
_MOST_TILES = 4
"""Repetitions of a texture that are drawn without further thought."""
_FEWEST_TILE_PX = 4


@dataclass(frozen=True, kw_only=True, eq=False)
class _Piece:
    """A window of the plane that a texture tiles, in pixels: columns from u = 0, rows from v = 1 downwards."""

    texture: Texture
    x0: int
    y0: int
    width: int
    height: int

    def pixels(self) -> UInt8[np.ndarray, "h w 3"]:
        rows = _wrapped(np.arange(self.y0, self.y0 + self.height), self.texture.rgb.shape[0], self.texture.wrap[1])
        columns = _wrapped(np.arange(self.x0, self.x0 + self.width), self.texture.rgb.shape[1], self.texture.wrap[0])
        return np.asarray(self.texture.rgb[rows[:, None], columns])


def needs_atlas(parts: list[MeshPart]) -> bool:
    """Whether the parts cannot share a single texture that repeats."""
    textures = {id(part.texture) for part in parts if part.texture is not None}
    if not textures:
        return False
    if len(textures) > 1 or any(part.texture is None for part in parts):
        return True
    return any(_leaves_image(part) for part in parts)


def with_atlas(file: Path, parts: list[MeshPart]) -> list[MeshPart]:
    """The parts with one texture between them, and coordinates in it.

    A part without a texture gets a small piece of its colour; where its vertices differ, a white one. Pieces of
    textures that repeat hold all repetitions. Where that would be many, faces are shifted by whole repetitions first.

    Args:
        file: For messages.
        parts: Parts, some with a texture.

    Raises:
        MeshError: A texture repeats so often that its pattern would be lost.
    """
    parts = [_compact(part) if part.texture is not None else part for part in parts]
    groups: dict[int, list[MeshPart]] = {}
    for part in parts:
        if part.texture is not None:
            groups.setdefault(id(part.texture), []).append(part)
    windows = {key: _window(group) for key, group in groups.items()}
    colours = dict.fromkeys(_plain_colour(part) for part in parts if part.texture is None)
    margin, halvings = 0, 0
    while True:
        pieces = [_piece(groups[key][0].texture, window, halvings, margin) for key, window in windows.items()]
        pieces += [_swatch(colour, margin) for colour in colours]
        if not margin:
            margin = _margin(pieces)
            continue
        corners, (width, height) = _packed(pieces)
        if max(width, height) <= LARGEST_ATLAS_PX:
            break
        if margin > _MARGIN:
            margin //= 2
            continue
        halvings += 1
        if any(min(piece.texture.rgb.shape[:2]) < _FEWEST_TILE_PX for piece in pieces[: len(windows)]):
            raise MeshError(f"{file}: its textures repeat too often to be drawn together; bake them into one texture")
    if halvings:
        log.warning("%s: its textures are scaled down by %d to fit into %d px", file, 1 << halvings, LARGEST_ATLAS_PX)
    image = np.full((height, width, 3), 255, np.uint8)
    for piece, (x, y) in zip(pieces, corners, strict=True):
        image[y : y + piece.height, x : x + piece.width] = piece.pixels()
    # a pixel of a mip level reaches 1.5 of its sides from where it is read
    atlas = Texture(rgb=image, mip_levels=None if len(corners) == 1 else margin.bit_length() - 2)
    located = dict(zip([*windows, *colours], zip(pieces, corners, strict=True), strict=True))
    return [
        _on_swatch(part, atlas, *located[_plain_colour(part)])
        if part.texture is None
        else _in_window(part, atlas, *located[id(part.texture)])
        for part in parts
    ]


def _plain_colour(part: MeshPart) -> tuple[int, int, int]:
    """The colour of a part without a texture; white where its vertices differ."""
    if part.rgb is None:
        return (GREY, GREY, GREY)
    if (part.rgb != part.rgb[0]).any():
        return (255, 255, 255)
    red, green, blue = part.rgb[0].tolist()
    return (red, green, blue)


def _margin(pieces: list[_Piece]) -> int:
    """Pixels around each piece, a power of two; the fewest for a single piece, which has no neighbour."""
    side = max(max(piece.width, piece.height) for piece in pieces) // _MARGIN_PART
    return _MARGIN if len(pieces) == 1 else max(_MARGIN, 1 << max(side, 1).bit_length() - 1)


def _swatch(colour: tuple[int, int, int], margin: int) -> _Piece:
    return _Piece(texture=Texture(rgb=np.array([[colour]], np.uint8)), x0=0, y0=0, width=2 * margin, height=2 * margin)


def _on_swatch(part: MeshPart, atlas: Texture, piece: _Piece, corner: tuple[int, int]) -> MeshPart:
    height, width = atlas.rgb.shape[:2]
    middle = np.array([(corner[0] + piece.width / 2) / width, 1.0 - (corner[1] + piece.height / 2) / height])
    varies = part.rgb is not None and bool((part.rgb != part.rgb[0]).any())
    uv = np.tile(middle, (len(part.vertices), 1))
    return replace(part, uv=uv, texture=atlas, rgb=part.rgb if varies else None)


def _in_window(part: MeshPart, atlas: Texture, piece: _Piece, corner: tuple[int, int]) -> MeshPart:
    assert part.uv is not None
    height, width = atlas.rgb.shape[:2]
    tile_height, tile_width = piece.texture.rgb.shape[:2]
    column = part.uv[:, 0] * tile_width - piece.x0 + corner[0]
    row = (1.0 - part.uv[:, 1]) * tile_height - piece.y0 + corner[1]
    return replace(part, uv=np.stack([column / width, 1.0 - row / height], axis=1), texture=atlas)


def _leaves_image(part: MeshPart) -> bool:
    """Whether texture coordinates leave [0, 1] along an axis that does not repeat."""
    if part.texture is None or part.uv is None:
        return False
    used = part.uv[np.unique(part.faces)]
    outside = ((used < -1e-6) | (used > 1 + 1e-6)).any(axis=0)
    return any(bool(out) and wrap != "repeat" for out, wrap in zip(outside, part.texture.wrap, strict=True))


def _compact(part: MeshPart) -> MeshPart:
    """The part with faces shifted by whole repetitions of its texture, if it has many."""
    assert part.texture is not None and part.uv is not None
    corners = part.uv[part.faces]
    low, high = corners.min(axis=(0, 1)), corners.max(axis=(0, 1))
    periods = np.array([{"repeat": 1.0, "mirror": 2.0, "clamp": 0.0}[wrap] for wrap in part.texture.wrap])
    if np.prod(np.ceil(high) - np.floor(low)) <= _MOST_TILES or not periods.any():
        return part
    shifts = np.floor(corners.min(axis=1) / np.where(periods > 0, periods, 1.0)) * periods
    rows = np.column_stack([part.faces.reshape(-1), np.repeat(shifts, 3, axis=0)])
    unique, inverse = np.unique(rows, axis=0, return_inverse=True)
    of_vertex = unique[:, 0].astype(np.int64)
    return part.picked(of_vertex, inverse.reshape(-1, 3), part.uv[of_vertex] - unique[:, 1:])


def _window(parts: list[MeshPart]) -> tuple[Float[np.ndarray, "2"], Float[np.ndarray, "2"]]:
    """Lowest and highest texture coordinates of the faces."""
    used = np.concatenate([part.uv[np.unique(part.faces)] for part in parts if part.uv is not None])
    return used.min(axis=0), used.max(axis=0)


def _piece(
    texture: Texture | None, window: tuple[Float[np.ndarray, "2"], Float[np.ndarray, "2"]], halvings: int, margin: int
) -> _Piece:
    assert texture is not None
    rgb = texture.rgb
    for _ in range(halvings):
        size = (max(rgb.shape[1] // 2, 1), max(rgb.shape[0] // 2, 1))
        rgb = np.asarray(cv2.resize(rgb, size, interpolation=cv2.INTER_AREA))
    height, width = rgb.shape[:2]
    low, high = window
    x0, x1 = int(np.floor(low[0] * width)) - margin, int(np.ceil(high[0] * width)) + margin
    y0, y1 = int(np.floor((1 - high[1]) * height)) - margin, int(np.ceil((1 - low[1]) * height)) + margin
    return _Piece(texture=replace(texture, rgb=rgb), x0=x0, y0=y0, width=x1 - x0, height=y1 - y0)


def _wrapped(index: Int[np.ndarray, " n"], size: int, wrap: Wrap) -> Int[np.ndarray, " n"]:
    if wrap == "clamp":
        return index.clip(0, size - 1)
    if wrap == "mirror":
        folded = index % (2 * size)
        return np.where(folded < size, folded, 2 * size - 1 - folded)
    return index % size


def _packed(pieces: list[_Piece]) -> tuple[list[tuple[int, int]], tuple[int, int]]:
    """Corners of the pieces on shelves, the tallest first, and the size of the whole."""
    area = sum(piece.width * piece.height for piece in pieces)
    widest = max(max(piece.width for piece in pieces), int(np.ceil(np.sqrt(area))))
    corners: list[tuple[int, int]] = [(0, 0)] * len(pieces)
    x = y = shelf = right = 0
    for i in sorted(range(len(pieces)), key=lambda i: (-pieces[i].height, i)):
        if x + pieces[i].width > widest:
            x, y, shelf = 0, y + shelf, 0
        corners[i] = (x, y)
        x += pieces[i].width
        shelf, right = max(shelf, pieces[i].height), max(right, x)
    return corners, (right, y + shelf)
