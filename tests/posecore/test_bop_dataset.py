"""BOP folders: written ones read back the same, the format's traps, and one clear line for every broken folder."""

import json
import shutil

import cv2
import numpy as np
import pytest
from posecore import se3
from posecore.bop import (
    BopDataset,
    BopTarget,
    BopWriter,
    FrameRecord,
    GroundTruth,
    ModelInfo,
    visible_targets,
    write_models,
    write_targets,
)
from posecore.bop.images import image_size, read_rgb, write_image
from posecore.bop.writer import gt_info
from posecore.camera import Camera
from posecore.errors import DatasetError
from posecore.mesh import load_mesh
from posecore.symmetry import ContinuousSymmetry

WIDTH, HEIGHT = 40, 30
BOBBIN = ModelInfo(
    diameter_m=0.1,
    symmetries_discrete=(se3.make_T(np.diag([1.0, -1.0, -1.0]), np.array([0.0, 0.001, 0.0])),),
    symmetries_continuous=(ContinuousSymmetry((0.0, 0.0, 1.0), (0.0, 0.002, 0.0)),),
)


def camera(focal=50.0):
    return Camera(K=np.array([[focal, 0, 20.5], [0, focal, 15.25], [0, 0, 1]]), width_px=WIDTH, height_px=HEIGHT)


def pose(seed):
    rng = np.random.default_rng(seed)
    return se3.make_T(se3.random_rotation(rng), np.array([0.01, -0.02, 0.5 + 0.01 * seed]))


def box_mask(x, y, w, h, width=WIDTH, height=HEIGHT):
    mask = np.zeros((height, width), bool)
    mask[y : y + h, x : x + w] = True
    return mask


def write_frame(writer, im_id, *, focal=50.0, obj_id=2):
    rgb = np.random.default_rng(im_id).integers(0, 255, (HEIGHT, WIDTH, 3), dtype=np.uint8)
    depth_m = np.full((HEIGHT, WIDTH), 0.4567, np.float32)
    gts = [GroundTruth(obj_id=obj_id, T_cam_obj=pose(im_id))]
    full, visible = box_mask(5, 6, 10, 8), box_mask(5, 6, 5, 8)
    writer.add_frame(
        im_id, FrameRecord(rgb=rgb, depth_m=depth_m, camera=camera(focal), gts=gts, masks=[full], masks_visib=[visible])
    )
    return rgb, gts[0]


@pytest.fixture
def dataset_path(tmp_path, bobbin_ply):
    root = tmp_path / "things"
    write_models(root, {2: load_mesh(bobbin_ply)}, {2: BOBBIN})
    for scene_id, im_id in ((3, 0), (11, 7)):
        with BopWriter(root, "test", scene_id) as writer:
            write_frame(writer, im_id, focal=50.0 + im_id)
    return root


def test_written_dataset_reads_back(dataset_path, bobbin_ply):
    dataset = BopDataset(dataset_path)
    assert (dataset.name, dataset.split, dataset.scene_ids, dataset.obj_ids) == ("things", "test", [3, 11], [2])
    assert dataset.targets == [BopTarget(scene_id=3, im_id=0, obj_id=2), BopTarget(scene_id=11, im_id=7, obj_id=2)]
    assert np.allclose(dataset.camera(11, 7).K, camera(57.0).K)
    assert (dataset.camera(3, 0).width_px, dataset.camera(3, 0).height_px) == (WIDTH, HEIGHT)
    (truth,) = dataset.gt(11, 7)
    assert np.allclose(truth.T_cam_obj, pose(7), atol=1e-12)
    assert truth.visib_fract == 0.5
    depth_m = dataset.depth_m(3, 0)
    assert depth_m is not None
    assert np.allclose(depth_m, 0.4567, atol=0.00006)
    rgb = np.random.default_rng(7).integers(0, 255, (HEIGHT, WIDTH, 3), dtype=np.uint8)
    assert np.array_equal(dataset.rgb(11, 7), rgb)
    assert np.allclose(dataset.mesh(2).vertices_m, load_mesh(bobbin_ply).vertices_m, atol=1e-7)


def test_symmetries_read_back_in_metres(dataset_path):
    info = BopDataset(dataset_path).models_info[2]
    assert np.allclose(info.symmetries_discrete[0], BOBBIN.symmetries_discrete[0])
    assert np.allclose(info.symmetries_continuous[0].offset_m, (0.0, 0.002, 0.0))
    assert info.is_symmetric


