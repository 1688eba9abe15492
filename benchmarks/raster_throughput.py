"""Time of the rasteriser per pose: batched or one call each, with or without colour, with or without back faces.

    python benchmarks/raster_throughput.py --mesh examples/objects/tug.ply --side 64 --batch 32

Both sides of each comparison alternate in one run; the medians of the repetitions are compared. The last line is JSON.
"""

import argparse
import json
import os
import statistics
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np
from posecore import se3
from posecore.camera import intrinsics
from posecore.mesh import Mesh, load_mesh
from posecore.raster import Rasteriser


def without_culling(mesh: Mesh) -> Mesh:
    """The same mesh, taken for one that is not closed."""
    twin = Mesh(
        vertices_m=mesh.vertices_m,
        faces=mesh.faces,
        normals=mesh.normals,
        vertex_rgb=mesh.vertex_rgb,
        uv=mesh.uv,
        texture_rgb=mesh.texture_rgb,
    )
    twin.__dict__["is_closed"] = False
    return twin


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--mesh", type=Path, default=Path("examples/objects/tug.ply"))
    parser.add_argument("--units", default="mm", choices=["mm", "cm", "m"])
    parser.add_argument("--side", type=int, default=64, help="pixels")
    parser.add_argument("--batch", type=int, default=32)
    parser.add_argument("--repeat", type=int, default=15)
    arguments = parser.parse_args()
    mesh = load_mesh(arguments.mesh, units=arguments.units)
    rng, side, n = np.random.default_rng(0), arguments.side, arguments.batch
    t = np.array([0.0, 0.0, 6 * mesh.diameter_m])
    T = np.stack([se3.make_T(se3.random_rotation(rng), t) for _ in range(n)])
    K = intrinsics(4 * side, 4 * side, side / 2, side / 2)
    rasteriser = Rasteriser({1: mesh, 2: without_culling(mesh)})
    ways: dict[str, Callable[[], object]] = {
        "batch": lambda: rasteriser.render(1, K, T, side, side),
        "batch_depth_only": lambda: rasteriser.render(1, K, T, side, side, rgb=False),
        "batch_all_faces": lambda: rasteriser.render(2, K, T, side, side),
        "one_call_a_pose": lambda: [rasteriser.render(1, K, T[i : i + 1], side, side) for i in range(n)],
    }
    times_ms: dict[str, list[float]] = {name: [] for name in ways}
    for repetition in range(arguments.repeat + 1):
        for name, draw in ways.items():
            began = time.perf_counter()
            draw()
            if repetition:  # the first round compiles and uploads
                times_ms[name].append(1e3 * (time.perf_counter() - began) / n)
    medians = {f"{name}_ms": round(statistics.median(values), 4) for name, values in times_ms.items()}
    facts = {
        "mesh": arguments.mesh.name,
        "faces": len(mesh.faces),
        "closed": mesh.is_closed,
        "side_px": side,
        "batch": n,
        "renderer": rasteriser.device,
        "software_threads": os.environ.get("LP_NUM_THREADS", "all"),
    }
    for name, value in medians.items():
        print(f"{name:24s} {value:8.3f} a pose, {value / medians['batch_ms']:5.2f} x batch")
    print(json.dumps({**facts, **medians}))


if __name__ == "__main__":
    main()
