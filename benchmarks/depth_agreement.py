"""Where along the viewing ray gradients agree best with an image, from the annotated poses of a BOP dataset.

If the best depth is not the annotated one in the median, images and annotations (or meshes) do not fit each other, and
a method that goes by what it sees errs in depth by as much.

    python benchmarks/depth_agreement.py lmo
"""

import argparse
import sys
from pathlib import Path

import numpy as np
from posecore.bop import BopDataset
from posecore.errors import PoseError
from posecore.raster import Rasteriser
from refinenet.baselines.global_search import similarity_at
from refinenet.baselines.patch import TrackedObject
from refinenet.refiner import Frame

STRETCH = np.arange(-10, 11) * 0.005
"""Logarithms of depth over annotated depth."""


def main() -> None:
    """Print the mean agreement by depth, and the median of the best depths."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("dataset", type=Path, help="BOP dataset with ground truth")
    parser.add_argument("--visible", type=float, default=0.7, help="least visible share of an object")
    arguments = parser.parse_args()
    try:
        bop = BopDataset(arguments.dataset)
        meshes = {obj_id: bop.mesh(obj_id) for obj_id in bop.obj_ids}
    except PoseError as error:
        sys.exit(str(error))
    curves, best_m = [], []
    with Rasteriser(meshes) as rasteriser:
        for scene_id, im_id in bop.target_images():
            frame = Frame(image=bop.rgb(scene_id, im_id), K=bop.camera(scene_id, im_id).K)
            for truth in bop.gt(scene_id, im_id):
                if not truth.has_pose or truth.visib_fract is None or truth.visib_fract < arguments.visible:
                    continue
                mesh = meshes[truth.obj_id]
                target = TrackedObject(obj_id=truth.obj_id, mesh=mesh, rasteriser=rasteriser)
                centre_m = truth.T_cam_obj[:3, :3] @ mesh.center_m + truth.T_cam_obj[:3, 3]
                poses = [truth.T_cam_obj.copy() for _ in STRETCH]
                for T_cam_obj, stretch in zip(poses, STRETCH, strict=True):
                    T_cam_obj[:3, 3] += np.expm1(stretch) * centre_m
                curve = [similarity_at(frame, T_cam_obj, target) for T_cam_obj in poses]
                curves.append(curve)
                best_m.append(np.expm1(STRETCH[int(np.argmax(curve))]) * centre_m[2] / mesh.diameter_m)
    if not curves:
        sys.exit(f"{arguments.dataset}: no annotated pose is known to be visible by {arguments.visible:g} or more")
    for stretch, agreement in zip(STRETCH, np.mean(curves, axis=0), strict=True):
        print(f"depth {100 * np.expm1(stretch):+.1f} %: mean agreement {agreement:.4f}")
    print(f"{len(curves)} poses; best {np.median(best_m):+.3f} diameters from the annotated depth in the median")


if __name__ == "__main__":
    main()
