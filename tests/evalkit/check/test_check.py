"""`evalkit check`: a sound dataset passes, and every kind of fault is found, counted and named with its place."""

import json
import re
import shutil
from collections import Counter

import cv2
import numpy as np
import pytest
from bop_folders import name_sensor, write_rendered, write_shards
from click.testing import CliRunner
from evalkit.check import Findings, check
from evalkit.check import models as check_models
from evalkit.cli.check import check as command
from posecore import se3
from posecore.bop import BopDataset, Estimate, write_results
from posecore.bop import dataset as dataset_module
from posecore.mesh import load_mesh

TUG, BOBBIN = 1, 5
IMAGES = ((3, 0), (3, 4), (11, 7))
GT = "test/000003/scene_gt.json"
INFO = "test/000003/scene_gt_info.json"
CAMERA = "test/000003/scene_camera.json"
TARGETS = "test_targets_bop19.json"
MODELS = "models/models_info.json"


@pytest.fixture(scope="module")
def sound(tmp_path_factory, tug_ply, bobbin_ply):
    meshes = {TUG: load_mesh(tug_ply), BOBBIN: load_mesh(bobbin_ply)}
    return write_rendered(tmp_path_factory.mktemp("sound") / "toys", meshes, BOBBIN, IMAGES)


@pytest.fixture
def root(sound, tmp_path):
    return shutil.copytree(sound, tmp_path / "toys")


def change(root, name, edit):
    file = root / name
    content = json.loads(file.read_text())
    changed = edit(content)
    file.write_text(json.dumps(content if changed is None else changed))


def perfect(root, **changes):
    dataset = BopDataset(root)
    return [
        Estimate(**({"scene_id": s, "im_id": i, "obj_id": gt.obj_id, "T_cam_obj": gt.T_cam_obj} | changes))
        for s, i in IMAGES
        for gt in dataset.gt(s, i)
    ]


def lines(findings, level, kind):
    return [str(v) for v in findings.violations if (v.level, v.kind) == (level, kind)]


def test_every_model_is_read_once(root, tmp_path, monkeypatch):
    """Also for result files, and for the ground truth against itself."""
    shutil.copytree(root / "models", root / "models_eval")
    files = [tmp_path / f"{name}_toys-test.csv" for name in ("one", "two")]
    for file in files:
        write_results(file, perfect(root))
    read = Counter()

    def counted(path, **options):
        read[path.relative_to(root)] += 1
        return load_mesh(path, **options)

    monkeypatch.setattr(dataset_module, "load_mesh", counted)
    monkeypatch.setattr(check_models, "load_mesh", counted, raising=False)
    check(root, files)
    assert len(read) == 4 and set(read.values()) == {1}, read


def test_a_sound_dataset_and_its_own_poses_pass_without_a_word(root, tmp_path):
    file = tmp_path / "truth_toys-test.csv"
    write_results(file, perfect(root))
    findings = check(root, [file])
    assert findings.lines() == []
    assert findings.ok
    assert findings.covered == {
        "models": 2,
        "scenes": 2,
        "images": 3,
        "ground-truth poses": 6,
        "images decoded": 3,
        "bop19 targets": 6,
        "bop24 targets": 3,
        "poses against themselves": 6,
        "result files": 1,
        "estimates": 6,
    }


def test_shards_pass_as_folders_do(sound, tmp_path):
    root = tmp_path / "toys"
    write_shards(sound, "test", root / "test")
    shutil.copytree(sound / "models", root / "models")
    shutil.copy(sound / TARGETS, root)
    findings = check(root)
    assert findings.lines() == []
    assert findings.covered["poses against themselves"] == 6
    assert findings.covered["images decoded"] == 3


def test_one_sensor_of_several_is_checked(root):
    for scene in (root / "test").iterdir():
        name_sensor(scene, "cam1")
    shutil.copy(root / "test/000003/scene_camera_cam1.json", root / "test/000003/scene_camera_cam2.json")
    assert check(root, sensor="cam1").lines() == []
    (line,) = check(root).lines()
    assert line.startswith("error dataset: ")
    assert "several sensors (cam1 in 2 scene(s), cam2 in 1 scene(s))" in line


