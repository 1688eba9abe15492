import re
from dataclasses import replace

import cv2
import numpy as np
import pytest
import torch
import trimesh
from posecore import se3
from posecore.camera import project
from posecore.errors import CameraError, CheckpointError, ConfigError
from posecore.mesh import Mesh, load_mesh, mesh_digest, save_ply
from posecore.window import Window, cut, cut_rgb, diameter_window
from refinenet.batch import NetworkInput
from refinenet.errors import RefinementError
from refinenet.geometry import poses
from refinenet.geometry.poses import PoseUpdate
from refinenet.models import checkpoint
from refinenet.refine.multi_hypothesis import MultiHypothesisRefiner
from refinenet.refine.network_refiner import Refiner
from refinenet.refiner import Frame, Request, Status

from ..conftest import HEIGHT_PX, WIDTH_PX, K, starts_of


class Oracle(torch.nn.Module):
    """Moves every hypothesis, a pose of the centre, a share of the way to the nearest truth."""

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


def at_center(poses, mesh):
    """Poses of the object's centre, as a network has them."""
    return [se3.with_origin_at(T, mesh.center_m) for T in poses]


def requests_of(poses):
    return [Request(obj_id=1, T_cam_obj=T) for T in poses]


@pytest.mark.parametrize(("share", "most"), [(1.0, 2), (0.5, 10)])
def test_refinement_iterates_to_the_truth_and_stops(mesh, trained, frame, share, most):
    image, truths = frame
    with Refiner.load(trained, {1: mesh}, iterations=10) as refiner:
        refiner._network = Oracle(at_center(truths, mesh), share)
        results = refiner.refine_batch(Frame(image=image, K=K), requests_of(starts_of(truths, mesh)))
    assert [result.status for result in results] == [Status.CONVERGED] * 2
    assert all(result.failure is None and result.iterations <= most for result in results)
    dR, dt = se3.update_between(np.stack([result.T_cam_obj for result in results]), truths)
    assert np.rad2deg(se3.rotation_angle_rad(dR)).max() < 1.6
    assert np.linalg.norm(dt, axis=1).max() < 7.5e-3


def test_iterations_that_are_used_up_are_said(mesh, trained, frame):
    image, truths = frame
    with Refiner.load(trained, {1: mesh}, iterations=1) as refiner:
        refiner._network = Oracle(at_center(truths, mesh), 0.5)
        result = refiner.refine(image, K, starts_of(truths, mesh)[0], 1)
    assert (result.status, result.iterations) == (Status.STOPPED, 1)


def test_a_result_does_not_depend_on_the_other_poses(mesh, trained, frame):
    """To the last bit: alone, at any place of a batch, in batches of another size."""
    image, truths = frame
    starts = starts_of(truths, mesh)
    many = np.concatenate([starts, starts[::-1], starts])
    with (
        Refiner.load(trained, {1: mesh}, iterations=3, device="cpu") as refiner,
        Refiner.load(trained, {1: mesh}, iterations=3, device="cpu", batch=3) as other,
    ):
        alone = [refiner.refine(image, K, T, 1) for T in starts]
        for results in (batch.refine_batch(Frame(image=image, K=K), requests_of(many)) for batch in (refiner, other)):
            for result, expected in zip(results, [*alone, *alone[::-1], *alone], strict=True):
                np.testing.assert_array_equal(result.T_cam_obj, expected.T_cam_obj)
                assert (result.confidence, result.status) == (expected.confidence, expected.status)
                assert se3.is_rotation(result.T_cam_obj[:3, :3], 1e-9)


@pytest.mark.parametrize(
    ("lost_t", "why"),
    [
        ((0, 0, -0.5), "at z = -0.475 m it is behind the camera"),
        ((0, 0, 0.01), "behind the camera or reaches it"),
        ((5.0, 0, 0.7), r"it lies at \(\d+, \d+\) px, outside the image of 640 x 480 px"),
        ((0, 0, np.nan), "its pose is not finite"),
        ((0, 0, 700.0), "it is 700.* m away .* were millimetres taken for metres"),
    ],
)
def test_a_pose_that_cannot_be_seen_fails_with_the_reason(mesh, trained, frame, lost_t, why):
    image, truths = frame
    starts = starts_of(truths, mesh)
    starts[0] = se3.make_T(np.eye(3), np.array(lost_t, float))
    with Refiner.load(trained, {1: mesh}) as refiner:
        refiner._network = Oracle(at_center(truths, mesh), 1.0)
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
        refiner._network = Oracle(at_center(away, mesh), 1.0)
        results = refiner.refine_batch(Frame(image=image, K=K), requests_of(starts))
    for result, start in zip(results, starts, strict=True):
        assert "after 1 updates it lies at" in result.failure
        np.testing.assert_array_equal(result.T_cam_obj, start)


