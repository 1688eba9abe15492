import json
from dataclasses import replace

import numpy as np
import pytest
import torch
from posecore import contour
from refinenet.data.pair_stream import PairSource
from refinenet.geometry import poses
from refinenet.geometry.poses import PoseUpdate
from refinenet.image.masks import visible_mask_iou
from refinenet.models import checkpoint
from refinenet.training import losses
from refinenet.training.loop import train
from refinenet.training.on_policy import OnPolicyHypotheses, fraction_at
from refinenet.training.setup import open_run
from safetensors.torch import load_file
from torch import nn

from .test_training import small

OWN = ["on_policy.fraction=1", "on_policy.begin=0", "on_policy.full=0"]


class Moves(nn.Module):
    """Turns and moves every hypothesis alike."""

    def forward(self, pair):
        b = len(pair.K_crop)
        dR = poses.rotation_from_quat_wxyz(torch.tensor([[1.0, 0.02, -0.03, 0.05]]).repeat(b, 1))
        return PoseUpdate(dR, torch.tensor([[0.004, -0.003, 0.01]]).repeat(b, 1))


@pytest.fixture(scope="module")
def centred(mesh):
    """The object as pairs have it: its origin at the centre."""
    return mesh.with_origin_at(mesh.center_m)


@pytest.fixture(scope="module")
def batch(dataset):
    config = small("hypothesis.max_angle_deg=10", "hypothesis.max_translation_diameter=0.1")
    config = replace(config, augment=replace(config.augment, noise=0.0, blur=0.0, permute_channels=1.0))
    source = PairSource(str(dataset), config, training=True)
    arrays = source.load([0])[0]
    made = source.batch(
        [(0, 0, row) for row in range(8)], [{name: values[row] for name, values in arrays.items()} for row in range(8)]
    )
    source.close()
    return made


def moved(centred, batch, *overrides):
    with OnPolicyHypotheses(small(*OWN, *overrides), {1: centred}) as own:
        return own(Moves(), batch, step=3)


def test_the_share_grows_and_then_stays():
    config = small("on_policy.fraction=0.6", "on_policy.begin=0.2", "on_policy.full=0.6").on_policy
    shares = [fraction_at(config, step, 100) for step in (0, 20, 40, 60, 99)]
    assert shares == pytest.approx([0, 0, 0.3, 0.6, 0.6])
    assert fraction_at(small().on_policy, 50, 100) == 0


def test_hypotheses_go_where_the_network_moved_them(centred, batch):
    after = moved(centred, batch)
    wanted = poses.apply_update(batch.inputs.T_cam_obj, Moves()(batch.inputs))
    torch.testing.assert_close(after.inputs.T_cam_obj, wanted, atol=1e-5, rtol=0)
    torch.testing.assert_close(after.target.T_cam_obj, batch.target.T_cam_obj)
    torch.testing.assert_close(after.target.T_cam_obj_hypothesis, wanted, atol=1e-5, rtol=0)
    centre = torch.from_numpy(centred.center_m.astype(np.float32)).repeat(8, 1, 1)
    at = centre @ wanted[:, :3, :3].transpose(1, 2) + wanted[:, None, :3, 3]
    assert (poses.project(after.inputs.K_crop, at) - 32).abs().max() < 1e-2  # the window inference would cut


def test_scene_and_labels_follow_the_new_window(centred, batch):
    """Truth rendered with the new camera: its contour lies on the resampled distance transform's zero."""
    from posecore.raster import Rasteriser

    after = moved(centred, batch)
    K, T = after.inputs.K_crop.double().numpy(), after.target.T_cam_obj.double().numpy()
    with Rasteriser({1: centred}) as rasteriser:
        truth = rasteriser.render(1, K, T, 64, 64)
    for mask, distance, bits in zip(truth.mask, after.target.scene_distance_px, after.target.scene_bits, strict=True):
        assert distance.numpy()[contour.contour_mask(mask)].mean() < 1.0
        assert (mask == (bits.numpy() & 1 > 0)).mean() > 0.95
    true = poses.update_between(after.target.T_cam_obj_hypothesis, after.target.T_cam_obj)
    stay = PoseUpdate(torch.eye(3).repeat(8, 1, 1), torch.zeros(8, 3))
    home = losses.contour_loss_px(true, after.target)
    assert home.mean() < 0.5 * losses.contour_loss_px(stay, after.target).mean()
    assert home.mean() < 2.5
    overlap = visible_mask_iou((after.inputs.hypothesis_rgb > 0).any(1).numpy(), after.target.scene_bits.numpy())
    np.testing.assert_allclose(after.target.visible_iou.numpy(), overlap, atol=0.03)


def test_renders_keep_the_batchs_colours(centred, batch):
    """A network that moves nothing: the same render in the same permuted colours."""

    class Stays(nn.Module):
        def forward(self, pair):
            b = len(pair.K_crop)
            return PoseUpdate(torch.eye(3).repeat(b, 1, 1), torch.zeros(b, 3))

    with OnPolicyHypotheses(small(*OWN), {1: centred}) as own:
        after = own(Stays(), batch, step=0)
    difference = (after.inputs.hypothesis_rgb.int() - batch.inputs.hypothesis_rgb.int()).abs()
    assert (difference <= 1).float().mean() > 0.99
    assert (after.inputs.scene_rgb.int() - batch.inputs.scene_rgb.int()).abs().float().mean() < 1