@pytest.mark.slow
def test_real_data_has_only_what_is_truly_wrong_in_it(shared_data):
    """LM-O's own rotations are up to 0.01 off, and only one of the 48 frames has its depth here."""
    findings = check(shared_data / "lmo", [shared_data / "lmo/init_ssd6d-like_lmo-test.csv"], samples=5)
    assert {kind for level, kind in findings.counts if level == "error"} <= set()
    assert findings.counts["warning", "rough-rotation"] == 182
    assert findings.counts["warning", "depth-missing"] == 4
    assert {kind for level, kind in findings.counts if level == "warning"} == {"rough-rotation", "depth-missing"}
    assert lines(findings, "hint", "file-name")
    assert findings.covered["ground-truth poses"] == 367


def set_entry(name, im_id, index, **values):
    return lambda root: change(root, name, lambda c: c[im_id][index].update(values))


def drop_entry(name, im_id, index, key):
    return lambda root: change(root, name, lambda c: c[im_id][index].pop(key) and None)


def set_camera(**values):
    return lambda root: change(root, CAMERA, lambda c: c["4"].update(values))


def add_target(**values):
    base = {"scene_id": 3, "im_id": 4, "obj_id": 1, "inst_count": 1}
    return lambda root: change(root, TARGETS, lambda c: [e for e in c if e != base] + [base | values])


def set_model(obj_id, **values):
    return lambda root: change(root, MODELS, lambda c: c[str(obj_id)].update(values))


def write(name, text):
    return lambda root: (root / name).write_text(text)


def scale_translations(factor):
    def scale(root):
        for scene in (root / "test").iterdir():
            file = f"test/{scene.name}/scene_gt.json"
            change(root, file, lambda c: [scaled(e, factor) for gts in c.values() for e in gts] and None)

    def scaled(entry, by):
        entry["cam_t_m2c"] = [value * by for value in entry["cam_t_m2c"]]
        return entry

    return scale


def resize(name, size, dtype=None):
    def resized(root):
        image = cv2.resize(cv2.imread(str(root / name), -1), size, interpolation=cv2.INTER_NEAREST)
        cv2.imwrite(str(root / name), image if dtype is None else image.astype(dtype))

    return resized


def fill(name, value):
    def filled(root):
        image = cv2.imread(str(root / name), -1)
        cv2.imwrite(str(root / name), np.full_like(image, value))

    return filled


def cut(name, count):
    return lambda root: (root / name).write_bytes((root / name).read_bytes()[:-count])


def remove(name):
    return lambda root: (root / name).unlink()


def repeat_truth(root):
    change(root, GT, lambda c: c["4"].append(c["4"][0]))
    change(root, INFO, lambda c: c["4"].append(c["4"][0]))


def drop_image(name):
    return lambda root: change(root, name, lambda c: c.pop("4") and None)


def turn_off_axis(root):
    set_model(BOBBIN, symmetries_continuous=[{"axis": [1, 0, 0], "offset": [0, 0, 0]}])(root)


def tug_has_a_flip(root):
    flip = [-1, 0, 0, 0, 0, -1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1]
    set_model(TUG, symmetries_discrete=[flip])(root)


def empty_scene(root):
    (root / "test/000012/rgb").mkdir(parents=True)