def test_scene_gt_info_follows_bop(dataset_path):
    entry = json.loads((dataset_path / "test/000003/scene_gt_info.json").read_text())["0"][0]
    assert entry == {
        "bbox_obj": [5, 6, 9, 7],
        "bbox_visib": [5, 6, 4, 7],
        "px_count_all": 80,
        "px_count_valid": 80,
        "px_count_visib": 40,
        "visib_fract": 0.5,
    }
    masks = [dataset_path / f"test/000003/{folder}/000000_000000.png" for folder in ("mask", "mask_visib")]
    assert [int((cv2.imread(str(path), -1) == 255).sum()) for path in masks] == [80, 40]


@pytest.mark.slow
def test_boxes_match_real_annotations(shared_data):
    """px counts and boxes of LM-O's own scene_gt_info come out of silhouettes rendered at its ground truth."""
    raster = pytest.importorskip("posecore.raster")
    dataset = BopDataset(shared_data / "lmo")
    entries = json.loads((shared_data / "lmo/test/000002/scene_gt_info.json").read_text())["3"]
    cam = dataset.camera(2, 3)
    with raster.Rasteriser({obj_id: dataset.mesh(obj_id) for obj_id in dataset.obj_ids}) as rasteriser:
        for truth, entry in zip(dataset.gt(2, 3), entries, strict=True):
            pose_batch = truth.T_cam_obj[None]
            mask = rasteriser.render(truth.obj_id, cam.K, pose_batch, 640, 480, rgb=False).mask[0]
            info = gt_info(mask, mask, mask, dataset.depth_m(2, 3))
            assert info["bbox_obj"] == entry["bbox_obj"]
            assert abs(info["px_count_all"] - entry["px_count_all"]) <= 2
            assert abs(info["px_count_valid"] - entry["px_count_valid"]) <= 2


def test_box_reaches_outside_the_image(tmp_path):
    canvas = box_mask(10, 20, 25, 5, width=WIDTH + 40, height=HEIGHT + 40)
    writer = BopWriter(tmp_path, "test", 1)
    rgb = np.zeros((HEIGHT, WIDTH, 3), np.uint8)
    gts = [GroundTruth(obj_id=1, T_cam_obj=pose(1))]
    inside = canvas[20 : 20 + HEIGHT, 20 : 20 + WIDTH]
    writer.add_frame(
        0,
        FrameRecord(
            rgb=rgb,
            depth_m=None,
            camera=camera(),
            gts=gts,
            masks=[canvas],
            masks_visib=[inside],
            mask_origin_px=(20, 20),
        ),
    )
    writer.close()
    entry = json.loads((tmp_path / "test/000001/scene_gt_info.json").read_text())["0"][0]
    assert entry["bbox_obj"] == [-10, 0, 24, 4]
    assert entry["bbox_visib"] == [0, 0, 14, 4]
    assert (entry["px_count_all"], entry["px_count_visib"], entry["visib_fract"]) == (125, 75, 0.6)


def test_frames_count_once_they_are_noted(dataset_path, monkeypatch):
    """A writer killed after its images leaves the dataset as it was."""
    writer = BopWriter(dataset_path, "test", 3)
    monkeypatch.setattr(writer, "commit", lambda *_: (_ for _ in ()).throw(KeyboardInterrupt))
    with pytest.raises(KeyboardInterrupt):
        write_frame(writer, 1)
    assert (dataset_path / "test/000003/rgb/000001.png").is_file()
    assert BopWriter(dataset_path, "test", 3).im_ids == [0]
    assert BopDataset(dataset_path).im_ids(3) == [0]


def test_the_journal_of_a_killed_writer_is_taken_up(dataset_path):
    """Its frames count; a line that was cut off does not, and is not in the way of the next one."""
    killed = BopWriter(dataset_path, "test", 3)
    write_frame(killed, 4)
    write_frame(killed, 5)
    journal = dataset_path / "test/000003/.frames.jsonl"
    journal.write_bytes(journal.read_bytes()[:-20])
    assert BopDataset(dataset_path).im_ids(3) == [0]
    with BopWriter(dataset_path, "test", 3) as writer:
        assert writer.im_ids == [0, 4]
        write_frame(writer, 7)
    assert not journal.exists()
    assert BopDataset(dataset_path).im_ids(3) == [0, 4, 7]
    assert len(BopDataset(dataset_path).gt(3, 4)) == 1
    with pytest.raises(DatasetError, match="image 8: the scene is closed"):
        write_frame(writer, 8)


