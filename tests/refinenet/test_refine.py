import json
import re
import shutil
import threading
from dataclasses import replace

import cv2
import numpy as np
import pytest
import torch
import trimesh
from posecore import raster, se3
from posecore.bop import BopDataset, BopWriter, Estimate, read_results, read_sidecar, write_models, write_results
from posecore.camera import Camera, project
from posecore.errors import CameraError, CheckpointError
from posecore.mesh import Mesh, load_mesh, mesh_digest, save_ply
from posecore.raster import Rasteriser
from posecore.window import Window, cut, cut_rgb, diameter_window
from refinenet import checkpoint, geometry
from refinenet.config import load_config
from refinenet.errors import RefinementError
from refinenet.geometry import PoseUpdate
from refinenet.methods import Frame, Request, Status
from refinenet.network import make_network
from refinenet.pool import PooledRefiner
from refinenet.refine import Refiner

from .conftest import HEIGHT_PX, WIDTH_PX, K, background


@pytest.fixture(scope="module")
def frame(mesh):
    """An image with two instances, and their poses."""
    rng = np.random.default_rng(0)
    z = 6 * mesh.diameter_m
    truths = np.stack([
        se3.make_T(se3.random_rotation(rng), np.array([x * z, 0.05 * z, z])) for x in (-0.2, 0.22)
    ])  # fmt: skip
    image = background(rng)
    with Rasteriser({1: mesh}) as rasteriser:
        layers = rasteriser.render(1, K, truths, WIDTH_PX, HEIGHT_PX)
    for rgb, mask in zip(layers.rgb, layers.mask, strict=True):
        image[mask] = rgb[mask]
    return image, truths


@pytest.fixture(scope="module")
def trained(mesh, tmp_path_factory):
    """A checkpoint of random weights for object 1."""
    torch.manual_seed(0)
    config = load_config("compact")
    path = tmp_path_factory.mktemp("checkpoint") / "random.safetensors"
    objects = {"1": {"name": "thing", "diameter_m": mesh.diameter_m, "window_side_px": 150.0}}
    provenance = checkpoint.Provenance(
        config=config, step=7, dataset_sha256="0" * 64, objects=objects, camera_fx_px=K[0, 0]
    )
    checkpoint.save(path, make_network(config.network), provenance)
    return path


class Oracle(torch.nn.Module):
    """Moves every hypothesis a share of the way to the nearest truth."""

    def __init__(self, truths, share):
        super().__init__()
        self.truths, self.share, self.calls = truths, share, 0

    def forward(self, pair):
        self.calls += 1
        updates = []
        for T in pair.T_cam_obj.double().numpy():
            truth = min(self.truths, key=lambda other: np.linalg.norm(other[:3, 3] - T[:3, 3]))
            dR, dt = se3.update_between(T, truth)
            updates.append((se3.rotation_from_rotvec(self.share * se3.rotvec_from_rotation(dR)), self.share * dt))
        return PoseUpdate(*(torch.from_numpy(np.stack(x)).float() for x in zip(*updates, strict=True)))


def starts_of(truths, mesh):
    rng = np.random.default_rng(1)
    return np.stack([se3.perturb(T, np.deg2rad(20), 0.15 * mesh.diameter_m, rng) for T in truths])


def requests_of(poses):
    return [Request(obj_id=1, T_cam_obj=T) for T in poses]


@pytest.mark.parametrize(("share", "most"), [(1.0, 2), (0.5, 10)])
def test_refinement_iterates_to_the_truth_and_stops(mesh, trained, frame, share, most):
    image, truths = frame
    with Refiner.load(trained, {1: mesh}, iterations=10) as refiner:
        refiner._network = Oracle(truths, share)
        results = refiner.refine_batch(Frame(image=image, K=K), requests_of(starts_of(truths, mesh)))
    assert [result.status for result in results] == [Status.CONVERGED] * 2
    assert all(result.failure is None and result.iterations <= most for result in results)
    dR, dt = se3.update_between(np.stack([result.T_cam_obj for result in results]), truths)
    assert np.rad2deg(se3.rotation_angle_rad(dR)).max() < 1.6
    assert np.linalg.norm(dt, axis=1).max() < 7.5e-3


