"""Configuration of the network's architecture."""

from dataclasses import dataclass, field
from typing import Annotated, Literal

from posecore.config import Range, check_ranges

from refinenet.config.checks import require

NetworkKind = Literal["paper", "compact", "plus", "flow"]
RotationOutput = Literal["6d", "quaternion"]
TranslationOutput = Literal["crop", "camera"]
StemName = Literal["inception_v4", "inception_v3"]
PATCH_MULTIPLES: dict[NetworkKind, int] = {"paper": 8, "compact": 8, "plus": 32, "flow": 16}
"""Total stride of each kind of network: its patch is a multiple."""


@dataclass(frozen=True, kw_only=True)
class BackboneConfig:
    """The frozen stem of kind `paper`.

    Attributes:
        name: architecture of the stem.
        pretrained: load ImageNet weights when training starts from scratch.
        weights: safetensors file with these weights; None downloads them from the Hugging Face hub.
    """

    name: StemName = "inception_v4"
    pretrained: bool = True
    weights: str | None = None


@dataclass(frozen=True, kw_only=True)
class NetworkConfig:
    """Architecture.

    Attributes:
        kind: `paper`, `compact`, `plus` or `flow`.
        patch_px: side of both input patches.
        rotation: output of the rotation head, `6d` or `quaternion`. None takes the kind's default: `quaternion` for
            `paper`, else `6d`. `flow` has no such head: its pose is solved from the flow.
        translation: output of the translation head, image-plane shift and depth ratio in the `crop`, or metres in
            `camera` axes. None takes the kind's default: `camera` for `paper`, else `crop`.
        confidence: add a head for the hypothesis' confidence.
        backbone: stem of `paper`.
        branch_channels: channels of `paper`'s last strided convolution, before the heads.
        encoder: channels of the two encoder stages, which reduce a patch to a quarter of its size; not in `paper`.
        match_channels: length of the features whose dot products are matched; neither in `paper` nor in `flow`.
        match_radius: search radius of the matching, in cells of a quarter of the patch's resolution; half of its
            resolution in `flow`, which matches gradients.
        appearance_channels: channels of appearance features, concatenated with the matching scores; not in `paper`.
        widths: channels of the two layers after matching, at an eighth of the patch's size. The second layer of `plus`
            ends at a thirty-second; `flow` has the first layer at a quarter, the second down to a sixteenth.
        hidden: units before the heads; neither in `paper` nor in `flow`.
        head_std: standard deviation of the heads' initial weights.
    """

    kind: NetworkKind
    patch_px: Annotated[int, Range(16, 1024)]
    rotation: RotationOutput | None = None
    translation: TranslationOutput | None = None
    confidence: bool = False
    backbone: BackboneConfig = field(default_factory=BackboneConfig)
    branch_channels: Annotated[int, Range(1)] = 96
    encoder: tuple[Annotated[int, Range(1)], Annotated[int, Range(1)]] = (24, 48)
    match_channels: Annotated[int, Range(1)] = 32
    match_radius: Annotated[int, Range(1, 16, unit="cells")] = 4
    appearance_channels: Annotated[int, Range(1)] = 64
    widths: tuple[Annotated[int, Range(1)], Annotated[int, Range(1)]] = (96, 128)
    hidden: Annotated[int, Range(1)] = 256
    head_std: Annotated[float, Range(0)] = 1e-3

    def __post_init__(self) -> None:
        check_ranges(self)
        kind, patch_px, multiple = self.kind, self.patch_px, PATCH_MULTIPLES[self.kind]
        require(kind != "paper" or patch_px == 224, f"patch_px is {patch_px}, expected 224 for kind=paper")
        require(patch_px % multiple == 0, f"patch_px is {patch_px}, expected a multiple of {multiple} for kind={kind}")
        require(
            kind != "flow" or (self.rotation is None and self.translation is None),
            "rotation and translation are outputs of heads, which kind=flow does not have: leave both null",
        )

    @property
    def uses_depth(self) -> bool:
        """Whether the hypothesis' depth is a network input."""
        return self.kind == "flow"