def test_what_is_written_for_a_frame_does_not_grow_with_the_scene(tmp_path):
    rgb, mask = np.zeros((HEIGHT, WIDTH, 3), np.uint8), box_mask(0, 0, 4, 4)
    sizes = []
    with BopWriter(tmp_path, "test", 1) as writer:
        for im_id in range(40):
            truth = GroundTruth(obj_id=1, T_cam_obj=pose(1))
            writer.add_frame(
                im_id,
                FrameRecord(rgb=rgb, depth_m=None, camera=camera(), gts=[truth], masks=[mask], masks_visib=[mask]),
            )
            sizes.append((tmp_path / "test/000001/.frames.jsonl").stat().st_size)
            assert not (tmp_path / "test/000001/scene_gt.json").exists()
    assert max(np.diff(sizes)) <= min(np.diff(sizes)) + 1
    assert BopDataset(tmp_path).im_ids(1) == list(range(40))


def test_targets_count_instances_that_are_visible_enough(tmp_path):
    rgb, full = np.zeros((HEIGHT, WIDTH, 3), np.uint8), box_mask(0, 0, 10, 10)
    parts = [box_mask(0, 0, 10, 1), box_mask(0, 0, 9, 1), full, box_mask(0, 0, 0, 0)]
    gts = [GroundTruth(obj_id=i, T_cam_obj=pose(i)) for i in (2, 2, 2, 7)]
    with BopWriter(tmp_path, "test", 4) as writer:
        writer.add_frame(
            3, FrameRecord(rgb=rgb, depth_m=None, camera=camera(), gts=gts, masks=[full] * 4, masks_visib=parts)
        )
        writer.add_frame(
            9, FrameRecord(rgb=rgb, depth_m=None, camera=camera(), gts=gts[:1], masks=[full], masks_visib=parts[3:])
        )
    targets = visible_targets(tmp_path, "test", 4)
    assert targets == [BopTarget(scene_id=4, im_id=3, obj_id=2, inst_count=2)]
    write_targets(tmp_path, "test", targets)
    assert json.loads((tmp_path / "test_targets_bop24.json").read_text()) == [{"im_id": 3, "scene_id": 4}]


def test_the_world_pose_is_bops(tmp_path):
    rgb = np.zeros((HEIGHT, WIDTH, 3), np.uint8)
    with BopWriter(tmp_path, "test", 1) as writer:
        writer.add_frame(
            0,
            FrameRecord(rgb=rgb, depth_m=None, camera=camera(), gts=[], masks=[], masks_visib=[], T_cam_world=pose(3)),
        )
    entry = json.loads((tmp_path / "test/000001/scene_camera.json").read_text())["0"]
    assert np.allclose(np.reshape(entry["cam_R_w2c"], (3, 3)), pose(3)[:3, :3])
    assert np.allclose(np.array(entry["cam_t_w2c"]) / 1000, pose(3)[:3, 3])


def test_writer_continues_and_replaces(dataset_path):
    with BopWriter(dataset_path, "test", 3) as writer:
        assert writer.im_ids == [0]
        write_frame(writer, 5)
        write_frame(writer, 5, focal=60.0)
    dataset = BopDataset(dataset_path)
    assert dataset.im_ids(3) == [0, 5]
    assert dataset.camera(3, 5).K[0, 0] == 60.0
    assert len(dataset.gt(3, 5)) == 1


@pytest.mark.parametrize("broken", ["masks", "camera", "depth", "far"])
def test_writer_refuses_what_does_not_fit(tmp_path, broken):
    writer = BopWriter(tmp_path, "test", 1)
    rgb = np.zeros((HEIGHT, WIDTH, 3), np.uint8)
    depth_m = np.full((HEIGHT, WIDTH), 9.0 if broken == "far" else 1.0, np.float32)
    depth_m = depth_m[:-1] if broken == "depth" else depth_m
    cam = Camera(K=np.eye(3), width_px=WIDTH + (broken == "camera"), height_px=HEIGHT)
    gts = [GroundTruth(obj_id=1, T_cam_obj=pose(1))]
    masks = [] if broken == "masks" else [box_mask(1, 1, 2, 2)]
    with pytest.raises(DatasetError):
        writer.add_frame(
            0,
            FrameRecord(rgb=rgb, depth_m=depth_m, camera=cam, gts=gts, masks=masks, masks_visib=[box_mask(1, 1, 2, 2)]),
        )
    assert not (tmp_path / "test/000001/scene_gt.json").exists()