def test_iterations_that_are_used_up_are_said(mesh, trained, frame):
    image, truths = frame
    with Refiner.load(trained, {1: mesh}, iterations=1) as refiner:
        refiner._network = Oracle(truths, 0.5)
        result = refiner.refine(image, K, starts_of(truths, mesh)[0], 1)
    assert (result.status, result.iterations) == (Status.STOPPED, 1)


def test_batches_and_single_poses_agree(mesh, trained, frame):
    image, truths = frame
    starts = starts_of(truths, mesh)
    with (
        Refiner.load(trained, {1: mesh}, iterations=3) as together,
        Refiner.load(trained, {1: mesh}, iterations=3, batch=1) as alone,
    ):
        both = together.refine_batch(Frame(image=image, K=K), requests_of(starts))
        ones = alone.refine_batch(Frame(image=image, K=K), requests_of(starts))
        single = together.refine(image, K, starts[1], 1)
    for a, b in zip(both, ones, strict=True):
        np.testing.assert_allclose(a.T_cam_obj, b.T_cam_obj, atol=1e-5)
        assert a.confidence == pytest.approx(b.confidence, abs=1e-3)
        assert se3.is_rotation(a.T_cam_obj[:3, :3], 1e-9)
    np.testing.assert_allclose(single.T_cam_obj, both[1].T_cam_obj, atol=1e-5)


@pytest.mark.parametrize(
    ("lost_t", "why"),
    [
        ((0, 0, -0.5), "at z = -0.475 m it is behind the camera"),
        ((0, 0, 0.01), "behind the camera or reaches it"),
        ((5.0, 0, 0.7), r"it lies at \(\d+, \d+\) px, outside of the image of 640 x 480 px"),
        ((0, 0, np.nan), "its pose is not finite"),
        ((0, 0, 700.0), "it is 700.* m away .* were millimetres taken for metres"),
    ],
)
def test_a_pose_that_cannot_be_seen_fails_with_the_reason(mesh, trained, frame, lost_t, why):
    image, truths = frame
    starts = starts_of(truths, mesh)
    starts[0] = se3.make_T(np.eye(3), np.array(lost_t, float))
    with Refiner.load(trained, {1: mesh}) as refiner:
        refiner._network = Oracle(truths, 1.0)
        lost, found = refiner.refine_batch(Frame(image=image, K=K), requests_of(starts))
    assert (lost.failed, lost.confidence, lost.iterations) == (True, 0.0, 0)
    assert re.search(why, lost.failure)
    assert found.status is Status.CONVERGED
    np.testing.assert_array_equal(lost.T_cam_obj, starts[0])


def test_a_render_without_a_pixel_fails(trained, frame, tmp_path):
    """A mesh that is a needle: from 40 m it falls between the pixels."""
    image, _ = frame
    needle = trimesh.creation.box((0.1, 2e-5, 2e-5))
    mesh = Mesh(vertices_m=needle.vertices, faces=needle.faces, normals=needle.vertex_normals)
    T = se3.make_T(np.eye(3), np.array([0.0123, 0.0117, 0.6]))
    loaded = checkpoint.load(trained)
    loaded.provenance.objects["1"] |= {"diameter_m": mesh.diameter_m}
    with Refiner(loaded, {1: mesh}) as refiner:
        result = refiner.refine(image, K, T, 1)
    assert result.failed
    assert "its render at 0.6 m covers no pixel" in result.failure


def test_a_pose_that_is_driven_out_of_the_image_fails(mesh, trained, frame):
    image, truths = frame
    away = [se3.make_T(T[:3, :3], np.array([9.0, 0, 1])) for T in truths]
    starts = starts_of(truths, mesh)
    with Refiner.load(trained, {1: mesh}, iterations=1) as refiner:
        refiner._network = Oracle(away, 1.0)
        results = refiner.refine_batch(Frame(image=image, K=K), requests_of(starts))
    for result, start in zip(results, starts, strict=True):
        assert "after 1 updates it lies at" in result.failure
        np.testing.assert_array_equal(result.T_cam_obj, start)


@pytest.mark.parametrize(("width", "height"), [(320, 240), (1280, 960), (640, 200)])
def test_the_camera_of_another_image_size_is_refused(mesh, trained, frame, width, height):
    image, truths = frame
    with (
        Refiner.load(trained, {1: mesh}) as refiner,
        pytest.raises(CameraError, match=rf"does not fit an image of {width} x {height} px; it looks like that of 651"),
    ):
        refiner.refine(cv2.resize(image, (width, height)), K, truths[0], 1)


