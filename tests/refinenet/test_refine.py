import cv2
import numpy as np
import pytest
import torch
from posecore import se3
from posecore.bop import BopDataset, BopWriter, Estimate, read_results, read_sidecar, write_models, write_results
from posecore.camera import Camera, project
from posecore.errors import CheckpointError
from posecore.raster import Rasteriser
from posecore.window import Window, cut, diameter_window
from refinenet import checkpoint, geometry
from refinenet.config import load_config
from refinenet.geometry import PoseUpdate
from refinenet.network import make_network
from refinenet.refine import Refiner, cut_patch

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


@pytest.mark.parametrize(("share", "most"), [(1.0, 2), (0.5, 10)])
def test_refinement_iterates_to_the_truth_and_stops(mesh, trained, frame, share, most):
    image, truths = frame
    with Refiner.load(trained, {1: mesh}) as refiner:
        refiner._network = Oracle(truths, share)
        result = refiner.refine(image, K, starts_of(truths, mesh), np.array([1, 1]), iterations=10)
    assert result.converged.all()
    assert not result.failed.any()
    assert (result.iterations <= most).all()
    dR, dt = se3.update_between(result.T_cam_obj, truths)
    assert np.rad2deg(se3.rotation_angle_rad(dR)).max() < 1.6
    assert np.linalg.norm(dt, axis=1).max() < 7.5e-3


def test_batches_and_single_poses_agree(mesh, trained, frame):
    image, truths = frame
    starts = starts_of(truths, mesh)
    with Refiner.load(trained, {1: mesh}) as together, Refiner.load(trained, {1: mesh}, batch=1) as alone:
        both = together.refine(image, K, starts, np.array([1, 1]), iterations=3)
        one = alone.refine(image, K, starts, np.array([1, 1]), iterations=3)
    np.testing.assert_allclose(both.T_cam_obj, one.T_cam_obj, atol=1e-5)
    assert se3.is_rotation(both.T_cam_obj[:, :3, :3], 1e-9).all()


@pytest.mark.parametrize("lost_t", [(0, 0, -0.5), (0, 0, 0.01), (5.0, 0, 0.7), (0, 0, np.nan)])
def test_a_pose_that_cannot_be_seen_fails_and_is_returned_as_it_was(mesh, trained, frame, lost_t):
    image, truths = frame
    starts = starts_of(truths, mesh)
    starts[0] = se3.make_T(np.eye(3), np.array(lost_t, float))
    with Refiner.load(trained, {1: mesh}) as refiner:
        refiner._network = Oracle(truths, 1.0)
        result = refiner.refine(image, K, starts, np.array([1, 1]))
    assert result.failed.tolist() == [True, False]
    assert result.converged.tolist() == [False, True]
    np.testing.assert_array_equal(result.T_cam_obj[0], starts[0])


def test_a_pose_that_is_driven_out_of_the_image_fails(mesh, trained, frame):
    image, truths = frame
    away = [se3.make_T(T[:3, :3], np.array([9.0, 0, 1])) for T in truths]
    with Refiner.load(trained, {1: mesh}) as refiner:
        refiner._network = Oracle(away, 1.0)
        result = refiner.refine(image, K, starts_of(truths, mesh), np.array([1, 1]), iterations=1)
    assert result.failed.all()
    np.testing.assert_array_equal(result.T_cam_obj, starts_of(truths, mesh))


def test_the_network_sees_the_pose_it_refines(mesh, trained, frame):
    """At the truth the render and the scene patch show the same object at the same place."""
    image, truths = frame
    seen = []
    with Refiner.load(trained, {1: mesh}) as refiner:
        refiner._network.register_forward_hook(lambda _, inputs, __: seen.append(inputs[0]))
        refiner.refine(image, K, truths, np.array([1, 1]), iterations=1)
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
        assert np.abs(cut_patch(image, window, 64).astype(int) - whole).max() <= 1
    window = diameter_window(K, truths[0], mesh.center_m, mesh.diameter_m)
    assert cut_patch(image, window, 64).any()
    assert not cut_patch(image, Window(x0_px=5000, y0_px=0, side_px=50), 64).any()


def test_objects_that_were_not_trained_are_refused(mesh, trained):
    with pytest.raises(CheckpointError, match=r"object 2 was not in its training data \(objects 1\)"):
        Refiner.load(trained, {2: mesh})
    from dataclasses import replace

    half = replace(mesh, vertices_m=mesh.vertices_m / 2)
    with pytest.raises(CheckpointError, match=r"diameter of .* mm in training, this one has"):
        Refiner.load(trained, {1: half})


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
    assert "3 poses refined" in result.stdout
    assert "1 failed (left out of the file" in result.stdout
    refined, starts = read_results(out, BopDataset(root)), read_results(start)
    assert [e.score for e in refined] == [0.9, 0.9]
    assert np.abs(refined[0].T_cam_obj - starts[0].T_cam_obj).max() > 1e-4
    assert len({e.time_s for e in refined}) == 1
    assert refined[0].time_s > 0
    sidecar = read_sidecar(out)
    assert sidecar["method"] == "mine"
    assert sidecar["checkpoint_sha256"] == checkpoint.load(trained).sha256
    assert sidecar["perturbation"] == {"rows": [{"line": 2}]}
    assert sidecar["start_lines"] == [2, 3]
    assert sidecar["failed_lines"] == [4]
    picture = cv2.imread(str(tmp_path / "pics" / "000001_000000.png"))
    assert picture.shape == (HEIGHT_PX, WIDTH_PX, 3)


def test_refine_errors_are_one_line(cli, bop, trained, tmp_path):
    root, start = bop
    rest = ["--dataset", root, "--init", start, "--out", tmp_path / "x.csv"]
    for arguments, code, text in (
        (["--checkpoint", tmp_path / "none.safetensors", *rest], 1, "no such checkpoint"),
        (["--checkpoint", trained, *rest, "--object", "5"], 2, "no pose of object 5"),
        (["--checkpoint", trained, "--dataset", tmp_path / "no", *rest[2:]], 1, "no such folder"),
    ):
        result = cli("refine", *arguments)
        assert result.exit_code == code, result.output
        assert text in result.stderr
        assert "Traceback" not in result.output
        assert len(result.stderr.strip().splitlines()) == 1
