"""The two networks: PaperNet (two frozen stems, late fusion) and CompactNet (small, early fusion)."""

from typing import NamedTuple

import torch
from jaxtyping import Float, UInt8
from torch import Tensor, nn

from refinenet import geometry
from refinenet.backbone import ConvNorm, InceptionA, make_stem
from refinenet.config import NetworkConfig
from refinenet.geometry import PoseUpdate


class Pair(NamedTuple):
    """What a network sees.

    Attributes:
        scene_rgb: (b, 3, p, p) patch of the image.
        hypothesis_rgb: (b, 3, p, p) render of the object alone on black, same window.
        T_cam_obj: (b, 4, 4) the hypothesis, metres.
        K_crop: (b, 3, 3) intrinsics of the patch.
    """

    scene_rgb: UInt8[Tensor, "b 3 p p"]
    hypothesis_rgb: UInt8[Tensor, "b 3 p p"]
    T_cam_obj: Float[Tensor, "b 4 4"]
    K_crop: Float[Tensor, "b 3 3"]


def normalised(rgb: UInt8[Tensor, "b 3 p p"]) -> Float[Tensor, "b 3 p p"]:
    """Colours in [-1, 1], as the pretrained stems expect them."""
    return rgb.to(torch.float32) / 127.5 - 1.0


class _Branch(nn.Module):
    """Two Inception-A blocks, a strided convolution to 6 x 6 and a 6 x 6 convolution to the outputs."""

    def __init__(self, channels: int, outputs: int, bias: tuple[float, ...], head_std: float) -> None:
        super().__init__()
        self.blocks = nn.Sequential(InceptionA(InceptionA.c_out), InceptionA(InceptionA.c_out))
        # No batch norm here: it would scale the features back to 1 and the first updates to centimetres.
        self.reduction = nn.Conv2d(InceptionA.c_out, channels, 3, stride=2, padding=1)
        self.head = nn.Conv2d(channels, outputs, 6)
        nn.init.normal_(self.head.weight, std=head_std)
        with torch.no_grad():
            self.head.bias.copy_(torch.tensor(bias))

    def forward(self, x: Float[Tensor, "b 384 12 12"]) -> Float[Tensor, "b k"]:
        return self.head(torch.relu(self.reduction(self.blocks(x)))).flatten(1)


class PaperNet(nn.Module):
    """The 2018 design: both 224 px patches through one frozen stem, then Inception-A blocks and two branches.

    Output: a quaternion and a translation in metres, both in camera axes about the object's origin. Heads start at
    the identity. Left open by the paper and settled here: 384 channels in the strided convolution beside the pooling,
    `config.branch_channels` before the heads, batch norm in the trained blocks.

    Source: Manhardt et al., ECCV 2018, section 3.3.
    """

    def __init__(self, config: NetworkConfig) -> None:
        super().__init__()
        self.stem = make_stem(config.backbone.name)
        channels = 2 * self.stem.c_out
        self.pool = nn.MaxPool2d(3, stride=2)
        self.down = ConvNorm(channels, 384, 3, stride=2)
        self.blocks = nn.Sequential(InceptionA(channels + 384), InceptionA(InceptionA.c_out))
        self.rotation = _Branch(config.branch_channels, 4, (1.0, 0.0, 0.0, 0.0), config.head_std)
        self.translation = _Branch(config.branch_channels, 3, (0.0, 0.0, 0.0), config.head_std)

    def forward(self, pair: Pair) -> PoseUpdate:
        """The update of each hypothesis."""
        b = len(pair.scene_rgb)
        with torch.no_grad():
            low = self.stem(normalised(torch.cat((pair.scene_rgb, pair.hypothesis_rgb))))
        x = torch.cat((low[:b], low[b:]), 1)
        x = self.blocks(torch.cat((self.pool(x), self.down(x)), 1))
        return PoseUpdate(geometry.rotation_from_quat_wxyz(self.rotation(x)), self.translation(x))


class _Residual(nn.Module):
    """Two 3 x 3 convolutions around a shortcut."""

    def __init__(self, channels: int) -> None:
        super().__init__()
        self.first = ConvNorm(channels, channels, 3, padding=1)
        self.second = nn.Conv2d(channels, channels, 3, padding=1, bias=False)
        self.norm = nn.BatchNorm2d(channels)

    def forward(self, x: Tensor) -> Tensor:
        return torch.relu(x + self.norm(self.second(self.first(x))))


class CompactNet(nn.Module):
    """`plus` made small: the stacked pair through a short convolutional net, heads for 6D rotation, xy and log z.

    LayerNorm and GELU before the heads: a ReLU there died in training. See `geometry.crop_update` for the output.
    """

    def __init__(self, config: NetworkConfig) -> None:
        super().__init__()
        first, *rest = config.widths
        layers: list[nn.Module] = [ConvNorm(6, first, 5, stride=2, padding=2)]
        for c_in, c_out in zip((first, *rest), rest, strict=False):
            layers.append(ConvNorm(c_in, c_out, 3, stride=2, padding=1))
            layers.extend(_Residual(c_out) for _ in range(config.blocks))
        self.features = nn.Sequential(*layers)
        side = config.patch_px
        for _ in config.widths:
            side = (side + 1) // 2
        self.trunk = nn.Sequential(
            nn.Flatten(), nn.Linear(config.widths[-1] * side * side, config.hidden), nn.LayerNorm(config.hidden), nn.GELU()
        )
        self.rotation = nn.Linear(config.hidden, 6)
        self.translation = nn.Linear(config.hidden, 3)
        for head, bias in ((self.rotation, (1.0, 0.0, 0.0, 0.0, 1.0, 0.0)), (self.translation, (0.0, 0.0, 0.0))):
            nn.init.normal_(head.weight, std=config.head_std)
            with torch.no_grad():
                head.bias.copy_(torch.tensor(bias))
        self.patch_px = config.patch_px
        self.to(memory_format=torch.channels_last)  # type: ignore[call-overload]

    def forward(self, pair: Pair) -> PoseUpdate:
        """The update of each hypothesis."""
        x = torch.cat((normalised(pair.hypothesis_rgb), normalised(pair.scene_rgb)), 1)
        x = self.trunk(self.features(x.contiguous(memory_format=torch.channels_last)))
        rotation_ray = geometry.rotation_from_6d(self.rotation(x))
        return geometry.crop_update(rotation_ray, self.translation(x), pair.T_cam_obj, pair.K_crop, self.patch_px)


def make_network(config: NetworkConfig) -> nn.Module:
    """The network a config describes, with fresh weights (the stem's too: see `backbone.load_pretrained`)."""
    return PaperNet(config) if config.kind == "paper" else CompactNet(config)