def test_no_pose_marker(dataset_path):
    with BopWriter(dataset_path, "test", 3) as writer:
        nowhere = GroundTruth(obj_id=2, T_cam_obj=np.full((4, 4), np.nan), has_pose=False)
        rgb, mask = np.zeros((HEIGHT, WIDTH, 3), np.uint8), box_mask(0, 0, 1, 1)
        writer.add_frame(
            9, FrameRecord(rgb=rgb, depth_m=None, camera=camera(), gts=[nowhere], masks=[mask], masks_visib=[mask])
        )
    entry = json.loads((dataset_path / "test/000003/scene_gt.json").read_text())["9"][0]
    assert entry["cam_t_m2c"] == [-1, -1, -1]
    dataset = BopDataset(dataset_path)
    (truth,) = dataset.gt(3, 9)
    assert not truth.has_pose
    assert np.isnan(truth.T_cam_obj).all()
    assert all(target.im_id != 9 for target in dataset.targets)


@pytest.mark.parametrize(("folder", "extension"), [("rgb", "jpg"), ("rgb", "tif"), ("gray", "png"), ("gray", "tif")])
def test_other_image_files(dataset_path, folder, extension):
    scene = dataset_path / "test/000003"
    shutil.rmtree(scene / "rgb")
    (scene / folder).mkdir()
    image = np.full((24, 36) if folder == "gray" else (24, 36, 3), 77, np.uint8)
    cv2.imwrite(str(scene / folder / f"000000.{extension}"), image)
    dataset = BopDataset(dataset_path)
    assert dataset.rgb(3, 0).shape == (24, 36, 3)
    assert abs(int(dataset.rgb(3, 0)[5, 5, 1]) - 77) <= 1
    assert (dataset.camera(3, 0).width_px, dataset.camera(3, 0).height_px) == (36, 24)


def test_depth_as_tif_with_its_own_scale(dataset_path):
    scene = dataset_path / "test/000003"
    (scene / "depth/000000.png").unlink()
    cv2.imwrite(str(scene / "depth/000000.tif"), np.full((HEIGHT, WIDTH), 1000, np.uint16))
    cameras = json.loads((scene / "scene_camera.json").read_text())
    cameras["0"]["depth_scale"] = 0.5
    (scene / "scene_camera.json").write_text(json.dumps(cameras))
    depth_m = BopDataset(dataset_path).depth_m(3, 0)
    assert depth_m is not None
    assert np.allclose(depth_m, 0.5)


@pytest.mark.parametrize("extension", ["png", "jpg"])
def test_an_image_that_is_cut_off_is_one_line(tmp_path, extension, capfd):
    """OpenCV alone returns half a JPEG, and libpng writes to stderr."""
    file = tmp_path / f"a.{extension}"
    write_image(file, np.random.default_rng(0).integers(0, 255, (60, 80, 3), np.uint8))
    assert read_rgb(file).shape == (60, 80, 3)
    file.write_bytes(file.read_bytes()[:-2000])
    with pytest.raises(DatasetError, match=rf"a.{extension}: cannot be decoded as an image"):
        read_rgb(file)
    assert capfd.readouterr().err == ""


@pytest.mark.parametrize("extension", ["png", "jpg", "tif"])
def test_image_size_agrees_with_decoding(tmp_path, extension):
    path = tmp_path / f"x.{extension}"
    cv2.imwrite(str(path), np.zeros((33, 57, 3), np.uint8))
    assert image_size(path) == (57, 33)


def test_size_from_camera_json_without_images(dataset_path):
    scene = dataset_path / "test/000003"
    shutil.rmtree(scene / "rgb")
    shutil.rmtree(scene / "depth")
    assert BopDataset(dataset_path).camera(3, 0).width_px == WIDTH


def test_targets_files(dataset_path):
    (dataset_path / "test_targets_bop24.json").write_text('[{"im_id": 7, "scene_id": 11}]')
    assert BopDataset(dataset_path).targets == [BopTarget(scene_id=11, im_id=7, obj_id=2)]
    write_targets(dataset_path, "test", [BopTarget(scene_id=3, im_id=0, obj_id=2, inst_count=4)])
    assert BopDataset(dataset_path).targets == [BopTarget(scene_id=3, im_id=0, obj_id=2, inst_count=4)]