@pytest.mark.parametrize(("width", "height"), [(320, 240), (1280, 960), (640, 200)])
def test_the_camera_of_another_image_size_is_refused(mesh, trained, frame, width, height):
    image, truths = frame
    with (
        Refiner.load(trained, {1: mesh}) as refiner,
        pytest.raises(CameraError, match=rf"does not fit an image of {width} x {height} px; it fits 651"),
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
        refiner._network, refiner._pass = Small(refiner._network, 3), 64
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
        refiner._network, refiner.scorer = Sure(at_center(truths, mesh)), "learned"
        result = refiner.refine(image, K, starts[0], 1)
    assert result.confidence == pytest.approx(1 / (1 + np.exp(-2)), abs=0.01)


@pytest.mark.slow
def test_a_pool_is_ranked_and_its_best_is_returned(mesh, trained, frame, monkeypatch):
    """With a network that leaves poses where they are, the pool alone must bring the pose nearer."""
    image, truths = frame
    starts, seen = starts_of(truths, mesh), []
    with Refiner.load(trained, {1: mesh}) as refiner:
        refiner._network = Oracle(at_center(truths, mesh), 0.0)
        inner = refiner.refine_batch
        monkeypatch.setattr(
            refiner, "refine_batch", lambda frame, requests: seen.append(len(requests)) or inner(frame, requests)
        )
        pools = {scorer: MultiHypothesisRefiner(refiner, 64, scorer) for scorer in ("gradient", "none")}
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
    pair = NetworkInput(
        *(torch.cat(tensors)[: len(truths)] for tensors in zip(*(one[:4] for one in seen), strict=True))
    )
    render = pair.hypothesis_rgb.float()
    inside = render.sum(dim=1, keepdim=True) > 0
    difference = (render - pair.scene_rgb.float()).abs()[inside.expand_as(render)]
    assert difference.median() < 12
    centre = project(pair.K_crop.double().numpy(), (truths[:, :3, :3] @ mesh.center_m + truths[:, :3, 3])[:, None])
    np.testing.assert_allclose(centre[:, 0], 32.0, atol=1e-3)
    assert poses.rotation_angle_deg(pair.T_cam_obj[:, :3, :3] @ torch.from_numpy(truths[:, :3, :3].transpose(0, 2, 1)).float()).max() < 0.1  # fmt: skip # noqa: E501


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


@pytest.mark.slow
def test_a_trained_checkpoint_knows_its_mesh_from_another(cli, dataset, mesh, tmp_path):
    """The digest that training stores fits the mesh that a BOP dataset or a file brings, and no other."""
    small = ["--steps", 1, "--batch", 4, "--workers", 0, "--threads", 1, "--set", "loss.contour_points=32"]
    result = cli("train", dataset, "--out", tmp_path / "run", *small, "--set", "validation.pairs=4", "--quiet")
    assert result.exit_code == 0, result.output
    Refiner.load(tmp_path / "run" / "best.safetensors", {1: mesh}).close()
    painted = replace(mesh, vertex_rgb=255 - mesh.vertex_rgb, sha256="f" * 64)
    with pytest.raises(CheckpointError, match="object 1 is another mesh than in training"):
        Refiner.load(tmp_path / "run" / "best.safetensors", {1: painted})


def test_the_trained_file_read_in_another_unit_is_refused(repository, tug_ply):
    """Its hash is the same."""
    shipped = repository / "examples" / "checkpoints" / "tug_compact.safetensors"
    with pytest.raises(CheckpointError, match=r"of 118\.9 mm in training, this one has 1189\..* ten times too"):
        Refiner.load(shipped, {1: load_mesh(tug_ply, units="cm")})
    with pytest.raises(ConfigError, match="device: found 'gpu', expected auto, cpu or cuda"):
        Refiner.load(shipped, {1: load_mesh(tug_ply)}, device="gpu")


def test_confidences_of_an_object_without_a_mesh(trained, mesh, frame):
    image, truths = frame
    with Refiner.load(trained, {1: mesh}) as refiner, pytest.raises(ConfigError, match="object 7 has no mesh here"):
        refiner.confidences(Frame(image=image, K=K), [Request(obj_id=7, T_cam_obj=truths[0])])
