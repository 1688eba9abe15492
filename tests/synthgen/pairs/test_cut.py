"""Pairs cut out of annotated images: what they hold, which there are, and that they come back the same."""

import json
import shutil

import cv2
import numpy as np
import pytest
from click.testing import CliRunner
from posecore import se3
from posecore.bop import BopDataset, Estimate, write_results
from posecore.camera import project
from posecore.errors import ConfigError, DatasetError, ResultFileError, ShardError
from posecore.mesh import load_mesh
from posecore.shard import BIT_FOREGROUND, BIT_OBJECT, BIT_VISIBLE, ShardReader, ShardWriter
from synthgen.bop.dataset_writer import write_dataset
from synthgen.bop.frame_maker import FramePlan
from synthgen.cli import main
from synthgen.config import CutConfig, PerturbationConfig
from synthgen.inspect.info import dataset_info, info_text
from synthgen.pairs import cut, cut_plan
from synthgen.pairs.cut import cut_pairs
from synthgen.pairs.data_card import cut_card, model_files
from synthgen.pairs.merge import merged_card, open_parts, write_merged
from synthgen.verify.page import report_page
from synthgen.verify.verify import verify

NEAR = PerturbationConfig(max_angle_deg=15.0, max_translation_diameter=0.1)
SMALL = {"patch_px": 64, "contour_points": 20, "hypotheses_per_pose": 2, "shard_size": 4, "perturbation": NEAR}
CAMERA = {"width_px": 320, "height_px": 240, "fx": 286, "fy": 287, "cx": 162.5, "cy": 121}

CROWD = (
    *(f"camera.{key}={value}" for key, value in CAMERA.items()),
    "frames.objects=[5, 6]", "frames.instances=3", "window.min_area_px=5", "distance.max=6",
)  # fmt: skip


@pytest.fixture(scope="module")
def images(tmp_path_factory, config_of, tug, bobbin_ply):
    """Three images of up to six objects that hide one another; some objects are there twice."""
    folder = tmp_path_factory.mktemp("images") / "crowd"
    write_dataset(folder, config_of(*CROWD), {1: tug, 4: load_mesh(bobbin_ply)}, FramePlan(frames=3))
    return BopDataset(folder)


@pytest.fixture
def own(images, tmp_path):
    """A copy that a test may change."""
    return BopDataset(shutil.copytree(images.root, tmp_path / "own"))


def cut_to(url, dataset, config, hypotheses=None, on_shard=lambda n: None):
    planned = cut_plan.plan(dataset, config, hypotheses)
    writer = ShardWriter.create(str(url), cut_card(dataset, planned, config, drawn=hypotheses is None))
    for key, data in model_files(planned.meshes, {}).items():
        writer.add_file(key, data)
    cut_pairs(dataset, planned, config, writer, on_shard)
    return planned


def samples(url):
    reader = ShardReader(str(url))
    shards = [reader.read(i) for i in reader.committed]
    return {name: np.concatenate([s[name] for s in shards]) for name in shards[0]}


def tree(folder):
    return {str(p.relative_to(folder)): p.read_bytes() for p in sorted(folder.rglob("*")) if p.is_file()}


def poses(dataset):
    """Scene, image and annotation of everything that is visible enough to be cut."""
    found = [(s, i, gt) for s in dataset.scene_ids for i in dataset.im_ids(s) for gt in dataset.gt(s, i)]
    return [one for one in found if one[2].visib_fract >= CutConfig().min_visible]


def estimate(scene_id, im_id, obj_id, T):
    return Estimate(scene_id=scene_id, im_id=im_id, obj_id=obj_id, T_cam_obj=T)


@pytest.mark.slow
@pytest.mark.parametrize("window", ["fixed", "diameter"])
def test_every_check_of_a_dataset_passes(images, window, tmp_path):
    cut_to(tmp_path / "shards", images, CutConfig(**SMALL, window=window))
    report = verify(str(tmp_path / "shards"))
    assert [f.name for f in report.findings if not f.ok] == []
    checked = {f.name: f.covered for f in report.findings}
    assert checked["ground truth re-rendered"] == report.committed >= 12
    assert "angle" not in checked
    page = report_page(report)
    assert f"3 of {images.name}, split test" in page
    assert "<dt>engine</dt>" not in page


