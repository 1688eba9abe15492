"""Configuration of training and refinement; the presets are YAML files beside this module."""

import math
from collections.abc import Sequence
from dataclasses import dataclass, field
from importlib import resources
from pathlib import Path
from typing import Literal

from posecore import config as posecore_config
from posecore.errors import ConfigError

PRESETS = ("paper", "compact", "plus", "flow")


def _require(ok: bool, message: str) -> None:
    if not ok:
        raise ConfigError(message)


def _require_finite(config: object, *names: str) -> None:
    for name in names:
        value = getattr(config, name)
        _require(0 <= value < math.inf, f"{name} is {value}, expected a number of 0 or more")


@dataclass(frozen=True, kw_only=True)
class BackboneConfig:
    """The frozen stem of preset `paper`.

    Attributes:
        name: which stem.
        pretrained: whether ImageNet weights are loaded when training starts from scratch.
        weights: safetensors file to load them from; None asks the Hugging Face hub.
    """

    name: Literal["inception_v4", "inception_v3"] = "inception_v4"
    pretrained: bool = True
    weights: str | None = None


@dataclass(frozen=True, kw_only=True)
class NetworkConfig:
    """Architecture.

    Attributes:
        kind: `paper`, `compact`, `plus` or `flow`.
        patch_px: side of both input patches.
        rotation: output of the rotation head, `6d` or `quaternion`; None is the kind's own: `paper`'s is `quaternion`,
            the others' `6d`. `flow` has none of these two: its pose is solved for.
        translation: output of the translation head, image-plane shift and depth ratio as the `crop` shows them, or
            metres in `camera` axes; None is the kind's own: `paper`'s is `camera`, the others' `crop`.
        confidence: whether another head tells how well the hypothesis fits.
        backbone: stem of `paper`.
        branch_channels: channels of `paper`'s last strided convolution, before the heads.
        encoder: channels of the two stages that each patch goes through, to a quarter of its size; not in `paper`.
        match_channels: length of the features whose dot products are matched; neither in `paper` nor in `flow`.
        match_radius: how far they are matched, in cells of a quarter of the patch's resolution; in `flow`, how far
            gradients are, in cells of half of it.
        appearance_channels: channels that tell what is there, beside what moved; not in `paper`.
        widths: channels of the two layers after matching, at an eighth of the patch's size; `plus` ends with the second
            at a thirty-second, `flow` has the first at a quarter and the second down to a sixteenth.
        hidden: units before the heads; neither in `paper` nor in `flow`.
        head_std: standard deviation of the heads' initial weights.
    """

    kind: Literal["paper", "compact", "plus", "flow"]
    patch_px: int
    rotation: Literal["6d", "quaternion"] | None = None
    translation: Literal["crop", "camera"] | None = None
    confidence: bool = False
    backbone: BackboneConfig = field(default_factory=BackboneConfig)
    branch_channels: int = 96
    encoder: tuple[int, int] = (24, 48)
    match_channels: int = 32
    match_radius: int = 4
    appearance_channels: int = 64
    widths: tuple[int, int] = (96, 128)
    hidden: int = 256
    head_std: float = 1e-3

    def __post_init__(self) -> None:
        _require(16 <= self.patch_px <= 1024, f"patch_px is {self.patch_px}, expected 16 to 1024")
        _require(
            self.kind != "paper" or self.patch_px == 224, f"patch_px is {self.patch_px}: kind=paper is built for 224"
        )
        _require(self.patch_px % 8 == 0, f"patch_px is {self.patch_px}, expected a multiple of 8")
        _require(
            self.kind != "plus" or self.patch_px % 32 == 0,
            f"patch_px is {self.patch_px}, expected a multiple of 32 for kind=plus",
        )
        _require(
            self.kind != "flow" or self.patch_px % 16 == 0,
            f"patch_px is {self.patch_px}, expected a multiple of 16 for kind=flow",
        )
        _require(
            self.kind != "flow" or (self.rotation is None and self.translation is None),
            "rotation and translation are outputs of heads, which kind=flow does not have: leave both null",
        )
        _require(1 <= self.match_radius <= 16, f"match_radius is {self.match_radius}, expected 1 to 16 cells")
        for name in ("branch_channels", "match_channels", "appearance_channels", "hidden"):
            _require(getattr(self, name) >= 1, f"{name} is {getattr(self, name)}, expected 1 or more")
        for name in ("encoder", "widths"):
            _require(min(getattr(self, name)) >= 1, f"{name} is {getattr(self, name)}, expected 1 or more channels")
        _require_finite(self, "head_std")

    @property
    def sees_depth(self) -> bool:
        """Whether the network asks for the hypothesis' depth."""
        return self.kind == "flow"