@pytest.mark.parametrize("scale", [0.5, 2.0])
def test_an_image_of_any_size_with_its_camera_gives_the_same_pose(mesh, trained, frame, scale):
    image, truths = frame
    size = (int(WIDTH_PX * scale), int(HEIGHT_PX * scale))
    interpolation = cv2.INTER_AREA if scale < 1 else cv2.INTER_LINEAR
    scaled, K_scaled = cv2.resize(image, size, interpolation=interpolation), np.diag([scale, scale, 1.0]) @ K
    start = starts_of(truths, mesh)[0]
    with Refiner.load(trained, {1: mesh}, iterations=2) as refiner:
        a, b = refiner.refine(image, K, start, 1), refiner.refine(scaled, K_scaled, start, 1)
    dR, dt = se3.update_between(a.T_cam_obj, b.T_cam_obj)
    assert np.rad2deg(se3.rotation_angle_rad(dR)) < 1
    assert np.linalg.norm(dt) < 1e-3


class Small(torch.nn.Module):
    """Stands for a GPU whose memory holds so many poses."""

    def __init__(self, network, fits):
        super().__init__()
        self.network, self.fits, self.passed = network, fits, []

    def forward(self, pair):
        if len(pair.scene_rgb) > self.fits:
            raise torch.OutOfMemoryError("CUDA out of memory")
        self.passed.append(len(pair.scene_rgb))
        return self.network(pair)


def test_memory_that_is_too_small_says_which_batch_fits(mesh, trained, frame, caplog):
    image, truths = frame
    many = requests_of(np.concatenate([starts_of(truths, mesh)] * 5))
    with Refiner.load(trained, {1: mesh}, iterations=1) as refiner:
        whole = refiner.refine_batch(Frame(image=image, K=K), many)
        refiner._network = Small(refiner._network, 3)
        parts = refiner.refine_batch(Frame(image=image, K=K), many)
        assert refiner._network.passed == [2] * 5
        for a, b in zip(whole, parts, strict=True):
            np.testing.assert_allclose(a.T_cam_obj, b.T_cam_obj, atol=1e-5)
        (line,) = caplog.messages
        assert line == "a batch of 64 poses does not fit into the GPU's memory, 2 do; use --batch 2"
        refiner._network = Small(refiner._network, 0)
        with pytest.raises(RefinementError, match=r"too small for a single pose; .* --device cpu"):
            refiner.refine_batch(Frame(image=image, K=K), many)


class Sure(torch.nn.Module):
    """An oracle that also says how near the hypothesis is to a truth."""

    def __init__(self, truths):
        super().__init__()
        self.truths, self.oracle = truths, Oracle(truths, 1.0)

    def forward(self, pair):
        far = [min(np.linalg.norm(T[:3, 3] - t[:3, 3]) for t in self.truths) for T in pair.T_cam_obj.double().numpy()]
        return self.oracle(pair)._replace(confidence=2 - 100 * torch.tensor(far))


def test_confidence_is_the_networks_where_it_has_one_and_else_of_the_gradients(mesh, trained, frame):
    image, truths = frame
    starts = starts_of(truths, mesh)
    with Refiner.load(trained, {1: mesh}) as refiner:
        assert refiner.scorer == "gradient"
        at_truth, at_start = (refiner.confidences(Frame(image=image, K=K), requests_of(T)) for T in (truths, starts))
        assert (at_truth > at_start + 0.1).all()
        assert ((at_start > 0) & (at_truth <= 1)).all()
        with pytest.raises(CheckpointError, match="has no confidence output; choose --scorer gradient"):
            refiner.confidences(Frame(image=image, K=K), requests_of(truths), "learned")
        refiner._network, refiner.scorer = Sure(truths), "learned"
        result = refiner.refine(image, K, starts[0], 1)
    assert result.confidence == pytest.approx(1 / (1 + np.exp(-2)), abs=0.01)


