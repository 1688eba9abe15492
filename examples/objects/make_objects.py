"""Build the example objects: `tug.ply` (no symmetry) and `bobbin.ply` (turning about z changes nothing).

Every part is a set of quad grids with a colour per quad. Corners are then split wherever the colour or the crease
changes, so that vertex colours and vertex normals stay crisp. Nothing here is random: two runs write the same bytes.

    python examples/objects/make_objects.py
"""

import json
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike
from posecore.mesh import Mesh, save_ply

Array = np.ndarray
Rgb = tuple[int, int, int]
Paint = Callable[[Array, int, int], Rgb]
"""Colour of a quad from its centre (3,) in mm and its row and column in the grid."""

CREASE_RAD = np.radians(38.0)

RED, GREEN, BLUE = (220, 25, 35), (15, 165, 70), (25, 70, 205)
YELLOW, ORANGE, PURPLE, CYAN = (250, 205, 0), (255, 115, 0), (125, 35, 190), (0, 190, 225)
MAGENTA, WHITE, BLACK, BROWN = (235, 20, 150), (245, 245, 240), (28, 28, 32), (120, 62, 20)
LIME, SKY, SAND = (160, 225, 20), (120, 190, 255), (225, 170, 105)


@dataclass(frozen=True, kw_only=True)
class Part:
    """One closed solid: corners of its triangles in mm (f, 3, 3) and a colour per triangle (f, 3) uint8."""

    corners_mm: Array
    rgb: Array


def solid_paint(rgb: Rgb) -> Paint:
    """Return a paint that gives every quad the same colour."""
    return lambda _centre, _row, _column: rgb


def part_from_grids(grids: Sequence[tuple[Array, Paint]]) -> Part:
    """Join quad grids, points (n, m, 3) with a paint each, into one solid that faces outwards.

    The grids of a part must be wound alike; the sign of the enclosed volume then decides which way is out. Quads that
    collapse to a line are dropped, and those that collapse to a triangle stay one.
    """
    corners: list[Array] = []
    colours: list[Rgb] = []
    for points, paint in grids:
        for row in range(points.shape[0] - 1):
            for column in range(points.shape[1] - 1):
                a, b = points[row, column], points[row + 1, column]
                c, d = points[row + 1, column + 1], points[row, column + 1]
                rgb = paint((a + b + c + d) / 4, row, column)
                for triangle in (np.stack([a, b, c]), np.stack([a, c, d])):
                    area = np.linalg.norm(np.cross(triangle[1] - triangle[0], triangle[2] - triangle[0]))
                    if area > 1e-6:
                        corners.append(triangle)
                        colours.append(rgb)
    corners_mm = np.array(corners)
    if np.einsum("fi,fi->", corners_mm[:, 0], np.cross(corners_mm[:, 1], corners_mm[:, 2])) < 0:
        corners_mm = corners_mm[:, ::-1]
    return Part(corners_mm=corners_mm, rgb=np.array(colours, dtype=np.uint8))


def box(cuts_x: ArrayLike, cuts_y: ArrayLike, cuts_z: ArrayLike, paint: Paint) -> Part:
    """Build a box whose sides are cut at the given coordinates (mm), so that windows can have their own colour."""
    cuts = [np.asarray(c, dtype=np.float64) for c in (cuts_x, cuts_y, cuts_z)]
    grids = []
    for axis in range(3):
        first, second = cuts[(axis + 1) % 3], cuts[(axis + 2) % 3]
        for side in (0, -1):
            points = np.empty((len(first), len(second), 3))
            points[..., axis] = cuts[axis][side]
            points[..., (axis + 1) % 3] = first[:, None]
            points[..., (axis + 2) % 3] = second[None, :]
            grids.append((points if side == -1 else points[:, ::-1], paint))
    return part_from_grids(grids)


def revolved(profile_mm: Sequence[tuple[float, float]], segments: int, paint: Paint) -> Part:
    """Turn a profile of (radius, height) pairs about z; rows follow the profile, columns the angle."""
    angle = np.linspace(0.0, 2 * np.pi, segments + 1)
    angle[-1] = 0.0
    profile = np.asarray(profile_mm, dtype=np.float64)
    points = np.empty((len(profile), segments + 1, 3))
    points[..., 0] = profile[:, :1] * np.cos(angle)
    points[..., 1] = profile[:, :1] * np.sin(angle)
    points[..., 2] = profile[:, 1:]
    return part_from_grids([(points, paint)])


