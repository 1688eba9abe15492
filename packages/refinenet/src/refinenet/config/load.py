"""Loading of a training configuration: preset, YAML file and `--set` overrides."""

from collections.abc import Sequence
from importlib import resources
from pathlib import Path
from typing import get_args

from posecore import config as posecore_config
from posecore.renamed import refuse_renamed_keys

from refinenet.config.checks import require
from refinenet.config.renamed import RENAMED
from refinenet.config.train import PresetName, TrainConfig


def load_config(preset: str, overrides: Sequence[str] = (), file: Path | None = None) -> TrainConfig:
    """A preset, overlaid with a YAML file's keys and then with `a.b=c` overrides.

    `backbone.` may be written for `network.backbone.`.

    Raises:
        ConfigError: an unknown preset or key, or a value of the wrong type or out of range; named.
    """
    presets = get_args(PresetName)
    require(preset in presets, f"unknown preset '{preset}', expected one of: {', '.join(presets)}")
    mapping = posecore_config.load_yaml(
        Path(str(resources.files("refinenet").joinpath(f"config/presets/{preset}.yaml")))
    )
    where = f"preset {preset}"
    if file is not None:
        mapping = posecore_config.merge(mapping, posecore_config.load_yaml(file))
        where = str(file)
    full = [f"network.{item}" if item.startswith(("backbone.", "backbone=")) else item for item in overrides]
    refuse_renamed_keys(posecore_config.apply_overrides({}, full), RENAMED, "--set")
    mapping = posecore_config.apply_overrides(mapping, full)
    config = posecore_config.build(TrainConfig, mapping, posecore_config.sources(where, overrides), renamed=RENAMED)
    require_used(config, posecore_config.assigned_keys(full))
    return config


def require_used(config: TrainConfig, keys: Sequence[str]) -> None:
    """Refuse keys that were set by hand and have no effect under the rest of the configuration.

    Keys of a switch that was turned off by hand, too, are allowed: one more option on a command then turns it off.

    Raises:
        ConfigError: There is such a key; the message names the key and the setting that it needs.
    """
    loss, kind = config.loss.name, config.network.kind
    switches = {
        "hypothesis.online=true": (config.hypothesis.online, ["hypothesis.sample_symmetries", "hypothesis.in_plane"]),
        "network.confidence=true": (config.network.confidence, ["loss.confidence_"]),
        "on_policy.fraction=0.5 or so": (config.on_policy.fraction, ["on_policy."]),
        "augment.occlusion=0.3 or so": (config.augment.occlusion, ["augment.min_visible_fraction"]),
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
            require(
                not key.startswith(tuple(names)),
                f"{key} changes nothing here: it needs {needed}; leave it out, or set that as well",
            )