def test_a_real_network_ranks_a_pool_by_its_own_confidence(cli, bop, mesh, frame, tmp_path):
    """Through the command, on random weights: the scores in the file are what the network says of the poses there."""
    torch.manual_seed(1)
    config = load_config("compact", ["network.confidence=true", "network.head_std=0.05"])
    objects = {"1": {"name": "thing", "diameter_m": mesh.diameter_m, "window_side_px": 150.0}}
    provenance = checkpoint.Provenance(
        config=config, step=1, dataset_sha256="0" * 64, objects=objects, camera_fx_px=K[0, 0]
    )
    path, out = tmp_path / "sure.safetensors", tmp_path / "pool.csv"
    checkpoint.save(path, make_network(config.network), provenance)
    root, start = bop
    options = ["--hypotheses", 8, "--scorer", "learned", "--iterations", 1, "--threads", 1, "--quiet"]
    result = cli("refine", "--checkpoint", path, "--dataset", root, "--init", start, "--out", out, *options)
    assert result.exit_code == 0, result.output
    settings = read_sidecar(out)["settings"]
    assert (settings["scorer"], settings["confidence"], settings["hypotheses"]) == ("learned", "learned", 8)
    found = read_results(out)
    image, _ = frame
    with Refiner.load(path, {1: mesh}) as refiner:
        said = refiner.confidences(
            Frame(image=image, K=K), [Request(obj_id=1, T_cam_obj=e.T_cam_obj) for e in found], "learned"
        )
    np.testing.assert_allclose([e.score for e in found], said, atol=2e-3)  # poses in files are rounded
    assert len({round(float(value), 4) for value in said}) == len(found) > 1


def test_a_pool_is_ranked_and_its_best_is_returned(mesh, trained, frame, monkeypatch):
    """With a network that leaves poses where they are, the pool alone must bring the pose nearer."""
    image, truths = frame
    starts, seen = starts_of(truths, mesh), []
    with Refiner.load(trained, {1: mesh}) as refiner:
        refiner._network = Oracle(truths, 0.0)
        inner = refiner.refine_batch
        monkeypatch.setattr(
            refiner, "refine_batch", lambda frame, requests: seen.append(len(requests)) or inner(frame, requests)
        )
        pools = {scorer: PooledRefiner(refiner, 64, scorer) for scorer in ("gradient", "none")}
        found = {s: pool.refine_batch(Frame(image=image, K=K), requests_of(starts)) for s, pool in pools.items()}
        again = pools["gradient"].refine_batch(Frame(image=image, K=K), requests_of(starts))
        at_start = refiner.confidences(Frame(image=image, K=K), requests_of(starts))
    assert seen == [32, 128, 32]
    for row, start in enumerate(starts):
        best = found["gradient"][row]
        assert best.confidence > at_start[row] + 0.02
        assert best.confidence == pytest.approx(found["none"][row].confidence, abs=1e-9)
        np.testing.assert_array_equal(best.T_cam_obj, again[row].T_cam_obj)
        assert off_px(mesh, best.T_cam_obj, truths[row]) < off_px(mesh, start, truths[row])


def off_px(mesh, T, truth):
    """Mean distance of projected vertices; depth, which gradients hardly show, is left out of it."""
    projected = [project(K, se3.apply(pose, mesh.vertices_m)) for pose in (T, truth)]
    return np.linalg.norm(projected[0] - projected[1], axis=-1).mean()


def test_the_network_sees_the_pose_it_refines(mesh, trained, frame):
    """At the truth the render and the scene patch show the same object at the same place."""
    image, truths = frame
    seen = []
    with Refiner.load(trained, {1: mesh}) as refiner:
        refiner._network.register_forward_hook(lambda _, inputs, __: seen.append(inputs[0]))
        refiner.refine_batch(Frame(image=image, K=K), requests_of(truths))
    pair = seen[0]
    render = pair.hypothesis_rgb.float()
    inside = render.sum(dim=1, keepdim=True) > 0
    difference = (render - pair.scene_rgb.float()).abs()[inside.expand_as(render)]
    assert difference.median() < 12
    centre = project(pair.K_crop.double().numpy(), (truths[:, :3, :3] @ mesh.center_m + truths[:, :3, 3])[:, None])
    np.testing.assert_allclose(centre[:, 0], 32.0, atol=1e-3)
    assert geometry.rotation_angle_deg(pair.T_cam_obj[:, :3, :3] @ torch.from_numpy(truths[:, :3, :3].transpose(0, 2, 1)).float()).max() < 0.1  # fmt: skip # noqa: E501