DATASET_FAULTS = {
    "json": (write(GT, '{"0": [\n {,'), "error", "json", r"scene_gt.json:2:3: invalid JSON"),
    "json shape": (write(GT, "[]"), "error", "json", "found a list at the top, expected a dict"),
    "key twice": (write(GT, '{"4": [], "4": []}'), "error", "json", "the key '4' occurs twice"),
    "no list": (
        lambda r: change(r, GT, lambda c: c | {"4": {}}),
        "error",
        "ground-truth",
        "image 4: found a dict, expected a",
    ),
    "rotation": (
        set_entry(GT, "4", 0, cam_R_m2c=[1, 0, 0, 0, 2, 0, 0, 0, 1]),
        "error",
        "ground-truth",
        "entry 0: 'cam_R_m2c'",
    ),
    "no id": (
        drop_entry(GT, "4", 1, "obj_id"),
        "error",
        "ground-truth",
        "image 4, entry 1: 'obj_id' is None, expected an",
    ),
    "strange id": (set_entry(GT, "4", 1, obj_id=77), "error", "unknown-object", "entry 1: 'obj_id' is 77, models_info"),
    "behind": (
        set_entry(GT, "4", 1, cam_t_m2c=[0, 0, -500]),
        "error",
        "behind-camera",
        r"entry 1: the object's centre is at z = -5\d\d.* mm, expected",
    ),
    "metres": (scale_translations(0.001), "error", "units", r"length of t of 6 ground-truth poses is 0\.5.*metres\?"),
    "rough": (
        set_entry(GT, "4", 0, cam_R_m2c=[1.002, 0, 0, 0, 1.002, 0, 0, 0, 1.002]),
        "warning",
        "rough-rotation",
        r"entry 0: 'cam_R_m2c' is 0.004 from orthonormal \(scale 1.00200\)",
    ),
    "repeated": (
        repeat_truth,
        "warning",
        "repeated-ground-truth",
        "image 4: entries 0 and 2 are the same pose of object 1",
    ),
    "info length": (
        lambda r: change(r, INFO, lambda c: c["4"].pop() and None),
        "error",
        "info-misaligned",
        "the 2 obj",
    ),
    "share": (set_entry(INFO, "4", 0, visib_fract=1.5), "error", "visibility", "entry 0: 'visib_fract' is 1.5, expec"),
    "other share": (
        set_entry(INFO, "4", 0, visib_fract=0.2),
        "error",
        "visibility",
        r"'visib_fract' is 0.2, expected ",
    ),
    "no share": (drop_entry(INFO, "4", 0, "visib_fract"), "warning", "visibility", "entry 0: has no 'visib_fract'"),
    "counts": (set_entry(INFO, "4", 0, px_count_visib=10**6), "error", "visibility", "'px_count_visib' is 1000000 and"),
    "count words": (set_entry(INFO, "4", 0, px_count_all="9"), "error", "visibility", r"pixel counts are \['9', "),
    "box": (set_entry(INFO, "4", 0, bbox_obj=[1, 2]), "error", "visibility", "'bbox_obj' has 2 numbers"),
    "no camera": (drop_image(CAMERA), "error", "images-differ", r"scene_camera.json: found no image 4, scene_gt.json"),
    "no truth": (drop_image(GT), "warning", "images-differ", r"scene_gt.json: found no image 4, scene_camera.json has"),
    "no info": (drop_image(INFO), "error", "images-differ", r"scene_gt_info.json: found no image 4"),
    "K": (set_camera(cam_K=[1, 2, 3]), "error", "camera", "image 4: 'cam_K' has 3 numbers"),
    "negative f": (set_camera(cam_K=[-5, 0, 9, 0, 5, 9, 0, 0, 1]), "error", "camera", "with positive fx and fy"),
    "stretched": (set_camera(cam_K=[50, 0, 60, 0, 250, 45, 0, 0, 1]), "warning", "camera", "fx is 50 and fy 250"),
    "focal": (set_camera(cam_K=[5000, 0, 60, 0, 5000, 45, 0, 0, 1]), "warning", "camera-size", "K of another image"),
    "principal": (set_camera(cam_K=[160, 0, 960, 0, 162, 540, 0, 0, 1]), "warning", "camera-size", "point .960, 540."),
    "off image": (set_camera(cam_K=[160, 0, 960, 0, 162, 45, 0, 0, 1]), "error", "off-image", "px outside the image"),
    "scale 0": (set_camera(depth_scale=0), "error", "depth-scale", "'depth_scale' is 0, expected"),
    "scale": (
        set_camera(depth_scale=100.0),
        "error",
        "depth-scale",
        r"depth is \d{3,4}.* times that of the objects.*is the scale 0\.1",
    ),
    "world": (
        set_camera(cam_R_w2c=[1, 0, 0, 0, 1, 0, 0, 0, 9], cam_t_w2c=[0, 0, 0]),
        "warning",
        "camera",
        "'cam_R_w2c'",
    ),
    "world t": (set_camera(cam_R_w2c=[1, 0, 0, 0, 1, 0, 0, 0, 1]), "error", "camera", "has no 'cam_t_w2c'"),
    "no scene": (empty_scene, "error", "scene", "000012: found no scene_camera.json, expected one in every scene"),
    "image gone": (
        remove("test/000003/rgb/000004.png"),
        "error",
        "image-missing",
        "no image 000004 as png, jpg or tif",
    ),
    "image cut": (cut("test/000003/rgb/000004.png", 40), "error", "image", "rgb/000004.png: cannot be decoded"),
    "blank": (fill("test/000003/rgb/000004.png", 7), "warning", "image-blank", r"every pixel is \[7, 7, 7\]"),
    "depth cut": (cut("test/000003/depth/000004.png", 40), "error", "depth", "depth/000004.png: cannot be decoded"),
    "depth size": (resize("test/000003/depth/000004.png", (60, 45)), "error", "depth", "is 60 x 45 pixels, the colour"),
    "depth bits": (
        resize("test/000003/depth/000004.png", (120, 90), "uint8"),
        "warning",
        "depth",
        "holds uint8 numbers",
    ),
    "depth empty": (fill("test/000003/depth/000004.png", 0), "warning", "depth", "is 0 everywhere"),
    "depth gone": (
        remove("test/000003/depth/000004.png"),
        "warning",
        "depth-missing",
        "image 4: found no depth, other",
    ),
    "mask gone": (
        remove("test/000003/mask/000004_000001.png"),
        "error",
        "mask-missing",
        "no mask of entries 1, the oth",
    ),
    "mask size": (
        resize("test/000003/mask/000004_000001.png", (60, 45)),
        "error",
        "mask",
        "is 60 x 45 pixels, the ima",
    ),
    "mask pixels": (
        fill("test/000003/mask_visib/000004_000001.png", 255),
        "warning",
        "mask",
        "has 10800 pixels, 'px_c",
    ),
    "mask cut": (cut("test/000003/mask/000004_000001.png", 9), "error", "mask", "000004_000001.png: cannot be decoded"),
    "models gone": (lambda r: shutil.rmtree(r / "models"), "error", "models", "found no models/ folder"),
    "model gone": (remove("models/obj_000005.ply"), "error", "model-missing", "obj_000005.ply: models_info.json lists"),
    "model cut": (cut("models/obj_000005.ply", 900), "error", "model", "obj_000005.ply: "),
    "unlisted": (
        lambda r: change(r, MODELS, lambda c: c.pop("5") and None),
        "warning",
        "model-unlisted",
        "obj_000005.pl",
    ),
    "no objects": (write(MODELS, "{}"), "error", "models-info", "found no objects"),
    "no diameter": (
        lambda r: change(r, MODELS, lambda c: c["1"].pop("diameter") and None),
        "error",
        "models-info",
        "1: has",
    ),
    "diameter": (
        set_model(TUG, diameter=90.0),
        "error",
        "diameter",
        r"obj_000001.ply: is \d+\.?\d* mm across, models_i",
    ),
    "diameter in m": (set_model(TUG, diameter=0.0789), "error", "diameter", "metres instead of millimetres|anew"),
    "box size": (set_model(TUG, size_y=500.0), "warning", "model-box", "object 1: 'size_y' is 500, the model's is"),
    "no box": (
        lambda r: change(r, MODELS, lambda c: c["1"].pop("min_x") and None),
        "hint",
        "model-box",
        "has no min_x;",
    ),
    "symmetry": (tug_has_a_flip, "error", "symmetry", r"object 1, symmetries_discrete 0: moves the surface by"),
    "axis": (turn_off_axis, "error", "symmetry", r"object 5, symmetries_continuous 0: moves .*wrong axis or offset\?"),
    "symmetry shape": (
        set_model(TUG, symmetries_discrete=7),
        "error",
        "models-info",
        "'symmetries_discrete' is 7, expe",
    ),
    "target json": (write(TARGETS, "[{]"), "error", "json", "test_targets_bop19.json:1:3: invalid JSON"),
    "target key": (
        write(TARGETS, '[{"scene_id": 3}]'),
        "error",
        "target",
        "entry 0: 'im_id' is None, expected an integ",
    ),
    "target scene": (add_target(scene_id=99), "error", "target", "scene 99 is not in"),
    "target image": (add_target(im_id=99), "error", "target", "scene 3 has no image 99"),
    "target object": (add_target(obj_id=99), "error", "target", "'obj_id' is 99, which models_info.json does not list"),
    "target count": (
        add_target(inst_count=3),
        "error",
        "target",
        "asks for 3 of object 1, scene_gt.json has 1 in image",
    ),
    "target none": (add_target(inst_count=0), "error", "target", "'inst_count' is 0, expected 1 or more"),
    "target twice": (lambda r: change(r, TARGETS, lambda c: c + c[:1]), "error", "target", "entry 6: repeats entry 0"),
    "target 24": (
        write("test_targets_bop24.json", '[{"scene_id": 3, "im_id": 5}]'),
        "error",
        "target",
        r"test_targets_bop24.json, entry 0: scene 3 has no image 5",
    ),
}


