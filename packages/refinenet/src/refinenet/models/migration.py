"""Migration of files that earlier versions wrote: checkpoints, optimiser states, data records and metrics of a run.

Files are migrated when they are read. Only `metrics.jsonl` is rewritten, by a resumed run. Tensor names have not
changed since the first version.
"""

from collections.abc import Mapping
from typing import Any

from posecore.renamed import migrated_keys

from refinenet.config.renamed import RENAMED

STATE_KEYS = {"held_out_shards": "validation_shards"}
RECORD_KEYS = {"held_out_scenes": "validation_scenes"}
METRIC_KEYS = {"visible_share": "visible_fraction", "data_wait_share": "data_wait_fraction"}


def migrated_config(config: Mapping[str, Any], version: str) -> dict[str, Any]:
    """The configuration in the metadata of a checkpoint of a format version; version 1 had the origin as its pivot."""
    return migrated_keys(config, RENAMED) | ({"pivot": "origin"} if version == "1" else {})


def migrated_state(state: Mapping[str, Any]) -> dict[str, Any]:
    """The optimiser state of a step, `optimiser-*.pt`."""
    return migrated_keys(state, STATE_KEYS)


def migrated_record(record: Mapping[str, Any]) -> dict[str, Any]:
    """The split of a run, `data.json`."""
    return migrated_keys(record, RECORD_KEYS)


def migrated_metrics(line: Mapping[str, Any]) -> dict[str, Any]:
    """One line of `metrics.jsonl`."""
    return migrated_keys(line, METRIC_KEYS)