@dataclass(frozen=True, kw_only=True)
class WindowConfig:
    """How patches are cut.

    Attributes:
        kind: `fixed` (one side per object, from the data card) or `diameter` (scale x f x diameter / z).
        scale: side of a `diameter` window in projected diameters.
    """

    kind: Literal["fixed", "diameter"]
    scale: float = 1.5

    def __post_init__(self) -> None:
        _require(1.0 <= self.scale <= 5.0, f"scale is {self.scale}, expected 1 to 5 diameters")


@dataclass(frozen=True, kw_only=True)
class HypothesisConfig:
    """Hypotheses rendered in the training loop.

    Attributes:
        fresh: draw and render them anew at every pass; otherwise the shards' own hypotheses are used.
        max_angle_deg: largest rotation; angles are uniform up to it.
        max_translation_diameter: largest move, in object diameters; lengths are uniform up to it.
        depth_stretch: factor on the part of the move along the viewing ray; detectors that see RGB alone err several
            times as far in depth as across the image.
        easy_share: share of samples whose angle is scaled down at random, and of those whose distance is,
            independently: what the later iterations of a refinement see.
        stored_share: share of samples that take the shard's own hypothesis in place of a fresh one, as shards that
            `synthgen cut` made of a detector's or a search's poses hold them.
        any_twin: draw around any of the poses that look like the truth, where the object has symmetries, as detectors
            give them. Which one it was cannot be seen; `mse` asks for it all the same, the other losses do not.
        in_plane: turn each scene about the optical axis by a random angle.
    """

    fresh: bool = False
    max_angle_deg: float = 25.0
    max_translation_diameter: float = 0.2
    depth_stretch: float = 1.0
    easy_share: float = 0.3
    stored_share: float = 0.0
    any_twin: bool = False
    in_plane: bool = True

    def __post_init__(self) -> None:
        _require(0 < self.max_angle_deg <= 180, f"max_angle_deg is {self.max_angle_deg}, expected above 0 up to 180")
        _require(0 <= self.easy_share <= 1, f"easy_share is {self.easy_share}, expected 0 to 1")
        _require(0 <= self.stored_share <= 1, f"stored_share is {self.stored_share}, expected 0 to 1")
        _require(
            0 <= self.max_translation_diameter <= 2,
            f"max_translation_diameter is {self.max_translation_diameter}, expected 0 to 2",
        )
        _require(1 <= self.depth_stretch <= 10, f"depth_stretch is {self.depth_stretch}, expected 1 to 10")


@dataclass(frozen=True, kw_only=True)
class AugmentConfig:
    """Colour augmentation; probabilities are per sample.

    Attributes:
        permute_channels: probability of one random order of colour channels for both patches.
        gain: both patches' channels are scaled by up to this share.
        scene_gain: the scene's channels alone, likewise.
        brightness: the scene is shifted by up to this share of the range.
        contrast: the scene's contrast is scaled by up to this share.
        noise: largest standard deviation of the scene's noise, in grey levels.
        blur: probability that the scene is blurred.
        background: probability that everything behind the scene's foreground is exchanged.
        occlusion: probability that a piece of another scene's foreground is pasted over the object.
        occlusion_leaves: share of the visible object that a pasted piece leaves at least.
    """

    permute_channels: float = 0.0
    gain: float = 0.0
    scene_gain: float = 0.0
    brightness: float = 0.0
    contrast: float = 0.0
    noise: float = 0.0
    blur: float = 0.0
    background: float = 0.0
    occlusion: float = 0.0
    occlusion_leaves: float = 0.35

    def __post_init__(self) -> None:
        for name in ("permute_channels", "blur", "background", "occlusion", "occlusion_leaves"):
            value = getattr(self, name)
            _require(0 <= value <= 1, f"{name} is {value}, expected a probability")
        for name in ("gain", "scene_gain", "brightness", "contrast"):
            value = getattr(self, name)
            _require(0 <= value < 1, f"{name} is {value}, expected 0 to under 1")
        _require_finite(self, "noise")


