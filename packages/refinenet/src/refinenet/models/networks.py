"""Networks: PaperNet (frozen stems), CompactNet (matching, for two CPU cores), PlusNet (for a GPU), FlowNet."""

import torch
from jaxtyping import Float, UInt8
from torch import Tensor, nn

from refinenet.batch import NetworkInput
from refinenet.config import NetworkConfig
from refinenet.geometry.poses import Flow, PoseUpdate
from refinenet.models.correlation import GradientCorrelation, LocalCorrelation
from refinenet.models.flow_solver import CELL_PX, surface_points, update_from_flow
from refinenet.models.heads import ROTATION_BIAS, forms, init_head, pose_update
from refinenet.models.inception import ConvNorm, InceptionA, make_stem


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

    Output: a quaternion and a translation in metres, both in camera axes about the pose's origin, unless the config
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

    def forward(self, inputs: NetworkInput) -> PoseUpdate:
        """The update of each hypothesis."""
        b = len(inputs.scene_rgb)
        with torch.no_grad():
            low = self.stem(normalised(torch.cat((inputs.scene_rgb, inputs.hypothesis_rgb))))
        x = torch.cat((low[:b], low[b:]), 1)
        x = self.blocks(torch.cat((self.pool(x), self.down(x)), 1))
        rotation, translation = self.rotation(x), self.translation(x)
        confidence = None if self.confidence is None else self.confidence(x).float()
        with torch.autocast(x.device.type, enabled=False):
            return pose_update(
                rotation.float(), translation.float(), inputs.T_cam_obj, inputs.K_crop, self.patch_px, crop=self.crop,
                confidence=confidence,
            )  # fmt: skip


