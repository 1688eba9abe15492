"""Preset `flow`: the pose that surface points ask for, its loss, and training, refining and exporting with it."""

import numpy as np
import onnxruntime
import pytest
import torch
from posecore import se3
from posecore.camera import back_project, crop_K
from posecore.errors import ConfigError
from posecore.raster import Rasteriser
from posecore.window import diameter_window
from refinenet.batch import LossTarget
from refinenet.config import LossConfig, load_config
from refinenet.data.pair_stream import PairSource
from refinenet.geometry import poses
from refinenet.geometry.poses import Flow
from refinenet.geometry.symmetry import ObjectPoints
from refinenet.models import checkpoint, export, flow_solver
from refinenet.models.flow_solver import offsets_to_px, surface_points, update_from_flow
from refinenet.models.networks import FlowNet, make_network
from refinenet.refine.network_refiner import Refiner
from refinenet.refiner import Status
from refinenet.training import losses, validation
from refinenet.training.on_policy import OnPolicyHypotheses
from refinenet.training.setup import open_run
from scipy.spatial.transform import Rotation
from torch.autograd import gradcheck

from ..conftest import K, background
from ..training.test_on_policy import Moves
from ..training.test_training import SMALL, small

P = 96
SURE = torch.tensor([1.0, 0.0, 1.0])


def hypothesis_of(mesh, truth, angle_deg, seed=0):
    """A hypothesis near a truth, its patch camera, and its render's depth."""
    rng = np.random.default_rng(seed)
    guess = se3.perturb(truth, np.deg2rad(angle_deg), 0.15 * mesh.diameter_m, rng)
    window = diameter_window(K, guess, mesh.center_m, mesh.diameter_m, 1.3)
    K_crop = crop_K(K, window, P)
    with Rasteriser({1: mesh}) as rasteriser:
        depth_m = rasteriser.render(1, K_crop, guess[None], P, P, rgb=False).depth_m[0]
    return guess, K_crop, depth_m


@pytest.fixture(scope="module")
def scenes(mesh):
    """Truths, hypotheses, cameras and depth, float64."""
    truths = [
        se3.make_T(se3.random_rotation(np.random.default_rng(i)), np.array([0.1 * (i - 1), 0.05, (5 + i) * 0.12]))
        for i in range(4)
    ]
    rows = [(truth, *hypothesis_of(mesh, truth, 15, seed=i)) for i, truth in enumerate(truths)]
    return [torch.from_numpy(np.stack(column).astype(np.float64)) for column in zip(*rows, strict=True)]


def true_flow(truth, guess, K_crop, depth_m):
    flow = Flow(*surface_points(depth_m, K_crop), torch.zeros(0), torch.zeros(0))
    offsets = offsets_to_px(flow, guess, truth, K_crop)
    return flow._replace(offset_px=offsets, certainty=SURE.double().expand(*offsets.shape[:2], 3))


def solved(flow, guess, K_crop, mesh):
    return update_from_flow(flow, guess, K_crop, torch.full((len(guess),), mesh.diameter_m / 2, dtype=guess.dtype))


def off_by(update, truth, guess):
    """Angle in degrees and distance in metres that is left of the way to the truth."""
    after = poses.apply_update(guess, update)
    left = poses.update_between(after, truth)
    return poses.rotation_angle_deg(left.dR), left.dt.norm(dim=-1)


