"""How confident is a network of poses that are so far off? `python benchmarks/confidence.py CHECKPOINT DATASET...`.

Of every sixth image of each BOP dataset, three poses at each distance from the truth are scored as they are, and
after a refinement; a pose whose refinement fails counts as 0. What a tracker can tell apart shows in the table:
5 % of the scores lie under the first number. The last line is JSON.
"""

import argparse
import json
from pathlib import Path

import numpy as np
from posecore import se3
from posecore.bop import BopDataset
from refinenet.refine.network_refiner import Refiner
from refinenet.refiner import Frame, Request

DISTANCES = ((0, 0.0), (2, 0.02), (10, 0.05), (20, 0.1), (40, 0.2), (0, 1.0), (170, 0.0))
"""Degrees and diameters."""
EACH, STEP = 3, 6


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("checkpoint", type=Path)
    parser.add_argument("datasets", type=Path, nargs="+", help="BOP datasets of one object that the network knows")
    arguments = parser.parse_args()
    datasets = [BopDataset(path) for path in arguments.datasets]
    obj_id = datasets[0].obj_ids[0]
    mesh, rng = datasets[0].mesh(obj_id), np.random.default_rng(0)
    scores: dict[str, list[float]] = {}
    with Refiner.load(arguments.checkpoint, {obj_id: mesh}) as refiner:
        for dataset in datasets:
            for scene_id in dataset.scene_ids:
                for im_id in dataset.im_ids(scene_id)[::STEP]:
                    frame = Frame(image=dataset.rgb(scene_id, im_id), K=dataset.camera(scene_id, im_id).K)
                    truth = next(gt.T_cam_obj for gt in dataset.gt(scene_id, im_id) if gt.obj_id == obj_id)
                    for deg, diameters in DISTANCES:
                        poses = [
                            se3.perturb(truth, np.deg2rad(deg), diameters * mesh.diameter_m, rng) for _ in range(EACH)
                        ]
                        asked = [Request(obj_id=obj_id, T_cam_obj=T) for T in poses]
                        name = f"{deg} deg, {diameters} diameters"
                        scores.setdefault(name, []).extend(refiner.confidences(frame, asked).tolist())
                        refined = [result.confidence or 0.0 for result in refiner.refine_batch(frame, asked)]
                        scores.setdefault(f"{name}, refined", []).extend(refined)
    result = {}
    for name, values in scores.items():
        low, high = np.quantile(values, [0.05, 0.95])
        result[name] = {"n": len(values), "mean": round(float(np.mean(values)), 3)}
        result[name] |= {"low": round(float(low), 3), "high": round(float(high), 3)}
        print(f"{name:32} mean {np.mean(values):.2f}, 90 % between {low:.2f} and {high:.2f}")
    print(json.dumps({"benchmark": "confidence", "checkpoint": arguments.checkpoint.name, "scores": result}))


if __name__ == "__main__":
    main()