@pytest.mark.slow
def test_windows_follow_the_distance_or_not(images):
    followed, fixed = (cut_plan.plan(images, CutConfig(**SMALL, window=w)) for w in ("diameter", "fixed"))
    for image in followed.images:
        for pair in image.pairs:
            mesh, T = followed.meshes[pair.gt.obj_id], pair.T_cam_obj_hypothesis
            z = (T[:3, :3] @ mesh.center_m + T[:3, 3])[2]
            focal = np.sqrt(CAMERA["fx"] * CAMERA["fy"])
            assert pair.window.side_px == pytest.approx(2.0 * focal * mesh.diameter_m / z)
    sides = {(p.gt.obj_id, p.window.side_px) for image in fixed.images for p in image.pairs}
    assert len(sides) == len({obj_id for obj_id, _ in sides}) == 2


def test_a_fixed_window_is_as_large_as_the_nearest_pose_may_need(images, tmp_path):
    """Whatever way the object is turned there; so nothing larger is left out, and it is not much too large."""
    there = poses(images)
    write_results(tmp_path / "truth.csv", [estimate(s, i, gt.obj_id, gt.T_cam_obj) for s, i, gt in there])
    config = CutConfig(**SMALL, window="fixed", padding=0.0)
    planned = cut_plan.plan(images, config, tmp_path / "truth.csv")
    assert planned.n == len(there)
    for obj_id, side_px in planned.windows_px.items():
        mesh = planned.meshes[obj_id]
        z = min(mesh.center_cam_m(gt.T_cam_obj)[2] for *_, gt in there if gt.obj_id == obj_id)
        across_px = CAMERA["fy"] * mesh.diameter_m / z
        assert 0.8 < side_px / across_px < 1.3


@pytest.mark.slow
def test_the_scene_patch_is_the_image_there(images, tmp_path):
    """Every pixel of a patch is the image's where the window says that its centre lies."""
    planned = cut_to(tmp_path / "shards", images, CutConfig(**{**SMALL, "patch_px": 128}))
    values = samples(tmp_path / "shards")
    listed = [(image, pair) for image in planned.images for pair in image.pairs]
    for i, (image, _) in enumerate(listed):
        x0, y0, side = values["window_px"][i]
        assert side / 128 < 1.2  # else it would be blurred first
        centres = (np.arange(128) + 0.5) * side / 128
        u, v = (grid.astype(np.float32) for grid in np.meshgrid(x0 + centres - 0.5, y0 + centres - 0.5))
        rgb = images.rgb(image.scene_id, image.im_id)
        expected = cv2.remap(rgb, u, v, cv2.INTER_LINEAR, borderMode=cv2.BORDER_CONSTANT)
        assert np.abs(values["scene_rgb"][i].astype(int) - expected).max() <= 8  # of remap's steps of 1/32 pixel


