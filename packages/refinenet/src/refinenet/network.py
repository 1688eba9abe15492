"""PaperNet (frozen stems, late fusion), CompactNet (local matching, for two CPU cores) and PlusNet (for a GPU)."""

from typing import NamedTuple

import torch
from jaxtyping import Float, UInt8
from torch import Tensor, nn

from refinenet.backbone import ConvNorm, InceptionA, make_stem
from refinenet.config import NetworkConfig
from refinenet.geometry import PoseUpdate
from refinenet.heads import ROTATION_BIAS, forms, pose_update, start_linear


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
        self.head.bias = nn.Parameter(torch.tensor(bias))

    def forward(self, x: Float[Tensor, "b 384 12 12"]) -> Float[Tensor, "b k"]:
        return self.head(torch.relu(self.reduction(self.blocks(x)))).flatten(1)


class PaperNet(nn.Module):
    """The 2018 design: both 224 px patches through one frozen stem, then Inception-A blocks and two branches.

    Output: a quaternion and a translation in metres, both in camera axes about the object's origin, unless the config
    asks for others. Heads start at the identity. Left open by the paper and settled here: 384 channels in the strided
    convolution beside the pooling, `config.branch_channels` before the heads, batch norm in the trained blocks.

    Source: Manhardt et al., ECCV 2018, section 3.3.
    """

    def __init__(self, config: NetworkConfig) -> None:
        super().__init__()
        self.stem = make_stem(config.backbone.name)
        channels = 2 * self.stem.c_out
        self.pool = nn.MaxPool2d(3, stride=2)
        self.down = ConvNorm(channels, 384, 3, stride=2)
        self.blocks = nn.Sequential(InceptionA(channels + 384), InceptionA(InceptionA.c_out))
        rotation, translation = forms(config)
        self.rotation = self._branch(ROTATION_BIAS[rotation], config)
        self.translation = self._branch((0.0, 0.0, 0.0), config)
        self.confidence = self._branch((0.0,), config) if config.confidence else None
        self.crop, self.patch_px = translation == "crop", config.patch_px

    @staticmethod
    def _branch(bias: tuple[float, ...], config: NetworkConfig) -> _Branch:
        return _Branch(config.branch_channels, len(bias), bias, config.head_std)

    def forward(self, pair: Pair) -> PoseUpdate:
        """The update of each hypothesis."""
        b = len(pair.scene_rgb)
        with torch.no_grad():
            low = self.stem(normalised(torch.cat((pair.scene_rgb, pair.hypothesis_rgb))))
        x = torch.cat((low[:b], low[b:]), 1)
        x = self.blocks(torch.cat((self.pool(x), self.down(x)), 1))
        rotation, translation = self.rotation(x), self.translation(x)
        confidence = None if self.confidence is None else self.confidence(x).float()
        with torch.autocast(x.device.type, enabled=False):
            return pose_update(
                rotation.float(), translation.float(), pair.T_cam_obj, pair.K_crop, self.patch_px, crop=self.crop,
                confidence=confidence,
            )  # fmt: skip


