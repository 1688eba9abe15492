import json
import os
import re
import signal
import sys
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
from children import started, wait_until
from posecore.bop import BopDataset
from posecore.errors import ConfigError, DatasetError, StorageError
from posecore.mesh import load_mesh
from posecore.raster import Rasteriser
from synthgen import lock
from synthgen.bop import dataset_writer
from synthgen.bop.dataset_writer import write_dataset
from synthgen.bop.frame_maker import FramePlan
from synthgen.config import load_config
from synthgen.inputs.assets import Assets

SMALL_CAMERA = tuple(
    f"camera.{key}={value}"
    for key, value in {"width_px": 160, "height_px": 120, "fx": 143, "fy": 143, "cx": 81.5, "cy": 60.5}.items()
)
MANY = (*SMALL_CAMERA, "frames.objects=[3, 5]", "frames.instances=3", "window.min_area_px=5", "distance.max=6")


def tree(folder):
    return {str(p.relative_to(folder)): p.read_bytes() for p in sorted(folder.rglob("*")) if p.is_file()}


@pytest.fixture(scope="module")
def meshes(tug, bobbin_ply):
    return {1: tug, 4: load_mesh(bobbin_ply)}


@pytest.fixture(scope="module")
def written(tmp_path_factory, config_of, tug):
    folder = tmp_path_factory.mktemp("bop") / "tug"
    write_dataset(folder, config_of(), {1: tug}, FramePlan(frames=3))
    return folder


@pytest.fixture(scope="module")
def crowded(tmp_path_factory, config_of, meshes):
    folder = tmp_path_factory.mktemp("bop") / "crowd"
    write_dataset(folder, config_of(*MANY), meshes, FramePlan(frames=5))
    return folder


@pytest.mark.slow
def test_it_reads_back_as_bop_with_poses_that_match_the_images(written, tug):
    dataset = BopDataset(written)
    assert [(t.scene_id, t.im_id, t.obj_id, t.inst_count) for t in dataset.targets] == [(1, i, 1, 1) for i in range(3)]
    assert dataset.models_info[1].diameter_m == pytest.approx(tug.diameter_m, rel=1e-4)
    with Rasteriser({1: dataset.mesh(1)}) as rasteriser:
        for im_id in range(3):
            camera = dataset.camera(1, im_id)
            assert dataset.rgb(1, im_id).shape == (480, 640, 3)
            (gt,) = dataset.gt(1, im_id)
            alone = rasteriser.render(1, camera.K, gt.T_cam_obj[None], 640, 480).depth_m[0]
            depth = dataset.depth_m(1, im_id)
            same = (alone > 0) & (np.abs(depth - alone) < 2e-4)
            assert gt.visib_fract == pytest.approx(same.sum() / (alone > 0).sum(), abs=0.02)