@dataclass(frozen=True, kw_only=True)
class OwnPredictionsConfig:
    """Training on the network's own predictions: what the later iterations of a refinement see.

    Part of each batch starts from where the network itself, as it is at that step, moved the hypothesis. The part grows
    with the run: a young network's predictions teach little.

    Attributes:
        share: part of a batch at the end of its growth; 0 trains on drawn hypotheses only.
        begin: part of the run's steps after which it starts to grow from 0.
        full: part of the run's steps after which it has grown.
        updates: most updates in a row; their number is drawn for each batch.
    """

    share: float = 0.0
    begin: float = 0.1
    full: float = 0.5
    updates: int = 1

    def __post_init__(self) -> None:
        _require(0 <= self.share <= 1, f"share is {self.share}, expected 0 to 1")
        _require(0 <= self.begin <= self.full <= 1, f"begin is {self.begin}, expected 0 to full, which is {self.full}")
        _require(1 <= self.updates <= 8, f"updates is {self.updates}, expected 1 to 8")


@dataclass(frozen=True, kw_only=True)
class LossConfig:
    """The loss.

    Attributes:
        name: which.
        gamma: weight of the translation in `mse`, per metre.
        point_weight: weight of the point loss in `contour+point` and `flow+point`.
        rotation_weight: weight of the rotation within the point loss; image-plane position and depth have 1.
        contour_points: contour points used of each patch.
        model_points: model points of the point loss.
        symmetry_step_deg: step at which continuous symmetries are sampled, before the nearest sample is turned about
            the axis the rest of the way.
        confidence_weight: weight of the confidence's cross-entropy, for a network with that output.
        confidence_target: what that output says of a hypothesis. `overlap`: how its silhouette fits what is visible of
            the object. `closeness`: how near it is to the truth as the camera sees it, turns included.
        min_closeness: hypotheses less close than this teach the confidence alone: what is too far off to be mended
            would drown what can be; 0 leaves none out.
    """

    name: Literal["contour", "contour-forward", "mse", "point", "contour+point", "flow+point"] = "contour"
    gamma: float = 10.0
    point_weight: float = 1.0
    rotation_weight: float = 1.0
    contour_points: int = 100
    model_points: int = 64
    symmetry_step_deg: float = 10.0
    confidence_weight: float = 1.0
    confidence_target: Literal["overlap", "closeness"] = "overlap"
    min_closeness: float = 0.0

    def __post_init__(self) -> None:
        _require(0 <= self.min_closeness < 1, f"min_closeness is {self.min_closeness}, expected 0 to under 1")
        _require_finite(self, "gamma", "point_weight", "rotation_weight", "confidence_weight")
        for name in ("contour_points", "model_points"):
            _require(getattr(self, name) >= 1, f"{name} is {getattr(self, name)}, expected 1 or more")
        _require(
            0 < self.symmetry_step_deg <= 180, f"symmetry_step_deg is {self.symmetry_step_deg}, expected up to 180"
        )


@dataclass(frozen=True, kw_only=True)
class OptimiserConfig:
    """Optimiser and its schedule.

    Attributes:
        name: `adam` or `adamw`.
        lr: learning rate, its peak under `cosine`.
        weight_decay: of `adamw`.
        schedule: `constant`, or `cosine` down to a hundredth of `lr` at the last step.
        warmup_steps: steps of linear rise.
        gradient_clip: largest gradient norm; 0 leaves it alone.
        accumulate: batches whose gradients are averaged for one step.
        ema_decay: of the running average of the weights, which is what is measured and kept; 0 keeps the weights
            themselves. Early on, the average is over fewer steps: the decay of step n is at most (n + 1) / (n + 10).
    """

    name: Literal["adam", "adamw"] = "adam"
    lr: float = 3e-4
    weight_decay: float = 0.0
    schedule: Literal["constant", "cosine"] = "constant"
    warmup_steps: int = 0
    gradient_clip: float = 0.0
    accumulate: int = 1
    ema_decay: float = 0.0

    def __post_init__(self) -> None:
        _require(0 < self.lr < math.inf, f"lr is {self.lr}, expected a positive number")
        _require_finite(self, "weight_decay", "gradient_clip", "warmup_steps")
        _require(self.accumulate >= 1, f"accumulate is {self.accumulate}, expected 1 or more")
        _require(0 <= self.ema_decay < 1, f"ema_decay is {self.ema_decay}, expected 0 to under 1")


