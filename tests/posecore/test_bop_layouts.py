"""The layouts that BOP datasets come in: sensors, split names, model folders, cameras; all without registration."""

import json
import shutil

import cv2
import numpy as np
import pytest
from bop_folders import CAMERA, name_sensor, write_rendered
from posecore.bop import BopDataset, BopTarget
from posecore.errors import DatasetError
from posecore.mesh import load_mesh

IMAGES = ((3, 0), (3, 4), (11, 7))


@pytest.fixture(scope="module")
def plain(tmp_path_factory, tug_ply, bobbin_ply):
    meshes = {1: load_mesh(tug_ply), 5: load_mesh(bobbin_ply)}
    return write_rendered(tmp_path_factory.mktemp("plain") / "things", meshes, 5, IMAGES)


@pytest.fixture
def root(plain, tmp_path):
    return shutil.copytree(plain, tmp_path / "things")


def change(file, edit):
    content = json.loads(file.read_text())
    edit(content)
    file.write_text(json.dumps(content))


def second_sensor(scene, sensor):
    """A copy of a scene's plain files under a sensor's name, with another focal length."""
    copy = shutil.copytree(scene, scene.parent / "copy")
    change(copy / "scene_camera.json", lambda c: [entry["cam_K"].__setitem__(0, 200.0) for entry in c.values()])
    name_sensor(copy, sensor)
    for path in copy.iterdir():
        path.rename(scene / path.name)
    copy.rmdir()


def test_a_single_named_sensor_needs_no_choice(root):
    for scene in (root / "test").iterdir():
        name_sensor(scene, "photoneo")
    (root / "camera.json").rename(root / "camera_photoneo.json")
    dataset = BopDataset(root)
    assert dataset.sensors == ("photoneo",)
    assert dataset.scene_ids == [3, 11]
    assert dataset.image_file(3, 4).path == root / "test/000003/rgb_photoneo/000004.png"
    assert dataset.depth_m(3, 4).max() > 0.4
    assert dataset.mask(3, 4, 1, visible=True).sum() > 50
    assert dataset.gt(3, 4)[0].visib_fract == pytest.approx(1.0)
    assert dataset.camera_file == root / "camera_photoneo.json"
    assert dataset.targets[0] == BopTarget(scene_id=3, im_id=0, obj_id=1)


def test_several_sensors_are_listed_until_one_is_named(root):
    for scene in (root / "test").iterdir():
        name_sensor(scene, "cam1")
    second = root / "test/000003"
    for path in list(second.iterdir()):
        if path.is_dir():
            shutil.copytree(path, second / path.name.replace("cam1", "cam2"))
        else:
            shutil.copy(path, second / path.name.replace("cam1", "cam2"))
    change(second / "scene_camera_cam2.json", lambda c: c["4"]["cam_K"].__setitem__(0, 200.0))
    with pytest.raises(
        DatasetError, match=r"several sensors \(cam1 in 2 scene\(s\), cam2 in 1 scene\(s\)\); choose one"
    ):
        BopDataset(root)
    with pytest.raises(DatasetError, match=r"no sensor 'cam3'; there are cam1 in 2"):
        BopDataset(root, sensor="cam3")
    dataset = BopDataset(root, sensor="cam2")
    assert dataset.scene_ids == [3]
    assert dataset.camera(3, 4).K[0, 0] == 200.0
    assert BopDataset(root, sensor="cam1").camera(3, 4).K[0, 0] == 160.0


def test_the_sensor_without_a_name_is_the_default(root):
    second_sensor(root / "test/000003", "realsense")
    assert BopDataset(root).camera(3, 4).K[0, 0] == 160.0
    assert BopDataset(root).scene_ids == [3, 11]
    named = BopDataset(root, sensor="realsense")
    assert (named.camera(3, 4).K[0, 0], named.scene_ids) == (200.0, [3])


def test_scenes_of_different_sensors_take_the_first_they_have(root):
    """HOT3D: colour in some scenes, two gray cameras in others, image folders named as the sensor."""
    name_sensor(root / "test/000003", "rgb", image_folder="rgb")
    name_sensor(root / "test/000011", "gray1", image_folder="gray1")
    with pytest.raises(DatasetError, match="several sensors"):
        BopDataset(root)
    dataset = BopDataset(root, sensor="rgb,gray1")
    assert dataset.scene_ids == [3, 11]
    assert dataset.image_file(3, 0).path.parent.name == "rgb"
    assert dataset.image_file(11, 7).path.parent.name == "gray1"
    assert dataset.rgb(11, 7).shape == (CAMERA.height_px, CAMERA.width_px, 3)
    assert len(dataset.gt(11, 7)) == 2


