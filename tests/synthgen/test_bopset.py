import json

import numpy as np
import pytest
from posecore.bop import BopDataset
from posecore.errors import DatasetError
from posecore.raster import Rasteriser
from synthgen.bopset import write_dataset


def tree(folder):
    return {str(p.relative_to(folder)): p.read_bytes() for p in sorted(folder.rglob("*")) if p.is_file()}


@pytest.fixture(scope="module")
def written(tmp_path_factory, config_of, tug):
    folder = tmp_path_factory.mktemp("bop") / "tug"
    write_dataset(folder, config_of(), {1: tug}, 3)
    return folder


def test_it_reads_back_as_bop_with_poses_that_match_the_pictures(written, tug):
    dataset = BopDataset(written)
    assert [(t.scene_id, t.im_id, t.obj_id, t.inst_count) for t in dataset.targets] == [(1, i, 1, 1) for i in range(3)]
    assert dataset.models_info[1].diameter_m == pytest.approx(tug.diameter_m, rel=1e-4)
    with Rasteriser({1: dataset.mesh(1)}) as rasteriser:
        for im_id in range(3):
            camera = dataset.camera(1, im_id)
            assert dataset.rgb(1, im_id).shape == (480, 640, 3)
            (truth,) = dataset.gt(1, im_id)
            alone = rasteriser.render(1, camera.K, truth.T_cam_obj[None], 640, 480).depth_m[0]
            depth = dataset.depth_m(1, im_id)
            same = (alone > 0) & (np.abs(depth - alone) < 2e-4)
            assert truth.visib_fract == pytest.approx(same.sum() / (alone > 0).sum(), abs=0.02)


def test_masks_agree_with_the_info(written):
    import cv2

    info = json.loads((written / "test/000001/scene_gt_info.json").read_text())
    for im_id in range(3):
        masks = [
            cv2.imread(str(written / f"test/000001/{kind}/{im_id:06d}_000000.png"), cv2.IMREAD_UNCHANGED) > 0
            for kind in ("mask", "mask_visib")
        ]
        entry = info[str(im_id)][0]
        assert (masks[1] <= masks[0]).all()
        assert entry["px_count_visib"] == masks[1].sum()
        assert entry["px_count_all"] >= masks[0].sum()


def test_a_started_dataset_is_continued_to_the_same_bytes(written, tmp_path, config_of, tug):
    class Stop(Exception):
        pass

    def stop(im_id):
        if im_id == 1:
            raise Stop

    with pytest.raises(Stop):
        write_dataset(tmp_path / "b", config_of(), {1: tug}, 3, on_frame=stop)
    write_dataset(tmp_path / "b", config_of(), {1: tug}, 3)
    assert tree(tmp_path / "b") == tree(written)


def test_another_dataset_is_refused(written, config_of, tug, tmp_path):
    with pytest.raises(DatasetError, match="config differ"):
        write_dataset(written, config_of("seed=9"), {1: tug}, 3)
    with pytest.raises(DatasetError, match="frames differ"):
        write_dataset(written, config_of(), {1: tug}, 4)
    (tmp_path / "notes.txt").write_text("mine")
    with pytest.raises(DatasetError, match="not empty"):
        write_dataset(tmp_path, config_of(), {1: tug}, 3)