def test_cut_patch_is_the_cut_of_the_whole_image(frame, mesh):
    image, truths = frame
    rng = np.random.default_rng(0)
    for _ in range(20):
        window = Window(x0_px=rng.uniform(-100, 600), y0_px=rng.uniform(-100, 440), side_px=rng.uniform(30, 300))
        whole = cut(image, window, 64, interpolation="area").astype(int)
        assert np.abs(cut_rgb(image, window, 64).astype(int) - whole).max() <= 1
    window = diameter_window(K, truths[0], mesh.center_m, mesh.diameter_m)
    assert cut_rgb(image, window, 64).any()
    assert not cut_rgb(image, Window(x0_px=5000, y0_px=0, side_px=50), 64).any()


def test_objects_that_were_not_trained_are_refused(mesh, trained):
    with pytest.raises(CheckpointError, match=r"object 2 was not in its training data \(objects 1\)"):
        Refiner.load(trained, {2: mesh})
    for factor, why in ((0.5, "another object, or another unit"), (1000, "a thousand times too large a unit")):
        other = replace(mesh, vertices_m=mesh.vertices_m * factor, sha256="")
        with pytest.raises(CheckpointError, match=rf"diameter of .* mm in training, this one has .* {why}"):
            Refiner.load(trained, {1: other})


def test_another_mesh_of_the_same_size_is_refused_and_a_copy_is_not(mesh, trained, tmp_path):
    loaded = checkpoint.load(trained)
    loaded.provenance.objects["1"] |= {"mesh_digest": mesh_digest(mesh), "sha256": mesh.sha256}
    copy = load_mesh(save(replace(mesh, path="", sha256=""), tmp_path / "copy.ply"), units="mm")
    Refiner(loaded, {1: copy}).close()
    painted = replace(mesh, vertex_rgb=255 - mesh.vertex_rgb, sha256="f" * 64)
    with pytest.raises(CheckpointError, match=r"object 1 is another mesh than in training .* --allow-other-mesh"):
        Refiner(loaded, {1: painted})
    Refiner(loaded, {1: painted}, allow_other_mesh=True).close()


def test_a_category_takes_unseen_members_of_about_its_size(mesh, trained, frame):
    loaded = checkpoint.load(trained)
    config = replace(
        loaded.provenance.config, category=True, window=replace(loaded.provenance.config.window, kind="fixed")
    )
    loaded = replace(loaded, provenance=replace(loaded.provenance, config=config))
    member = replace(mesh, vertices_m=1.1 * mesh.vertices_m, sha256="")
    image, truths = frame
    with Refiner(loaded, {7: member}) as refiner:
        assert not refiner.refine(image, K, truths[0], 7).failed
    for factor in (0.5, 1000):
        other = replace(mesh, vertices_m=mesh.vertices_m * factor, sha256="")
        with pytest.raises(
            CheckpointError, match=r"object 7 has a diameter of .* mm, expected .* read in another unit"
        ):
            Refiner(loaded, {7: other})


def save(mesh, path):
    save_ply(mesh, path, units="mm")
    return path


def test_a_machine_without_egl_gets_one_line(cli, bop, trained, tmp_path, monkeypatch):
    root, start = bop
    monkeypatch.setattr(raster, "_threads", threading.local())

    def no_device(**settings):
        raise Exception("(standalone) XOpenDisplay: cannot open display")

    monkeypatch.setattr(raster.moderngl, "create_context", no_device)
    result = cli(
        "refine", "--checkpoint", trained, "--dataset", root, "--init", start, "--out", tmp_path / "x.csv", "--quiet"
    )
    assert result.exit_code == 1
    (line,) = result.stderr.splitlines()
    assert "no EGL device for the rasteriser" in line
    assert "libegl1" in line


@pytest.fixture
def bop(tmp_path, mesh, frame):
    """A BOP dataset of that image, and start poses with a sidecar; one of them is behind the camera."""
    image, truths = frame
    root = tmp_path / "bop"
    camera = Camera(K=K, width_px=WIDTH_PX, height_px=HEIGHT_PX)
    make_bop(root, image, camera, truths, mesh)
    starts = [*starts_of(truths, mesh), se3.make_T(np.eye(3), np.array([0, 0, -0.5]))]
    estimates = [Estimate(scene_id=1, im_id=0, obj_id=1, score=0.9, T_cam_obj=T) for T in starts]
    sidecar = {"dataset": str(root), "method": "start", "perturbation": {"rows": [{"line": 2}]}}
    write_results(tmp_path / "start.csv", estimates, sidecar)
    return root, tmp_path / "start.csv"


