"""Checkpoints: weights with the resolved config, step, seed, versions and dataset hash in one safetensors file.

The weights are those to refine with: the EMA, where the run has one. The optimiser's state, and the weights that
training continues with, are in a file beside it named by its step and written first: a run killed between the two still
finds a matching pair.
"""

import io
import json
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
from posecore import config as posecore_config
from posecore.errors import CheckpointError, ConfigError
from posecore.files import read_regular, sha256_bytes, write_atomic
from safetensors import SafetensorError, safe_open
from safetensors.torch import load as load_tensors
from safetensors.torch import save as save_tensors
from torch import Tensor, nn

from refinenet import __version__
from refinenet.config import NetworkConfig, TrainConfig
from refinenet.models.checkpoint_schema import checked_state, parsed_metadata, require_finite
from refinenet.models.heads import forms
from refinenet.models.migration import migrated_config
from refinenet.models.networks import make_network

FORMAT, VERSION = "refinenet", "2"
VERSIONS = ("1", VERSION)
"""Versions that are read; updates of version 1 are about the mesh's origin, see `migration.migrated_config`."""


@dataclass(frozen=True, kw_only=True)
class Provenance:
    """Origin of weights.

    Attributes:
        config: Resolved config of the run.
        step: Optimiser steps taken.
        dataset_sha256: Hash of the training data's card and manifest.
        objects: By object id as text: name, diameter_m, window_side_px, mesh sha256, as on the data card.
        camera_fx_px: Focal length of the training camera, which a fixed window depends on; 0 where unknown.
    """

    config: TrainConfig
    step: int
    dataset_sha256: str
    objects: dict[str, dict[str, Any]]
    camera_fx_px: float = 0.0

    def window_side_px(self, obj_id: int) -> float:
        """Side of an object's fixed window in training, pixels; the largest for an unseen member of a category."""
        cards = [self.objects[str(obj_id)]] if str(obj_id) in self.objects else list(self.objects.values())
        return max(float(card["window_side_px"]) for card in cards)


@dataclass(frozen=True, kw_only=True, eq=False)
class Checkpoint:
    """A checkpoint file in memory.

    Attributes:
        provenance: Origin of the weights.
        tensors: Weights by name.
        path: File.
        sha256: Hash of the file.
    """

    provenance: Provenance
    tensors: dict[str, Tensor]
    path: Path
    sha256: str

    def give_weights(self, network: nn.Module, config: NetworkConfig) -> None:
        """Load these weights into another run's network.

        Args:
            network: Receives the weights.
            config: Configuration of that network.

        Raises:
            CheckpointError: The network has other layers, or outputs of another kind.
        """
        try:
            network.load_state_dict(self.tensors)
        except RuntimeError as error:
            detail = str(error).splitlines()[-1].strip()[:200]
            raise CheckpointError(
                f"{self.path}: weights of another network ({detail}); begin with a checkpoint of preset "
                f"{self.provenance.config.preset} trained with the same `network` settings as this run"
            ) from error
        stored, expected = forms(self.provenance.config.network), forms(config)
        if stored != expected:  # heads of both kinds of translation have the same shape
            raise CheckpointError(
                f"{self.path}: its outputs are {' and '.join(stored)}, this run's are {' and '.join(expected)}; train "
                f"with --set network.rotation={stored[0]} --set network.translation={stored[1]}"
            )

    def network(self) -> nn.Module:
        """The network with these weights, in evaluation mode.

        Raises:
            CheckpointError: The weights do not fit the config beside them.
        """
        network = make_network(self.provenance.config.network)
        try:
            network.load_state_dict(self.tensors)
        except RuntimeError as error:
            detail = str(error).splitlines()[-1].strip()[:200]
            raise CheckpointError(f"{self.path}: weights do not fit its own config: {detail}") from error
        return network.eval()


def save(path: Path, network: nn.Module, provenance: Provenance) -> None:
    """Write a checkpoint atomically."""
    metadata = {
        "format": FORMAT,
        "version": VERSION,
        "config": json.dumps(posecore_config.to_dict(provenance.config)),
        "step": str(provenance.step),
        "seed": str(provenance.config.seed),
        "dataset_sha256": provenance.dataset_sha256,
        "objects": json.dumps(provenance.objects),
        "camera_fx_px": repr(provenance.camera_fx_px),
        "versions": json.dumps({"refinenet": __version__, "torch": torch.__version__}),
    }
    tensors = {name: tensor.detach().cpu().contiguous() for name, tensor in network.state_dict().items()}
    write_atomic(path, save_tensors(tensors, metadata))