@pytest.mark.slow
def test_labels_are_those_of_the_annotation(images, tmp_path):
    """Model points project into the silhouette, and what others hide is not visible; what others show is in front."""
    planned = cut_to(tmp_path / "shards", images, CutConfig(**SMALL))
    values = samples(tmp_path / "shards")
    hidden = other = 0
    listed = [(image, pair) for image in planned.images for pair in image.pairs]
    for i, (image, pair) in enumerate(listed):
        gt, bits = pair.gt, values["scene_mask"][i]
        annotation = images.gt(image.scene_id, image.im_id)[gt.gt_index]
        assert gt.obj_id == annotation.obj_id == values["obj_id"][i]
        assert values["T_cam_obj"][i] == pytest.approx(annotation.T_cam_obj, abs=1e-6)
        assert values["visible_fraction"][i] == pytest.approx(annotation.visib_fract, abs=0.08)
        uv = project(values["K_crop"][i], se3.apply(gt.T_cam_obj, planned.meshes[gt.obj_id].vertices_m))
        column, row = np.floor(uv).clip(0, 63).astype(int).T
        grown = cv2.dilate((bits & BIT_OBJECT > 0).astype(np.uint8), np.ones((3, 3), np.uint8))
        assert (grown[row, column] > 0).mean() > 0.98
        x0, y0, side = values["window_px"][i]
        r, c = np.nonzero(bits & BIT_OBJECT)
        x, y = (np.floor(o + (p + 0.5) * side / 64).astype(int) for o, p in ((x0, c), (y0, r)))
        inside = (x >= 0) & (x < 320) & (y >= 0) & (y < 240)
        seen = images.mask(image.scene_id, image.im_id, gt.gt_index, visible=True)[y[inside], x[inside]]
        visible = (bits & BIT_VISIBLE > 0)[r[inside], c[inside]]
        whole = images.mask(image.scene_id, image.im_id, gt.gt_index)[y[inside], x[inside]]
        assert (seen == visible)[whole].mean() > 0.97
        hidden += (~visible).sum()
        other += ((bits & BIT_FOREGROUND > 0) & (bits & BIT_OBJECT == 0)).sum()
    assert hidden > 100
    assert other > 1000


@pytest.mark.slow
def test_without_visible_masks_the_annotated_objects_hide_one_another(tug, config_of, tmp_path):
    """In images in which nothing else could hide them."""
    config = config_of(
        *CROWD, "occluders.front=[0, 0]", "occluders.props=[0, 0]", "frames.objects=[8, 8]", "frames.instances=8"
    )
    write_dataset(tmp_path / "own", config, {1: tug}, FramePlan(frames=2))
    cut_to(tmp_path / "with", BopDataset(tmp_path / "own"), CutConfig(**SMALL))
    for folder in (tmp_path / "own").rglob("mask_visib"):
        shutil.rmtree(folder)
    cut_to(tmp_path / "without", BopDataset(tmp_path / "own"), CutConfig(**SMALL))
    with_masks, without = (samples(tmp_path / name)["scene_mask"] & BIT_VISIBLE > 0 for name in ("with", "without"))
    whole = samples(tmp_path / "with")["scene_mask"] & BIT_OBJECT > 0
    assert (whole & ~with_masks).sum() > 200
    assert ((with_masks != without) & whole).sum() < 0.1 * (whole & ~with_masks).sum()


@pytest.mark.slow
def test_hypotheses_of_a_result_file_belong_to_the_nearest_instance(images, tmp_path):
    rng = np.random.default_rng(0)
    there = poses(images)
    hypotheses = [se3.perturb(gt.T_cam_obj, 0.1, 0.004, rng) for *_, gt in there]
    rows = [estimate(s, i, gt.obj_id, T) for (s, i, gt), T in zip(there, hypotheses, strict=True)]
    write_results(tmp_path / "guesses.csv", rows)
    planned = cut_to(tmp_path / "shards", images, CutConfig(**SMALL), tmp_path / "guesses.csv")
    values = samples(tmp_path / "shards")
    assert planned.n == len(values["obj_id"]) == len(there)
    assert len({(s, i, gt.obj_id) for s, i, gt in there}) < len(there)  # some are there twice
    for T, hypothesis in zip(values["T_cam_obj"], values["T_cam_obj_hypothesis"], strict=True):
        distances = [np.abs(other - hypothesis).max() for other in hypotheses]
        which = int(np.argmin(distances))
        assert hypotheses[which] == pytest.approx(hypothesis, abs=1e-6)
        assert there[which][2].T_cam_obj == pytest.approx(T, abs=1e-6)


