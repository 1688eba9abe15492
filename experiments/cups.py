"""Make a category: cups, mugs and bowls of random shapes and colours, and one more that nobody trains on.

    python experiments/cups.py cups --count 8 --seed 0

All are scaled to one diameter. The unseen one is `unseen/obj_000001.ply`, in a models folder of its own.
"""

import argparse
import json
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
from posecore.mesh import Mesh, save_ply

sys.path.insert(0, str(Path(__file__).resolve().parent.parent))
from examples.objects.make_objects import Part, Rgb, mesh_of, models_info, part_from_grids, revolved, solid_paint

DIAMETER_M = 0.12
ABOUT_Z = {"symmetries_continuous": [{"axis": [0, 0, 1], "offset": [0, 0, 0]}]}


def parser() -> argparse.ArgumentParser:
    """The command line."""
    made = argparse.ArgumentParser(description="Make cups, mugs and bowls, and one more that is kept aside.")
    made.add_argument("out", type=Path, help="folder for train/ and unseen/, models folders as BOP has them")
    made.add_argument("--count", type=int, default=8, help="members to train on (%(default)s)")
    made.add_argument("--seed", type=int, default=0, help="of shapes and colours (%(default)s)")
    return made


def vessel(kind: str, rng: np.random.Generator) -> Mesh:
    """One member: `bowl`, `cup` without a handle or `mug` with one; metres, z up."""
    height = rng.uniform(45, 60) if kind == "bowl" else rng.uniform(75, 110)
    top = rng.uniform(58, 75) if kind == "bowl" else rng.uniform(36, 46)
    foot, belly, wall = top * rng.uniform(0.45, 0.95), top * rng.uniform(-0.08, 0.12), rng.uniform(3, 5)
    share = np.linspace(0.0, 1.0, 13)
    radius = foot + (top - foot) * share + belly * np.sin(np.pi * share)
    outside = [(0.0, 0.0), *zip(radius, height * share, strict=True)]
    inside = [(r - wall, max(z, wall)) for r, z in reversed(outside[1:])]
    body, band, inner = (colour(rng) for _ in range(3))
    low = int(rng.integers(3, 8))
    high = low + int(rng.integers(2, 5))

    def paint(_centre: np.ndarray, row: int, _column: int) -> Rgb:
        return inner if row >= len(outside) else (band if low <= row < high else body)

    parts = [revolved([*outside, *inside, (0.0, wall)], 48, paint)]
    if kind == "mug":
        parts.append(handle(radius[6] - wall / 2, height / 2, height * rng.uniform(0.28, 0.36), colour(rng)))
    mesh = mesh_of(parts)
    return replace(mesh, vertices_m=mesh.vertices_m * (DIAMETER_M / mesh.diameter_m))


def handle(radius_mm: float, height_mm: float, reach_mm: float, rgb: Rgb) -> Part:
    """Half a ring in the xz plane, both ends inside the wall at this radius around this height."""
    along, around = np.linspace(-np.pi / 2, np.pi / 2, 17)[:, None], np.linspace(0.0, 2 * np.pi, 11)[None, :]
    out = reach_mm + 4.5 * np.cos(around)
    x, z = radius_mm + out * np.cos(along), height_mm + out * np.sin(along)
    points = np.stack([x, np.broadcast_to(4.5 * np.sin(around), x.shape), z], axis=2)
    points[:, -1] = points[:, 0]
    caps = [np.stack([np.broadcast_to(end.mean(axis=0), end.shape), end]) for end in (points[0], points[-1][::-1])]
    return part_from_grids([(points, solid_paint(rgb)), *((cap, solid_paint(rgb)) for cap in caps)])


def colour(rng: np.random.Generator) -> Rgb:
    """Any colour."""
    red, green, blue = (int(value) for value in rng.integers(10, 250, 3))
    return red, green, blue


def write_models(folder: Path, members: list[tuple[str, Mesh]]) -> None:
    """Write a BOP models folder; without a handle turning about z changes nothing."""
    folder.mkdir(parents=True, exist_ok=True)
    info = {}
    for number, (kind, mesh) in enumerate(members, start=1):
        save_ply(mesh, folder / f"obj_{number:06d}.ply")
        info[str(number)] = models_info(mesh) | ({} if kind == "mug" else ABOUT_Z)
    (folder / "models_info.json").write_text(json.dumps(info, indent=2) + "\n", encoding="utf-8")


def main() -> int:
    """Write both folders."""
    chosen = parser().parse_args()
    rng = np.random.default_rng(chosen.seed)
    kinds = [("mug", "cup", "mug", "bowl")[number % 4] for number in range(chosen.count)]
    write_models(chosen.out / "unseen", [("mug", vessel("mug", rng))])
    write_models(chosen.out / "train", [(kind, vessel(kind, rng)) for kind in kinds])
    return 0


if __name__ == "__main__":
    sys.exit(main())
