import logging
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from posecore.errors import CheckpointError, ConfigError
from refinenet.config import load_config
from refinenet.geometry import poses
from refinenet.models import checkpoint, inception
from refinenet.models.networks import CompactNet, NetworkInput, PaperNet, make_network
from refinenet.refine.network_refiner import STOP_ANGLE_DEG, STOP_DISTANCE_M
from safetensors.torch import load_file, save_file


def make_pair(patch_px, b=2, seed=0):
    generator = torch.Generator().manual_seed(seed)
    rgb = [torch.randint(0, 256, (b, 3, patch_px, patch_px), dtype=torch.uint8, generator=generator) for _ in range(2)]
    T = torch.eye(4).repeat(b, 1, 1)
    T[:, 2, 3] = 0.8
    K = torch.tensor([[340.0, 0, 90], [0, 340.0, -20], [0, 0, 1]]).repeat(b, 1, 1)
    return NetworkInput(*rgb, T, K)


@pytest.mark.parametrize(
    ("preset", "angle_deg", "distance_m"),
    [
        ("paper", STOP_ANGLE_DEG, STOP_DISTANCE_M),  # so a refiner would stop at once
        ("compact", 6.0, 0.01),  # its heads start five times wider, which learns faster
        ("plus", 6.0, 0.01),
    ],
)
def test_an_untrained_network_returns_its_input_pose(preset, angle_deg, distance_m):
    torch.manual_seed(0)
    config = load_config(preset)
    network = make_network(config.network).eval()
    with torch.no_grad():
        update = network(make_pair(config.network.patch_px))
    assert (poses.rotation_angle_deg(update.dR) < angle_deg).all()
    assert (update.dt.norm(dim=-1) < distance_m).all()


def test_paper_heads_start_at_the_identity():
    network = make_network(load_config("paper").network)
    assert isinstance(network, PaperNet)
    assert network.rotation.head.bias.tolist() == [1, 0, 0, 0]
    assert network.translation.head.bias.tolist() == [0, 0, 0]
    for head in (network.rotation.head, network.translation.head):
        assert head.weight.shape[2:] == (6, 6)
        assert float(head.weight.detach().std()) == pytest.approx(0.001, rel=0.05)


def test_the_stem_stays_frozen_in_training_mode():
    torch.manual_seed(0)
    network = make_network(load_config("paper").network).train()
    assert isinstance(network, PaperNet)
    before = {name: value.clone() for name, value in network.stem.state_dict().items()}
    update = network(make_pair(224))
    (update.dt.sum() + update.dR.sum()).backward()
    torch.optim.SGD([p for p in network.parameters() if p.requires_grad], lr=0.1).step()
    assert not any(module.training for module in network.stem.modules())
    assert network.down.training
    assert all(torch.equal(before[name], value) for name, value in network.stem.state_dict().items())
    assert all(p.grad is None for p in network.stem.parameters())
    assert network.translation.head.weight.grad is not None


@pytest.mark.parametrize("preset", ["compact", "paper", "plus"])
@pytest.mark.parametrize("rotation", ["6d", "quaternion"])
@pytest.mark.parametrize("translation", ["crop", "camera"])
def test_every_head_starts_at_the_identity(preset, rotation, translation):
    """Weights at zero, so that the biases alone speak."""
    switches = [f"network.rotation={rotation}", f"network.translation={translation}", "network.confidence=true"]
    network = make_network(load_config(preset, switches).network).eval()
    pair = make_pair(network.patch_px)
    for name, weight in network.named_parameters():
        if name.split(".")[0] in ("rotation", "translation", "confidence") and name.endswith(
            ("head.weight", ".weight")
        ):
            torch.nn.init.zeros_(weight)
    with torch.no_grad():
        update = network(pair)
    torch.testing.assert_close(update.dR, torch.eye(3).repeat(2, 1, 1), atol=1e-5, rtol=0)
    torch.testing.assert_close(update.dt, torch.zeros(2, 3), atol=1e-5, rtol=0)
    torch.testing.assert_close(update.confidence, torch.zeros(2))


@pytest.mark.parametrize("preset", ["paper", "compact"])
def test_networks_without_a_confidence_say_so(preset):
    network = make_network(load_config(preset).network).eval()
    with torch.no_grad():
        assert network(make_pair(network.patch_px)).confidence is None


def test_plus_gives_every_weight_a_gradient():
    network = make_network(load_config("plus").network)
    update = network(make_pair(128))
    (update.dt.square().sum() + (update.dR - torch.eye(3)).square().sum() + update.confidence.sum()).backward()
    assert all(p.grad is not None and p.grad.abs().sum() > 0 for p in network.parameters())


