"""Configuration of the training pairs: windows, hypotheses, augmentation, loading, validation."""

from dataclasses import dataclass
from typing import Annotated, Literal

from posecore.config import Range, check_ranges

WindowKind = Literal["fixed", "diameter"]


@dataclass(frozen=True, kw_only=True)
class WindowConfig:
    """Crop windows.

    Attributes:
        kind: `fixed` (one side per object, from the data card) or `diameter` (scale x f x diameter / z).
        scale: side of a `diameter` window in projected diameters.
    """

    kind: WindowKind
    scale: Annotated[float, Range(1, 5, unit="diameters")] = 1.5

    def __post_init__(self) -> None:
        check_ranges(self)


@dataclass(frozen=True, kw_only=True)
class HypothesisConfig:
    """Hypotheses of the training pairs.

    Attributes:
        online: draw and render a new hypothesis at every pass; otherwise the shards' precomputed hypotheses are used.
        max_angle_deg: largest rotation; angles are uniform up to this limit.
        max_translation_diameter: largest translation, in object diameters; lengths are uniform up to this limit.
        depth_stretch: factor on the translation along the viewing ray; detectors that use RGB alone err several times
            as far in depth as across the image.
        easy_fraction: fraction of samples whose angle is scaled down at random, and, drawn independently, fraction of
            samples whose distance is: hypotheses of a refinement's later iterations.
        precomputed_fraction: fraction of samples that take the shard's precomputed hypothesis instead of an online
            one, for shards that `synthgen cut` made from a detector's or a search's poses.
        sample_symmetries: for symmetric objects, draw around a random symmetry-equivalent ground truth, as detectors
            return one. The image does not show which; only `mse` depends on it.
        in_plane: rotate each scene about the optical axis by a random angle.
    """

    online: bool = False
    max_angle_deg: Annotated[float, Range(0, 180, above=True)] = 25.0
    max_translation_diameter: Annotated[float, Range(0, 2)] = 0.2
    depth_stretch: Annotated[float, Range(1, 10)] = 1.0
    easy_fraction: Annotated[float, Range(0, 1)] = 0.3
    precomputed_fraction: Annotated[float, Range(0, 1)] = 0.0
    sample_symmetries: bool = False
    in_plane: bool = True

    def __post_init__(self) -> None:
        check_ranges(self)


@dataclass(frozen=True, kw_only=True)
class AugmentConfig:
    """Image augmentation; probabilities are per sample.

    Attributes:
        permute_channels: probability of a random order of colour channels, the same for both patches.
        gain: largest relative change of both patches' channels.
        scene_gain: largest relative change of the scene's channels alone.
        brightness: largest shift of the scene, as a fraction of the range.
        contrast: largest relative change of the scene's contrast.
        noise: largest standard deviation of the scene's noise, in grey levels.
        blur: probability that the scene is blurred.
        background: probability that everything behind the scene's foreground is replaced.
        occlusion: probability that a piece of another scene's foreground is pasted over the object.
        min_visible_fraction: smallest fraction of the visible object that a pasted piece leaves visible.
    """

    permute_channels: Annotated[float, Range(0, 1)] = 0.0
    gain: Annotated[float, Range(0, 1, under=True)] = 0.0
    scene_gain: Annotated[float, Range(0, 1, under=True)] = 0.0
    brightness: Annotated[float, Range(0, 1, under=True)] = 0.0
    contrast: Annotated[float, Range(0, 1, under=True)] = 0.0
    noise: Annotated[float, Range(0)] = 0.0
    blur: Annotated[float, Range(0, 1)] = 0.0
    background: Annotated[float, Range(0, 1)] = 0.0
    occlusion: Annotated[float, Range(0, 1)] = 0.0
    min_visible_fraction: Annotated[float, Range(0, 1)] = 0.35

    def __post_init__(self) -> None:
        check_ranges(self)


@dataclass(frozen=True, kw_only=True)
class LoaderConfig:
    """Reading of shards.

    Attributes:
        workers: loader processes; 0 loads in the training process. Each process reads shards of its own.
        shuffle_shards: number of shards whose samples are shuffled together.
        prefetch: batches that each worker prepares ahead.
        cache_mb: decoded shards that each worker keeps for the next epoch; 0 disables the cache.
        follow: the dataset is still being rendered: wait for its first shards, and add new shards between epochs.
        skip_bad_shards: train on without unreadable shards, instead of stopping at the first.
    """

    workers: Annotated[int, Range(0)] = 1
    shuffle_shards: Annotated[int, Range(1)] = 4
    prefetch: Annotated[int, Range(1)] = 4
    cache_mb: Annotated[int, Range(0)] = 0
    follow: bool = False
    skip_bad_shards: bool = False

    def __post_init__(self) -> None:
        check_ranges(self)


@dataclass(frozen=True, kw_only=True)
class ValidationConfig:
    """Validation scenes, with hypotheses that stay the same throughout.

    Attributes:
        scene_fraction: fraction of scenes kept for validation, at least one scene.
        pairs: number of validation pairs.
        every: steps between validations; the last step is always validated.
    """

    scene_fraction: Annotated[float, Range(0, 1, above=True, under=True)] = 0.1
    pairs: Annotated[int, Range(1)] = 256
    every: Annotated[int, Range(1)] = 500

    def __post_init__(self) -> None:
        check_ranges(self)
