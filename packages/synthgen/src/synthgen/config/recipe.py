"""The whole configuration of a dataset, resolved from presets and overrides."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Any

from posecore import config as config_tools
from posecore.config import Range, check_ranges
from posecore.errors import ConfigError
from posecore.files import data_spec
from posecore.renamed import refuse_renamed_keys

from synthgen.config.geometry import (
    MAX_PATCH_PX,
    CameraConfig,
    DistanceConfig,
    FixedWindowConfig,
    PerturbationConfig,
    ViewConfig,
)
from synthgen.config.images import FrameConfig, SequenceConfig
from synthgen.config.renamed_keys import RENAMED_KEYS
from synthgen.config.surroundings import (
    BackgroundConfig,
    LightConfig,
    MaterialConfig,
    OccluderConfig,
    SceneConfig,
    SensorConfig,
    TabletopConfig,
)
from synthgen.names import Device, EngineName


@dataclass(frozen=True, kw_only=True)
class SynthConfig:
    """A dataset's whole configuration; with the objects and the number of samples it decides every byte.

    Attributes:
        seed: Dataset seed.
        engine: Renderer of the scenes.
        hypothesis_engine: Renderer of the hypothesis patches; inference uses the rasteriser.
        device: Device of Cycles.
        samples: Light paths per pixel of the Blender engines.
        patch_px: Side of the patches.
        contour_points: Contour points per silhouette.
        hypotheses_per_scene: Hypotheses per rendered scene.
        shard_size: Samples in a shard, the unit of work and of resuming. A multiple of `hypotheses_per_scene`.
        camera: Intrinsics.
        distance: Distance of the object.
        view: Viewpoint and position in the image.
        perturbation: Distance of the hypotheses from the ground truth.
        window: Fixed window.
        scene: Kinds of scene.
        tabletop: Tabletop scenes.
        lights: Lighting.
        material: Surface of the object.
        occluders: Occluders and props.
        background: Background.
        sensor: Camera effects.
        frames: Whole camera images.
        sequence: Motion of tracking sequences.
    """

    seed: Annotated[int, Range(0, 2**63 - 1)] = 0
    engine: EngineName = "cycles"
    hypothesis_engine: EngineName = "raster"
    device: Device = "cpu"
    samples: Annotated[int, Range(1, 65536)] = 16
    patch_px: Annotated[int, Range(16, MAX_PATCH_PX)] = 224
    contour_points: Annotated[int, Range(1, 100_000)] = 100
    hypotheses_per_scene: Annotated[int, Range(1, 4096)] = 8
    shard_size: Annotated[int, Range(1, 1_000_000)] = 64
    camera: CameraConfig = field(default_factory=CameraConfig)
    distance: DistanceConfig = field(default_factory=DistanceConfig)
    view: ViewConfig = field(default_factory=ViewConfig)
    perturbation: PerturbationConfig = field(default_factory=PerturbationConfig)
    window: FixedWindowConfig = field(default_factory=FixedWindowConfig)
    scene: SceneConfig = field(default_factory=SceneConfig)
    tabletop: TabletopConfig = field(default_factory=TabletopConfig)
    lights: LightConfig = field(default_factory=LightConfig)
    material: MaterialConfig = field(default_factory=MaterialConfig)
    occluders: OccluderConfig = field(default_factory=OccluderConfig)
    background: BackgroundConfig = field(default_factory=BackgroundConfig)
    sensor: SensorConfig = field(default_factory=SensorConfig)
    frames: FrameConfig = field(default_factory=FrameConfig)
    sequence: SequenceConfig = field(default_factory=SequenceConfig)

    def __post_init__(self) -> None:
        check_ranges(self)
        if self.shard_size % self.hypotheses_per_scene:
            near = max(1, round(self.shard_size / self.hypotheses_per_scene)) * self.hypotheses_per_scene
            raise ConfigError(
                f"shard_size is {self.shard_size}, expected a multiple of hypotheses_per_scene "
                f"({self.hypotheses_per_scene}) because a scene is in one shard; try shard_size={near}"
            )


def preset_names() -> list[str]:
    """Names of the shipped presets."""
    return sorted(p.stem for p in data_spec("presets").glob("*.yaml"))


def load_config(
    preset: str = "default", overrides: Sequence[str] = (), values: Mapping[str, Any] | None = None
) -> SynthConfig:
    """Resolve a preset, `key=value` overrides and option values (in rising priority) to a configuration.

    Args:
        preset: Name of a shipped preset, or a YAML file.
        overrides: Assignments such as `window.padding=0.5`.
        values: Top-level values from command-line options; None entries are left out.

    Raises:
        ConfigError: Unknown preset, key or value, or a key with a new name; the message names it.
    """
    if preset.endswith((".yaml", ".yml")) or Path(preset).is_file():
        where, mapping = preset, config_tools.load_yaml(preset)
    elif preset in preset_names():
        where, mapping = f"preset {preset}", config_tools.load_yaml(data_spec(f"presets/{preset}.yaml"))
    else:
        raise ConfigError(
            f"--preset {preset}: there is no such preset; choose one of {', '.join(preset_names())} or a .yaml file"
        )
    refuse_renamed_keys(config_tools.apply_overrides({}, overrides), RENAMED_KEYS, "--set")
    mapping = config_tools.apply_overrides(mapping, overrides)
    mapping.update({k: v for k, v in (values or {}).items() if v is not None})
    return config_tools.build(SynthConfig, mapping, config_tools.sources(where, overrides), RENAMED_KEYS)
