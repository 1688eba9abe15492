"""Configuration of a training run: loss, optimiser, on-policy hypotheses, and the run itself."""

from dataclasses import dataclass, field
from typing import Annotated, Literal

from posecore.config import Range, check_ranges

from refinenet.config.checks import require
from refinenet.config.data import AugmentConfig, HypothesisConfig, LoaderConfig, ValidationConfig, WindowConfig
from refinenet.config.network import NetworkConfig

PresetName = Literal["paper", "compact", "plus", "flow"]
LossName = Literal["contour", "contour-forward", "mse", "point", "contour+point", "flow+point"]
ConfidenceTarget = Literal["visible_iou", "pose_quality"]
DeviceName = Literal["auto", "cpu", "cuda"]
Precision = Literal["auto", "float32", "bfloat16"]
Pivot = Literal["center", "origin"]


@dataclass(frozen=True, kw_only=True)
class OnPolicyConfig:
    """On-policy hypotheses: poses that the network itself predicted, as a refinement's later iterations receive them.

    Part of each batch starts from the hypothesis updated by the network with its current weights. This part grows with
    the run: predictions of an untrained network teach little.

    Attributes:
        fraction: final fraction of a batch; 0 trains on drawn hypotheses only.
        begin: fraction of the run's steps at which the growth from 0 begins.
        full: fraction of the run's steps at which it ends.
        updates: most updates in a row; their number is drawn for each batch.
    """

    fraction: Annotated[float, Range(0, 1)] = 0.0
    begin: Annotated[float, Range(0, 1)] = 0.1
    full: Annotated[float, Range(0, 1)] = 0.5
    updates: Annotated[int, Range(1, 8)] = 1

    def __post_init__(self) -> None:
        check_ranges(self)
        require(self.begin <= self.full, f"begin is {self.begin}, expected at most full, which is {self.full}")


@dataclass(frozen=True, kw_only=True)
class LossConfig:
    """Loss.

    Attributes:
        name: which loss.
        gamma: weight of the translation in `mse`, per metre.
        point_weight: weight of the point loss in `contour+point` and `flow+point`.
        rotation_weight: weight of the rotation within the point loss; image-plane position and depth have weight 1.
        contour_points: contour points used of each patch.
        model_points: model points of the point loss.
        symmetry_step_deg: sampling step of continuous symmetries; the nearest sample is then rotated about the axis to
            the exact minimum.
        confidence_weight: weight of the confidence's cross-entropy, for a network with that output.
        confidence_target: regression target of the confidence. `visible_iou`: IoU of the hypothesis' silhouette and
            the object's visible mask. `pose_quality`: from the projected distance of the hypothesis to the ground
            truth, rotation included.
        min_pose_quality: hypotheses of a lower pose quality train the confidence alone: errors too large to correct
            would dominate the loss. 0 includes all.
    """

    name: LossName = "contour"
    gamma: Annotated[float, Range(0)] = 10.0
    point_weight: Annotated[float, Range(0)] = 1.0
    rotation_weight: Annotated[float, Range(0)] = 1.0
    contour_points: Annotated[int, Range(1)] = 100
    model_points: Annotated[int, Range(1)] = 64
    symmetry_step_deg: Annotated[float, Range(0, 180, above=True)] = 10.0
    confidence_weight: Annotated[float, Range(0)] = 1.0
    confidence_target: ConfidenceTarget = "visible_iou"
    min_pose_quality: Annotated[float, Range(0, 1, under=True)] = 0.0

    def __post_init__(self) -> None:
        check_ranges(self)


@dataclass(frozen=True, kw_only=True)
class OptimiserConfig:
    """Optimiser and learning-rate schedule.

    Attributes:
        name: `adam` or `adamw`.
        lr: learning rate, its peak under `cosine`.
        weight_decay: decay of `adamw`.
        schedule: `constant`, or `cosine` down to a hundredth of `lr` at the last step.
        warmup_steps: steps of linear rise.
        gradient_clip: largest gradient norm; 0 disables clipping.
        accumulate: batches whose gradients are averaged for one step.
        ema_decay: decay of the exponential moving average (EMA) of the weights, which is validated and saved; 0 saves
            the weights themselves. The decay of step n is at most (n + 1) / (n + 10).
    """

    name: Literal["adam", "adamw"] = "adam"
    lr: Annotated[float, Range(0, above=True)] = 3e-4
    weight_decay: Annotated[float, Range(0)] = 0.0
    schedule: Literal["constant", "cosine"] = "constant"
    warmup_steps: Annotated[int, Range(0)] = 0
    gradient_clip: Annotated[float, Range(0)] = 0.0
    accumulate: Annotated[int, Range(1)] = 1
    ema_decay: Annotated[float, Range(0, 1, under=True)] = 0.0

    def __post_init__(self) -> None:
        check_ranges(self)