@dataclass(frozen=True, kw_only=True)
class LoaderConfig:
    """Reading of shards.

    Attributes:
        workers: loader processes; 0 loads in the training process. Each takes shards of its own.
        shuffle_shards: shards whose samples are shuffled together.
        prefetch: batches each worker prepares ahead.
        cache_mb: decoded shards each worker keeps for the next epoch; 0 keeps none.
        follow: the dataset is still growing: wait for its first shards, and take in new ones between epochs.
        skip_bad_shards: train on without shards that cannot be read, instead of stopping at the first.
    """

    workers: int = 1
    shuffle_shards: int = 4
    prefetch: int = 4
    cache_mb: int = 0
    follow: bool = False
    skip_bad_shards: bool = False

    def __post_init__(self) -> None:
        _require(self.workers >= 0, f"workers is {self.workers}, expected 0 or more")
        _require(self.prefetch >= 1, f"prefetch is {self.prefetch}, expected 1 or more")
        _require(self.cache_mb >= 0, f"cache_mb is {self.cache_mb}, expected 0 or more")
        _require(self.shuffle_shards >= 1, f"shuffle_shards is {self.shuffle_shards}, expected 1 or more")


@dataclass(frozen=True, kw_only=True)
class ValidationConfig:
    """Held-out scenes, with hypotheses that stay the same throughout.

    Attributes:
        scene_share: share of scenes held out, at least one.
        pairs: how many pairs are measured.
        every: steps between measurements; the last step is always measured.
    """

    scene_share: float = 0.1
    pairs: int = 256
    every: int = 500

    def __post_init__(self) -> None:
        _require(0 < self.scene_share < 1, f"scene_share is {self.scene_share}, expected between 0 and 1")
        _require(self.pairs >= 1 and self.every >= 1, "pairs and every must be 1 or more")


@dataclass(frozen=True, kw_only=True)
class TrainConfig:
    """Everything that decides a training run, apart from its data.

    Attributes:
        preset: the preset it came from.
        network: architecture.
        window: how patches are cut.
        hypothesis: how pairs are drawn.
        own_predictions: training on where the network itself moved hypotheses.
        augment: colour augmentation.
        loss: loss.
        optimiser: optimiser.
        loader: loader.
        validation: held-out measurement.
        batch: pairs in a batch, on each rank; a step takes `optimiser.accumulate` of them.
        steps: steps of the run; the cosine schedule ends there.
        seed: of weights, order, hypotheses and augmentation.
        init: checkpoint whose weights the run begins with, of a network of the same settings; empty begins at random.
        objects: ids of the dataset's objects to train on; empty takes all.
        category: whether the objects are members of a category, so that the network is meant for others of it too.
        threads: torch threads; 0 leaves torch's own choice.
        precision: of the convolutions in training; `auto` is bfloat16 on GPUs and on processors that compute in it,
            float32 elsewhere. Poses, losses and weights are float32 always.
        device: `cpu`, `cuda`, or `auto` for a GPU where there is one.
        compile: let torch.compile fuse the network; the first step takes longer. Needs a C++ compiler.
        log_every: steps between lines of metrics.
        checkpoint_every: steps between checkpoints.
    """

    preset: Literal["paper", "compact", "plus", "flow"]
    network: NetworkConfig
    window: WindowConfig
    hypothesis: HypothesisConfig = field(default_factory=HypothesisConfig)
    own_predictions: OwnPredictionsConfig = field(default_factory=OwnPredictionsConfig)
    augment: AugmentConfig = field(default_factory=AugmentConfig)
    loss: LossConfig = field(default_factory=LossConfig)
    optimiser: OptimiserConfig = field(default_factory=OptimiserConfig)
    loader: LoaderConfig = field(default_factory=LoaderConfig)
    validation: ValidationConfig = field(default_factory=ValidationConfig)
    batch: int = 16
    steps: int = 100_000
    seed: int = 0
    init: str = ""
    objects: tuple[int, ...] = ()
    category: bool = False
    threads: int = 0
    precision: Literal["auto", "float32", "bfloat16"] = "auto"
    device: Literal["auto", "cpu", "cuda"] = "auto"
    compile: bool = False
    log_every: int = 20
    checkpoint_every: int = 500

    def __post_init__(self) -> None:
        _require_finite(self, "seed", "threads")
        for name in ("batch", "steps", "log_every", "checkpoint_every"):
            value = getattr(self, name)
            _require(value >= 1, f"{name} is {value}, expected 1 or more")
        _require(
            self.recut or not self.augment.occlusion,
            "augment.occlusion needs pairs made in the training loop: window.kind=diameter or hypothesis.fresh=true",
        )

        _require(
            self.hypothesis.fresh or not self.hypothesis.stored_share,
            "hypothesis.stored_share mixes stored hypotheses with fresh ones: set hypothesis.fresh=true as well",
        )
        _require(
            self.network.confidence or not self.loss.min_closeness,
            "loss.min_closeness leaves hypotheses to the confidence, which this network has not: set "
            "network.confidence=true as well",
        )
        _require(
            self.loss.name != "flow+point" or self.network.kind == "flow",
            f"loss.name is flow+point, but kind {self.network.kind} predicts no flow; use kind flow, or another loss",
        )

    @property
    def recut(self) -> bool:
        """Whether scenes are cut anew and hypotheses rendered in the training loop; else shards' own pairs are used."""
        return self.window.kind == "diameter" or self.hypothesis.fresh


