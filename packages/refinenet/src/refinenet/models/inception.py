"""Frozen ImageNet stems: InceptionV4 up to Mixed_5a and InceptionV3 up to Mixed_5d, with timm's state-dict names."""

from pathlib import Path

import torch
from jaxtyping import Float
from posecore.errors import CheckpointError, ConfigError
from posecore.files import require_regular
from safetensors import SafetensorError
from safetensors.torch import load_file
from torch import Tensor, nn

from refinenet.models.checkpoint_schema import require_finite

HUB_REPOSITORY = "timm/inception_v4.tf_in1k"
HUB_FILE = "model.safetensors"


class ConvNorm(nn.Module):
    """Convolution without bias, batch norm with eps 1e-3, ReLU; named as in timm."""

    def __init__(
        self, c_in: int, c_out: int, size: int | tuple[int, int], stride: int = 1, padding: int | tuple[int, int] = 0
    ) -> None:
        super().__init__()
        self.conv = nn.Conv2d(c_in, c_out, size, stride, padding, bias=False)
        self.bn = nn.BatchNorm2d(c_out, eps=1e-3)

    def forward(self, x: Float[Tensor, "b c h w"]) -> Float[Tensor, "b d u v"]:
        """Features after the ReLU."""
        return torch.relu(self.bn(self.conv(x)))


class InceptionA(nn.Module):
    """Inception-A of InceptionV4 with any number of input channels and 4 * 96 output channels."""

    c_out = 384

    def __init__(self, c_in: int) -> None:
        super().__init__()
        self.branch0 = ConvNorm(c_in, 96, 1)
        self.branch1 = nn.Sequential(ConvNorm(c_in, 64, 1), ConvNorm(64, 96, 3, padding=1))
        self.branch2 = nn.Sequential(
            ConvNorm(c_in, 64, 1), ConvNorm(64, 96, 3, padding=1), ConvNorm(96, 96, 3, padding=1)
        )
        self.branch3 = nn.Sequential(nn.AvgPool2d(3, 1, 1, count_include_pad=False), ConvNorm(c_in, 96, 1))

    def forward(self, x: Float[Tensor, "b c h w"]) -> Float[Tensor, "b 384 h w"]:
        """Same size, 384 channels."""
        return torch.cat((self.branch0(x), self.branch1(x), self.branch2(x), self.branch3(x)), 1)


class _Beside(nn.Module):
    """Max pooling and a strided convolution side by side: Mixed_3a and Mixed_5a, which differ in the order."""

    def __init__(self, c_in: int, c_out: int, pool_first: bool) -> None:
        super().__init__()
        self.conv = ConvNorm(c_in, c_out, 3, stride=2)
        self.maxpool = nn.MaxPool2d(3, stride=2)
        self.pool_first = pool_first

    def forward(self, x: Tensor) -> Tensor:
        pooled, convolved = self.maxpool(x), self.conv(x)
        return torch.cat((pooled, convolved) if self.pool_first else (convolved, pooled), 1)


class _Mixed4a(nn.Module):
    def __init__(self) -> None:
        super().__init__()
        self.branch0 = nn.Sequential(ConvNorm(160, 64, 1), ConvNorm(64, 96, 3))
        self.branch1 = nn.Sequential(
            ConvNorm(160, 64, 1),
            ConvNorm(64, 64, (1, 7), padding=(0, 3)),
            ConvNorm(64, 64, (7, 1), padding=(3, 0)),
            ConvNorm(64, 96, 3),
        )

    def forward(self, x: Tensor) -> Tensor:
        return torch.cat((self.branch0(x), self.branch1(x)), 1)


class _Mixed5(nn.Module):
    """Mixed_5b to Mixed_5d of InceptionV3."""

    def __init__(self, c_in: int, c_pool: int) -> None:
        super().__init__()
        self.branch1x1 = ConvNorm(c_in, 64, 1)
        self.branch5x5_1 = ConvNorm(c_in, 48, 1)
        self.branch5x5_2 = ConvNorm(48, 64, 5, padding=2)
        self.branch3x3dbl_1 = ConvNorm(c_in, 64, 1)
        self.branch3x3dbl_2 = ConvNorm(64, 96, 3, padding=1)
        self.branch3x3dbl_3 = ConvNorm(96, 96, 3, padding=1)
        self.branch_pool = ConvNorm(c_in, c_pool, 1)

    def forward(self, x: Tensor) -> Tensor:
        wide = self.branch5x5_2(self.branch5x5_1(x))
        double = self.branch3x3dbl_3(self.branch3x3dbl_2(self.branch3x3dbl_1(x)))
        pooled = self.branch_pool(nn.functional.avg_pool2d(x, 3, stride=1, padding=1))
        return torch.cat((self.branch1x1(x), wide, double, pooled), 1)


class Stem(nn.Module):
    """A frozen stem: no gradients, and batch norm in evaluation mode even after `train`.

    Input: (b, 3, h, w) colours as x / 127.5 - 1. At 224 x 224 the output is 25 x 25.
    """

    c_out: int

    def freeze(self) -> None:
        """Exclude every parameter from training and set evaluation mode."""
        self.requires_grad_(False)
        self.eval()

    def train(self, mode: bool = True) -> "Stem":
        """Stay in evaluation mode: batch statistics of small batches of renders would undo the pretraining."""
        return super().train(False)


