"""BlenderProc's side of render_throughput.py: scene and hypothesis images of one mesh, with depth and segmentation.

Run by render_throughput.py in BlenderProc's own environment, never by hand. Many frames go through one render call,
which is the fastest way BlenderProc has. The last line is JSON: seconds a pair.
"""

import argparse
import json
import sys
import time

import blenderproc as bproc
import numpy as np


def main() -> None:
    """Render and print the time."""
    parser = argparse.ArgumentParser()
    parser.add_argument("--mesh", required=True)
    parser.add_argument("--diameter", type=float, required=True, help="in the mesh's own unit")
    parser.add_argument("--focal", type=float, required=True, help="pixels")
    parser.add_argument("--distance", type=float, nargs=2, required=True, help="in diameters")
    parser.add_argument("--side", type=int, required=True)
    parser.add_argument("--samples", type=int, required=True)
    parser.add_argument("--pairs", type=int, required=True)
    parser.add_argument("--denoiser", choices=["none", "default"], required=True)
    a = parser.parse_args()
    rng = np.random.default_rng(0)
    bproc.init()
    bproc.renderer.set_cpu_threads(0)
    thing = bproc.loader.load_obj(a.mesh)[0]
    thing.set_scale([1.0 / a.diameter] * 3)  # its clipping plane is at 0.1: the object is one unit large
    light = bproc.types.Light()
    light.set_type("POINT")
    light.set_location([2.0, -2.0, 2.0])
    light.set_energy(300)
    K = np.array([[a.focal, 0, a.side / 2], [0, a.focal, a.side / 2], [0, 0, 1.0]])
    bproc.camera.set_intrinsics_from_K_matrix(K, a.side, a.side)
    bproc.renderer.set_max_amount_of_samples(a.samples)
    bproc.renderer.enable_depth_output(activate_antialiasing=False)
    bproc.renderer.enable_segmentation_output(map_by=["instance"], default_values={"category_id": 0})
    if a.denoiser == "none":
        bproc.renderer.set_denoiser(None)
    took_s = []
    for pairs in (1, a.pairs):  # the first call compiles and loads
        bproc.utility.reset_keyframes()
        for frame in range(2 * pairs):
            thing.set_rotation_euler(rng.uniform(0, 2 * np.pi, 3), frame=frame)
            pose = bproc.math.build_transformation_mat([0, 0, rng.uniform(*a.distance)], np.eye(3))
            bproc.camera.add_camera_pose(pose, frame=frame)
        began = time.perf_counter()
        data = bproc.renderer.render()
        took_s.append((time.perf_counter() - began) / pairs)
        if len(data["colors"]) != 2 * pairs or not (np.array(data["depth"]) < 100).any(axis=(1, 2)).all():
            sys.exit("BlenderProc rendered empty images")
    print(json.dumps({"s_per_pair": took_s[-1]}))


if __name__ == "__main__":
    main()