def load_config(preset: str, overrides: Sequence[str] = (), file: Path | None = None) -> TrainConfig:
    """A preset, overlaid with a YAML file's keys and then with `a.b=c` overrides.

    `backbone.` may be written for `network.backbone.`.

    Raises:
        ConfigError: an unknown preset or key, or a value of the wrong type or out of range; named.
    """
    _require(preset in PRESETS, f"unknown preset '{preset}', expected one of: {', '.join(PRESETS)}")
    mapping = posecore_config.load_yaml(
        Path(str(resources.files("refinenet").joinpath(f"config/presets/{preset}.yaml")))
    )
    where = f"preset {preset}"
    if file is not None:
        mapping = posecore_config.merge(mapping, posecore_config.load_yaml(file))
        where = str(file)
    full = [f"network.{item}" if item.startswith(("backbone.", "backbone=")) else item for item in overrides]
    config = posecore_config.build(TrainConfig, posecore_config.apply_overrides(mapping, full), where)
    _require_used(config, posecore_config.assigned_keys(full))
    return config


def _require_used(config: TrainConfig, keys: Sequence[str]) -> None:
    """Refuse keys that someone set by hand and that change nothing under the rest of the configuration.

    Those of a switch that was turned off by hand as well may stand: so one option added to a command does that.

    Raises:
        ConfigError: There is one; it and what it needs are named.
    """
    loss, kind = config.loss.name, config.network.kind
    switches = {
        "hypothesis.fresh=true": (config.hypothesis.fresh, ["hypothesis.any_twin", "hypothesis.in_plane"]),
        "network.confidence=true": (config.network.confidence, ["loss.confidence_"]),
        "own_predictions.share=0.5 or so": (config.own_predictions.share, ["own_predictions."]),
        "augment.occlusion=0.3 or so": (config.augment.occlusion, ["augment.occlusion_leaves"]),
        "loader.workers=1 or more": (config.loader.workers, ["loader.prefetch"]),
    }
    choices = {
        "network.kind=paper": (kind == "paper", ["network.backbone.", "network.branch_channels"]),
        "network.kind=compact or plus": (kind in ("compact", "plus"), ["network.match_channels", "network.hidden"]),
        "network.kind=compact, plus or flow": (
            kind != "paper",
            ["network.encoder", "network.match_radius", "network.appearance_channels", "network.widths"],
        ),
        "optimiser.name=adamw": (config.optimiser.name == "adamw", ["optimiser.weight_decay"]),
        "window.kind=diameter": (config.window.kind == "diameter", ["window.scale"]),
        "loss.name=mse": (loss == "mse", ["loss.gamma"]),
        "loss.name=point, contour+point or flow+point": ("point" in loss, ["loss.rotation_weight"]),
        "loss.name=contour+point or flow+point": ("+point" in loss, ["loss.point_weight"]),
    }
    off_by_hand = {needed for needed in switches if needed.partition("=")[0] in keys}
    for needed, (met, names) in (switches | choices).items():
        for key in keys if not met and needed not in off_by_hand else ():
            _require(
                not key.startswith(tuple(names)),
                f"{key} changes nothing here: it needs {needed}; leave it out, or set that as well",
            )
