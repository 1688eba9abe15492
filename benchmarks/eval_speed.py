"""What an estimate costs: `python benchmarks/eval_speed.py --dataset lmo --results start.csv`.

Rounds of the same work, after one that loads and renders the ground truth: every error and VSS of every estimate; VSD
at its ten tolerances beside them, of the images that have depth; and the pure functions one by one. Milliseconds an
estimate of processor time, of one process: medians over the rounds, then one JSON line.
"""

import argparse
import json
import os
import resource
import statistics
import time
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path

import numpy as np
from evalkit import metrics
from evalkit.evaluate import Evaluator
from evalkit.files import load_result_files
from evalkit.pairing import Pair, pair_up
from posecore.bop import BopDataset, symmetry_transforms


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--dataset", type=Path, required=True, help="BOP dataset with ground truth")
    parser.add_argument("--results", type=Path, required=True, help="BOP result file")
    parser.add_argument("--rounds", type=int, default=5)
    arguments = parser.parse_args()
    dataset = BopDataset(arguments.dataset)
    (file,) = load_result_files([arguments.results], dataset)
    pairs = [pair for pair in pair_up(dataset, file).pairs if pair.estimate is not None]
    deep = [pair for pair in pairs if dataset.depth_m(pair.scene_id, pair.im_id) is not None]
    with Evaluator(dataset, with_vsd=False) as errors, Evaluator(dataset) as both:
        work: dict[str, tuple[Callable[[], object], int]] = {"all": (lambda: errors.evaluate(pairs), len(pairs))}
        if deep:
            work["all_where_depth"] = (lambda: errors.evaluate(deep), len(deep))
            work["all_and_vsd_where_depth"] = (lambda: both.evaluate(deep), len(deep))
        work |= {name: (run, len(pairs)) for name, run in functions(dataset, errors, pairs).items()}
        times_ms = rounds(work, arguments.rounds)
    result: dict[str, object] = {
        "benchmark": "eval_speed",
        "estimates": len(pairs),
        "estimates_with_depth": len(deep),
        "cpus": os.cpu_count(),
        "load_average_1min": round(os.getloadavg()[0], 2),
        "peak_memory_mb": round(resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1e3, 1),
    }
    for name, value in times_ms.items():
        print(f"{name:24s} {value:8.3f} ms an estimate")
        result[f"{name}_ms"] = round(value, 4)
    print(json.dumps(result))


def functions(dataset: BopDataset, evaluator: Evaluator, pairs: Sequence[Pair]) -> dict[str, Callable[[], object]]:
    """Each error over all pairs by itself."""
    symmetries = {obj_id: symmetry_transforms(info) for obj_id, info in dataset.models_info.items()}
    cases = [
        (
            pair.estimate.T_cam_obj,
            pair.truth.T_cam_obj,
            evaluator.mesh(pair.truth.obj_id).vertices_m,
            symmetries[pair.truth.obj_id],
            evaluator.camera(pair.scene_id, pair.im_id).K,
        )
        for pair in pairs
        if pair.estimate is not None
    ]
    return {
        "add": lambda: [metrics.add(est, gt, points) for est, gt, points, _, _ in cases],
        "adi": lambda: [metrics.adi(est, gt, points) for est, gt, points, _, _ in cases],
        "mssd_all_vertices": lambda: [metrics.mssd(est, gt, points, turns) for est, gt, points, turns, _ in cases],
        "mspd_and_proj": lambda: [
            metrics.projection_errors(est, gt, K, points, turns) for est, gt, points, turns, K in cases
        ],
        "re_and_te": lambda: [(metrics.re(est, gt), metrics.te(est, gt)) for est, gt, _, _, _ in cases],
    }


def rounds(work: Mapping[str, tuple[Callable[[], object], int]], count: int) -> dict[str, float]:
    """Median processor time an estimate of each piece of work, in milliseconds; pieces take turns."""
    times_ms: dict[str, list[float]] = {name: [] for name in work}
    for index in range(count + 1):
        for name, (run, n) in work.items():
            began = time.process_time()
            run()
            if index:
                times_ms[name].append(1e3 * (time.process_time() - began) / n)
    return {name: float(np.round(statistics.median(values), 4)) for name, values in times_ms.items()}


if __name__ == "__main__":
    main()