def test_it_reads_the_way_bop_toolkit_reads(crowded):
    """File names, keys, shapes and dtypes that bop_toolkit's inout and dataset_params expect."""
    scene = crowded / "test" / "000001"
    camera = json.loads((crowded / "camera.json").read_text())
    assert set(camera) == {"cx", "cy", "depth_scale", "fx", "fy", "height", "width"}
    models = json.loads((crowded / "models/models_info.json").read_text())
    assert set(models) == {"1", "4"}
    for about in models.values():
        assert {"diameter", "min_x", "min_y", "min_z", "size_x", "size_y", "size_z"} <= set(about)
    cameras, gts, info = (
        {int(k): v for k, v in json.loads((scene / f"scene_{name}.json").read_text()).items()}
        for name in ("camera", "gt", "gt_info")
    )
    assert list(cameras) == list(gts) == list(info) == list(range(5))
    for im_id in gts:
        K = np.array(cameras[im_id]["cam_K"]).reshape(3, 3)
        assert K[0, 1] == K[1, 0] == 0 and K[2, 2] == 1
        assert cameras[im_id]["depth_scale"] == 0.1
        rgb = cv2.imread(str(scene / f"rgb/{im_id:06d}.png"), cv2.IMREAD_UNCHANGED)
        depth = cv2.imread(str(scene / f"depth/{im_id:06d}.png"), cv2.IMREAD_UNCHANGED)
        assert (rgb.dtype, rgb.shape, depth.dtype, depth.shape) == (np.uint8, (120, 160, 3), np.uint16, (120, 160))
        for gt_id, gt in enumerate(gts[im_id]):
            R, t = np.array(gt["cam_R_m2c"]).reshape(3, 3), np.array(gt["cam_t_m2c"]).reshape(3, 1)
            assert np.allclose(R @ R.T, np.eye(3)) and np.linalg.det(R) > 0 and t[2] > 100
            for kind in ("mask", "mask_visib"):
                mask = cv2.imread(str(scene / f"{kind}/{im_id:06d}_{gt_id:06d}.png"), cv2.IMREAD_UNCHANGED)
                assert (mask.dtype, mask.shape) == (np.uint8, (120, 160)) and set(np.unique(mask)) <= {0, 255}
    assert len(list((scene / "mask").iterdir())) == sum(map(len, gts.values()))
    targets = json.loads((crowded / "test_targets_bop19.json").read_text())
    expected = {}
    for im_id, poses in gts.items():
        for gt, about in zip(poses, info[im_id], strict=True):
            if about["visib_fract"] >= 0.1:
                expected[im_id, gt["obj_id"]] = expected.get((im_id, gt["obj_id"]), 0) + 1
    assert {(t["im_id"], t["obj_id"]): t["inst_count"] for t in targets} == expected
    assert max(expected.values()) > 1
    images = json.loads((crowded / "test_targets_bop24.json").read_text())
    assert images == [{"im_id": i, "scene_id": 1} for i in sorted({im_id for im_id, _ in expected})]


def test_visibility_is_that_of_a_render_of_all_objects(crowded):
    """Masks, counts and boxes against the rasteriser with all labelled objects; shapes in front hide more."""
    dataset = BopDataset(crowded)
    info = json.loads((crowded / "test/000001/scene_gt_info.json").read_text())
    hidden = 0
    with Rasteriser({i: dataset.mesh(i) for i in (1, 4)}) as rasteriser:
        for im_id in dataset.im_ids(1):
            depth, K = dataset.depth_m(1, im_id), dataset.camera(1, im_id).K.copy()
            K[:2, 2] += (160, 120)
            for gt in dataset.gt(1, im_id):
                wide = rasteriser.render(gt.obj_id, K, gt.T_cam_obj[None], 480, 360, rgb=False).depth_m[0]
                inside = wide[120:240, 160:320]
                masks = [
                    cv2.imread(str(crowded / f"test/000001/{kind}/{im_id:06d}_{gt.gt_index:06d}.png"), -1) > 0
                    for kind in ("mask", "mask_visib")
                ]
                assert np.array_equal(masks[0], inside > 0)
                seen = (inside > 0) & (np.abs(depth - inside) < 2e-4)
                assert (masks[1] ^ seen).sum() <= 2
                assert (masks[1] <= masks[0]).all()
                about = info[str(im_id)][gt.gt_index]
                assert about["px_count_all"] == (wide > 0).sum()
                assert about["px_count_valid"] == ((inside > 0) & (depth > 0)).sum()
                assert about["px_count_visib"] == masks[1].sum()
                assert about["visib_fract"] == pytest.approx(masks[1].sum() / (wide > 0).sum())
                rows, columns = np.nonzero(wide > 0)
                if masks[1].any():
                    box = [columns.min() - 160, rows.min() - 120, np.ptp(columns), np.ptp(rows)]
                    assert about["bbox_obj"] == box
                    rows, columns = np.nonzero(masks[1])
                    assert about["bbox_visib"] == [columns.min(), rows.min(), np.ptp(columns), np.ptp(rows)]
                hidden += about["visib_fract"] < 0.99
    assert hidden, "no object is hidden in part: the test shows nothing"


@pytest.mark.slow
def test_a_started_dataset_is_continued_to_the_same_bytes(crowded, tmp_path, config_of, meshes):
    class Stop(Exception):
        pass

    def stop(scene_id, im_id):
        if im_id == 1:
            raise Stop

    for _ in range(2):  # the second one stops at once, with frame 1 there
        with pytest.raises(Stop):
            write_dataset(tmp_path / "b", config_of(*MANY), meshes, FramePlan(frames=5), on_frame=stop)
        assert len(BopDataset(tmp_path / "b").im_ids(1)) == 2
    write_dataset(tmp_path / "b", config_of(*MANY), meshes, FramePlan(frames=5))
    assert tree(tmp_path / "b") == tree(crowded)