def test_a_hypothesis_of_a_pose_that_is_left_out_is_not_another_ones(images, tmp_path):
    """Of two instances one is hidden: what was found there is not a bad hypothesis at the other."""
    there = poses(images)
    (s, i, hidden), rest = next(
        ((s, i, gt), others)
        for s, i, gt in there
        if (others := [o for t, k, o in there if (t, k) == (s, i) and o.obj_id == gt.obj_id and o is not gt])
        and all(o.visib_fract > gt.visib_fract + 0.01 for o in others)
    )
    rows = [estimate(s, i, hidden.obj_id, gt.T_cam_obj) for gt in (hidden, *rest)]
    write_results(tmp_path / "guesses.csv", rows)
    all_ = cut_plan.plan(images, CutConfig(**SMALL), tmp_path / "guesses.csv")
    least = hidden.visib_fract + 1e-6
    planned = cut_plan.plan(images, CutConfig(**SMALL, min_visible=least), tmp_path / "guesses.csv")
    assert (all_.n, planned.n) == (len(rows), len(rest))
    assert planned.left_out["hypotheses are of poses that are left out"] == 1


@pytest.mark.slow
def test_what_cannot_be_cut_is_left_out_and_counted(images, tmp_path):
    (s, i, gt), *_ = poses(images)
    far = gt.T_cam_obj.copy()
    far[0, 3] += 10 * images.mesh(gt.obj_id).diameter_m
    near = gt.T_cam_obj.copy()
    near[2, 3] = 0.01
    rows = [estimate(s, i, gt.obj_id, T) for T in (gt.T_cam_obj, far, near)]
    write_results(tmp_path / "guesses.csv", rows)
    planned = cut_plan.plan(images, CutConfig(**SMALL), tmp_path / "guesses.csv")
    assert planned.n == 1
    assert sorted(planned.left_out.items())[:2] == [
        ("pairs do not fit into their windows (more scale, or padding of fixed ones, helps)", 1),
        ("pairs reach behind the camera", 1),
    ]
    assert set(planned.meshes) == {gt.obj_id}
    strict = cut_plan.plan(images, CutConfig(**SMALL, min_visible=0.9))
    least = min(pair.gt.visib_fract for image in strict.images for pair in image.pairs)
    assert least >= 0.9
    assert strict.left_out["poses are visible by less than 0.9"] == sum(
        gt.visib_fract < 0.9 for s in images.scene_ids for i in images.im_ids(s) for gt in images.gt(s, i)
    )
    with pytest.raises(DatasetError, match=r"there is no pair to cut \(\d+ pairs show an object on less than 90000 pi"):
        cut_plan.plan(images, CutConfig(**SMALL, min_area_px=90_000))


def test_the_same_line_twice_is_one_pair(images, tmp_path):
    (s, i, gt), *_ = poses(images)
    write_results(tmp_path / "guesses.csv", [estimate(s, i, gt.obj_id, gt.T_cam_obj)] * 3)
    assert cut_plan.plan(images, CutConfig(**SMALL), tmp_path / "guesses.csv").n == 1


@pytest.mark.slow
def test_some_images_evenly_spread(images):
    planned = cut_plan.plan(images, CutConfig(**SMALL, images=2))
    assert [image.im_id for image in planned.images] == [0, 2]
    assert len(cut_plan.plan(images, CutConfig(**SMALL, images=5)).images) == 3


@pytest.mark.slow
def test_images_of_one_of_several_scenes_are_one_scene(images, own, tmp_path):
    scene = own.split_path / "000001"
    shutil.copytree(scene, own.split_path / "000007")
    planned = cut_to(tmp_path / "shards", BopDataset(own.root), CutConfig(**SMALL))
    assert [image.scene_index for image in planned.images] == [0, 0, 0, 1, 1, 1]
    first, second = (planned.images[k].pairs[0].T_cam_obj_hypothesis for k in (0, 3))
    assert not np.allclose(first, second)  # the same image, and other draws


@pytest.mark.parametrize(
    ("together", "one", "two"),
    [(0, [0, 1, 2], [0, 0, 0, 1, 1, 1]), (2, [0, 0, 1], [0, 0, 1, 2, 2, 3]), (9, [0] * 3, [0] * 3 + [1] * 3)],
)
def test_images_of_a_video_go_together(images, own, together, one, two):
    config = CutConfig(**SMALL, images_per_scene=together)
    assert [image.scene_index for image in cut_plan.plan(images, config).images] == one
    shutil.copytree(own.split_path / "000001", own.split_path / "000007")
    assert [image.scene_index for image in cut_plan.plan(BopDataset(own.root), config).images] == two


