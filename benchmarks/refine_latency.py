"""How long one refinement iteration takes, rendering included: `python benchmarks/refine_latency.py`.

One image of the object over noise, poses around its true one. For each batch size, iterations of all batch sizes are
timed in turn, so that a busy machine slows all of them alike; medians are printed, then one JSON line. An iteration
renders the hypotheses and cuts both patches (render), runs the network and updates the poses (network). A whole
refinement takes up to five of them and a last render for the confidence.
"""

import argparse
import json
import os
import statistics
import time
from datetime import UTC, datetime
from pathlib import Path

import numpy as np
import torch
from posecore import se3
from posecore.camera import intrinsics
from posecore.mesh import Mesh, load_mesh
from posecore.raster import Rasteriser
from refinenet.refine.network_refiner import Refiner
from refinenet.refiner import Frame, Request

ROOT = Path(__file__).resolve().parent.parent
K = intrinsics(572.4, 573.6, 325.3, 242.0)
WIDTH_PX, HEIGHT_PX = 640, 480
ITERATIONS = 5


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    shipped = ROOT / "examples" / "checkpoints" / "tug_compact.safetensors"
    parser.add_argument("--checkpoint", type=Path, default=shipped)
    parser.add_argument("--mesh", type=Path, default=ROOT / "examples" / "objects" / "tug.ply")
    parser.add_argument("--batches", type=int, nargs="+", default=[1, 8, 64])
    parser.add_argument("--repeat", type=int, default=30)
    parser.add_argument("--threads", type=int, default=0, help="torch threads; 0 leaves torch's choice")
    parser.add_argument("--device", choices=["auto", "cpu", "cuda"], default="auto")
    arguments = parser.parse_args()
    if arguments.threads:
        torch.set_num_threads(arguments.threads)
    mesh = load_mesh(arguments.mesh, units="mm")
    frame, T_true = scene(mesh)
    rng = np.random.default_rng(1)
    refiner = Refiner.load(
        arguments.checkpoint, {1: mesh}, iterations=ITERATIONS, device=arguments.device, batch=max(arguments.batches),
        allow_other_mesh=True,
    )  # fmt: skip
    requests = {
        b: [Request(obj_id=1, T_cam_obj=se3.perturb(T_true, 0.2, 0.1 * mesh.diameter_m, rng)) for _ in range(b)]
        for b in arguments.batches
    }
    times_ms: dict[int, dict[str, list[float]]] = {
        b: {name: [] for name in ("iteration", "render", "network", "refine")} for b in requests
    }
    for repetition in range(arguments.repeat + 3):
        for b, of_batch in requests.items():
            parts = iteration_ms(refiner, frame, of_batch)
            if repetition >= 3:  # the first rounds compile, upload and warm up
                for name, value in parts.items():
                    times_ms[b][name].append(value)
    with refiner:
        report(arguments, refiner, times_ms)


def scene(mesh: Mesh) -> tuple[Frame, np.ndarray]:
    """An image of the object over noise, and its pose."""
    rng = np.random.default_rng(0)
    T = se3.make_T(se3.random_rotation(rng), np.array([0.02, -0.03, 6 * mesh.diameter_m]))
    with Rasteriser({1: mesh}) as rasteriser:
        layers = rasteriser.render(1, K, T[None], WIDTH_PX, HEIGHT_PX)
    assert layers.rgb is not None
    noise = rng.integers(0, 256, (HEIGHT_PX, WIDTH_PX, 3), dtype=np.uint8)
    return Frame(image=np.where(layers.mask[0][..., None], layers.rgb[0], noise), K=K), T


def iteration_ms(refiner: Refiner, frame: Frame, requests: list[Request]) -> dict[str, float]:
    """Time of one iteration, of its two parts, and of a whole refinement."""
    pivots = refiner.frames.requests(requests)
    T, obj_id = np.stack([r.T_cam_obj for r in pivots]), np.array([r.obj_id for r in pivots])
    began = time.perf_counter()
    patches = refiner.patch_renderer.render_and_crop(frame, T, obj_id)
    rendered = time.perf_counter()
    refiner.updated(patches, T[patches.rows])
    updated = time.perf_counter()
    refiner.refine_batch(frame, requests)
    end = time.perf_counter()
    return {
        "iteration": 1e3 * (updated - began),
        "render": 1e3 * (rendered - began),
        "network": 1e3 * (updated - rendered),
        "refine": 1e3 * (end - updated),
    }


def report(arguments: argparse.Namespace, refiner: Refiner, times_ms: dict[int, dict[str, list[float]]]) -> None:
    """Print a line for each batch size and the JSON line."""
    result: dict[str, object] = {
        "benchmark": "refine_latency",
        "date": datetime.now(UTC).date().isoformat(),
        "checkpoint": arguments.checkpoint.name,
        "preset": refiner.checkpoint.provenance.config.preset,
        "device": torch.cuda.get_device_name() if refiner.device.type == "cuda" else "cpu",
        "torch_threads": torch.get_num_threads(),
        "renderer": refiner.patch_renderer.device,
        "software_threads": os.environ.get("LP_NUM_THREADS", "all"),
        "cpus": os.cpu_count(),
        "load_average_1min": round(os.getloadavg()[0], 2),
    }
    for b, parts in times_ms.items():
        median = {name: statistics.median(values) for name, values in parts.items()}
        print(
            f"batch {b:3d}: {median['iteration']:8.2f} ms an iteration ({median['render']:.2f} render and cut, "
            f"{median['network']:.2f} network), {median['iteration'] / b:.2f} ms a hypothesis, "
            f"best {min(parts['iteration']):.2f} ms; whole refinement {median['refine']:.1f} ms"
        )
        for name, value in median.items():
            result[f"batch_{b}_{name}_ms"] = round(value, 3)
        result[f"batch_{b}_hypothesis_ms"] = round(median["iteration"] / b, 3)
        result[f"batch_{b}_hypotheses_per_s"] = round(1e3 * b / median["iteration"], 1)
        result[f"batch_{b}_iteration_best_ms"] = round(min(parts["iteration"]), 3)
    print(json.dumps(result))


if __name__ == "__main__":
    main()