def test_a_network_gone_astray_leaves_pairs_as_they_were(centred, batch):
    class Astray(nn.Module):
        def forward(self, pair):
            b = len(pair.K_crop)
            far = torch.tensor([[0.0, 0.0, -9.0], [9.0, 0.0, 0.0], [torch.nan, 0.0, 0.0], [0.0, 0.0, 50.0]])
            return PoseUpdate(torch.eye(3).repeat(b, 1, 1), far.repeat(b // 4, 1))

    with OnPolicyHypotheses(small(*OWN), {1: centred}) as own:
        after = own(Astray(), batch, step=0)
    assert torch.equal(after.inputs.hypothesis_rgb, batch.inputs.hypothesis_rgb)
    assert torch.equal(after.inputs.T_cam_obj, batch.inputs.T_cam_obj)


def test_part_of_a_batch_is_replaced_and_the_same_part_again(centred, batch):
    half = "on_policy.fraction=0.5"
    first, again = moved(centred, batch, half), moved(centred, batch, half)
    changed = (first.inputs.T_cam_obj != batch.inputs.T_cam_obj).flatten(1).any(1)
    assert changed.sum() == 4
    assert torch.equal(first.inputs.hypothesis_rgb, again.inputs.hypothesis_rgb)
    assert torch.equal(first.inputs.hypothesis_rgb[~changed], batch.inputs.hypothesis_rgb[~changed])


def test_each_object_is_seen_through_its_own_window(centred, batch):
    """A category: rows of two objects, the second twice as large, in the order of their ids."""
    twice = replace(centred, vertices_m=2 * centred.vertices_m)
    index = torch.tensor([0, 1] * 4)
    mixed = batch._replace(target=batch.target._replace(object_index=index))
    with OnPolicyHypotheses(small(*OWN), {7: twice, 3: centred}) as own:
        after = own(Moves(), mixed, step=0)
    T, K = after.inputs.T_cam_obj, after.inputs.K_crop
    across = (
        K[:, 0, 0]
        * centred.diameter_m
        / (T[:, :3, :3] @ torch.from_numpy(centred.center_m).float() + T[:, :3, 3])[:, 2]
    )
    assert across[index == 0].numpy() == pytest.approx(64 / 1.5, rel=0.02)
    assert across[index == 1].numpy() == pytest.approx(32 / 1.5, rel=0.1)


@pytest.mark.slow
def test_a_run_with_everything_on_resumes_to_the_same_weights(dataset, tmp_path):
    everything = small(
        "on_policy.fraction=0.5", "on_policy.begin=0.2", "on_policy.full=0.5",
        "on_policy.updates=2", "network.confidence=true", "augment.occlusion=0.5", "optimiser.ema_decay=0.9",
    )  # fmt: skip
    train(everything, str(dataset), tmp_path / "whole")

    class Stop(Exception):
        pass

    def stop(step, values):
        if step == 5:
            raise Stop

    with pytest.raises(Stop):
        train(everything, str(dataset), tmp_path / "cut", report=stop)
    train(everything, str(dataset), tmp_path / "cut", resume=True)
    first, again = (load_file(tmp_path / name / "last.safetensors") for name in ("whole", "cut"))
    assert first.keys() == again.keys()
    assert all(torch.equal(first[name], again[name]) for name in first)
    assert checkpoint.load(tmp_path / "whole" / "last.safetensors").network().confidence is not None
    lines = [json.loads(line) for line in (tmp_path / "whole" / "metrics.jsonl").read_text().splitlines()]
    assert 0 < lines[-1]["validation/confidence_error"] < 1
    assert 0 < lines[0]["visible_fraction"] < 1


@pytest.mark.slow
@pytest.mark.parametrize(
    "switch",
    [
        "network.rotation=quaternion", "network.translation=camera", "network.kind=plus", "network.confidence=true",
        "window.kind=fixed", "hypothesis.online=false", "augment.occlusion=1.0", "on_policy.fraction=1.0",
        "loss.name=mse", "stored pairs",
    ],
)  # fmt: skip
def test_every_switch_trains_alone(dataset, tmp_path, switch):
    stored = ["window.kind=fixed", "hypothesis.online=false", "network.confidence=true", "on_policy.fraction=1"]
    switches = stored if switch == "stored pairs" else [switch]
    if any("on_policy" in each for each in switches):
        switches += ["on_policy.begin=0", "on_policy.full=0"]
    trainer = open_run(small(*switches), str(dataset), tmp_path)
    try:
        values = trainer.take_step(next(trainer.stream()))
    finally:
        trainer.close()
    assert all(np.isfinite(float(value)) for value in values.values())
    assert 0 < float(values["visible_fraction"]) <= 1
    # a confidence's cross-entropy and quaternions are no pixels
    assert ("loss_px" in values) == (switch not in ("network.confidence=true", "loss.name=mse", "stored pairs"))