def test_hidden_rims_are_hidden_and_thin_differences_are_not():
    disc = cv2.circle(np.zeros((80, 80), np.uint8), (40, 40), 25, 1, -1) > 0
    lower = np.arange(80)[:, None] > 40
    hidden = cut._hidden(disc, disc & ~lower)
    ring = (cv2.dilate(disc.astype(np.uint8), np.ones((3, 3), np.uint8)) > 0) & ~disc
    assert hidden[ring & (np.arange(80)[:, None] > 43)].all()
    assert not hidden[ring & ~lower][: ring[:38].sum()].any()
    assert (hidden & disc)[lower & disc].mean() > 0.97
    smaller = cv2.erode(disc.astype(np.uint8), np.ones((3, 3), np.uint8)) > 0
    assert not cut._hidden(disc, smaller).any()


@pytest.mark.slow
def test_what_is_visible_beyond_the_mesh_stays_foreground(images, own, tmp_path):
    """The object is a little larger than its mesh: exchanging what is behind must not cut it at the label's edge."""
    for file in own.split_path.rglob("mask_visib/*.png"):
        mask = cv2.imread(str(file), cv2.IMREAD_GRAYSCALE)
        cv2.imwrite(str(file), cv2.dilate(mask, np.ones((5, 5), np.uint8)))
    cut_to(tmp_path / "as", images, CutConfig(**SMALL))
    cut_to(tmp_path / "beyond", BopDataset(own.root), CutConfig(**SMALL))
    before, after = (samples(tmp_path / name)["scene_mask"] for name in ("as", "beyond"))
    rim = (before & BIT_OBJECT == 0) & (before & BIT_FOREGROUND == 0)
    assert (after & BIT_FOREGROUND > 0)[rim].sum() > 2000
    np.testing.assert_array_equal(before & BIT_OBJECT, after & BIT_OBJECT)
    assert [f.name for f in verify(str(tmp_path / "beyond")).findings if not f.ok] == []


@pytest.mark.slow
def test_a_source_that_changed_is_another_one(images, own, tmp_path):
    planned = cut_plan.plan(images, CutConfig(**SMALL))
    same = cut_plan.plan(own, CutConfig(**SMALL))
    assert planned.digest == same.digest
    file = next(own.split_path.rglob("rgb/000001.png"))
    cv2.imwrite(str(file), cv2.GaussianBlur(cv2.imread(str(file)), (0, 0), 2.0))
    assert cut_plan.plan(BopDataset(own.root), CutConfig(**SMALL)).digest != planned.digest


@pytest.mark.slow
def test_fixed_windows_need_one_focal_length(own):
    file = own.split_path / "000001" / "scene_camera.json"
    cameras = json.loads(file.read_text())
    cameras["1"]["cam_K"][0] *= 1.5
    file.write_text(json.dumps(cameras))
    with pytest.raises(DatasetError, match=r"image 0 of scene 1 has fx 286 and image 1 of scene 1 429, expected one"):
        cut_plan.plan(BopDataset(own.root), CutConfig(**SMALL, window="fixed"))
    planned = cut_plan.plan(BopDataset(own.root), CutConfig(**SMALL))
    assert cut_card(own, planned, CutConfig(**SMALL))["camera"]["shared"] is False


@pytest.mark.slow
def test_pairs_of_one_image_are_one_scene(images, tmp_path):
    planned = cut_to(tmp_path / "shards", images, CutConfig(**SMALL))
    index = samples(tmp_path / "shards")["scene_index"]
    assert index.tolist() == [image.scene_index for image in planned.images for _ in image.pairs]
    assert sorted(set(index.tolist())) == [0, 1, 2]