@dataclass(frozen=True, kw_only=True)
class TrainConfig:
    """A training run, apart from its data.

    Attributes:
        preset: preset that the configuration is based on.
        network: architecture.
        window: crop windows.
        hypothesis: hypotheses of the pairs.
        on_policy: hypotheses from the network's output.
        augment: image augmentation.
        loss: loss.
        optimiser: optimiser.
        loader: reading of shards.
        validation: validation.
        batch: pairs in a batch, on each rank; a step takes `optimiser.accumulate` batches.
        steps: steps of the run; the cosine schedule ends there.
        seed: seed of weights, order, hypotheses and augmentation.
        init: checkpoint of the initial weights, of a network with the same settings; empty initialises at random.
        objects: ids of the dataset's objects to train on; empty takes all.
        category: the objects are members of a category; the network is meant for its other members, too.
        pivot: point of an object that hypotheses and updates are about, and whose distance is learned: its `center`.
            Earlier versions had its mesh's `origin`, and a run of theirs keeps it.
        threads: torch threads; 0 keeps torch's default.
        precision: precision of the convolutions in training; `auto` is bfloat16 on GPUs and on processors with bfloat16
            instructions, else float32. Poses, losses and weights are float32 always.
        device: `cpu`, `cuda`, or `auto` for a GPU where there is one.
        compile: compile the network with torch.compile; the first step takes longer. Needs a C++ compiler.
        log_every: steps between lines of metrics.
        checkpoint_every: steps between checkpoints.
    """

    preset: PresetName
    network: NetworkConfig
    window: WindowConfig
    hypothesis: HypothesisConfig = field(default_factory=HypothesisConfig)
    on_policy: OnPolicyConfig = field(default_factory=OnPolicyConfig)
    augment: AugmentConfig = field(default_factory=AugmentConfig)
    loss: LossConfig = field(default_factory=LossConfig)
    optimiser: OptimiserConfig = field(default_factory=OptimiserConfig)
    loader: LoaderConfig = field(default_factory=LoaderConfig)
    validation: ValidationConfig = field(default_factory=ValidationConfig)
    batch: Annotated[int, Range(1)] = 16
    steps: Annotated[int, Range(1)] = 100_000
    seed: Annotated[int, Range(0)] = 0
    init: str = ""
    objects: tuple[int, ...] = ()
    category: bool = False
    pivot: Pivot = "center"
    threads: Annotated[int, Range(0)] = 0
    precision: Precision = "auto"
    device: DeviceName = "auto"
    compile: bool = False
    log_every: Annotated[int, Range(1)] = 20
    checkpoint_every: Annotated[int, Range(1)] = 500

    def __post_init__(self) -> None:
        check_ranges(self)
        require(
            self.makes_pairs_online or not self.augment.occlusion,
            "augment.occlusion needs pairs made in the training loop: window.kind=diameter or hypothesis.online=true",
        )
        require(
            self.hypothesis.online or not self.hypothesis.precomputed_fraction,
            "hypothesis.precomputed_fraction mixes precomputed hypotheses with online ones: set "
            "hypothesis.online=true as well",
        )
        require(
            self.network.confidence or not self.loss.min_pose_quality,
            "loss.min_pose_quality trains the confidence alone on some hypotheses, but this network has no confidence: "
            "set network.confidence=true as well",
        )
        require(
            self.loss.name != "flow+point" or self.network.kind == "flow",
            f"loss.name is flow+point, but kind {self.network.kind} predicts no flow; use kind flow, or another loss",
        )

    @property
    def makes_pairs_online(self) -> bool:
        """Whether the training loop crops scenes and renders hypotheses; otherwise it uses the shards' pairs."""
        return self.window.kind == "diameter" or self.hypothesis.online