@pytest.mark.slow
def test_workers_make_the_same_bytes_and_one_that_is_killed_is_replaced(crowded, tmp_path, config_of, meshes):
    killed = []

    def kill_one(scene_id, im_id):
        if not killed:
            killed.append(children()[-1])
            os.kill(killed[0], signal.SIGKILL)

    def children():
        return sorted(
            int(stat.parent.name)
            for stat in Path("/proc").glob("[0-9]*/stat")
            if stat.read_text().rpartition(")")[2].split()[1] == str(os.getpid())
            and b"spawn_main" in (stat.parent / "cmdline").read_bytes()
        )

    write_dataset(tmp_path / "w", config_of(*MANY), meshes, FramePlan(frames=5), workers=2, on_frame=kill_one)
    assert killed
    assert tree(tmp_path / "w") == tree(crowded)


@pytest.mark.slow
def test_workers_that_are_interrupted_leave_no_temporary_files(tmp_path, config_of, meshes):
    def stop(scene_id, im_id):
        (tmp_path / "w/.rgb.png.tmp").touch()
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        write_dataset(tmp_path / "w", config_of(*MANY), meshes, FramePlan(frames=5), workers=2, on_frame=stop)
    assert not list((tmp_path / "w").rglob(".*.tmp"))
    assert len(BopDataset(tmp_path / "w").im_ids(1)) == 1


@pytest.mark.slow
def test_kill_9_of_the_whole_run_loses_only_frames_in_flight(crowded, tmp_path, tug_ply, bobbin_ply, config_of, meshes):
    script = (
        "import sys; sys.path[:0] = sys.argv[1:3]\n"
        "from posecore.mesh import load_mesh\n"
        "from synthgen.bop.dataset_writer import write_dataset\n"
        "from synthgen.config import load_config\n"
        "from synthgen.bop.frame_maker import FramePlan\n"
        "from conftest import SMALL\n"
        "from bop.test_dataset_writer import MANY\n"
        "meshes = {1: load_mesh(sys.argv[4]), 4: load_mesh(sys.argv[5])}\n"
        "write_dataset(sys.argv[3], load_config('default', [*SMALL, *MANY]), meshes, FramePlan(frames=5))\n"
    )
    here, out = Path(__file__).parents[1], tmp_path / "k"
    journal = out / "test/000001/.frames.jsonl"
    with started([sys.executable, "-c", script, here, here.parent, out, tug_ply, bobbin_ply]) as process:
        wait_until(lambda: journal.is_file() and journal.stat().st_size, process)
    assert process.returncode == -signal.SIGKILL, "the run ended before it could be killed"
    (out / "test/000001/rgb/.000003.png.1.tmp").write_bytes(b"half")  # what a kill within a write leaves
    write_dataset(out, config_of(*MANY), meshes, FramePlan(frames=5))
    assert tree(out) == tree(crowded)


@pytest.mark.slow
def test_training_images_are_jpeg_share_their_scene_and_have_no_targets(tmp_path, config_of, meshes):
    config = config_of(*MANY, "scene.kind=tabletop", "tabletop.tables=2")
    write_dataset(tmp_path / "p", config, meshes, FramePlan(split="train_pbr", frames=3, frames_per_scene=2))
    dataset = BopDataset(tmp_path / "p", "train_pbr")
    assert [(s, dataset.im_ids(s)) for s in dataset.scene_ids] == [(0, [0, 1]), (1, [0])]
    assert not list((tmp_path / "p").glob("*targets*"))
    assert dataset.image_file(0, 0).path.suffix == ".jpg"
    cameras = json.loads((tmp_path / "p/train_pbr/000000/scene_camera.json").read_text())
    in_world = []
    for im_id in (0, 1):
        R = np.reshape(cameras[str(im_id)]["cam_R_w2c"], (3, 3))
        t_m = np.array(cameras[str(im_id)]["cam_t_w2c"]) / 1000
        gts = dataset.gt(0, im_id)
        in_world.append([(g.obj_id, R.T @ (g.T_cam_obj[:3, 3] - t_m)) for g in gts])
    assert [i for i, _ in in_world[0]] == [i for i, _ in in_world[1]]
    assert np.allclose([x for _, x in in_world[0]], [x for _, x in in_world[1]], atol=1e-9)
    assert not np.allclose(dataset.gt(0, 0)[0].T_cam_obj, dataset.gt(0, 1)[0].T_cam_obj, atol=1e-2)


