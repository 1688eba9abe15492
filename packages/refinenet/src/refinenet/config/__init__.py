"""Configuration of training: one frozen dataclass a section, presets as YAML, and their loading."""

from refinenet.config.data import AugmentConfig, HypothesisConfig, LoaderConfig, ValidationConfig, WindowConfig
from refinenet.config.load import load_config
from refinenet.config.network import BackboneConfig, NetworkConfig
from refinenet.config.train import (
    ConfidenceTarget,
    DeviceName,
    LossConfig,
    LossName,
    OnPolicyConfig,
    OptimiserConfig,
    Pivot,
    PresetName,
    TrainConfig,
)

__all__ = [
    "AugmentConfig",
    "BackboneConfig",
    "ConfidenceTarget",
    "DeviceName",
    "HypothesisConfig",
    "LoaderConfig",
    "LossConfig",
    "LossName",
    "NetworkConfig",
    "OnPolicyConfig",
    "OptimiserConfig",
    "Pivot",
    "PresetName",
    "TrainConfig",
    "ValidationConfig",
    "WindowConfig",
    "load_config",
]
