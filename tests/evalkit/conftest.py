"""A small BOP dataset with a plain and a symmetric object, rendered with the rasteriser."""

import numpy as np
import pytest
from posecore import se3
from posecore.bop import BopDataset, BopWriter, Estimate, FrameRecord, GroundTruth, ModelInfo, write_models
from posecore.camera import Camera
from posecore.mesh import load_mesh
from posecore.raster import Instance, Rasteriser
from posecore.symmetry import ContinuousSymmetry

TUG, BOBBIN = 1, 5
IMAGES = ((4, 0), (4, 3), (20, 1))
CAMERA = Camera(K=np.array([[260.0, 0, 101.5], [0, 262.0, 70.25], [0, 0, 1]]), width_px=200, height_px=140)


def place(rng, x_m):
    return se3.make_T(se3.random_rotation(rng), np.array([x_m, rng.uniform(-0.02, 0.02), rng.uniform(0.45, 0.6)]))


def write_dataset(root, meshes):
    turning = ModelInfo(
        diameter_m=meshes[BOBBIN].diameter_m,
        symmetries_continuous=(ContinuousSymmetry((0.0, 0.0, 1.0), (0.0, 0.0, 0.0)),),
    )
    write_models(root, meshes, {BOBBIN: turning})
    rng = np.random.default_rng(7)
    with Rasteriser(meshes) as rasteriser:
        for scene_id, im_id in IMAGES:
            poses = {TUG: place(rng, -0.06), BOBBIN: place(rng, 0.06)}
            instances = [Instance(obj_id=obj_id, T_cam_obj=T) for obj_id, T in poses.items()]
            layers = rasteriser.render_scene(instances, CAMERA.K, CAMERA.width_px, CAMERA.height_px)
            size = (CAMERA.width_px, CAMERA.height_px)
            masks = [rasteriser.render(i.obj_id, CAMERA.K, i.T_cam_obj[None], *size).mask[0] for i in instances]
            gts = [GroundTruth(obj_id=obj_id, T_cam_obj=T) for obj_id, T in poses.items()]
            visible = [layers.instance == index for index in range(len(gts))]
            with BopWriter(root, "test", scene_id) as writer:
                writer.add_frame(
                    im_id,
                    FrameRecord(
                        rgb=layers.rgb, depth_m=layers.depth_m, camera=CAMERA, gts=gts, masks=masks, masks_visib=visible
                    ),
                )
    return root


@pytest.fixture(scope="session")
def dataset_path(tmp_path_factory, tug_ply, bobbin_ply):
    meshes = {TUG: load_mesh(tug_ply), BOBBIN: load_mesh(bobbin_ply)}
    return write_dataset(tmp_path_factory.mktemp("bop") / "toys", meshes)


@pytest.fixture(scope="session")
def dataset(dataset_path):
    return BopDataset(dataset_path)


@pytest.fixture(scope="session")
def perfect(dataset):
    """Ground truth as estimates."""
    return [
        Estimate(scene_id=s, im_id=i, obj_id=gt.obj_id, T_cam_obj=gt.T_cam_obj)
        for s, i in IMAGES
        for gt in dataset.gt(s, i)
    ]
