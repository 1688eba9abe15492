"""Stand-ins for real frames: what settings are chosen on, and what a network's mistakes are collected on.

A scan of an object is not the object, and its colours are not those that a camera sees. So frames are rendered of
altered meshes, while refinement knows the ones that were scanned; and boards of markers lie among the backgrounds,
whose edges draw poses to them.

    python experiments/stand_ins.py meshes lmo/models --seed 17 --out altered
    python experiments/stand_ins.py boards backgrounds --out behind
    synthgen bop --object altered --backgrounds behind --frames 100 --out frames ...
    python experiments/stand_ins.py known frames lmo/models
"""

import argparse
import shutil
import sys
from pathlib import Path

import cv2
import numpy as np
from posecore.mesh import Mesh, load_mesh, save_ply

DISPLACED = 0.006
"""Standard deviation of the surface's displacement, of the box's diagonal."""
WAVES, COLOUR_WAVES = 12, 8
MARKERS, CELLS, CELL_PX, PITCH_PX = 6, 6, 29, 233
BOARDS = 5


def altered(mesh: Mesh, rng: np.random.Generator) -> Mesh:
    """The mesh with its surface moved along its normals in waves, and other colours."""
    extent_m = float(np.linalg.norm(np.ptp(mesh.vertices_m, axis=0)))

    def wave(lowest: float, highest: float) -> np.ndarray:
        k = rng.normal(size=3)
        k *= rng.uniform(lowest, highest) / extent_m / np.linalg.norm(k)
        return np.asarray(np.cos(mesh.vertices_m @ k + rng.uniform(0, 2 * np.pi)))

    moved = np.sum([wave(6, 25) * rng.uniform(0.3, 1) for _ in range(WAVES)], axis=0)
    moved = (moved - moved.mean()) / moved.std() * DISPLACED * extent_m
    gain, gamma = rng.uniform(0.75, 1.3, 3), rng.uniform(0.75, 1.35)
    mottled = np.sum([wave(5, 40)[:, None] * rng.normal(size=3) for _ in range(COLOUR_WAVES)], axis=0)
    rgb = np.clip((mesh.colours / 255.0) ** gamma * gain + 0.02 * mottled, 0, 1)
    return Mesh(
        vertices_m=mesh.vertices_m + mesh.normals * moved[:, None],
        faces=mesh.faces,
        normals=mesh.normals,
        vertex_rgb=np.rint(255 * rgb).astype(np.uint8),
        path=mesh.path,
    )


def board(rng: np.random.Generator) -> np.ndarray:
    """A sheet of square markers around an empty middle, RGB."""
    side = MARKERS * PITCH_PX
    sheet = np.full((side, side), 223, np.uint8)
    for row in range(MARKERS):
        for column in range(MARKERS):
            if abs(row - 2.5) < 1 and abs(column - 2.5) < 1:
                continue
            bits = np.pad(rng.random((CELLS - 2, CELLS - 2)) < 0.5, 1)
            marker = np.kron(np.where(bits, 223, 20), np.ones((CELL_PX, CELL_PX)))
            y, x = (int((i + 0.5) * PITCH_PX) - CELLS * CELL_PX // 2 for i in (row, column))
            sheet[y : y + CELLS * CELL_PX, x : x + CELLS * CELL_PX] = marker
    return np.repeat(cv2.GaussianBlur(sheet, (0, 0), 1.0)[..., None], 3, axis=2)


def parser() -> argparse.ArgumentParser:
    """The command line."""
    made = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    kinds = made.add_subparsers(dest="kind", required=True)
    meshes = kinds.add_parser("meshes", help="alter the meshes of a BOP models folder")
    meshes.add_argument("models", type=Path)
    meshes.add_argument("--seed", type=int, default=0)
    meshes.add_argument("--out", type=Path, required=True)
    boards = kinds.add_parser("boards", help="a folder of backgrounds with boards of markers among them")
    boards.add_argument("backgrounds", type=Path)
    boards.add_argument("--seed", type=int, default=0)
    boards.add_argument("--out", type=Path, required=True)
    known = kinds.add_parser("known", help="replace the models of rendered frames by those that refinement knows")
    known.add_argument("frames", type=Path)
    known.add_argument("models", type=Path)
    return made


def require_models(models: Path) -> None:
    """End where a folder is no BOP models folder."""
    if not (models / "models_info.json").is_file():
        raise SystemExit(f"Error: {models}: no models_info.json in it, expected a BOP models folder")


def alter(models: Path, seed: int, out: Path) -> None:
    """Write altered meshes under the names of the known ones."""
    require_models(models)
    out.mkdir(parents=True, exist_ok=True)
    rng = np.random.default_rng(seed)
    for file in sorted(models.glob("obj_*.ply")):
        save_ply(altered(load_mesh(file, units="mm"), rng), out / file.name, units="mm")
    shutil.copy(models / "models_info.json", out)


def draw_boards(backgrounds: Path, seed: int, out: Path) -> None:
    """Copy a folder of backgrounds and add boards."""
    shutil.copytree(backgrounds, out, dirs_exist_ok=True)
    rng = np.random.default_rng(seed)
    for number in range(BOARDS):
        cv2.imwrite(str(out / f"board{number}.png"), board(rng))


def make_known(frames: Path, models: Path) -> None:
    """Replace the models of rendered frames.

    Raises:
        SystemExit: One of the folders is not there, or they are the same.
    """
    require_models(models)
    if not frames.is_dir() or (frames / "models").resolve() == models.resolve():
        raise SystemExit(f"Error: {frames}: expected the folder of rendered frames, beside the models in {models}")
    shutil.rmtree(frames / "models", ignore_errors=True)
    shutil.copytree(models, frames / "models")


def main() -> int:
    """Run from the command line."""
    chosen = parser().parse_args()
    if chosen.kind == "meshes":
        alter(chosen.models, chosen.seed, chosen.out)
    elif chosen.kind == "boards":
        draw_boards(chosen.backgrounds, chosen.seed, chosen.out)
    else:
        make_known(chosen.frames, chosen.models)
    return 0


if __name__ == "__main__":
    sys.exit(main())