@pytest.mark.slow
@pytest.mark.parametrize("name", DATASET_FAULTS)
def test_each_fault_of_a_dataset_is_found_at_its_place(root, name):
    damage, level, kind, message = DATASET_FAULTS[name]
    damage(root)
    findings = check(root)
    found = lines(findings, level, kind)
    assert any(re.search(message, line) for line in found), findings.lines()
    assert all("\n" not in line for line in findings.lines())
    assert level != "error" or not findings.ok


def test_all_faults_are_listed_not_only_the_first(root):
    for name in ("rotation", "K", "target scene", "image cut", "diameter", "share"):
        DATASET_FAULTS[name][0](root)
    findings = check(root)
    assert {"ground-truth", "camera", "target", "image", "diameter", "visibility"} <= {
        kind for _, kind in findings.counts
    }


def test_an_unknown_pose_is_no_fault(root):
    change(root, GT, lambda c: c["4"][1].update(cam_t_m2c=[-1, -1, -1], cam_R_m2c=[-1] * 9))
    change(root, TARGETS, lambda c: [e for e in c if (e["im_id"], e["obj_id"]) != (4, 5)])
    assert check(root).lines() == []


def test_a_split_without_public_truth_passes(root):
    for scene in (root / "test").iterdir():
        (scene / "scene_gt.json").unlink()
        (scene / "scene_gt_info.json").unlink()
        shutil.rmtree(scene / "mask")
        shutil.rmtree(scene / "mask_visib")
    findings = check(root)
    assert findings.lines() == []
    assert findings.covered["images decoded"] == 3