def test_surface_points_are_those_of_posecore(scenes):
    _, _, K_crop, depth_m = scenes
    points, uv_px, on_object = surface_points(depth_m, K_crop)
    assert on_object.shape == (4, (P // 4) ** 2)
    assert on_object.sum(1).min() > 60
    assert not on_object.all()
    for i in range(4):
        rows, columns = np.divmod(np.flatnonzero(on_object[i]), P // 4)
        at = np.stack([4 * columns + 2.5, 4 * rows + 2.5], -1)  # pixel 2 of four, at its centre
        np.testing.assert_allclose(uv_px[i][on_object[i]], at)
        z = depth_m[i].numpy()[4 * rows + 2, 4 * columns + 2]
        np.testing.assert_allclose(points[i][on_object[i]], back_project(K_crop[i].numpy(), at, z), rtol=1e-9)


def test_the_true_offsets_give_the_true_pose(scenes, mesh):
    truth, guess, K_crop, _ = scenes
    update = solved(true_flow(*scenes), guess, K_crop, mesh)
    angle_deg, distance_m = off_by(update, truth, guess)
    start_deg, start_m = off_by(poses.update_between(guess, guess), truth, guess)
    assert start_deg.min() > 10 and start_m.min() > 0.01
    assert angle_deg.max() < 0.05
    assert distance_m.max() < 5e-4


def test_points_that_nobody_is_sure_of_do_not_count(scenes, mesh):
    truth, guess, K_crop, _ = scenes
    flow = true_flow(*scenes)
    hidden = torch.arange(flow.offset_px.shape[1]) % 2 == 0
    wrong = torch.where(hidden[:, None], flow.offset_px + torch.tensor([9.0, -7.0]), flow.offset_px)
    unsure = torch.where(hidden[:, None], 1e-3 * flow.certainty, flow.certainty)
    angle_deg, _ = off_by(solved(flow._replace(offset_px=wrong, certainty=unsure), guess, K_crop, mesh), truth, guess)
    assert angle_deg.max() < 0.1
    _, moved_m = off_by(solved(flow._replace(offset_px=wrong), guess, K_crop, mesh), truth, guess)
    assert moved_m.min() > 2e-3  # sure of them, it goes elsewhere


def test_along_an_edge_offsets_may_be_anything(scenes, mesh):
    """Certain across diagonals of either direction alone, and wrong along them."""
    truth, guess, K_crop, _ = scenes
    flow = true_flow(*scenes)
    n = flow.offset_px.shape[1]
    across = torch.stack([torch.ones(n), (-1.0) ** torch.arange(n)], -1).double() / 2**0.5
    along = torch.stack([-across[:, 1], across[:, 0]], -1)
    rng = torch.Generator().manual_seed(0)
    slid = flow.offset_px + 5 * torch.randn(4, n, 1, generator=rng, dtype=torch.float64) * along
    # W with W^T W = across across^T: one row
    certainty = torch.stack([across[:, 0], across[:, 1], torch.full((n,), 1e-4).double()], -1).expand(4, -1, -1)
    angle_deg, distance_m = off_by(
        solved(flow._replace(offset_px=slid, certainty=certainty), guess, K_crop, mesh), truth, guess
    )
    assert angle_deg.max() < 0.1
    assert distance_m.max() < 1e-3


def test_where_nothing_is_seen_the_pose_stays(scenes, mesh):
    _, guess, K_crop, _ = scenes
    flow = true_flow(*scenes)
    update = solved(flow._replace(on_object=torch.zeros_like(flow.on_object)), guess, K_crop, mesh)
    torch.testing.assert_close(update.dR, torch.eye(3).double().expand(4, 3, 3))
    assert update.dt.abs().max() == 0


@pytest.mark.slow
def test_the_solution_has_true_gradients(scenes, mesh):
    """With errors of the pose's own model (true offsets), where weights, which carry none, do not matter."""
    _, guess, K_crop, _ = (x[:1] for x in scenes)
    flow = true_flow(*(x[:1] for x in scenes))
    some = flow.on_object[0].nonzero()[::8, 0]
    flow = Flow(flow.p_cam_m[:, some], flow.uv_px[:, some], flow.on_object[:, some], flow.offset_px[:, some],
                flow.certainty[:, some])  # fmt: skip
    assert gradcheck(
        lambda offsets: solved(flow._replace(offset_px=offsets), guess, K_crop, mesh).dt,
        flow.offset_px.clone().requires_grad_(),
        eps=1e-5,
        atol=1e-4,
    )


def test_rotations_by_a_vector_are_posecores():
    w = np.random.default_rng(2).normal(size=(20, 3))
    w[0] = 0
    found = poses.rotation_from_rotvec(torch.from_numpy(w))
    np.testing.assert_allclose(found, Rotation.from_rotvec(w).as_matrix(), atol=1e-9)


def targets(scenes):
    truth, guess, K_crop, _ = scenes
    none = torch.zeros(len(truth), 1, 3)
    return LossTarget(truth, guess, K_crop, none, none, none, none, torch.zeros(len(truth), dtype=torch.int64))


def points_of(mesh, *symmetries):
    every = np.stack([np.eye(4), *symmetries])
    points = mesh.vertices_m[:: len(mesh.vertices_m) // 40][None]
    valid = torch.ones(1, len(every), dtype=torch.bool)
    no_axes = torch.zeros(1, 0, 3, dtype=torch.float64), torch.zeros(1, 3, dtype=torch.float64)
    return ObjectPoints(torch.from_numpy(points), torch.from_numpy(every)[None], valid, *no_axes)


def test_the_flow_loss_is_least_at_the_truth_and_the_certainty_of_the_errors_size(scenes, mesh):
    _, guess, K_crop, _ = scenes
    target, objects = targets(scenes), points_of(mesh)
    flow = true_flow(*scenes)

    def cost(error_px, sure):
        off = flow._replace(offset_px=flow.offset_px + error_px, certainty=sure * flow.certainty)
        return losses.flow_loss(solved(off, guess, K_crop, mesh), target, objects)

    noise = torch.randn(flow.offset_px.shape, generator=torch.Generator().manual_seed(1), dtype=torch.float64)
    assert (cost(0.0, 1.0) < cost(0.3 * noise, 1.0)).all()
    assert (cost(0.3 * noise, 1.0) < cost(noise, 1.0)).all()
    # an error of about a pixel: neither ten times surer nor ten times less sure
    assert (cost(noise, 1.5) < cost(noise, 15.0)).all()
    assert (cost(noise, 1.5) < cost(noise, 0.15)).all()


def test_the_flow_loss_has_true_gradients_also_behind_the_camera(scenes, mesh):
    truth, guess, K_crop, depth_m = (x[:2] for x in scenes)
    target, objects, flow = (
        targets((truth, guess, K_crop, depth_m)),
        points_of(mesh),
        true_flow(*(x[:2] for x in scenes)),
    )
    few = flow.on_object.nonzero()[:, 1].unique()[::30]
    rng = torch.Generator().manual_seed(2)
    offsets = flow.offset_px[:, few] + torch.randn(2, len(few), 2, generator=rng, dtype=torch.float64)
    certainty = torch.tensor([0.8, 0.3, 1.2], dtype=torch.float64).expand(2, len(few), 3).clone()
    flow = Flow(flow.p_cam_m[:, few], flow.uv_px[:, few], flow.on_object[:, few], offsets, certainty)

    def cost(offset_px, certainty, at=target):
        seen = flow._replace(offset_px=offset_px, certainty=certainty)
        return losses.flow_loss(poses.update_between(guess, guess)._replace(flow=seen), at, objects)

    leaves = offsets.requires_grad_(), certainty.requires_grad_()
    assert gradcheck(cost, leaves, eps=1e-6, atol=1e-5)
    behind = truth.clone()
    behind[:, 2, 3] -= 2.0
    value = cost(*leaves, at=target._replace(T_cam_obj=behind))
    assert torch.isfinite(value).all()
    assert value.max() <= losses.MAX_FLOW_COST
    assert all(torch.isfinite(g).all() for g in torch.autograd.grad(value.sum(), leaves))


def test_the_flow_loss_takes_the_nearest_twin(scenes, mesh):
    """A truth turned by a symmetry is as good."""
    truth, guess, K_crop, _ = scenes
    half_turn = se3.make_T(np.diag([-1.0, -1.0, 1.0]), np.zeros(3))
    update = solved(true_flow(*scenes), guess, K_crop, mesh)
    turned = targets(scenes)._replace(T_cam_obj=truth @ torch.from_numpy(half_turn))
    near = losses.flow_loss(update, targets(scenes), points_of(mesh))
    torch.testing.assert_close(losses.flow_loss(update, turned, points_of(mesh, half_turn)), near)
    assert (losses.flow_loss(update, turned, points_of(mesh)) > near + 1).all()


def hypotheses_at(scenes, moves):
    """The scenes' targets with hypotheses moved away from the truth, camera frame, about the object's origin."""
    target = targets(scenes)
    return target._replace(T_cam_obj_hypothesis=se3_moved(target.T_cam_obj, moves))


def se3_moved(T, moves):
    turned = T.clone()
    turned[:, :3, :3] = torch.from_numpy(Rotation.from_rotvec(moves[0]).as_matrix()) @ T[:, :3, :3]
    turned[:, :3, 3] += torch.tensor(moves[1], dtype=T.dtype)
    return turned


def test_pose_quality_is_one_at_the_ground_truth_and_falls_with_the_visible_error(scenes, mesh):
    points = points_of(mesh)
    size_m = float((points.points_m.amax(1) - points.points_m.amin(1)).norm())
    still = np.zeros(3)

    def at(turn, move):
        return losses.pose_quality(hypotheses_at(scenes, (turn, move)), points)

    torch.testing.assert_close(at(still, still), torch.ones(4, dtype=torch.float64))
    across = at(still, [losses.POSE_QUALITY_SCALE * size_m, 0.0, 0.0])
    np.testing.assert_allclose(across, np.exp(-1), rtol=0.05)  # nearer points move by more pixels
    in_depth = at(still, [0.0, 0.0, losses.POSE_QUALITY_SCALE * size_m])
    assert (in_depth > 0.7).all()
    turned = [at(np.deg2rad(angle) * np.array([0.0, 0.0, 1.0]), still) for angle in (5, 20, 60)]
    assert (turned[0] > turned[1] + 0.1).all() and (turned[1] > 2 * turned[2]).all()


def test_the_nearest_twin_is_as_close(scenes, mesh):
    half_turn = se3.make_T(np.diag([-1.0, -1.0, 1.0]), np.zeros(3))
    target = targets(scenes)
    turned = target._replace(T_cam_obj_hypothesis=target.T_cam_obj @ torch.from_numpy(half_turn))
    torch.testing.assert_close(
        losses.pose_quality(turned, points_of(mesh, half_turn)), torch.ones(4, dtype=torch.float64)
    )
    assert (losses.pose_quality(turned, points_of(mesh)) < 0.5).all()


def test_the_confidence_is_asked_for_what_the_setting_says(scenes, mesh):
    """Cross-entropy is least for the confidence that says just that."""
    target = targets(scenes)._replace(visible_iou=torch.full((4,), 0.25, dtype=torch.float64))
    close = losses.pose_quality(target, points_of(mesh))
    update = solved(true_flow(*scenes), scenes[1], scenes[2], mesh)
    for name, wanted in (("visible_iou", target.visible_iou), ("pose_quality", close)):
        cost = losses.make_loss(
            LossConfig(name="flow+point", point_weight=0.0, confidence_target=name), points_of(mesh)
        )
        at = wanted.clamp(1e-6, 1 - 1e-6).logit().requires_grad_()
        (slope,) = torch.autograd.grad(cost(update._replace(confidence=at), target).sum(), at)
        np.testing.assert_allclose(slope, 0, atol=1e-6, err_msg=name)
    assert (close - 0.25).abs().min() > 0.01


def flow_config(*overrides):
    """Preset `flow`, as small as it gets."""
    of_every_kind = [item for item in SMALL if not item.startswith("network.hidden")]
    own = [
        "loss.name=flow+point", "loss.point_weight=0.3", "network.kind=flow", "network.patch_px=64",
        "network.encoder=[8,16]", "network.match_radius=4", "network.widths=[24,24]", "optimiser.gradient_clip=20",
    ]  # fmt: skip
    return load_config("compact", [*of_every_kind, *own, *overrides])


def batch_of(dataset, config, training=True, n=8):
    source = PairSource(str(dataset), config, training=training)
    rows = source.load([0])[0]
    made = source.batch([(0, 0, i) for i in range(n)], [{k: v[i] for k, v in rows.items()} for i in range(n)])
    source.close()
    return made


def test_every_stream_brings_the_depth_to_the_network_that_sees_it(dataset, mesh):
    mesh = mesh.with_origin_at(mesh.center_m)  # as pairs have it
    online = batch_of(dataset, flow_config())
    assert batch_of(dataset, small()).inputs.hypothesis_depth_m is None
    config = flow_config("on_policy.fraction=1", "on_policy.begin=0", "on_policy.full=0")
    with OnPolicyHypotheses(config, {1: mesh}) as own:
        moved = own(Moves(), online, step=3)
    shape = [batch.inputs.hypothesis_depth_m > 0 for batch in (online, moved)]
    assert (shape[0] != shape[1]).float().mean() > 0.01
    with Rasteriser({1: mesh}) as rasteriser:
        for batch in (online, moved):
            pair = batch.inputs
            layers = rasteriser.render(1, pair.K_crop.double().numpy(), pair.T_cam_obj.double().numpy(), 64, 64)
            there = pair.hypothesis_depth_m.numpy()
            assert ((there > 0) == layers.mask).mean() > 0.999
            both = (there > 0) & layers.mask
            np.testing.assert_allclose(there[both], layers.depth_m[both], atol=2e-3)


def test_stored_pairs_have_their_depth_too(dataset):
    pairs = batch_of(dataset, flow_config("hypothesis.online=false", "window.kind=fixed")).inputs
    mask = (pairs.hypothesis_rgb > 0).any(1)
    assert ((pairs.hypothesis_depth_m > 0) == mask).float().mean() > 0.99


@pytest.mark.slow
def test_it_learns_where_points_went(dataset, tmp_path):
    """A few steps on one batch: offsets come closer than those that nothing was learnt of, and the pose with them."""
    trainer = open_run(flow_config("optimiser.lr=0.003", "steps=150"), str(dataset), tmp_path)
    batch = batch_of(dataset, trainer.config)
    network = trainer.network

    def error_px():
        network.eval()
        with torch.no_grad():
            update = network(batch.inputs)
        true_px = offsets_to_px(update.flow, batch.inputs.T_cam_obj, batch.target.T_cam_obj, batch.inputs.K_crop)
        off = (update.flow.offset_px - true_px).norm(dim=-1)
        left = poses.update_between(poses.apply_update(batch.inputs.T_cam_obj, update), batch.target.T_cam_obj)
        return float(off[update.flow.on_object].mean()), float(poses.rotation_angle_deg(left.dR).mean())

    before = error_px()
    for _ in range(150):
        trainer.take_step(batch)
    after = error_px()
    trainer.close()
    assert before[0] > 2
    assert after[0] < 0.4 * before[0]
    assert after[1] < 0.5 * before[1]


def test_every_weight_gets_a_gradient(dataset):
    config = flow_config("network.confidence=true")
    batch = batch_of(dataset, config)
    network = make_network(config.network)
    update = network(batch.inputs)
    value = losses.flow_loss(update, batch.target, points_of_dataset(dataset))
    (value + losses.confidence_loss(update, batch.target.visible_iou)).mean().backward()
    for name, weight in network.named_parameters():
        assert weight.grad is not None and torch.isfinite(weight.grad).all(), name
        assert weight.grad.abs().sum() > 0, name


def points_of_dataset(dataset):
    from posecore.mesh import load_mesh

    mesh = load_mesh(dataset / "models" / "obj_000001.ply", units="mm")
    return ObjectPoints(*(x.float() if x.is_floating_point() else x for x in points_of(mesh)))


@pytest.fixture(scope="module")
def run(dataset, tmp_path_factory):
    """A checkpoint of a network whose offsets are not zero."""
    out = tmp_path_factory.mktemp("flow")
    trainer = open_run(flow_config("network.confidence=true", "network.match_radius=1"), str(dataset), out)
    with torch.no_grad():
        trainer.network.head.bias.copy_(torch.tensor([0.3, -0.2, 0.0, 0.0, 0.1]))
    trainer.save(None)
    trainer.close()
    return checkpoint.load(out / "last.safetensors")


@pytest.mark.slow
def test_an_offset_moves_the_pose_that_far_across_the_image(run, mesh):
    """Every point is seen 1.2 px to the right and 0.8 px up in the patch: so the object is."""
    T = se3.make_T(se3.random_rotation(np.random.default_rng(3)), np.array([0.05, -0.02, 6 * mesh.diameter_m]))
    image = background(np.random.default_rng(0))
    with Refiner(run, {1: mesh}, iterations=1) as refiner:
        found = refiner.refine(image, K, T, 1)
    assert found.status is not Status.FAILED
    px = diameter_window(K, T, mesh.center_m, mesh.diameter_m, run.provenance.config.window.scale).side_px / 64

    def centre(pose):
        at = K @ (pose[:3, :3] @ mesh.center_m + pose[:3, 3])
        return at[:2] / at[2]

    np.testing.assert_allclose(centre(found.T_cam_obj) - centre(T), [1.2 * px, -0.8 * px], atol=0.15 * px)
    assert 0 <= found.confidence <= 1


@pytest.mark.slow
@pytest.mark.parametrize(("target", "output"), [("visible_iou", True), ("pose_quality", True), ("pose_quality", False)])
def test_a_checkpoint_knows_what_its_confidence_says(dataset, mesh, tmp_path, target, output):
    says = [f"loss.confidence_target={target}"] if output else []
    config = flow_config(f"network.confidence={str(output).lower()}", "network.match_radius=1", *says)
    trainer = open_run(config, str(dataset), tmp_path)
    trainer.save(None)
    trainer.close()
    with Refiner.load(tmp_path / "last.safetensors", {1: mesh}) as refiner:
        assert refiner.scorer == ("learned" if output else "gradient")
        assert refiner.predicts_pose_quality == (output and target == "pose_quality")


class Unsure(torch.nn.Module):
    """Leaves poses as they are and says of all that they are half right."""

    def forward(self, pair):
        b = len(pair.T_cam_obj)
        return poses.PoseUpdate(torch.eye(3).expand(b, 3, 3), torch.zeros(b, 3), torch.zeros(b))


def test_validation_measures_the_confidence_against_what_it_is_to_say(dataset):
    batch, points = batch_of(dataset, flow_config("network.confidence=true")), points_of_dataset(dataset)
    errors = {}
    for target in ("visible_iou", "pose_quality"):
        found = validation.measure(Unsure(), [batch], points, torch.device("cpu"), LossConfig(confidence_target=target))
        errors[target] = found["validation/confidence_error"]
        wanted = losses.confidence_target(target, batch.target, points)
        assert errors[target] == pytest.approx(float((wanted - 0.5).abs().mean()), rel=1e-5)
    assert abs(errors["visible_iou"] - errors["pose_quality"]) > 0.01


def test_what_the_loss_leaves_out_is_not_measured(dataset):
    config = flow_config("network.confidence=true", "loss.min_pose_quality=0.2")
    batch, points = batch_of(dataset, config, training=False), points_of_dataset(dataset)
    close = losses.pose_quality(batch.target, points)
    counted = close >= 0.2
    assert 0 < counted.sum() < len(counted)
    before = validation.pose_errors(batch.inputs.T_cam_obj, batch.target.T_cam_obj, batch.target.object_index, points)

    def measured(least):
        loss = LossConfig(confidence_target="pose_quality", min_pose_quality=least)
        return validation.measure(Unsure(), [batch], points, torch.device("cpu"), loss)

    some, every, none = measured(0.2), measured(0.0), measured(0.999)
    assert some["validation/pairs"] == counted.sum()
    assert some["validation/add_before_mm"] == pytest.approx(float(before["add_mm"][counted].mean()), rel=1e-5)
    assert every["validation/add_before_mm"] == pytest.approx(float(before["add_mm"].mean()), rel=1e-5)
    assert none == every  # where it counts none, there is nothing better to say
    assert some["validation/confidence_error"] == every["validation/confidence_error"]


@pytest.mark.slow
def test_onnx_gives_its_updates(run, cli, tmp_path, monkeypatch):
    monkeypatch.setattr(flow_solver, "STEPS", 2)  # one from the hypothesis and one from elsewhere; each is translated
    result = cli("export", "--checkpoint", run.path, "--out", tmp_path / "model.onnx")
    assert result.exit_code == 0, result.output
    inputs = export.random_pairs(3, 64, seed=1, depth=True)
    session = onnxruntime.InferenceSession(tmp_path / "model.onnx", providers=["CPUExecutionProvider"])
    assert [one.name for one in session.get_inputs()] == list(export.INPUTS)
    dR, dt, logit = session.run(None, {n: x.numpy() for n, x in zip(export.INPUTS, inputs, strict=True)})
    with torch.no_grad():
        update = export.FlatNetwork(run.network())(*inputs)
    for found, expected in zip((dR, dt, logit), update, strict=True):
        np.testing.assert_allclose(found, expected, atol=1e-4)
    assert np.abs(dt).max() > 1e-3


@pytest.mark.parametrize(
    ("preset", "override", "message"),
    [
        ("compact", "loss.name=flow+point", "kind compact predicts no flow"),
        ("flow", "network.rotation=6d", "rotation and translation are outputs of heads"),
        ("flow", "network.patch_px=72", "expected a multiple of 16 for kind=flow"),
    ],
)
def test_settings_that_do_not_go_together(preset, override, message):
    with pytest.raises(ConfigError, match=message):
        load_config(preset, [override])


def test_the_preset_is_a_flow_network():
    assert isinstance(make_network(load_config("flow").network), FlowNet)
