"""A rendered scene to track through, and a network that leaves poses unchanged."""

import json

import numpy as np
import pytest
import torch
from posecore import se3
from posecore.bop import BopWriter, Estimate, FrameRecord, GroundTruth, write_models
from posecore.bop import write_results as write
from posecore.camera import Camera
from posecore.raster import Instance, Rasteriser
from refinenet.config import load_config
from refinenet.models import checkpoint
from refinenet.models.networks import make_network

from ..conftest import HEIGHT_PX, WIDTH_PX, K, background

FRAMES, GONE, BACK = 14, range(4, 9), 9


def still_checkpoint(path, mesh):
    """A checkpoint whose network leaves poses where they are: its heads are zero."""
    config = load_config("compact")
    network = make_network(config.network)
    for head in (network.rotation, network.translation):
        torch.nn.init.zeros_(head.weight)
    objects = {"1": {"name": "thing", "diameter_m": mesh.diameter_m, "window_side_px": 150.0}}
    provenance = checkpoint.Provenance(
        config=config, step=0, dataset_sha256="0" * 64, objects=objects, camera_fx_px=K[0, 0]
    )
    checkpoint.save(path, network, provenance)
    return path


@pytest.fixture(scope="module")
def still(mesh, tmp_path_factory):
    return still_checkpoint(tmp_path_factory.mktemp("still") / "still.safetensors", mesh)


def write_scene(root, mesh, truths, gone, info=None):
    """The object at these poses before a still background; not in the frames that are `gone`."""
    behind = background(np.random.default_rng(3))
    camera = Camera(K=K, width_px=WIDTH_PX, height_px=HEIGHT_PX)
    with Rasteriser({1: mesh}) as rasteriser, BopWriter(root, "test", 1) as writer:
        for frame, T in enumerate(truths):
            layers = rasteriser.render_scene([Instance(obj_id=1, T_cam_obj=T)], K, WIDTH_PX, HEIGHT_PX)
            mask = (layers.instance == 0) & (frame not in gone)
            image = np.where(mask[..., None], layers.rgb, behind)
            gt = GroundTruth(obj_id=1, T_cam_obj=T, gt_index=0)
            writer.add_frame(
                frame,
                FrameRecord(
                    rgb=image,
                    depth_m=np.where(mask, layers.depth_m, 0),
                    camera=camera,
                    gts=[gt],
                    masks=[mask],
                    masks_visib=[mask],
                ),
            )
    write_models(root, {1: mesh}, {} if info is None else {1: info})


@pytest.fixture(scope="module")
def scene(mesh, tmp_path_factory):
    """A scene in which the object stands, comes nearer by 1 % a frame, is gone, and is back somewhere else."""
    root = tmp_path_factory.mktemp("scene") / "bop"
    rng = np.random.default_rng(3)
    background(rng)
    first, second = (
        se3.make_T(se3.random_rotation(rng), np.array([x, 0.01, 6 * mesh.diameter_m])) for x in (-0.08, 0.1)
    )
    truths = []
    for frame in range(FRAMES):
        T = (first if frame < GONE[0] else second).copy()
        T[:3, 3] *= 1 - 0.01 * min(frame, GONE[0])
        truths.append(T)
    write_scene(root, mesh, truths, GONE)
    starts = [Estimate(scene_id=1, im_id=i, obj_id=1, T_cam_obj=truths[i]) for i in (0, 2, BACK)]
    write(root / "start.csv", starts)
    camera = {"fx": K[0, 0], "fy": K[1, 1], "cx": K[0, 2], "cy": K[1, 2], "width": WIDTH_PX, "height": HEIGHT_PX}
    (root / "cam.json").write_text(json.dumps(camera))
    entry = {
        "obj_id": 1,
        "cam_R_m2c": truths[0][:3, :3].ravel().tolist(),
        "cam_t_m2c": (1e3 * truths[0][:3, 3]).tolist(),
    }
    (root / "pose.json").write_text(json.dumps([entry]))
    return root, truths