@pytest.mark.slow
def test_two_cuts_of_the_same_images_are_merged_into_the_same_scenes(images, tmp_path):
    """With numbers of its own an image could be trained on and held out."""
    for seed in (0, 1):
        cut_to(tmp_path / f"cut{seed}", images, CutConfig(seed=seed, **SMALL))
    parts = open_parts([str(tmp_path / f"cut{seed}") for seed in (0, 1)])
    write_merged(parts, ShardWriter.create(str(tmp_path / "both"), merged_card(parts)))
    reader = ShardReader(str(tmp_path / "both"))
    rows = [reader.read(i, ["scene_index", "T_cam_obj"]) for i in reader.committed]
    scenes_of: dict[bytes, set[int]] = {}
    for row in rows:
        for T, scene in zip(row["T_cam_obj"], row["scene_index"], strict=True):
            scenes_of.setdefault(T.tobytes(), set()).add(int(scene))
    assert len(scenes_of) > 3
    assert all(len(scenes) == 1 for scenes in scenes_of.values())
    cut_to(tmp_path / "blocks", images, CutConfig(images_per_scene=2, **SMALL))
    with pytest.raises(ShardError, match=r"blocks: images_per_scene is 2, expected 0 as in .*cut0"):
        open_parts([str(tmp_path / "cut0"), str(tmp_path / "blocks")])


@pytest.mark.slow
def test_an_interrupted_run_ends_with_the_same_bytes(images, tmp_path):
    cut_to(tmp_path / "whole", images, CutConfig(**SMALL))

    def stop(_):
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        cut_to(tmp_path / "again", images, CutConfig(**SMALL), on_shard=stop)
    assert len(ShardReader(str(tmp_path / "again")).committed) == 1
    damaged = next(p for p in (tmp_path / "again" / "scene_rgb" / "c").rglob("0") if p.is_file())
    damaged.write_bytes(damaged.read_bytes()[:-1])
    counted = []
    cut_to(tmp_path / "again", images, CutConfig(**SMALL), on_shard=counted.append)
    assert tree(tmp_path / "again") == tree(tmp_path / "whole")
    assert sum(counted) == ShardReader(str(tmp_path / "whole")).n
    with pytest.raises(ShardError, match="seed"):
        cut_to(tmp_path / "again", images, CutConfig(**SMALL, seed=3))


@pytest.mark.slow
def test_workers_do_not_change_a_byte(images, tmp_path):
    cut_to(tmp_path / "one", images, CutConfig(**SMALL))
    planned = cut_plan.plan(images, CutConfig(**SMALL))
    assert planned.n > 2 * SMALL["shard_size"]
    command = ["cut", "--dataset", str(images.root), "--patch-px", "64", "--hypotheses-per-pose", "2", "--workers", "2"]
    settings = ["contour_points=20", "shard_size=4", "perturbation.max_angle_deg=15"]
    settings = [word for s in (*settings, "perturbation.max_translation_diameter=0.1") for word in ("--set", s)]
    result = CliRunner().invoke(main, [*command, *settings, "--out", str(tmp_path / "two"), "--quiet"])
    assert result.exit_code == 0, result.output
    one, two = (
        {path: data for path, data in tree(tmp_path / name).items() if not path.startswith("models/")}
        for name in ("one", "two")
    )
    assert one == two


@pytest.mark.slow
def test_the_seed_decides_hypotheses(images):
    first, again, other = (cut_plan.plan(images, CutConfig(**SMALL, seed=seed)) for seed in (1, 1, 2))

    def drawn(planned):
        return np.stack([p.T_cam_obj_hypothesis for image in planned.images for p in image.pairs])

    assert np.array_equal(drawn(first), drawn(again))
    assert not np.array_equal(np.sort(drawn(first), axis=0), np.sort(drawn(other), axis=0))