def make_bop(root, image, camera, truths, mesh):
    from posecore.bop import GroundTruth

    with Rasteriser({1: mesh}) as rasteriser:
        layers = rasteriser.render(1, camera.K, truths, camera.width_px, camera.height_px)
    gts = [GroundTruth(obj_id=1, T_cam_obj=T, visib_fract=1.0, gt_index=i) for i, T in enumerate(truths)]
    writer = BopWriter(root, "test", 1)
    writer.add_frame(0, image, layers.depth_m.max(axis=0), camera, gts, list(layers.mask), list(layers.mask))
    writer.close()
    write_models(root, {1: mesh}, {})


def test_refine_command(cli, bop, trained, tmp_path):
    root, start = bop
    out = tmp_path / "results" / "refined.csv"
    arguments = [
        "--checkpoint",
        trained,
        "--dataset",
        root,
        "--init",
        start,
        "--out",
        out,
        "--overlay",
        tmp_path / "pics",
    ]
    result = cli("refine", *arguments, "--name", "mine", "--iterations", 2)
    assert result.exit_code == 0, result.output
    assert "3 start poses, 2 refined (0 converged), 1 failed (left out of the file)" in result.stdout
    refined, starts = read_results(out, BopDataset(root)), read_results(start)
    assert all(0 < e.score < 1 and e.score != 0.9 for e in refined)  # how well the pose fits
    assert np.abs(refined[0].T_cam_obj - starts[0].T_cam_obj).max() > 1e-4
    assert len({e.time_s for e in refined}) == 1
    assert refined[0].time_s > 0
    sidecar = read_sidecar(out)
    assert sidecar["method"] == "mine"
    assert sidecar["checkpoint_sha256"] == checkpoint.load(trained).sha256
    assert sidecar["perturbation"] == {"rows": [{"line": 2}]}
    assert sidecar["start_lines"] == [2, 3]
    assert sidecar["failed_lines"] == [4]
    assert "behind the camera" in sidecar["failures"]["4"]
    assert f"Failed: {start}:4: scene 1, image 0, object 1: at z = " in result.stderr
    picture = cv2.imread(str(tmp_path / "pics" / "000001_000000.png"))
    assert picture.shape == (HEIGHT_PX, WIDTH_PX, 3)
    result = cli("refine", *arguments[:-2], "--iterations", 1, "--keep-failed")
    assert "1 failed (start poses kept)" in result.stdout
    kept, sidecar = read_results(out), read_sidecar(out)
    assert sidecar["settings"]["min_confidence"] == 0
    assert (len(kept), sidecar["start_lines"], sidecar["failed_lines"]) == (3, [2, 3, 4], [4])
    assert kept[2].score == 0
    np.testing.assert_allclose(kept[2].T_cam_obj, starts[2].T_cam_obj)
    between = (kept[0].score + kept[1].score) / 2
    result = cli("refine", *arguments[:-2], "--iterations", 1, "--min-confidence", between)
    assert "2 failed" in result.stdout
    doubted, sidecar = min(kept[:2], key=lambda estimate: estimate.score), read_sidecar(out)
    why = f"after 1 updates its confidence is {doubted.score:.3f}, {between:g} needed"
    assert sidecar["failures"][str(doubted.line)] == why
    assert sidecar["start_lines"] == [{2: 3, 3: 2}[doubted.line]]