@pytest.mark.parametrize(
    ("made", "chosen"),
    [
        (["test_primesense", "train_primesense"], "test_primesense"),
        (["train_pbr", "val"], "val"),
        (["train_pbr", "test", "test_kinect"], "test"),
        (["train_real", "onboarding"], "train_real"),
        (["mine"], "mine"),
    ],
)
def test_the_split_is_found_by_its_name(root, made, chosen):
    for name in made:
        shutil.copytree(root / "test", root / f"{name}.new")
    shutil.rmtree(root / "test")
    for name in made:
        (root / f"{name}.new").rename(root / name)
    assert BopDataset(root).split == chosen


def test_two_splits_of_one_kind_are_listed(root):
    shutil.copytree(root / "test", root / "test_kinect")
    (root / "test").rename(root / "test_primesense")
    with pytest.raises(DatasetError, match=r"several splits \(test_kinect, test_primesense\); choose one"):
        BopDataset(root)
    assert BopDataset(root, "test_kinect").scene_ids == [3, 11]


def test_a_split_with_a_type_uses_the_plain_splits_targets(root):
    (root / "test").rename(root / "test_primesense")
    shutil.copy(root / "camera.json", root / "camera_primesense.json")
    change(root / "test_targets_bop19.json", lambda entries: entries.pop())
    dataset = BopDataset(root)
    assert len(dataset.targets) == 5
    assert dataset.camera_file == root / "camera_primesense.json"


def test_targets_of_both_editions_are_there(root):
    dataset = BopDataset(root)
    assert dataset.target_images("bop24") == list(IMAGES)
    change(root / "test_targets_bop24.json", lambda entries: entries.pop(0))
    assert dataset.target_images("bop24") == list(IMAGES[1:])
    (root / "test_targets_bop24.json").unlink()
    assert dataset.target_images("bop24") == list(IMAGES)


def test_a_target_that_stands_twice_is_refused(root):
    change(root / "test_targets_bop19.json", lambda entries: entries.append(entries[0]))
    with pytest.raises(DatasetError, match=r"test_targets_bop19.json, entry 6: repeats the object of entry 0"):
        _ = BopDataset(root).targets


def test_model_folders_of_a_type_are_found(root):
    (root / "models").rename(root / "models_cad")
    shutil.copytree(root / "models_cad", root / "models_eval")
    (root / "models_eval/models_info.json").unlink()
    shutil.copytree(root / "models_cad", root / "models_reconst")
    dataset = BopDataset(root)
    assert dataset.models_info_file == root / "models_cad/models_info.json"
    assert dataset.mesh_path(1) == root / "models_cad/obj_000001.ply"
    assert dataset.mesh_path(1, eval=True) == root / "models_eval/obj_000001.ply"
    (root / "models_eval/obj_000001.ply").unlink()
    assert dataset.mesh_path(1, eval=True) == root / "models_cad/obj_000001.ply"


def test_only_models_for_evaluation_are_enough(root):
    (root / "models").rename(root / "models_eval")
    dataset = BopDataset(root)
    assert dataset.obj_ids == [1, 5]
    assert dataset.mesh_path(1) == root / "models_eval/obj_000001.ply"


def test_a_pinhole_camera_model_gives_its_matrix(root):
    model = {"projection_model_type": "CameraModelType.PINHOLE", "projection_params": [160, 162, 61.5, 44.25]}
    model |= {"image_width": 120, "image_height": 90}
    change(root / "test/000003/scene_camera.json", lambda c: c.update({"4": {"cam_model": model}}))
    assert np.array_equal(BopDataset(root).camera(3, 4).K, CAMERA.K)
    fisheye = model | {"projection_model_type": "CameraModelType.FISHEYE624"}
    change(root / "test/000003/scene_camera.json", lambda c: c.update({"4": {"cam_model": fisheye}}))
    with pytest.raises(DatasetError, match=r"image 4: 'cam_model' is 'CameraModelType.FISHEYE624', expected a pinhole"):
        BopDataset(root).camera(3, 4)


@pytest.mark.parametrize(
    ("K", "message"),
    [
        ([160, 0, 0, 0, 162, 0, 61.5, 44.25, 1], "saved by columns"),
        ([-160, 0, 61.5, 0, 162, 44.25, 0, 0, 1], "positive fx and fy"),
        ([160, 0, 61.5, 0, 162, 44.25, 0, 0, 2], "K\\[2,2\\] 2.0"),
        ([160, 0, 61.5, 0, 162, 44.25, 0, 0], "has 8 numbers"),
        (["160", 0, 61.5, 0, 162, 44.25, 0, 0, 1], "'cam_K' is \\['160'"),
        ([True, 0, 61.5, 0, 162, 44.25, 0, 0, 1], "'cam_K' is \\[True"),
    ],
)
def test_a_wrong_camera_matrix_names_its_image(root, K, message):
    change(root / "test/000003/scene_camera.json", lambda c: c["4"].update(cam_K=K))
    with pytest.raises(DatasetError, match=rf"scene_camera.json, image 4.*{message}"):
        BopDataset(root).camera(3, 4)


