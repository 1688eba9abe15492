"""Migration of files that earlier versions wrote: checkpoints, optimiser states, data records and metrics of a run.

Files are migrated when they are read and never rewritten. Tensor names have not changed since the first version.
"""

from collections.abc import Mapping
from typing import Any

from refinenet.config import renamed

STATE_KEYS = {"held_out_shards": "validation_shards"}
RECORD_KEYS = {"held_out_scenes": "validation_scenes"}
METRIC_KEYS = {"visible_share": "visible_fraction", "data_wait_share": "data_wait_fraction"}


def migrated_config(config: Mapping[str, Any]) -> dict[str, Any]:
    """The configuration in a checkpoint's metadata, under today's keys and values."""
    return renamed.migrated(config)


def migrated_state(state: Mapping[str, Any]) -> dict[str, Any]:
    """The optimiser state of a step, `optimiser-*.pt`."""
    return _renamed(state, STATE_KEYS)


def migrated_record(record: Mapping[str, Any]) -> dict[str, Any]:
    """The split of a run, `data.json`."""
    return _renamed(record, RECORD_KEYS)


def migrated_metrics(line: Mapping[str, Any]) -> dict[str, Any]:
    """One line of `metrics.jsonl`."""
    return _renamed(line, METRIC_KEYS)


def _renamed(mapping: Mapping[str, Any], keys: Mapping[str, str]) -> dict[str, Any]:
    return {keys.get(key, key): value for key, value in mapping.items()}