def test_what_was_finished_is_written_when_something_ends_it(cli, bop, trained, tmp_path, monkeypatch):
    root, start = bop
    two = tmp_path / "two"
    shutil.copytree(root, two)
    for name in ("scene_camera.json", "scene_gt.json"):
        file = two / "test" / "000001" / name
        content = json.loads(file.read_text())
        file.write_text(json.dumps({**content, "1": content["0"]}))
    (picture,) = (two / "test" / "000001" / "rgb").iterdir()
    second = picture.with_stem("000001")
    second.write_bytes(picture.read_bytes()[:200])
    lines = start.read_text().splitlines()
    (tmp_path / "start.csv").write_text("\n".join([lines[0], lines[1].replace("1,0,1", "1,1,1", 1), *lines[1:]]) + "\n")
    out = tmp_path / "x.csv"
    rest = [
        "--checkpoint",
        trained,
        "--dataset",
        two,
        "--init",
        tmp_path / "start.csv",
        "--out",
        out,
        "--iterations",
        1,
    ]
    result = cli("refine", *rest)
    assert result.exit_code == 1
    assert f"Stopped: 1 start poses were not reached, {out} holds the others" in result.stderr
    assert "000001" in result.stderr.splitlines()[-1]
    assert result.stderr.splitlines()[-1].startswith("Error: ")
    assert (len(read_results(out)), read_sidecar(out)["not_reached"]) == (2, 1)
    assert read_sidecar(out)["start_lines"] == [3, 4]
    shutil.copy(picture, second)
    calls = []

    def interrupted(self, frame, requests, original=Refiner.refine_batch):
        calls.append(len(requests))
        if len(calls) == interrupted.at:
            raise KeyboardInterrupt
        return original(self, frame, requests)

    monkeypatch.setattr(Refiner, "refine_batch", interrupted)
    interrupted.at = 2
    result = cli("refine", *rest)
    assert (result.exit_code, read_sidecar(out)["not_reached"]) == (130, 1)
    before = out.read_bytes()
    calls.clear()
    interrupted.at = 1
    result = cli("refine", *rest)
    assert (result.exit_code, out.read_bytes()) == (130, before)
    assert "Stopped: nothing was finished, nothing is written" in result.stderr


@pytest.mark.parametrize(
    ("image", "text"),
    [
        (np.zeros((HEIGHT_PX, WIDTH_PX), np.uint8), r"found uint8 of shape \(\d+, \d+\), expected uint8"),
        (np.zeros((HEIGHT_PX, WIDTH_PX, 4), np.uint8), r"4\), expected uint8 of"),
        (np.zeros((HEIGHT_PX, WIDTH_PX, 3), np.uint16), "found uint16"),
    ],
)
def test_an_image_that_is_no_8_bit_rgb_is_refused(image, text):
    frame = object.__new__(Frame)  # the types that tests check would say it first
    for name, value in (("image", image), ("K", K), ("depth_m", None)):
        object.__setattr__(frame, name, value)
    with pytest.raises(RefinementError, match=text):
        frame.__post_init__()


def test_refine_errors_are_one_line(cli, bop, trained, tmp_path):
    root, start = bop
    rest = ["--dataset", root, "--init", start, "--out", tmp_path / "x.csv"]
    for arguments, code, text in (
        (["--checkpoint", tmp_path / "none.safetensors", *rest], 1, "no such checkpoint"),
        (["--checkpoint", trained, *rest, "--object", "5"], 2, "no pose of object 5"),
        (["--checkpoint", trained, *rest, "--hypotheses", 4, "--scorer", "learned"], 1, "no confidence output"),
        (["--checkpoint", trained, "--dataset", tmp_path / "no", *rest[2:]], 1, "no such folder"),
    ):
        result = cli("refine", *arguments)
        assert result.exit_code == code, result.output
        assert text in result.stderr
        assert "Traceback" not in result.output
        assert len([line for line in result.stderr.splitlines() if line.startswith("Error: ")]) == 1


def test_a_trained_checkpoint_knows_its_mesh_from_another(cli, dataset, mesh, tmp_path):
    """The digest that training stores fits the mesh that a BOP dataset or a file brings, and no other."""
    small = ["--steps", 1, "--batch", 4, "--workers", 0, "--threads", 1, "--set", "loss.contour_points=32"]
    result = cli("train", dataset, "--out", tmp_path / "run", *small, "--set", "validation.pairs=4", "--quiet")
    assert result.exit_code == 0, result.output
    Refiner.load(tmp_path / "run" / "best.safetensors", {1: mesh}).close()
    painted = replace(mesh, vertex_rgb=255 - mesh.vertex_rgb, sha256="f" * 64)
    with pytest.raises(CheckpointError, match="object 1 is another mesh than in training"):
        Refiner.load(tmp_path / "run" / "best.safetensors", {1: painted})


def test_a_method_and_its_checkpoint_belong_together(cli, bop, tmp_path):
    root, start = bop
    result = cli("refine", "--dataset", root, "--init", start, "--out", tmp_path / "x.csv")
    assert result.exit_code == 2
    assert "--method network needs a --checkpoint" in result.stderr
