"""Schemas of a run's stored files: checkpoint metadata, weights, optimiser state, and the records of its data."""

from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Annotated, Any

import torch
from msgspec import Meta, Struct
from posecore.errors import CheckpointError
from posecore.files import read_regular
from posecore.schema import check, check_entries, parse_json
from posecore.shard.card_schema import Name
from torch import Tensor

from refinenet.models.migration import migrated_record, migrated_state

_METADATA_ADVICE = "the metadata is damaged; choose another checkpoint"
_STATE_ADVICE = "the run cannot be resumed; start a new one"
_Id = Annotated[int, Meta(ge=0, le=2**63 - 1)]
_Digits = Annotated[str, Meta(pattern=r"^[0-9]{1,15}\Z")]


class _Metadata(Struct):
    """Metadata of the safetensors file: text, of which some is JSON."""

    config: str
    step: _Digits
    dataset_sha256: Name
    objects: str
    camera_fx_px: Annotated[str, Meta(pattern=r"^[0-9]{1,20}(\.[0-9]{0,40})?(e[-+]?[0-9]{1,2})?\Z")]


class _ObjectCard(Struct):
    """An object of the training data."""

    window_side_px: Annotated[float, Meta(gt=0, le=1e6)]
    diameter_m: Annotated[float, Meta(gt=0, le=1e6)]
    name: Name = ""
    mesh_digest: Name = ""


class _Objects(Struct):
    objects: dict[str, Any]

    def __post_init__(self) -> None:
        if not self.objects or not all(key.isascii() and key.isdigit() and len(key) <= 19 for key in self.objects):
            raise ValueError("objects has other keys than object ids, or none")
        check_entries("objects", self.objects, _ObjectCard)


class _OptimiserState(Struct):
    """State of torch's optimiser. Its settings are those of the config, not of the file."""

    state: dict[int, dict[str, Any]]


class _State(Struct):
    optimiser: _OptimiserState
    best_mm: Annotated[float, Meta(ge=0)]
    world: Annotated[int, Meta(ge=1, le=1 << 20)]
    validation_shards: list[_Id] = []
    weights: dict[str, Any] | None = None


class _EmaState(_State, kw_only=True):
    weights: dict[str, Any]


class SplitRecord(Struct):
    """`data.json` of a run."""

    shards: list[_Id]
    validation_scenes: list[_Id]


class EpochRecord(Struct):
    """A file of `growth/`."""

    shards: list[_Id]
    complete: bool


def parsed_metadata(metadata: Mapping[str, str], path: Path) -> dict[str, Any]:
    """A checkpoint's metadata as values: config (a mapping), step, dataset_sha256, objects, camera_fx_px.

    Raises:
        CheckpointError: A key is missing or wrong; the message names it.
    """
    check(dict(metadata), _Metadata, str(path), CheckpointError, _METADATA_ADVICE)
    config, objects = (
        parse_json(metadata[key].encode(), f"{path}: {key}", CheckpointError, _METADATA_ADVICE)
        for key in ("config", "objects")
    )
    check({"objects": objects}, _Objects, str(path), CheckpointError, _METADATA_ADVICE)
    if not isinstance(config, dict):
        raise CheckpointError(f"{path}: config is a {type(config).__name__}, expected keys; {_METADATA_ADVICE}")
    return {
        "config": config,
        "step": int(metadata["step"]),
        "dataset_sha256": metadata["dataset_sha256"],
        "objects": objects,
        "camera_fx_px": float(metadata["camera_fx_px"]),
    }


def require_finite(tensors: Mapping[str, Any], path: Path) -> None:
    """Refuse weights or states with NaN or infinity.

    Raises:
        CheckpointError: The message names the tensor.
    """
    for name, tensor in _tensors(tensors, ""):
        if tensor.is_floating_point() and not bool(torch.isfinite(tensor).all()):
            bad = int((~torch.isfinite(tensor)).sum())
            raise CheckpointError(
                f"{path}: {bad} of {tensor.numel()} numbers of {name} are NaN or infinite; choose another checkpoint"
            )


def _tensors(values: Mapping[Any, Any], prefix: str) -> Iterator[tuple[str, Tensor]]:
    for key, value in values.items():
        if isinstance(value, Tensor):
            yield f"{prefix}{key}", value
        elif isinstance(value, Mapping):
            yield from _tensors(value, f"{prefix}{key}.")


def checked_state(content: Any, path: Path, *, ema: bool) -> dict[str, Any]:
    """An optimiser state with today's keys; beside an EMA with weights.

    Raises:
        CheckpointError: A key is missing or wrong, or a number is not finite; the message names it.
    """
    state = migrated_state(content) if isinstance(content, Mapping) else content
    check(state, _EmaState if ema else _State, str(path), CheckpointError, _STATE_ADVICE)
    require_finite({key: state.get(key) or {} for key in ("optimiser", "weights")}, path)
    return dict(state)


def own_optimiser_state(optimiser: torch.optim.Optimizer, stored: Mapping[str, Any], path: Path) -> dict[str, Any]:
    """A stored state for `optimiser.load_state_dict`, with this optimiser's own settings.

    Raises:
        CheckpointError: It is of other weights.
    """
    settings = optimiser.state_dict()["param_groups"]
    weights = [weight for group in optimiser.param_groups for weight in group["params"]]
    for index, entry in stored["state"].items():
        shape = weights[index].shape if 0 <= index < len(weights) else None
        for name, value in entry.items():
            if not isinstance(value, Tensor) or (value.ndim and value.shape != shape):
                actual = tuple(value.shape) if isinstance(value, Tensor) else type(value).__name__
                raise CheckpointError(
                    f"{path}: optimiser.state.{index}.{name} is {actual}, expected the shape of weight {index}, "
                    f"{None if shape is None else tuple(shape)}; {_STATE_ADVICE}"
                )
    return {"state": stored["state"], "param_groups": settings}


def read_record(file: Path, schema: type[Struct]) -> dict[str, Any]:
    """A small JSON file of a run.

    Raises:
        CheckpointError: It is missing or damaged; the message names file and key.
    """
    try:
        data = read_regular(file)
    except OSError as error:
        raise CheckpointError(f"{file}: cannot be read ({error.strerror}); {_STATE_ADVICE}") from error
    content: dict[str, Any] = parse_json(data, str(file), CheckpointError, _STATE_ADVICE)
    if isinstance(content, Mapping):
        content = migrated_record(content)
    check(content, schema, str(file), CheckpointError, _STATE_ADVICE)
    return content
