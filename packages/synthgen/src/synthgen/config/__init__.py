"""Sampling configuration: every number that decides what a dataset looks like, with the defaults that are shipped.

Ranges are (low, high) pairs drawn uniformly unless said otherwise. Sizes are in units of the object's diameter where
the field's name ends in `_diameter`, so that one preset serves a 3 cm screw and a 2 m chair.
"""

from synthgen.config.cut import CutConfig, load_cut_config
from synthgen.config.geometry import CameraConfig, DistanceConfig, PerturbationConfig, ViewConfig, WindowConfig
from synthgen.config.images import FrameConfig, SequenceConfig
from synthgen.config.recipe import SynthConfig, load_config, preset_names
from synthgen.config.renamed_keys import RENAMED_KEYS, migrate, refuse_renamed
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
    "WindowConfig",
    "load_config",
    "load_cut_config",
    "migrate",
    "preset_names",
    "refuse_renamed",
]