def test_models_eval_is_preferred_for_errors(dataset_path, tug_ply):
    shutil.copytree(dataset_path / "models", dataset_path / "models_eval")
    shutil.copy(tug_ply, dataset_path / "models_eval/obj_000002.ply")
    dataset = BopDataset(dataset_path)
    assert dataset.mesh_path(2, eval=True).parent.name == "models_eval"
    assert len(dataset.mesh(2).vertices_m) != len(dataset.mesh(2, eval=True).vertices_m)


def break_json(root):
    (root / "test/000003/scene_gt.json").write_text('{"0": [\n  {"obj_id": 2,,\n')


def drop_gt(root):
    (root / "test/000003/scene_gt.json").unlink()


def bad_rotation(root):
    file = root / "test/000003/scene_gt.json"
    content = json.loads(file.read_text())
    content["0"][0]["cam_R_m2c"] = [1, 0, 0, 0, 2, 0, 0, 0, 1]
    file.write_text(json.dumps(content))


def text_id(root):
    file = root / "test/000003/scene_gt.json"
    file.write_text(file.read_text().replace('"obj_id": 2', '"obj_id": "two"'))


def misaligned_info(root):
    (root / "test/000003/scene_gt_info.json").write_text('{"0": []}')


@pytest.mark.parametrize(
    ("damage", "message"),
    [
        (break_json, r"scene_gt.json:2:16: invalid JSON"),
        (drop_gt, r"no scene_gt.json"),
        (bad_rotation, r"scene_gt.json, image 0, entry 0: 'cam_R_m2c' is not a rotation"),
        (text_id, r"'obj_id' is 'two', expected an integer"),
        (misaligned_info, r"scene_gt_info.json, image 0: does not list the 1 objects"),
    ],
)
def test_broken_ground_truth_is_one_line_with_its_place(dataset_path, damage, message):
    damage(dataset_path)
    with pytest.raises(DatasetError, match=message) as caught:
        BopDataset(dataset_path).gt(3, 0)
    assert "\n" not in str(caught.value)


def test_folders_that_are_no_dataset(tmp_path, dataset_path):
    with pytest.raises(DatasetError, match="no such folder"):
        BopDataset(tmp_path / "nothing")
    (tmp_path / "empty").mkdir()
    with pytest.raises(DatasetError, match="no split with scenes"):
        BopDataset(tmp_path / "empty")
    with pytest.raises(DatasetError, match="give the one above"):
        BopDataset(dataset_path / "test")
    with pytest.raises(DatasetError, match="no scene folder"):
        BopDataset(dataset_path, split="val")


def test_unknown_ids_are_named(dataset_path):
    dataset = BopDataset(dataset_path)
    with pytest.raises(DatasetError, match="no scene 4; there are 3, 11"):
        dataset.gt(4, 0)
    with pytest.raises(DatasetError, match="no entry for image 1; there are 0"):
        dataset.camera(3, 1)
    with pytest.raises(DatasetError, match=r"no obj_000009\.ply"):
        dataset.mesh(9)


@pytest.mark.parametrize(
    ("content", "message"),
    [
        ("{}", "no objects"),
        ('{"1": {}}', "object 1: has no 'diameter'"),
        ('{"1": {"diameter": -3}}', "diameter is -3.0"),
        ('{"1": {"diameter": 5, "symmetries_discrete": [[1, 2]]}}', "expected 16 finite numbers"),
        ('{"1": {"diameter": 5, "symmetries_discrete": [[2,0,0,0,0,2,0,0,0,0,2,0,0,0,0,1]]}}', "not a rotation"),
        ('{"1": {"diameter": 5, "symmetries_continuous": [{"axis": [0,0,0], "offset": [0,0,0]}]}}', "expected a dir"),
        ('{"one": {"diameter": 5}}', "not an integer"),
    ],
)
def test_broken_models_info(dataset_path, content, message):
    (dataset_path / "models/models_info.json").write_text(content)
    with pytest.raises(DatasetError, match=message):
        _ = BopDataset(dataset_path).models_info


def test_targets_of_a_missing_scene(dataset_path):
    write_targets(dataset_path, "test", [BopTarget(scene_id=99, im_id=0, obj_id=2)])
    with pytest.raises(DatasetError, match="entry 0: scene 99 is not in"):
        _ = BopDataset(dataset_path).targets
