"""Configuration of training: one frozen dataclass a section, presets as YAML, and how they are loaded."""

from refinenet.config.train import (
    PRESETS,
    AugmentConfig,
    BackboneConfig,
    HypothesisConfig,
    LoaderConfig,
    LossConfig,
    NetworkConfig,
    OptimiserConfig,
    OwnPredictionsConfig,
    TrainConfig,
    ValidationConfig,
    WindowConfig,
    load_config,
)

__all__ = [
    "PRESETS",
    "AugmentConfig",
    "BackboneConfig",
    "HypothesisConfig",
    "LoaderConfig",
    "LossConfig",
    "NetworkConfig",
    "OptimiserConfig",
    "OwnPredictionsConfig",
    "TrainConfig",
    "ValidationConfig",
    "WindowConfig",
    "load_config",
]