def test_another_dataset_is_refused(written, config_of, tug, tmp_path):
    plan = FramePlan(frames=3)
    with pytest.raises(DatasetError, match="config differ"):
        write_dataset(written, config_of("seed=9"), {1: tug}, plan)
    with pytest.raises(DatasetError, match="frames differ"):
        write_dataset(written, config_of(), {1: tug}, replace(plan, frames=4))
    (tmp_path / "notes.txt").write_text("mine")
    with pytest.raises(DatasetError, match="not empty"):
        write_dataset(tmp_path, config_of(), {1: tug}, plan)


def test_a_dataset_of_an_earlier_version_with_old_keys_is_continued(written, config_of, tug):
    card = written / "synthgen.json"
    before, tree_before = card.read_text(), tree(written)
    card.write_text(before.replace('"easy_fraction"', '"easy_share"').replace('"min_period_s"', '"smoothness_s"'))
    write_dataset(written, config_of(), {1: tug}, FramePlan(frames=3))
    with pytest.raises(DatasetError, match="config differ"):
        write_dataset(written, config_of("seed=9"), {1: tug}, FramePlan(frames=3))
    card.write_text(before)
    assert tree(written) == tree_before


def test_photographs_are_compared_by_content(tmp_path, config_of, tug):
    photos = []
    for i in range(2):
        photos.append(str(tmp_path / f"{i}.png"))
        cv2.imwrite(photos[-1], np.full((60, 80, 3), 40 + 100 * i, np.uint8))
    config = config_of(*SMALL_CAMERA, "window.min_area_px=5")
    write_dataset(tmp_path / "d", config, {1: tug}, FramePlan(frames=1), assets=Assets(photos=(photos[0],)))
    with pytest.raises(DatasetError, match="backgrounds differ"):
        write_dataset(tmp_path / "d", config, {1: tug}, FramePlan(frames=1), assets=Assets(photos=(photos[1],)))


def test_two_runs_do_not_share_a_folder(tmp_path, config_of, tug):
    with lock.held(str(tmp_path / "d")), pytest.raises(StorageError, match="another synthgen"):
        write_dataset(tmp_path / "d", config_of(), {1: tug}, FramePlan(frames=1))


@pytest.mark.parametrize(
    ("plan", "message"),
    [
        ({"frames": 0}, "--frames 0"),
        ({"frames": 5, "sequences": 1, "frames_per_scene": 2}, "--frames-per-scene"),
        ({"frames": 5, "sequences": 0}, "--sequences 0"),
    ],
)
def test_plans_that_make_no_sense(plan, message):
    with pytest.raises(ConfigError, match=message):
        FramePlan(**plan)


def test_more_objects_than_there_are(tmp_path, config_of, tug):
    with pytest.raises(ConfigError, match="1 objects at most 2 times each are fewer"):
        write_dataset(
            tmp_path / "d", config_of("frames.objects=[3, 4]", "frames.instances=2"), {1: tug}, FramePlan(frames=1)
        )
    assert not (tmp_path / "d").exists()


@pytest.mark.slow
def test_the_pbr_preset_shows_many_objects_on_a_table(tmp_path, meshes):
    config = load_config("pbr", [*SMALL_CAMERA, "engine=raster", "window.min_area_px=5", "tabletop.tables=1"])
    write_dataset(tmp_path / "p", config, meshes, FramePlan(split="train_pbr", frames=2, frames_per_scene=2))
    dataset = BopDataset(tmp_path / "p", "train_pbr")
    assert dataset.scene_ids == [0]
    for im_id in (0, 1):
        assert 5 <= len(dataset.gt(0, im_id)) <= 10
        depth = dataset.depth_m(0, im_id)
        masks = [cv2.imread(str(f), -1) > 0 for f in (tmp_path / "p/train_pbr/000000/mask").glob(f"{im_id:06d}_*")]
        assert ((depth > 0) & ~np.any(masks, axis=0)).mean() > 0.1, "no table"