def test_truth_that_does_not_score_perfectly_is_a_violation(root, monkeypatch):
    """What the check is for: an evaluation that is off by anything at all."""
    from evalkit.evaluation.evaluator import Evaluator

    evaluate = Evaluator.evaluate

    def off(self, pairs, *rest):
        table = evaluate(self, pairs, *rest)
        table.loc[1, "add_m"] = 1e-15
        table.loc[2, "vss"] = 1 - 1e-12
        return table

    monkeypatch.setattr(Evaluator, "evaluate", off)
    found = lines(check(root), "error", "self-test")
    assert any("add_m is 1e-15" in line for line in found)
    assert any("VSS is 1" in line for line in found)


R, T = "1 0 0 0 1 0 0 0 1", "10 20 500"
GOOD = f"3,0,1,0.5,{R},{T},-1"
RESULT_FAULTS = {
    "fields": (["3,0,1"], "error", "line-line", r":2: found 3 fields, expected the 7"),
    "nan": ([f"3,0,1,nan,{R},{T},-1"], "error", "line-score", ":2: score holds NaN or infinity"),
    "scaled": ([f"3,0,1,1,2 0 0 0 2 0 0 0 2,{T},-1"], "error", "line-R", ":2: R is scaled by 2"),
    "mirrored": ([f"3,0,1,1,1 0 0 0 1 0 0 0 -1,{T},-1"], "error", "line-R", ":2: R is mirrored"),
    "scene": ([GOOD, f"9,0,1,1,{R},{T},-1"], "error", "line-scene_id", ":3: scene 9 is not in"),
    "image": ([GOOD, f"3,9,1,1,{R},{T},-1"], "error", "line-im_id", ":3: image 9 has no ground truth in"),
    "object": ([GOOD, f"3,0,9,1,{R},{T},-1"], "error", "line-obj_id", ":3: object 9 is unknown, toys has 1, 5"),
    "metres": ([f"3,0,1,1,{R},0.01 0.02 0.5,-1"], "error", "units", r"length of t in the file is 0.5.*\(metres\?\)"),
    "repeated": ([GOOD, GOOD], "warning", "duplicate", ":3: repeats the estimate of line 2"),
    "times": (
        [f"3,0,1,1,{R},{T},1.5", f"3,0,5,1,{R},{T},2"],
        "error",
        "time",
        ":3: time is 2, line 2 of the same imag",
    ),
    "odd time": ([f"3,0,1,1,{R},{T},-3"], "warning", "time", ":2: time is -3, expected seconds or -1"),
    "some times": ([GOOD, f"3,4,1,1,{R},{T},2"], "warning", "time", "1 of 2 lines have no time"),
    "scores": ([f"3,0,1,7,{R},{T},-1"], "hint", "score", "scores reach from 7 to 7; any scale is allowed"),
    "ties": ([GOOD, GOOD.replace("10 20", "11 20")], "warning", "score", "every score is 0.5, so nothing decides"),
    "rough": ([f"3,0,1,1,1.002 0 0 0 1.002 0 0 0 1.002,{T},-1"], "warning", "rough-rotation", ":2: R is 0.004 from"),
    "missing": ([GOOD], "warning", "missing", r"found 0 of 1 estimates of object 5 in scene 3, image 0"),
    "superfluous": (
        [GOOD, f"3,0,1,0.9,{R},11 20 500,-1"],
        "warning",
        "superfluous",
        r":2: the targets ask for 1 of object 1 here \(it is ignored\)",
    ),
    "behind": (
        [f"3,0,1,1,{R},10 20 -500,-1"],
        "warning",
        "behind-camera",
        r":2: the object's centre is at z = -5\d\d.* mm, behind",
    ),
    "off image": (
        [f"3,0,1,1,{R},5000 20 500,-1"],
        "warning",
        "off-image",
        r":2: object 1 lies at least \d+ px outside",
    ),
    "header": (["scene_id,im_id,R"], "error", "result-file", "the header is not|found 3 fields"),
}