@pytest.mark.slow
def test_wrong_inputs_are_one_line_each(images, own, tmp_path):
    (tmp_path / "empty.csv").write_text("scene_id,im_id,obj_id,score,R,t,time\n")
    with pytest.raises(DatasetError, match=r"empty\.csv: holds no pose"):
        cut_plan.plan(images, CutConfig(**SMALL), tmp_path / "empty.csv")
    write_results(tmp_path / "elsewhere.csv", [estimate(77, 0, 1, poses(images)[0][2].T_cam_obj)])
    with pytest.raises(ResultFileError, match="77"):
        cut_plan.plan(images, CutConfig(**SMALL), tmp_path / "elsewhere.csv")
    with pytest.raises(ConfigError, match=r"scale is 0\.5"):
        CutConfig(scale=0.5)
    mask = next(own.split_path.rglob("mask_visib/000001_000001.png"))
    whole = mask.read_bytes()
    cv2.imwrite(str(mask), np.zeros((100, 90), np.uint8))
    with pytest.raises(DatasetError, match=r"mask_visib.000001_000001\.png: is 90 x 100 pixels, expected 320 x 240"):
        cut_to(tmp_path / "sizes", BopDataset(own.root), CutConfig(**SMALL))
    mask.write_bytes(whole)
    file = next(own.split_path.rglob("rgb/000001.png"))
    cv2.imwrite(str(file), np.zeros((100, 90, 3), np.uint8))
    with pytest.raises(
        DatasetError, match=r"320 x 240 pixels and image 1 of scene 1 90 x 100, expected images of equal size"
    ):
        cut_plan.plan(BopDataset(own.root), CutConfig(**SMALL))
    for file in own.split_path.rglob("scene_gt.json"):
        file.unlink()
    with pytest.raises(DatasetError, match=r"no scene_gt\.json"):
        cut_plan.plan(BopDataset(own.root), CutConfig(**SMALL))


@pytest.mark.slow
def test_from_the_command_line(images, tmp_path):
    settings = ["--patch-px", "64", "--set", "contour_points=20", "--hypotheses-per-pose", "1", "--seed", "3"]
    arguments = [
        "cut",
        "--dataset",
        str(images.root),
        "--out",
        str(tmp_path / "shards"),
        *settings,
        "--set",
        "min_visible=0.5",
    ]
    result = CliRunner().invoke(main, arguments)
    assert result.exit_code == 0, result.output
    n = ShardReader(str(tmp_path / "shards")).n
    assert f"complete, {n} pairs of 3 images" in result.output
    assert f"{n} pairs of {images.split_path}, about" in result.output
    assert "left out: " in result.output
    assert "poses are visible by less than 0.5" in result.output
    shown = info_text(dataset_info(str(tmp_path / "shards")))
    assert "images:       3 of crowd, split test" in shown
    assert "hypotheses:   drawn" in shown
    assert "min_visible: 0.5 (default 0.1)" in shown
    models = json.loads((tmp_path / "shards" / "models" / "models_info.json").read_text())
    assert set(models) == {"1", "4"}
    shutil.copytree(images.split_path, tmp_path / "two" / "test")
    shutil.copytree(images.split_path, tmp_path / "two" / "train")
    unsure = CliRunner().invoke(main, ["cut", "--dataset", str(tmp_path / "two"), "--out", str(tmp_path / "x")])
    assert unsure.exit_code == 2
    assert "has the splits test, train: choose with --split" in unsure.output
    failed = CliRunner().invoke(main, ["cut", "--dataset", str(tmp_path / "nowhere"), "--out", str(tmp_path / "x")])
    assert failed.exit_code == 1
    assert "no such folder" in failed.output
    assert not (tmp_path / "x").exists()


def test_a_rough_rotation_becomes_exact_about_the_centre(tug):
    """LM-O's annotations are scaled by up to 1.0048: about an origin 2 m off, that would move the object by 10 mm."""
    T = se3.make_T(1.0048 * se3.random_rotation(np.random.default_rng(0)), np.array([0.1, 0.0, 0.8]))
    far = tug.with_origin_at(np.array([-2.0, 0.0, 0.0]))
    T_far = se3.with_origin_at(T, np.array([-2.0, 0.0, 0.0]))
    made, made_far = cut_plan.rigid(T, tug), cut_plan.rigid(T_far, far)
    assert se3.is_rotation(made_far[:3, :3], 1e-9)
    np.testing.assert_allclose(far.center_cam_m(made_far), tug.center_cam_m(T), atol=1e-12)
    np.testing.assert_allclose(se3.apply(made_far, far.vertices_m), se3.apply(made, tug.vertices_m), atol=1e-12)