def test_the_shipped_checkpoint_still_loads():
    path = Path(__file__).parents[3] / "examples" / "checkpoints" / "tug_compact.safetensors"
    network = checkpoint.load(path, "compact").network()
    with torch.no_grad():
        update = network(make_pair(64))
    assert torch.isfinite(update.dt).all()
    assert update.confidence is None


def test_compact_is_small_and_every_weight_gets_a_gradient():
    network = make_network(load_config("compact").network)
    assert isinstance(network, CompactNet)
    assert sum(p.numel() for p in network.parameters()) < 2.5e6
    update = network(make_pair(64))
    (update.dt.square().sum() + (update.dR - torch.eye(3)).square().sum()).backward()
    assert all(p.grad is not None and p.grad.abs().sum() > 0 for p in network.parameters())


@pytest.mark.parametrize(("name", "channels"), [("inception_v4", 384), ("inception_v3", 288)])
def test_stems_give_25_by_25(name, channels):
    stem = inception.make_stem(name)
    with torch.no_grad():
        assert stem(torch.zeros(1, 3, 224, 224)).shape == (1, channels, 25, 25)


def test_inception_v4_has_timms_names():
    names = set(inception.make_stem("inception_v4").state_dict())
    for name in (
        "features.0.conv.weight", "features.2.bn.running_var", "features.3.conv.conv.weight",
        "features.4.branch1.3.conv.weight", "features.4.branch0.1.bn.bias", "features.5.conv.bn.weight",
    ):  # fmt: skip
        assert name in names


def test_inception_v4_against_timm():
    timm = pytest.importorskip("timm", reason="timm is the oracle of this test only")
    torch.manual_seed(0)
    oracle = timm.create_model("inception_v4", pretrained=False).eval()
    stem = inception.make_stem("inception_v4")
    wanted = {name: oracle.state_dict()[name] for name in stem.state_dict()}
    stem.load_state_dict(wanted, strict=True)
    x = torch.rand(1, 3, 224, 224) * 2 - 1
    with torch.no_grad():
        torch.testing.assert_close(stem(x), oracle.features[:6](x))


def test_inception_v3_weights_load_and_see(shared_data):
    """Strict names; features of the real stem tell photographs apart, batch statistics near the stored ones."""
    import cv2

    path = shared_data / "weights" / "inception_v3_stem.safetensors"
    if not path.is_file():
        pytest.skip(f"no weights at {path}")
    stem = inception.make_stem("inception_v3")
    stored = set(load_file(path))
    assert {name for name in stem.state_dict() if not name.endswith("num_batches_tracked")} == stored
    inception.load_weights(stem, path)
    photos = [cv2.imread(str(p))[..., ::-1] for p in sorted((shared_data / "backgrounds").glob("*.jpg"))[:4]]
    small = [cv2.resize(photo[:1000, :1000], (224, 224), interpolation=cv2.INTER_AREA) for photo in photos]
    x = torch.from_numpy(np.stack(small).transpose(0, 3, 1, 2).copy()).float() / 127.5 - 1
    seen = []
    stem.Mixed_5d.branch1x1.conv.register_forward_hook(lambda _, __, output: seen.append(output))
    with torch.no_grad():
        features = stem(x)
    assert features.shape == (4, 288, 25, 25)
    norm = stem.Mixed_5d.branch1x1.bn
    means = seen[0].mean(dim=(0, 2, 3))
    assert np.corrcoef(means.numpy(), norm.running_mean.numpy())[0, 1] > 0.9


GOLDEN = {
    (0, 0, 0): 3.98673, (31, 5, 7): 0.22769, (63, 12, 12): 1.86396, (70, 3, 20): 1.00207, (127, 24, 24): 1.60818,
    (200, 11, 2): 0.53545, (240, 0, 24): 1.88591, (287, 13, 1): 0.77205, (140, 9, 9): 0.0,
}  # fmt: skip
"""Mixed_5d of torchvision 0.28.0's Inception3 with the shared weights and `golden_input`; by channel, row, column."""
GOLDEN_MEANS = (0.74412, 0.42163, 0.33179, 0.3538, 0.30087, 0.36323, 0.28073, 0.17963, 0.24319)
"""Means of each 32 channels, likewise."""