class CompactNet(nn.Module):
    """Small version of `plus`: local correlation, then heads for 6D rotation, image-plane xy and log z.

    The rotation follows from the displacement of each part of the object; convolutions over the stacked pair would have
    to learn the comparison first. LayerNorm and GELU before the heads: a ReLU there died in training. See
    `poses.crop_update` for the output.
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
        init_head(self.rotation, ROTATION_BIAS[rotation], config.head_std)
        init_head(self.translation, (0.0, 0.0, 0.0), config.head_std)
        self.confidence: nn.Linear | None = None
        if config.confidence:
            self.confidence = nn.Linear(config.hidden, 1)
            init_head(self.confidence, (0.0,), config.head_std)
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
        """From an eighth of the patch's size to the head features."""
        mixed, last = config.widths
        return nn.Sequential(
            ConvNorm(channels, mixed, 1),
            ConvNorm(mixed, last, 3, padding=1),
            nn.Flatten(),
            nn.Linear(last * (config.patch_px // 8) ** 2, config.hidden),
        )

    def features(self, inputs: NetworkInput) -> Float[Tensor, "b h"]:
        """Head features; runs in reduced precision under autocast."""
        scene = self.scene(normalised(inputs.scene_rgb).contiguous(memory_format=torch.channels_last))
        hypothesis = self.hypothesis(normalised(inputs.hypothesis_rgb).contiguous(memory_format=torch.channels_last))
        matches = self.correlation(self.match_hypothesis(hypothesis), self.match_scene(scene))
        appearance = self.appearance(torch.cat((scene, hypothesis), 1))
        return self.mix(torch.cat((matches, appearance), 1).contiguous(memory_format=torch.channels_last))

    def forward(self, inputs: NetworkInput) -> PoseUpdate:
        """The update of each hypothesis."""
        x = self.features(inputs)
        with torch.autocast(x.device.type, enabled=False):  # poses need every digit
            x = self.norm(x.float())
            return pose_update(
                self.rotation(x), self.translation(x), inputs.T_cam_obj, inputs.K_crop, self.patch_px, crop=self.crop,
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


MAX_LOG_CERTAINTY = 5.0
"""Bound of the absolute log certainty, 1 / px."""


class FlowNet(nn.Module):
    """Flow from render to scene with its certainty, and the pose update that fits the flow best.

    The hypothesis' depth makes each flow vector a constraint on the pose, which is solved for, not regressed: see
    `flow_solver.update_from_flow`. Fixed gradient features (`GradientCorrelation`) and learned appearance features are
    concatenated; an hourglass from a quarter of the patch's resolution to a sixteenth and back follows.

    Source: pose solved from the flow between render and image, as in PFA (Hu et al., ECCV 2022) and GenFlow
    (Moon et al., CVPR 2024); certainties from a likelihood.
    """

    def __init__(self, config: NetworkConfig) -> None:
        super().__init__()
        wide, wider = config.widths
        self.scene, self.hypothesis = self._encoder(3, config), self._encoder(5, config)
        self.correlation = GradientCorrelation(config.match_radius)
        self.appearance = nn.Conv2d(2 * config.encoder[1], config.appearance_channels, 1)
        channels = self.correlation.channels + config.appearance_channels
        self.fine = nn.Sequential(ConvNorm(channels, wide, 1), ConvNorm(wide, wide, 3, padding=1))
        self.coarse, self.coarsest = self._down(wide, wider), self._down(wider, wider)
        self.join_coarse = ConvNorm(2 * wider, wider, 3, padding=1)
        self.join_fine = ConvNorm(wider + wide, wide, 3, padding=1)
        self.head = nn.Conv2d(wide, 5, 3, padding=1)
        init_head(self.head, (0.0,) * 5, config.head_std)
        self.confidence: nn.Sequential | None = None
        if config.confidence:
            last = nn.Linear(wider, 1)
            init_head(last, (0.0,), config.head_std)
            self.confidence = nn.Sequential(nn.Linear(wider + wide, wider), nn.GELU(), last)
        self.patch_px = config.patch_px
        self.to(memory_format=torch.channels_last)  # type: ignore[call-overload]

    @staticmethod
    def _encoder(c_in: int, config: NetworkConfig) -> nn.Module:
        """From a patch to cells."""
        first, second = config.encoder
        return nn.Sequential(
            ConvNorm(c_in, first, 5, stride=2, padding=2), ConvNorm(first, second, 3, stride=2, padding=1)
        )

    @staticmethod
    def _down(c_in: int, c_out: int) -> nn.Module:
        return nn.Sequential(ConvNorm(c_in, c_out, 3, stride=2, padding=1), ConvNorm(c_out, c_out, 3, padding=1))

    def _flow_features(
        self, inputs: NetworkInput, depth_m: Float[Tensor, "b p p"], half_m: Float[Tensor, " b"]
    ) -> tuple[Float[Tensor, "b 5 n n"], Float[Tensor, "b c"]]:
        """Head outputs, and pooled features for the confidence; runs in reduced precision under autocast."""
        mask = (depth_m > 0).float()
        relief = ((depth_m - inputs.T_cam_obj[:, 2, 3, None, None]) / half_m[:, None, None]).clamp(-1.5, 1.5) * mask
        render = torch.cat((normalised(inputs.hypothesis_rgb), mask[:, None], relief[:, None]), 1)
        scene = self.scene(normalised(inputs.scene_rgb).contiguous(memory_format=torch.channels_last))
        hypothesis = self.hypothesis(render.contiguous(memory_format=torch.channels_last))
        appearance = self.appearance(torch.cat((scene, hypothesis), 1))
        matches = self.correlation(inputs.hypothesis_rgb, mask, inputs.scene_rgb).to(appearance.dtype)
        fine = self.fine(torch.cat((matches, appearance), 1).contiguous(memory_format=torch.channels_last))
        coarse = self.coarse(fine)
        coarsest = self.coarsest(coarse)
        coarse = self.join_coarse(torch.cat((nn.functional.interpolate(coarsest, scale_factor=2.0), coarse), 1))
        fine = self.join_fine(torch.cat((nn.functional.interpolate(coarse, scale_factor=2.0), fine), 1))
        return self.head(fine), torch.cat((coarsest.mean((2, 3)), fine.mean((2, 3))), 1)

    def forward(self, inputs: NetworkInput) -> PoseUpdate:
        """The update of each hypothesis."""
        depth_m, T = inputs.hypothesis_depth_m, inputs.T_cam_obj
        assert depth_m is not None  # filled by every stream for a config with `uses_depth`
        # half the window's side at the object's depth
        half_m = 0.5 * self.patch_px / inputs.K_crop[:, 0, 0] * T[:, 2, 3]
        outputs, pooled = self._flow_features(inputs, depth_m, half_m)
        with torch.autocast(depth_m.device.type, enabled=False):  # poses need every digit
            x = outputs.float().permute(0, 2, 3, 1).flatten(1, 2)
            diagonal = torch.exp(x[..., 2:4].clamp(-MAX_LOG_CERTAINTY, MAX_LOG_CERTAINTY))
            p_cam_m, uv_px, on_object = surface_points(depth_m, inputs.K_crop)
            flow = Flow(
                p_cam_m, uv_px, on_object, offset_px=CELL_PX * x[..., :2],
                certainty=torch.stack((diagonal[..., 0], x[..., 4], diagonal[..., 1]), -1),
            )  # fmt: skip
            update = update_from_flow(flow, T, inputs.K_crop, half_m)
            if self.confidence is not None:
                update = update._replace(confidence=self.confidence(pooled.float())[:, 0])
        return update


NETWORKS: dict[str, type[PaperNet | CompactNet | FlowNet]] = {
    "paper": PaperNet,
    "compact": CompactNet,
    "plus": PlusNet,
    "flow": FlowNet,
}


def make_network(config: NetworkConfig) -> nn.Module:
    """The configured network, with random weights (the stem's too: see `inception.load_pretrained`)."""
    return NETWORKS[config.kind](config)