class InceptionV4Stem(Stem):
    """InceptionV4 up to Mixed_5a: 384 channels. Source: Szegedy et al., 2016; weights' names as in timm."""

    c_out = 384

    def __init__(self) -> None:
        super().__init__()
        self.features = nn.Sequential(
            ConvNorm(3, 32, 3, stride=2),
            ConvNorm(32, 32, 3),
            ConvNorm(32, 64, 3, padding=1),
            _Beside(64, 96, pool_first=True),
            _Mixed4a(),
            _Beside(192, 192, pool_first=False),
        )

    def forward(self, x: Float[Tensor, "b 3 h w"]) -> Float[Tensor, "b 384 u v"]:
        """Features of the patch."""
        return self.features(x)


class InceptionV3Stem(Stem):
    """InceptionV3 up to Mixed_5d: 288 channels. Weights' names as in torchvision and timm."""

    c_out = 288

    def __init__(self) -> None:
        super().__init__()
        self.Conv2d_1a_3x3 = ConvNorm(3, 32, 3, stride=2)
        self.Conv2d_2a_3x3 = ConvNorm(32, 32, 3)
        self.Conv2d_2b_3x3 = ConvNorm(32, 64, 3, padding=1)
        self.Conv2d_3b_1x1 = ConvNorm(64, 80, 1)
        self.Conv2d_4a_3x3 = ConvNorm(80, 192, 3)
        self.Mixed_5b = _Mixed5(192, 32)
        self.Mixed_5c = _Mixed5(256, 64)
        self.Mixed_5d = _Mixed5(288, 64)

    def forward(self, x: Float[Tensor, "b 3 h w"]) -> Float[Tensor, "b 288 u v"]:
        """Features of the patch."""
        x = self.Conv2d_2b_3x3(self.Conv2d_2a_3x3(self.Conv2d_1a_3x3(x)))
        x = self.Conv2d_3b_1x1(nn.functional.max_pool2d(x, 3, stride=2))
        x = nn.functional.max_pool2d(self.Conv2d_4a_3x3(x), 3, stride=2)
        return self.Mixed_5d(self.Mixed_5c(self.Mixed_5b(x)))


STEMS: dict[str, type[InceptionV4Stem] | type[InceptionV3Stem]] = {
    "inception_v4": InceptionV4Stem,
    "inception_v3": InceptionV3Stem,
}


def make_stem(name: str) -> Stem:
    """A stem of `STEMS` with random weights, frozen."""
    stem = STEMS[name]()
    stem.freeze()
    return stem


def load_weights(stem: Stem, path: Path) -> None:
    """Load a stem's weights from a safetensors file, which may hold the rest of the network too.

    `num_batches_tracked` may be missing: it is not used in evaluation mode.

    Raises:
        CheckpointError: the file is missing or no safetensors file, or a tensor is missing or of another shape.
    """
    try:
        require_regular(path)
        stored = load_file(path)
    except (OSError, SafetensorError) as error:
        raise CheckpointError(f"{path}: cannot be read as backbone weights (safetensors): {error}") from error
    expected = stem.state_dict()
    chosen = {}
    for key, tensor in expected.items():
        if key in stored and stored[key].shape == tensor.shape:
            chosen[key] = stored[key]
        elif key.endswith("num_batches_tracked"):
            chosen[key] = tensor
        else:
            present = f"shape {tuple(stored[key].shape)}" if key in stored else "nothing"
            raise CheckpointError(
                f"{path}: tensor '{key}': found {present}, expected shape {tuple(tensor.shape)} "
                f"({type(stem).__name__}, names as in timm); check backbone.name"
            )
    require_finite(chosen, path)
    stem.load_state_dict(chosen)


def load_pretrained(stem: Stem, name: str, weights: str | None) -> None:
    """Fill a stem with ImageNet weights, from a file or, for inception_v4, from the Hugging Face hub.

    Raises:
        CheckpointError: the file does not match the stem.
        ConfigError: no file was named and the hub cannot be reached or has none for this stem.
    """
    ways = "name a file with --backbone-weights FILE, or train without with --set backbone.pretrained=false"
    if weights is not None:
        load_weights(stem, Path(weights))
        return
    if name != "inception_v4":
        raise ConfigError(f"backbone.name={name} has no trusted weights on the hub: {ways}")
    try:
        from huggingface_hub import hf_hub_download
        from huggingface_hub.utils import logging as hub_logging

        hub_logging.set_verbosity_error()  # without a network it logs each retry; the error below is enough
        path = hf_hub_download(HUB_REPOSITORY, HUB_FILE)
    except Exception as error:  # the hub's client raises errors of several libraries
        reason = str(error).strip().splitlines()[0] if str(error).strip() else type(error).__name__
        raise ConfigError(
            f"{HUB_REPOSITORY}/{HUB_FILE} cannot be fetched from the hub ({reason[:120]}): {ways}"
        ) from error
    load_weights(stem, Path(path))