def golden_input():
    y, x = torch.meshgrid(torch.arange(224.0), torch.arange(224.0), indexing="ij")
    waves = (torch.sin(0.11 * x + 0.05 * y), torch.cos(0.07 * y) * torch.sin(0.03 * x))
    return torch.stack([*waves, ((x * y / 224) % 29) / 14.5 - 1])[None]


def real_inception_v3(shared_data):
    path = shared_data / "weights" / "inception_v3_stem.safetensors"
    if not path.is_file():
        pytest.skip(f"no weights at {path}")
    stem = inception.make_stem("inception_v3")
    inception.load_weights(stem, path)
    return stem


def test_inception_v3_gives_torchvisions_features(shared_data):
    with torch.no_grad():
        features = real_inception_v3(shared_data)(golden_input())[0]
    for where, value in GOLDEN.items():
        assert float(features[where]) == pytest.approx(value, abs=2e-4)
    np.testing.assert_allclose(features.mean(dim=(1, 2)).reshape(9, 32).mean(1), GOLDEN_MEANS, atol=1e-4)


def test_inception_v3_against_torchvision(shared_data):
    inception = pytest.importorskip(
        "torchvision.models.inception", reason="torchvision is the oracle of this test only"
    )
    stem = real_inception_v3(shared_data)
    oracle = inception.Inception3(init_weights=False, aux_logits=False).eval()
    unknown = oracle.load_state_dict(stem.state_dict(), strict=False).unexpected_keys
    assert not unknown
    seen = []
    oracle.Mixed_5d.register_forward_hook(lambda _, __, output: seen.append(output))
    with torch.no_grad():
        oracle(golden_input())
        torch.testing.assert_close(stem(golden_input()), seen[0])


def test_wrong_weights_are_refused_by_name(tmp_path):
    path = tmp_path / "wrong.safetensors"
    save_file({"features.0.conv.weight": torch.zeros(32, 3, 5, 5)}, path)
    with pytest.raises(CheckpointError, match=r"'features.0.conv.weight': found shape \(32, 3, 5, 5\)"):
        inception.load_weights(inception.make_stem("inception_v4"), path)
    path.write_bytes(b"nothing")
    with pytest.raises(CheckpointError, match="cannot be read as backbone weights"):
        inception.load_weights(inception.make_stem("inception_v4"), path)


def test_without_weights_the_error_names_both_ways():
    with pytest.raises(ConfigError, match=r"--backbone-weights FILE.*--set backbone.pretrained=false"):
        inception.load_pretrained(inception.make_stem("inception_v3"), "inception_v3", None)


def test_no_hub_is_a_one_line_error_that_names_both_ways(monkeypatch, caplog):
    import huggingface_hub

    def fail(*_, **__):
        logging.getLogger("huggingface_hub.utils._http").warning("Retrying in 8s")
        raise OSError("no route\nto host")

    monkeypatch.setattr(huggingface_hub, "hf_hub_download", fail)
    with pytest.raises(ConfigError, match=r"no route.*--backbone-weights FILE.*backbone.pretrained=false") as caught:
        inception.load_pretrained(inception.make_stem("inception_v4"), "inception_v4", None)
    assert "\n" not in str(caught.value)
    assert not caplog.records


def test_training_options_are_checked():
    with pytest.raises(ConfigError, match=r"unknown key optimiser.momentum"):
        load_config("compact", ["optimiser.momentum=0.9"])
    with pytest.raises(ConfigError, match=r"patch_px is 64, expected 224 for kind=paper"):
        load_config("paper", ["network.patch_px=64"])
    with pytest.raises(ConfigError, match="unknown preset 'minus'"):
        load_config("minus")
    with pytest.raises(
        ConfigError, match=r"augment.occlusion needs pairs made in the training loop: window.kind=diameter"
    ):
        load_config("paper", ["augment.occlusion=0.5"])
    with pytest.raises(ConfigError, match=r"begin is 0.7, expected at most full, which is 0.5"):
        load_config("compact", ["on_policy.begin=0.7"])
    with pytest.raises(ConfigError, match=r"patch_px is 72, expected a multiple of 32 for kind=plus"):
        load_config("plus", ["network.patch_px=72"])
    config = load_config("paper", ["backbone.name=inception_v3", "backbone.pretrained=false", "steps=5"])
    assert (config.network.backbone.name, config.network.backbone.pretrained) == ("inception_v3", False)
    assert replace(config, steps=100_000).optimiser.lr == 3e-4


def test_the_command_line_starts_without_torch():
    code = "import refinenet.cli, sys; sys.exit('torch' in sys.modules)"
    assert subprocess.run([sys.executable, "-c", code], check=False).returncode == 0
