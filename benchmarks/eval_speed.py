"""Time of an evaluation per estimate: `python benchmarks/eval_speed.py --dataset lmo --results initial.csv`.

Rounds of the same work, after a first one that loads models and renders the ground truth: all errors and VSS of all
estimates; the same with VSD at its ten tolerances for images with depth; and each error by itself, ADI also with a k-d
tree for each estimate (`adi_trees`). Milliseconds of processor time an estimate in a single process: medians over the
rounds, then one JSON line.

    python benchmarks/eval_speed.py --dataset lmo --results initial.csv --synthetic 200000 --workers 2

scores so many estimates drawn near the ground truth instead, once, after a tenth as many: memory may grow with their
number only by the estimates and the error table.
"""

import argparse
import json
import os
import resource
import statistics
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
from evalkit.evaluation.evaluator import Evaluator
from evalkit.inputs.pairing import MatchedPose, pair_up
from evalkit.inputs.result_files import load_result_files
from evalkit.pose_errors import metrics
from evalkit.pose_errors.nearest_points import NearestPoints
from jaxtyping import Float
from posecore import se3
from posecore.bop import BopDataset, symmetry_transforms
from scipy.spatial import cKDTree


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--dataset", type=Path, required=True, help="BOP dataset with ground truth")
    parser.add_argument("--results", type=Path, required=True, help="BOP result file")
    parser.add_argument("--rounds", type=int, default=5)
    parser.add_argument(
        "--synthetic", type=int, default=0, metavar="N", help="score N estimates drawn near the ground truth"
    )
    parser.add_argument("--workers", type=int, default=1, help="processes, with --synthetic")
    arguments = parser.parse_args()
    dataset = BopDataset(arguments.dataset)
    (file,) = load_result_files([arguments.results], dataset)
    pairs = [pair for pair in pair_up(dataset, file).pairs if pair.estimate is not None]
    if arguments.synthetic:
        print(json.dumps(many(dataset, pairs, arguments.synthetic, arguments.workers)))
        return
    deep = [pair for pair in pairs if dataset.depth_m(pair.scene_id, pair.im_id) is not None]
    with Evaluator(dataset, with_vsd=False) as errors, Evaluator(dataset) as both:
        work: dict[str, tuple[Callable[[], object], int]] = {"all": (lambda: errors.evaluate(pairs), len(pairs))}
        if deep:
            both.evaluate(pairs)
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
        "peak_memory_mb": peak_mb(resource.RUSAGE_SELF),
    }
    for name, value in times_ms.items():
        print(f"{name:24s} {value:8.3f} ms an estimate")
        result[f"{name}_ms"] = round(value, 4)
    print(json.dumps(result))


def many(dataset: BopDataset, pairs: Sequence[MatchedPose], count: int, workers: int) -> dict[str, object]:
    """Score many estimates; times, and peak memory of this process and of its largest worker."""
    result: dict[str, object] = {
        "benchmark": "eval_speed_synthetic",
        "workers": workers,
        "cpus": os.cpu_count(),
        "load_average_1min": round(os.getloadavg()[0], 2),
    }
    with Evaluator(dataset, with_vsd=False, workers=workers) as evaluator:
        for name, n in (("tenth", count // 10), ("all", count)):
            drawn = near_ground_truth(pairs, n)
            began = time.monotonic()
            table = evaluator.evaluate(drawn)
            print(f"{len(table)} estimates in {time.monotonic() - began:.0f} s")
            result |= {f"{name}_estimates": len(table), f"{name}_wall_s": round(time.monotonic() - began, 1)}
            result[f"{name}_peak_memory_mb"] = peak_mb(resource.RUSAGE_SELF)
    if workers > 1:
        result["largest_worker_peak_memory_mb"] = peak_mb(resource.RUSAGE_CHILDREN)
    return result


def near_ground_truth(pairs: Sequence[MatchedPose], count: int) -> list[MatchedPose]:
    """Estimates up to 20 degrees and 3 cm from the ground truth, taken in turn."""
    rng = np.random.default_rng(0)
    drawn = []
    for index in range(count):
        pair = pairs[index % len(pairs)]
        assert pair.estimate is not None
        pose = se3.perturb(pair.gt.T_cam_obj, rng.uniform(0, 0.35), rng.uniform(0, 0.03), rng)
        drawn.append(replace(pair, estimate=replace(pair.estimate, T_cam_obj=pose)))
    return drawn


def peak_mb(who: int) -> float:
    """Peak resident memory."""
    return round(resource.getrusage(who).ru_maxrss / 1e3, 1)


def functions(
    dataset: BopDataset, evaluator: Evaluator, pairs: Sequence[MatchedPose]
) -> dict[str, Callable[[], object]]:
    """Each error over all pairs by itself, an object's together."""
    by_object: dict[int, list[MatchedPose]] = {}
    for pair in pairs:
        by_object.setdefault(pair.gt.obj_id, []).append(pair)
    cases = [
        (
            np.stack([pair.estimate.T_cam_obj for pair in of_object if pair.estimate is not None]),
            np.stack([pair.gt.T_cam_obj for pair in of_object]),
            evaluator.mesh(obj_id).vertices_m,
            symmetry_transforms(dataset.models_info[obj_id]),
            np.stack([evaluator.camera(pair.scene_id, pair.im_id).K for pair in of_object]),
        )
        for obj_id, of_object in by_object.items()
    ]
    nearest = [NearestPoints(points) for _, _, points, _, _ in cases]
    return {
        "add": lambda: [metrics.add(est, gt, points) for est, gt, points, _, _ in cases],
        "adi": lambda: [metrics.adi(est, gt, near) for (est, gt, *_), near in zip(cases, nearest, strict=True)],
        "adi_trees": lambda: [adi_by_trees(est, gt, points) for est, gt, points, _, _ in cases],
        "mssd_all_vertices": lambda: [
            metrics.mssd(est, gt, points, transforms) for est, gt, points, transforms, _ in cases
        ],
        "mspd_and_proj": lambda: [
            metrics.projection_errors(est, gt, K, points, transforms) for est, gt, points, transforms, K in cases
        ],
        "re_and_te": lambda: [(metrics.re(est, gt), metrics.te(est, gt)) for est, gt, _, _, _ in cases],
    }


def adi_by_trees(
    T_est: Float[np.ndarray, "b 4 4"], T_gt: Float[np.ndarray, "b 4 4"], points_m: Float[np.ndarray, "n 3"]
) -> Float[np.ndarray, " b"]:
    """ADI with a k-d tree for each estimate: the reference of `metrics.adi`, which walks a Delaunay graph."""
    errors_m = []
    for est, gt in zip(T_est, T_gt, strict=True):
        tree = cKDTree(se3.apply(est, points_m), leafsize=64, balanced_tree=False, compact_nodes=False)
        errors_m.append(np.mean(tree.query(se3.apply(gt, points_m))[0]))
    return np.array(errors_m)


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
