"""Sampling configuration: every parameter of a dataset, with its default.

A range is a (low, high) pair, drawn uniformly unless its field states another distribution. Sizes are in units of the
object's diameter where the field's name ends in `_diameter`, so that one preset serves a 3 cm screw and a 2 m chair.
"""

from synthgen.config.cut import CutConfig, load_cut_config
from synthgen.config.geometry import CameraConfig, DistanceConfig, FixedWindowConfig, PerturbationConfig, ViewConfig
from synthgen.config.images import FrameConfig, SequenceConfig
from synthgen.config.recipe import SynthConfig, load_config, preset_names
from synthgen.config.renamed_keys import RENAMED_KEYS, migrate
from synthgen.config.surroundings import (
    BackgroundConfig,
    LightConfig,
    MaterialConfig,
    OccluderConfig,
    SceneConfig,
    SensorConfig,
    TabletopConfig,
)

__all__ = [
    "RENAMED_KEYS",
    "BackgroundConfig",
    "CameraConfig",
    "CutConfig",
    "DistanceConfig",
    "FixedWindowConfig",
    "FrameConfig",
    "LightConfig",
    "MaterialConfig",
    "OccluderConfig",
    "PerturbationConfig",
    "SceneConfig",
    "SensorConfig",
    "SequenceConfig",
    "SynthConfig",
    "TabletopConfig",
    "ViewConfig",
    "load_config",
    "load_cut_config",
    "migrate",
    "preset_names",
]