class LocalCorrelation(nn.Module):
    """How well each hypothesis cell matches the scene cells around it: (b, c, n, n) twice to (b, k*k, n/2, n/2).

    Dot products of features over `sqrt(c)`, for every second hypothesis cell in both directions, with the scene cells
    up to `radius` away; scene cells outside the patch match with 0.

    Source: the correlation layer of FlowNet (Dosovitskiy et al., ICCV 2015).
    """

    def __init__(self, cells: int, radius: int) -> None:
        super().__init__()
        self.radius, self.side = radius, 2 * radius + 1
        row, column = torch.meshgrid(torch.arange(0, cells, 2), torch.arange(0, cells, 2), indexing="ij")
        down, right = torch.meshgrid(torch.arange(self.side), torch.arange(self.side), indexing="ij")
        padded = cells + 2 * radius
        where = (row.flatten()[:, None] + down.flatten()) * padded + column.flatten()[:, None] + right.flatten()
        self.register_buffer("where", where[None], persistent=False)
        self.where: Tensor

    def forward(
        self, hypothesis: Float[Tensor, "b c n n"], scene: Float[Tensor, "b c n n"]
    ) -> Float[Tensor, "b k m m"]:
        """Match features of both patches."""
        b, c, n, _ = hypothesis.shape
        r = self.radius
        queries = hypothesis[:, :, ::2, ::2].permute(0, 2, 3, 1).reshape(b, -1, c)
        keys = nn.functional.pad(scene, (r, r, r, r)).permute(0, 2, 3, 1).reshape(b, -1, c)
        all_pairs = torch.bmm(queries, keys.transpose(1, 2)) * c**-0.5
        near = all_pairs.gather(2, self.where.expand(b, -1, -1))
        return near.reshape(b, n // 2, n // 2, -1).permute(0, 3, 1, 2)


class CompactNet(nn.Module):
    """`plus` made small: match scene and hypothesis locally, then heads for 6D rotation, image-plane xy and log z.

    Where each part of the object went is what rotation is read from, and convolutions over the stacked pair would have
    to learn to compare first. LayerNorm and GELU before the heads: a ReLU there died in training. See
    `geometry.crop_update` for the output.
    """

    def __init__(self, config: NetworkConfig) -> None:
        super().__init__()
        second = config.encoder[1]
        self.scene, self.hypothesis = self._encoder(config), self._encoder(config)
        self.match_scene = nn.Conv2d(second, config.match_channels, 1)
        self.match_hypothesis = nn.Conv2d(second, config.match_channels, 1)
        self.correlation = LocalCorrelation(config.patch_px // 4, config.match_radius)
        self.appearance = ConvNorm(2 * second, config.appearance_channels, 3, stride=2, padding=1)
        self.mix = self._mixer(self.correlation.side**2 + config.appearance_channels, config)
        self.norm = nn.Sequential(nn.LayerNorm(config.hidden), nn.GELU())
        rotation, translation = forms(config)
        self.rotation = nn.Linear(config.hidden, len(ROTATION_BIAS[rotation]))
        self.translation = nn.Linear(config.hidden, 3)
        start_linear(self.rotation, ROTATION_BIAS[rotation], config.head_std)
        start_linear(self.translation, (0.0, 0.0, 0.0), config.head_std)
        self.confidence: nn.Linear | None = None
        if config.confidence:
            self.confidence = nn.Linear(config.hidden, 1)
            start_linear(self.confidence, (0.0,), config.head_std)
        self.crop, self.patch_px = translation == "crop", config.patch_px
        self.to(memory_format=torch.channels_last)  # type: ignore[call-overload]

    @staticmethod
    def _encoder(config: NetworkConfig) -> nn.Module:
        """From a patch to a quarter of its size."""
        first, second = config.encoder
        return nn.Sequential(
            ConvNorm(3, first, 5, stride=2, padding=2), ConvNorm(first, second, 3, stride=2, padding=1)
        )

    @staticmethod
    def _mixer(channels: int, config: NetworkConfig) -> nn.Module:
        """From an eighth of the patch's size to what the heads read."""
        mixed, last = config.widths
        return nn.Sequential(
            ConvNorm(channels, mixed, 1),
            ConvNorm(mixed, last, 3, padding=1),
            nn.Flatten(),
            nn.Linear(last * (config.patch_px // 8) ** 2, config.hidden),
        )

    def features(self, pair: Pair) -> Float[Tensor, "b h"]:
        """What the heads read; runs in reduced precision under autocast."""
        scene = self.scene(normalised(pair.scene_rgb).contiguous(memory_format=torch.channels_last))
        hypothesis = self.hypothesis(normalised(pair.hypothesis_rgb).contiguous(memory_format=torch.channels_last))
        matches = self.correlation(self.match_hypothesis(hypothesis), self.match_scene(scene))
        appearance = self.appearance(torch.cat((scene, hypothesis), 1))
        return self.mix(torch.cat((matches, appearance), 1).contiguous(memory_format=torch.channels_last))

    def forward(self, pair: Pair) -> PoseUpdate:
        """The update of each hypothesis."""
        x = self.features(pair)
        with torch.autocast(x.device.type, enabled=False):  # poses need every digit
            x = self.norm(x.float())
            return pose_update(
                self.rotation(x), self.translation(x), pair.T_cam_obj, pair.K_crop, self.patch_px, crop=self.crop,
                confidence=None if self.confidence is None else self.confidence(x),
            )  # fmt: skip


class Residual(nn.Module):
    """Two 3 x 3 convolutions beside the identity, or beside a 1 x 1 convolution where size or channels change."""

    def __init__(self, c_in: int, c_out: int, stride: int = 1) -> None:
        super().__init__()
        self.first = ConvNorm(c_in, c_out, 3, stride=stride, padding=1)
        self.second = nn.Sequential(nn.Conv2d(c_out, c_out, 3, padding=1, bias=False), nn.BatchNorm2d(c_out, eps=1e-3))
        same = stride == 1 and c_in == c_out
        self.beside: nn.Module = nn.Identity() if same else nn.Conv2d(c_in, c_out, 1, stride=stride)

    def forward(self, x: Float[Tensor, "b c h w"]) -> Float[Tensor, "b d u v"]:
        """Features after the ReLU."""
        return torch.relu(self.second(self.first(x)) + self.beside(x))


class PlusNet(CompactNet):
    """`CompactNet` with residual blocks, sized for a GPU: matched at an eighth of the patch, read at a 32nd."""

    @staticmethod
    def _encoder(config: NetworkConfig) -> nn.Module:
        first, second = config.encoder
        return nn.Sequential(
            ConvNorm(3, first, 7, stride=2, padding=3), Residual(first, first), Residual(first, second, stride=2),
            Residual(second, second),
        )  # fmt: skip

    @staticmethod
    def _mixer(channels: int, config: NetworkConfig) -> nn.Module:
        mixed, last = config.widths
        return nn.Sequential(
            ConvNorm(channels, mixed, 1),
            Residual(mixed, mixed),
            Residual(mixed, last, stride=2),
            Residual(last, last, stride=2),
            nn.Flatten(),
            nn.Linear(last * (config.patch_px // 32) ** 2, config.hidden),
        )


NETWORKS: dict[str, type[PaperNet] | type[CompactNet]] = {
    "paper": PaperNet,
    "compact": CompactNet,
    "plus": PlusNet,
}


def make_network(config: NetworkConfig) -> nn.Module:
    """The network a config describes, with fresh weights (the stem's too: see `backbone.load_pretrained`)."""
    return NETWORKS[config.kind](config)