@pytest.mark.parametrize("name", RESULT_FAULTS)
def test_each_fault_of_a_result_file_is_found_at_its_line(sound, tmp_path, name):
    rows, level, kind, message = RESULT_FAULTS[name]
    file = tmp_path / "m_toys-test.csv"
    head = [] if name == "header" else ["scene_id,im_id,obj_id,score,R,t,time"]
    file.write_text("\n".join([*head, *rows]) + "\n")
    findings = check(sound, [file], samples=0)
    found = lines(findings, level, kind)
    assert any(re.search(message, line) for line in found), findings.lines()
    assert findings.ok == (level != "error")


@pytest.mark.parametrize(
    ("name", "said"), [("quick.csv", "is not METHOD_DATASET-SPLIT.csv"), ("m_lmo-test.csv", "lmo")]
)
def test_a_file_name_is_only_hinted_at(sound, tmp_path, name, said):
    write_results(tmp_path / name, perfect(sound))
    findings = check(sound, [tmp_path / name], samples=0)
    assert [(level, kind) for level, kind in findings.counts] == [("hint", "file-name")]
    assert said in findings.lines()[0]


def test_a_broken_sidecar_and_a_file_that_is_not_there(sound, tmp_path):
    file = tmp_path / "m_toys-test.csv"
    write_results(file, perfect(sound))
    (tmp_path / "m_toys-test.csv.json").write_text("{")
    findings = check(sound, [file, tmp_path / "gone.csv"], samples=0)
    assert "m_toys-test.csv.json:1:2: invalid JSON" in lines(findings, "error", "sidecar")[0]
    assert "gone.csv: cannot be read" in lines(findings, "error", "result-file")[0]