@pytest.mark.slow
@pytest.mark.parametrize(
    ("size", "overrides", "scale_mm"),
    [
        (1.0, (), 0.1),
        (1.0, ("distance.unit=m", "distance.min=5", "distance.max=9"), 1.0),
        (100.0, ("distance.unit=m", "distance.min=100", "distance.max=110"), 10.0),
        (0.025, (), 0.01),
    ],
)
def test_depth_steps_follow_the_scenes_and_the_objects(config_of, meshes, size, overrides, scale_mm):
    from synthgen.draw.target import make_targets

    config = config_of(*overrides)
    scaled = {i: replace(mesh, vertices_m=size * mesh.vertices_m) for i, mesh in meshes.items()}
    assert dataset_writer._depth_scale(config, make_targets(scaled, config)) == pytest.approx(scale_mm)


@pytest.mark.slow
@pytest.mark.blender
def test_cycles_frames_match_the_rasteriser_and_do_not_depend_on_workers(tmp_path, config_of, meshes):
    config = config_of(*MANY, "engine=cycles", "samples=2", "scene.kind=tabletop", "tabletop.tables=1")
    plan = FramePlan(frames=4, frames_per_scene=2)
    write_dataset(tmp_path / "a", config, meshes, plan)
    write_dataset(tmp_path / "b", config, meshes, plan, workers=2)
    assert tree(tmp_path / "a") == tree(tmp_path / "b")
    dataset = BopDataset(tmp_path / "a")
    seen = wrong = 0
    with Rasteriser({i: dataset.mesh(i) for i in meshes}) as rasteriser:
        for scene_id, im_id in ((0, 0), (0, 1), (1, 0), (1, 1)):
            depth, K = dataset.depth_m(scene_id, im_id), dataset.camera(scene_id, im_id).K
            for gt in dataset.gt(scene_id, im_id):
                alone = rasteriser.render(gt.obj_id, K, gt.T_cam_obj[None], 160, 120, rgb=False).depth_m[0]
                file = tmp_path / f"a/test/{scene_id:06d}/mask_visib/{im_id:06d}_{gt.gt_index:06d}.png"
                visible = cv2.imread(str(file), cv2.IMREAD_UNCHANGED) > 0
                expected = (alone > 0) & (np.abs(depth - alone) < 2e-3)
                seen, wrong = seen + expected.sum(), wrong + (expected ^ visible).sum()
    assert seen > 500 and wrong < 0.03 * seen


@pytest.mark.slow
def test_the_commands_options_reach_the_dataset(tmp_path, tug_ply, small_set):
    from click.testing import CliRunner
    from synthgen.cli import main

    def invoke(*arguments):
        words = ["bop", "--object", tug_ply, "--quiet", *small_set, *arguments]
        return CliRunner().invoke(main, [str(word) for word in words])

    small = [word for assignment in SMALL_CAMERA for word in ("--set", assignment)]
    out = tmp_path / "s"
    options = ["--sequence", "--sequences", 2, "--fps", 10, "--objects-per-frame", 2, 2, "--set", "frames.instances=2"]
    result = invoke("--out", out, "--frames", 2, "--split", "val", *options, "--set", "window.min_area_px=5", *small)
    assert result.exit_code == 0, result.output
    dataset = BopDataset(out, "val")
    assert [len(dataset.gt(s, i)) for s in (1, 2) for i in (0, 1)] == [2, 2, 2, 2]
    card = json.loads((out / "synthgen.json").read_text())
    assert (card["sequences"], card["split"], card["config"]["sequence"]["fps"]) == (2, "val", 10.0)
    for arguments, message in (
        (["--fps", 10], "--fps: is for sequences alone; add --sequence"),
        (["--sequences", 2], "--sequences: is for sequences alone; add --sequence"),
        (["--sequence", "--frames-per-scene", 5], "--frames-per-scene: a sequence is one scene"),
        (["--objects-per-frame", 5, 2], r"frames.*objects is \[5, 2\]"),
    ):
        result = invoke("--out", tmp_path / "no", "--frames", 2, *arguments)
        assert result.exit_code in (1, 2) and "Traceback" not in result.output
        assert re.search(message, result.output.replace("\n", " ")), result.output
        assert not (tmp_path / "no").exists()