def torus(radius_mm: float, tube_mm: float, segments: int, tube_segments: int, paint: Paint) -> Part:
    """Build a ring about z; columns follow the angle about z, so that a paint can colour it in sectors."""
    turn = np.linspace(0.0, 2 * np.pi, tube_segments + 1)
    turn[-1] = 0.0
    return revolved([(radius_mm + tube_mm * np.cos(t), tube_mm * np.sin(t)) for t in turn], segments, paint)


def placed(part: Part, R: Array | None = None, t_mm: Sequence[float] = (0.0, 0.0, 0.0)) -> Part:
    """Rotate a part about the origin, then move it."""
    R = np.eye(3) if R is None else R
    return Part(corners_mm=part.corners_mm @ R.T + np.asarray(t_mm, dtype=np.float64), rgb=part.rgb)


def rotation(axis: int, degrees: float) -> Array:
    """Return the rotation about a coordinate axis (0, 1, 2)."""
    c, s = np.cos(np.radians(degrees)), np.sin(np.radians(degrees))
    i, j = (axis + 1) % 3, (axis + 2) % 3
    R = np.eye(3)
    R[i, i], R[i, j], R[j, i], R[j, j] = c, -s, s, c
    return R


# ---------------------------------------------------------------- tug: x towards the bow, y to port, z up

HULL_STATIONS = np.concatenate([[0.0, 0.018], np.linspace(0.06, 0.94, 23), [0.97, 0.99, 1.0]])
HULL_ROWS = 8


def hull_section(u: float) -> Array:
    """Return one closed cross-section of the hull (m, 3) at u in [0, 1] from stern to bow, from port edge downwards."""
    x = -52.0 + 108.0 * u + 2.0 * u
    half_beam = (
        22.0 * max(0.02, 1 - (abs(u - 0.45) / 0.55) ** 2.4) if u > 0.45 else 22.0 - 6.0 * ((0.45 - u) / 0.45) ** 2
    )
    top = 13.0 + 11.0 * max(0.0, (u - 0.4) / 0.6) ** 2 + 2.5 * max(0.0, (0.4 - u) / 0.4) ** 2
    bottom = -15.0 + 16.0 * max(0.0, (u - 0.65) / 0.35) ** 2 + 8.0 * max(0.0, (0.25 - u) / 0.25) ** 2
    t = np.linspace(0.0, np.pi / 2, HULL_ROWS + 1)
    y, depth = half_beam * np.cos(t).clip(0) ** 0.55, np.sin(t) ** 0.8
    y[-1] = 0.0
    z = top - (top - bottom) * depth
    wall = 0.0 if u in (0.0, 1.0) else 3.5
    inner = half_beam * 0.9
    deck = np.array([[-inner, top], [-inner, top - wall], [0, top - wall], [inner, top - wall], [inner, top]])
    ring = np.concatenate([np.c_[y, z], np.c_[-y, z][-2::-1], deck, [[half_beam, top]]])
    return np.column_stack([np.full(len(ring), x), ring])


def paint_hull(centre: Array, station: int, column: int) -> Rgb:
    """Colour the hull: sides by port and starboard, bow and stern apart, four quarters below the waterline."""
    u, port = HULL_STATIONS[station : station + 2].mean(), centre[1] > 0
    if column >= 2 * HULL_ROWS:  # rim, inside of the bulwark, deck
        if column in (2 * HULL_ROWS, 2 * HULL_ROWS + 5):
            return WHITE
        return LIME if u > 0.6 else SAND
    row = min(column, 2 * HULL_ROWS - 1 - column)
    if row < 3:
        if u > 0.82:
            return YELLOW
        if u < 0.16:
            return BLUE
        return RED if port else GREEN
    if row == 3:
        return WHITE
    if u > 0.48:
        return PURPLE if port else CYAN
    return ORANGE if port else BROWN


def tug_hull() -> Part:
    """Build the hull with bulwark and deck, closed at transom and stem."""
    points = np.stack([hull_section(u) for u in HULL_STATIONS])
    stern, bow = (np.broadcast_to(end.mean(axis=0), end.shape) for end in (points[0], points[-1]))
    return part_from_grids(
        [
            (points, paint_hull),
            (np.stack([stern, points[0]]), solid_paint(BLUE)),
            (np.stack([points[-1], bow]), solid_paint(YELLOW)),
        ]
    )