def test_a_file_without_estimates_is_a_warning(sound, tmp_path):
    file = tmp_path / "m_toys-test.csv"
    file.write_text("scene_id,im_id,obj_id,score,R,t,time\n")
    findings = check(sound, [file], samples=0)
    assert findings.ok
    assert findings.counts["warning", "no-estimates"] == 1
    assert findings.counts["warning", "missing"] == 6


def test_result_files_are_checked_without_a_usable_dataset(tmp_path):
    file = tmp_path / "m_toys-test.csv"
    file.write_text("1,2\n")
    findings = check(tmp_path / "nothing", [file])
    assert [kind for _, kind in findings.counts] == ["dataset", "line-line"]


def test_few_are_shown_and_all_are_counted(sound, tmp_path):
    file = tmp_path / "m_toys-test.csv"
    rng = np.random.default_rng(0)
    write_results(
        file, [e for e in perfect(sound, T_cam_obj=se3.make_T(se3.random_rotation(rng), np.array([0, 0, 0.5])))]
    )
    file.write_text(file.read_text() + "1,2\n" * 25)
    few = CliRunner().invoke(command, ["--dataset", str(sound), "--results", str(file), "--samples", "0"])
    every = CliRunner().invoke(command, ["--dataset", str(sound), "--results", str(file), "--samples", "0", "--all"])
    assert few.output.count("found 2 fields") == 10
    assert "error line-line: 15 more like this; see --all" in few.output
    assert every.output.count("found 2 fields") == 25
    assert few.output.splitlines()[-1] == every.output.splitlines()[-1]
    assert few.output.splitlines()[-1].startswith("25 errors; checked: models 2, scenes 2, images 3")


def test_the_command_ends_with_1_on_errors_only(root, tmp_path):
    out = tmp_path / "check.json"
    good = CliRunner().invoke(command, ["--dataset", str(root), "--json", str(out)])
    assert good.exit_code == 0, good.output
    assert good.output.startswith("nothing wrong; checked: models 2")
    assert json.loads(out.read_text())["ok"] is True
    DATASET_FAULTS["blank"][0](root)
    assert CliRunner().invoke(command, ["--dataset", str(root)]).exit_code == 0
    DATASET_FAULTS["K"][0](root)
    bad = CliRunner().invoke(command, ["--dataset", str(root), "--json", str(out)])
    assert bad.exit_code == 1
    content = json.loads(out.read_text())
    assert content["counts"] == {"error": 1, "warning": 1, "hint": 0}
    assert {"level": "error", "kind": "camera", "count": 1} in content["kinds"]
    assert len(content["violations"]) == 2


def test_samples_bound_the_images_that_are_decoded(root):
    DATASET_FAULTS["image cut"][0](root)
    assert check(root, samples=2).ok
    assert check(root, samples=2).covered["images decoded"] == 2
    assert not check(root, samples=3).ok


def test_findings_say_that_nothing_was_wrong():
    assert Findings().summary() == "nothing wrong; checked: nothing"