def test_depth_of_another_size_or_without_a_scale_is_refused(root):
    change(root / "test/000003/scene_camera.json", lambda c: c["4"].update(depth_scale=0))
    with pytest.raises(DatasetError, match="image 4: 'depth_scale' is 0, expected"):
        BopDataset(root).depth_m(3, 4)
    cv2.imwrite(str(root / "test/000003/depth/000000.png"), np.full((45, 60), 500, np.uint16))
    with pytest.raises(DatasetError, match=r"depth/000000.png: is 60 x 45 pixels, expected 120 x 90"):
        BopDataset(root).depth_m(3, 0)


def test_unknown_depth_is_zero_in_floating_point_images(root):
    depth = np.full((90, 120), 500.0, np.float32)
    depth[0, :3] = np.nan, np.inf, -4.0
    (root / "test/000003/depth/000000.png").unlink()
    cv2.imwrite(str(root / "test/000003/depth/000000.tif"), depth)
    change(root / "test/000003/scene_camera.json", lambda c: c["0"].update(depth_scale=1.0))
    depth_m = BopDataset(root).depth_m(3, 0)
    assert depth_m[0, :4].tolist() == [0, 0, 0, 0.5]


def test_two_folders_of_one_scene_are_refused(root):
    shutil.copytree(root / "test/000003", root / "test/3")
    with pytest.raises(DatasetError, match="is scene 3 as 000003 is"):
        BopDataset(root)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ('{"4": [], "4": []}', "the key '4' occurs twice"),
        ('{"4": [], "004": []}', "two keys mean 4, such as '004'"),
        ('{"-4": []}', "a key is not an integer \\('-4'\\)"),
        ('{"4": ' + "[" * 100_000, "nested too deep"),
        ('{"4": ' + "9" * 5000 + "}", "a number has thousands of digits"),
        ('{"4": [{"obj_id": 1e400}]}', "'obj_id' is inf"),
        ('{"4": [{"obj_id": -1}]}', "'obj_id' is -1, expected an integer, 0 or more"),
        ('{"4": [{"obj_id": 1, "cam_t_m2c": [NaN, 0, 9]}]}', "'cam_t_m2c' holds \\[nan, 0, 9\\]"),
        ('{"4": [{"obj_id": 1, "cam_t_m2c": [1e300, 0, 9]}]}', "'cam_t_m2c' holds 1e\\+300 mm"),
    ],
)
def test_json_that_a_parser_takes_silently_is_refused(root, text, message):
    (root / "test/000003/scene_gt.json").write_text(text)
    (root / "test/000003/scene_gt_info.json").unlink()
    with pytest.raises(DatasetError, match=message) as caught:
        BopDataset(root).gt(3, 4)
    assert "\n" not in str(caught.value)
    assert len(str(caught.value)) < 400


def test_a_visible_share_outside_zero_to_one_is_refused(root):
    change(root / "test/000003/scene_gt_info.json", lambda c: c["4"][1].update(visib_fract=1.5))
    with pytest.raises(DatasetError, match=r"image 4, entry 1: 'visib_fract' is 1.5, expected 0 to 1"):
        BopDataset(root).gt(3, 4)


def test_parsed_scenes_are_forgotten_when_memory_is_short(root, monkeypatch):
    """The scene in use stays, others go, and what went is read again."""
    reads = []
    monkeypatch.setattr("posecore.bop.sources.KEPT_BYTES", 100)
    original = json.loads
    monkeypatch.setattr("posecore.bop.jsonfile.json.loads", lambda *a, **k: reads.append(1) or original(*a, **k))
    dataset = BopDataset(root)
    for _ in range(3):
        dataset.gt(3, 4)
    assert len(reads) == 2
    dataset.gt(11, 7)
    dataset.gt(3, 4)
    assert len(reads) == 6
    dataset.forget(3)
    dataset.gt(3, 0)
    assert len(reads) == 8


def test_an_exif_turn_is_ignored_as_annotations_ignore_it(root):
    """Turning the pixels would put every annotation beside its object."""
    from PIL import Image

    path = root / "test/000003/rgb/000000.jpg"
    (root / "test/000003/rgb/000000.png").unlink()
    exif = Image.Exif()
    exif[0x0112] = 6
    Image.fromarray(np.zeros((90, 120, 3), np.uint8)).save(path, exif=exif)
    dataset = BopDataset(root)
    assert (dataset.camera(3, 0).width_px, dataset.camera(3, 0).height_px) == (120, 90)
    assert dataset.rgb(3, 0).shape == (90, 120, 3)


def test_a_png_with_a_flipped_byte_is_one_line_and_nothing_on_stderr(root, capfd):
    path = root / "test/000003/rgb/000004.png"
    data = bytearray(path.read_bytes())
    data[len(data) // 2] ^= 1
    path.write_bytes(data)
    with pytest.raises(DatasetError, match=r"rgb/000004.png: cannot be decoded"):
        BopDataset(root).rgb(3, 4)
    assert capfd.readouterr().err == ""
