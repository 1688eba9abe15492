"""What levels of detail save and change: `python benchmarks/levels_of_detail.py --object ../shared/data/lmo/models`.

Scenes of the preset `default` with the rasteriser, objects as occluders too, once with every face and once with levels,
in turn in one process on one core: processor time of a scene, and what differs between the pairs. Loading (reading,
diameter, levels) is timed of `--sphere`, an icosphere of so many subdivisions, of `--ball`, a bumpy ball of so many
rows with all its meridians' vertices at each pole (1000 rows: two million faces), and of `--mesh`; the peak of memory
is that of the process so far. The last line is JSON.
"""

import argparse
import json
import resource
import statistics
import tempfile
import time
from collections.abc import Callable
from dataclasses import replace
from functools import cache
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
import trimesh
from posecore.detail import with_levels
from posecore.mesh import load_mesh
from posecore.shard import BIT_OBJECT
from synthgen.config import load_config
from synthgen.draw.target import make_targets
from synthgen.inputs.sources import Sources
from synthgen.pairs.pair_maker import PairMaker, limit_threads

T = TypeVar("T")

WARM_SCENES = 16


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--object", type=Path, help="mesh or folder, in mm")
    parser.add_argument("--hypotheses", type=int, action="append", help="hypotheses a scene, 1 and 8 by default")
    parser.add_argument("--scenes", type=int, default=40)
    parser.add_argument("--sphere", type=int, action="append", default=[], metavar="SUBDIVISIONS")
    parser.add_argument("--ball", type=int, action="append", default=[], metavar="ROWS")
    parser.add_argument("--mesh", type=Path, action="append", default=[], help="mesh file that is loaded; repeatable")
    arguments = parser.parse_args()
    limit_threads(1)
    result: dict[str, Any] = {"benchmark": "levels_of_detail"}
    if arguments.object is not None:
        sources = Sources(objects=(arguments.object,), occluders=arguments.object)
        for hypotheses in arguments.hypotheses or [1, 8]:
            result[f"{hypotheses} a scene"] = scenes(sources, hypotheses, arguments.scenes)
    with tempfile.TemporaryDirectory() as folder:
        files = [sphere(Path(folder), subdivisions) for subdivisions in arguments.sphere]
        files += [ball(Path(folder), rows) for rows in arguments.ball]
        for file in (*files, *arguments.mesh):
            result[file.name] = loading(file)
    print(json.dumps(result))


def scenes(sources: Sources, hypotheses: int, count: int) -> dict[str, float]:
    """Processor milliseconds of a scene with every face and with levels, and differences of their pairs."""
    config = load_config("default", [f"hypotheses_per_scene={hypotheses}"], {"engine": "raster"})
    meshes, assets = sources.meshes(), sources.assets()
    levelled = cache(with_levels)
    fewer = {obj_id: levelled(mesh) for obj_id, mesh in meshes.items()}
    full = PairMaker(config, make_targets(meshes, config, assets), assets, threads=1)
    assets = replace(assets, occluders=tuple(map(levelled, assets.occluders)))
    levels = PairMaker(config, make_targets(fewer, config, assets), assets, threads=1)
    for scene in range(WARM_SCENES):  # compiles; uploads meshes
        full.samples(10_000_000 + scene), levels.samples(10_000_000 + scene)
    spent: dict[str, list[float]] = {"every_face_ms": [], "levels_ms": []}
    differences: list[dict[str, float]] = []
    for scene in range(count):
        (a, full_ms), (b, levels_ms) = timed(lambda: full.samples(scene)), timed(lambda: levels.samples(scene))  # noqa: B023
        spent["every_face_ms"].append(full_ms)
        spent["levels_ms"].append(levels_ms)
        differences += [difference(a, b, i) for i in range(hypotheses)]
    full.close()
    levels.close()
    values = {name: round(statistics.mean(times), 1) for name, times in spent.items()}
    for name in differences[0]:
        column = [row[name] for row in differences]
        values |= {f"{name}_mean": round(statistics.mean(column), 4), f"{name}_largest": round(max(column), 4)}
    print(f"{hypotheses} hypotheses a scene: {values}", flush=True)
    return values


def difference(a: dict[str, np.ndarray], b: dict[str, np.ndarray], i: int) -> dict[str, float]:
    """How much one pair of both sides differs."""
    contour = max(1, int((a["scene_distance_px"][i] == 0).sum()))
    return {
        "silhouette_px_per_contour_px": float(((a["scene_mask"][i] ^ b["scene_mask"][i]) & BIT_OBJECT > 0).sum())
        / contour,
        "distance_px": float(np.abs(a["scene_distance_px"][i] - b["scene_distance_px"][i]).mean()),
        "visible_fraction": float(abs(a["visible_fraction"][i] - b["visible_fraction"][i])),
        "hypothesis_levels_of_255": float(
            np.abs(a["hypothesis_rgb"][i].astype(int) - b["hypothesis_rgb"][i]).mean(where=a["hypothesis_rgb"][i] > 0)
        ),
        "pose": float(np.abs(a["T_cam_obj_hypothesis"][i] - b["T_cam_obj_hypothesis"][i]).max()),
    }


def sphere(folder: Path, subdivisions: int) -> Path:
    """A sphere of 100 mm; every vertex is on the hull."""
    file = folder / f"sphere{subdivisions}.ply"
    trimesh.creation.icosphere(subdivisions=subdivisions, radius=50.0).export(file)
    return file


def ball(folder: Path, rows: int) -> Path:
    """A bumpy ball of 100 mm: each pole is as many vertices at one position as there are meridians."""
    polar, azimuth = np.meshgrid(
        np.linspace(0, np.pi, rows + 1), np.linspace(0, 2 * np.pi, rows, endpoint=False), indexing="ij"
    )
    radius_mm = 50 * (1 + 0.1 * np.sin(5 * azimuth) * np.sin(4 * polar))
    direction = (np.sin(polar) * np.cos(azimuth), np.sin(polar) * np.sin(azimuth), np.cos(polar))
    points = (radius_mm * np.stack(direction)).reshape(3, -1).T
    row, column = np.meshgrid(np.arange(rows), np.arange(rows), indexing="ij")
    a, b = (row * rows + column).reshape(-1), (row * rows + (column + 1) % rows).reshape(-1)
    faces = np.concatenate([np.stack([a, a + rows, b], axis=-1), np.stack([b, a + rows, b + rows], axis=-1)])
    file = folder / f"ball{rows}.ply"
    trimesh.Trimesh(points, faces, process=False).export(file)
    return file


def loading(file: Path) -> dict[str, float]:
    """Processor seconds of reading, diameter and levels, and the process' peak memory."""
    mesh, read_ms = timed(lambda: load_mesh(file))
    _, diameter_ms = timed(lambda: replace(mesh).diameter_m)  # a copy computes it anew
    _, levels_ms = timed(lambda: with_levels(mesh))
    values = {
        "faces": len(mesh.faces),
        "read_s": round(read_ms / 1e3, 2),
        "diameter_s": round(diameter_ms / 1e3, 2),
        "levels_s": round(levels_ms / 1e3, 2),
        "peak_gb": round(resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1e6, 2),
    }
    print(f"{file.name}: {values}", flush=True)
    return values


def timed(action: Callable[[], T]) -> tuple[T, float]:
    """A result and the processor milliseconds that it took, which other work on the machine hardly changes."""
    began = time.process_time()
    result = action()
    return result, 1e3 * (time.process_time() - began)


if __name__ == "__main__":
    main()