def load(path: Path, preset: str | None = None) -> Checkpoint:
    """Read a checkpoint.

    Args:
        path: File.
        preset: Required preset; None accepts any.

    Raises:
        CheckpointError: Missing, not a checkpoint of this project, of another version or preset, with metadata out of
            bounds, or with weights that are not finite.
    """
    try:
        content = read_regular(path)
        with safe_open(path, "pt") as opened:
            metadata = opened.metadata() or {}
        tensors = load_tensors(content)
    except FileNotFoundError as error:
        raise CheckpointError(f"{path}: no such checkpoint; train one with `refinenet train`") from error
    except (OSError, SafetensorError) as error:
        raise CheckpointError(f"{path}: no readable safetensors file ({error}); choose another checkpoint") from error
    kind, version = metadata.get("format"), metadata.get("version", "")
    if kind != FORMAT or version not in VERSIONS:
        raise CheckpointError(
            f"{path}: format {kind} version {version}, expected {FORMAT} version {' or '.join(VERSIONS)}"
        )
    stored = parsed_metadata(metadata, path)
    try:
        config = posecore_config.build(TrainConfig, migrated_config(stored["config"], version), f"{path}: config")
    except ConfigError as error:
        raise CheckpointError(f"{error}; the metadata is damaged or of another version") from error
    provenance = Provenance(**{**stored, "config": config})
    require_finite(tensors, path)
    if preset is not None and config.preset != preset:
        raise CheckpointError(f"{path}: a checkpoint of preset {config.preset}, expected preset {preset}")
    return Checkpoint(provenance=provenance, tensors=tensors, path=path, sha256=sha256_bytes(content))


def save_state(folder: Path, step: int, state: Mapping[str, Any]) -> None:
    """Write the optimiser's state of a step, for `load_state`."""
    buffer = io.BytesIO()
    torch.save(dict(state), buffer)
    write_atomic(state_path(folder, step), buffer.getvalue())


def load_state(folder: Path, step: int, *, ema: bool = False) -> dict[str, Any]:
    """The optimiser's state that belongs to `last.safetensors` of this step.

    Args:
        folder: Of the run.
        step: Of the checkpoint.
        ema: Whether the checkpoint's weights are the EMA, and those that training continues with are in the state.

    Raises:
        CheckpointError: It is missing or damaged; the message names the key.
    """
    path = state_path(folder, step)
    try:
        content = torch.load(io.BytesIO(read_regular(path)), map_location="cpu", weights_only=True)
    except FileNotFoundError as error:
        raise CheckpointError(
            f"{path}: missing beside last.safetensors, so the run cannot be resumed; start a new one"
        ) from error
    except OSError as error:
        raise CheckpointError(
            f"{path}: cannot be read ({error.strerror or error}), so the run cannot be resumed; start a new one"
        ) from error
    except Exception as error:  # torch.load raises whatever its unpickler meets
        raise CheckpointError(
            f"{path}: damaged ({type(error).__name__}), so the run cannot be resumed; start a new one"
        ) from error
    return checked_state(content, path, ema=ema)


def drop_leftovers(folder: Path, keep: int) -> None:
    """Remove the optimiser states of other steps, and temporary files of a killed run."""
    for path in folder.glob("optimiser-*.pt"):
        if path != state_path(folder, keep):
            path.unlink(missing_ok=True)
    for name in ("*.safetensors", "optimiser-*.pt"):
        for path in folder.glob(f".{name}.*.tmp"):
            path.unlink(missing_ok=True)


def state_path(folder: Path, step: int) -> Path:
    """File of the optimiser's state of a step."""
    return folder / f"optimiser-{step:07d}.pt"


MAY_CHANGE = (
    "steps", "threads", "device", "compile", "log_every", "checkpoint_every", "validation.pairs", "validation.every",
    "loader.skip_bad_shards", "loader.prefetch", "loader.cache_mb", "init", "network.backbone.weights",
    "network.backbone.pretrained",
)  # fmt: skip
"""Settings that a resumed run may change: duration, machine, and initial weights.

Not `validation.scene_fraction`: with another value, training scenes would become validation scenes.
"""


def require_same(stored: TrainConfig, requested: TrainConfig, where: Path) -> None:
    """Refuse to resume a run under settings that would make it another run.

    Raises:
        ConfigError: A setting differs; the first is named with both values.
    """
    before, now = (dict(_leaves(posecore_config.to_dict(config))) for config in (stored, requested))
    for key in before:
        if key not in MAY_CHANGE and before[key] != now[key]:
            raise ConfigError(f"{where}: {key} was {before[key]} and is now {now[key]}; resume with the same settings")


def _leaves(mapping: Mapping[str, Any], prefix: str = "") -> Iterator[tuple[str, Any]]:
    for key, value in mapping.items():
        if isinstance(value, Mapping):
            yield from _leaves(value, f"{prefix}{key}.")
        else:
            yield prefix + key, value