def paint_cabin(centre: Array, _row: int, _column: int) -> Rgb:
    """Colour the deck house: another colour on each wall, a band of windows, a roof in two colours."""
    x, y, z = centre
    if z > 37.9:
        return MAGENTA if y > 0 else YELLOW
    window = 24.0 < z < 33.0
    if x > 25.9:
        return SKY if window else BLUE
    if x < -3.9:
        return PURPLE
    if window and (3.0 < x < 10.0 or 14.0 < x < 22.0):
        return BLACK
    return WHITE if y > 0 else ORANGE


def tug_parts() -> list[Part]:
    """Return the parts of the tug: hull, house, bridge, funnel, mast, rudder, fenders, buoy, crate, winch."""
    lean, along_y = rotation(1, -12.0), rotation(0, 90.0)
    house = box(
        [-4, 0, 3, 6.5, 10, 14, 18, 22, 26], np.linspace(-12, 12, 7), [8, 13, 18.5, 24, 28.5, 33, 38], paint_cabin
    )
    bridge = box(
        np.linspace(8, 24, 5),
        np.linspace(-9, 5, 5),
        [38, 41, 44, 47],
        lambda c, _r, _k: CYAN if c[2] > 46.9 else (RED if c[0] > 23.9 else (BLACK if 41 < c[2] < 44 else WHITE)),
    )
    funnel = revolved(
        [(0, 0), (3.5, 0), (7, 0), (7, 8), (6.8, 15), (6.6, 20), (6.4, 26), (6.4, 31), (4.5, 31), (4.5, 27), (0, 27)],
        24,
        lambda _c, row, _k: (BLACK, BLACK, BLACK, ORANGE, WHITE, GREEN, BLACK, BLACK, BLACK, BLACK)[row],
    )
    mast = revolved([(0, 0), (1.6, 0), (1.6, 6), (1.4, 12), (1.4, 18), (0, 18)], 10, solid_paint(YELLOW))
    tyre = torus(5.2, 2.1, 16, 8, solid_paint(BLACK))
    buoy = torus(4.6, 1.7, 16, 8, lambda _c, _row, column: RED if column // 2 % 2 else WHITE)
    crate = box(
        np.linspace(-40, -24, 4),
        np.linspace(1, 14, 4),
        np.linspace(8, 21, 4),
        lambda c, r, k: MAGENTA if c[2] > 20.9 else (YELLOW if (r, k) == (1, 1) else CYAN),
    )
    winch = revolved(
        [(0, -7), (4.8, -7), (4.8, -5), (3, -5), (3, 5), (4.8, 5), (4.8, 7), (0, 7)], 16, solid_paint(MAGENTA)
    )
    bollard = revolved([(0, 0), (2.4, 0), (2.4, 6), (3.4, 7), (3.4, 9), (0, 9)], 14, solid_paint(RED))
    rudder = box([-55, -51, -47], [-1.2, 1.2], [-13, -6, 2], lambda c, _r, _k: LIME if c[2] < -6 else RED)
    return [
        tug_hull(),
        house,
        bridge,
        placed(funnel, lean, (-12.0, -3.5, 9.0)),
        placed(mast, t_mm=(14.0, 1.0, 46.0)),
        *(placed(tyre, along_y, (x, 22.6, 6.0)) for x in (-16.0, 2.0, 20.0)),
        placed(buoy, along_y, (12.0, -13.0, 19.0)),
        crate,
        placed(winch, along_y, (38.0, -3.0, 19.0)),
        placed(bollard, t_mm=(-42.0, -7.0, 9.0)),
        rudder,
    ]


# ---------------------------------------------------------------- bobbin: any turn about z looks the same


def bobbin_parts() -> list[Part]:
    """Return the one part of the bobbin: a waist between a wide foot and a narrow, pointed head, in coloured rings."""
    rings: list[tuple[Rgb, list[tuple[float, float]]]] = [
        (PURPLE, [(0, -45), (12, -45), (24, -45)]),
        (CYAN, [(24, -45), (32, -45), (33.5, -43.5)]),
        (RED, [(33.5, -43.5), (34, -39), (33.5, -35)]),
        (YELLOW, [(33.5, -35), (30, -33), (22, -30), (16, -26)]),
        (BLUE, [(16, -26), (13.5, -20), (12.2, -14)]),
        (WHITE, [(12.2, -14), (11.5, -8), (11.3, -2)]),
        (GREEN, [(11.3, -2), (11.5, 4), (12.5, 10)]),
        (ORANGE, [(12.5, 10), (16, 15), (22, 19), (25, 21)]),
        (BLACK, [(25, 21), (26, 24), (25.5, 28)]),
        (MAGENTA, [(25.5, 28), (22, 30), (15, 32), (9, 33)]),
        (LIME, [(9, 33), (8, 38), (5, 43), (0, 45)]),
    ]
    profile = [rings[0][1][0]]
    colours: list[Rgb] = []
    for rgb, points in rings:
        profile += points[1:]
        colours += [rgb] * (len(points) - 1)
    return [revolved(profile, 64, lambda _c, row, _k: colours[row])]


# ---------------------------------------------------------------- parts -> mesh


def corner_normals(part: Part) -> Array:
    """Return a normal for each triangle corner (f, 3, 3): area-weighted over its side of a crease."""
    corners = part.corners_mm
    weighted = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    unit = weighted / np.linalg.norm(weighted, axis=1, keepdims=True)
    _, where = np.unique(np.round(corners.reshape(-1, 3), 4), axis=0, return_inverse=True)
    where = where.reshape(-1, 3)
    faces_at: dict[int, list[int]] = {}
    for face, ids in enumerate(where):
        for vertex in ids:
            faces_at.setdefault(int(vertex), []).append(face)
    normals = np.empty_like(corners)
    for face, ids in enumerate(where):
        for k, vertex in enumerate(ids):
            around = np.array(faces_at[int(vertex)])
            near = around[unit[around] @ unit[face] > np.cos(CREASE_RAD)]
            normals[face, k] = weighted[near].sum(axis=0)
    return np.asarray(normals / np.linalg.norm(normals, axis=2, keepdims=True))


def mesh_of(parts: Sequence[Part]) -> Mesh:
    """Join parts into one mesh with its origin at the centre of the bounding box."""
    corners = np.concatenate([part.corners_mm for part in parts]).reshape(-1, 3)
    corners = corners - (corners.min(axis=0) + corners.max(axis=0)) / 2
    normals = np.concatenate([corner_normals(part) for part in parts]).reshape(-1, 3)
    rgb = np.concatenate([part.rgb for part in parts]).repeat(3, axis=0)
    # Rounded, and with one kind of zero, so that corners that agree in place, normal and colour become one vertex.
    rows = np.round(np.concatenate([corners, normals, rgb], axis=1), 4) + 0.0
    vertices, index = np.unique(rows, axis=0, return_inverse=True)
    return Mesh(
        vertices_m=vertices[:, :3] * 1e-3,
        faces=index.reshape(-1, 3).astype(np.int32),
        normals=vertices[:, 3:6].astype(np.float32),
        vertex_rgb=vertices[:, 6:].astype(np.uint8),
    )


def models_info(mesh: Mesh) -> dict[str, float]:
    """Return BOP's size entries of `models_info.json`, in mm."""
    lowest, size = mesh.vertices_m.min(axis=0) * 1e3, np.ptp(mesh.vertices_m, axis=0) * 1e3
    info = {"diameter": round(mesh.diameter_m * 1e3, 4)}
    info |= {f"min_{name}": round(float(lowest[axis]), 4) for axis, name in enumerate("xyz")}
    return info | {f"size_{name}": round(float(size[axis]), 4) for axis, name in enumerate("xyz")}


def main() -> None:
    """Write both objects and their sizes and symmetries beside this file."""
    folder = Path(__file__).parent
    tug, bobbin = mesh_of(tug_parts()), mesh_of(bobbin_parts())
    save_ply(tug, folder / "tug.ply")
    save_ply(bobbin, folder / "bobbin.ply")
    about_z = {"symmetries_continuous": [{"axis": [0, 0, 1], "offset": [0, 0, 0]}]}
    info = {"tug": models_info(tug), "bobbin": models_info(bobbin) | about_z}
    (folder / "models_info.json").write_text(json.dumps(info, indent=2) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
