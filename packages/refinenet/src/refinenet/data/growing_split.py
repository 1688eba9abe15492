"""Split of a dataset that is still being rendered (a streaming dataset).

A run that follows a growing dataset adds one small file an epoch to what `data.json` fixed at its start. Whichever
process reaches the epoch first writes the file, and all processes read it: ranks, loader processes and resumed runs
agree on the samples of an epoch. Each scene is on one side of the split for good, whenever its shard arrives.
"""

import itertools
import json
import logging
import os
import time
from collections.abc import Collection, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from posecore.files import storage_error, write_atomic
from posecore.shard import GROUP, ShardReader, n_shards
from posecore.store import open_store

from refinenet.config import TrainConfig
from refinenet.data.split import (
    GROWTH,
    DataRecord,
    Split,
    divide,
    draw_validation_scenes,
    read_scenes,
    scenes_in,
)
from refinenet.models.checkpoint_schema import EpochRecord, read_record

POLL_S = 2.0
"""Seconds between polls of a growing dataset that has too few shards to begin with."""

log = logging.getLogger(__name__)


@dataclass(frozen=True, kw_only=True)
class GrowingSplit:
    """New shards of a growing dataset, an epoch at a time.

    Attributes:
        out: Folder of the run, the same for all its processes.
        record: Split that the run began with.
        config: Configuration of the run: validation scenes, objects, and whether a new shard that cannot be read is
            left for a later epoch or is an error.
    """

    out: Path
    record: DataRecord
    config: TrainConfig

    def epochs(self, url: str) -> Iterator[dict[int, np.ndarray]]:
        """Training rows by shard that join at each epoch from epoch 1 on, until the dataset is complete.

        Raises:
            ShardError: A new shard cannot be read, or has disappeared from the manifest.
            StorageError: The file of an epoch cannot be written.
        """
        reader = ShardReader(url)
        skip = self.config.loader.skip_bad_shards
        joined = set(self.record.shards)
        for epoch in itertools.count(1):
            path = self.out / GROWTH / f"epoch-{epoch:06d}.json"
            if not path.exists():
                reader.refresh()
                new, _ = read_scenes(reader, sorted({*reader.committed} - joined), skip=skip)
                complete = len(joined | set(new)) == n_shards(reader.card)
                _write_once(path, {"shards": sorted(new), "complete": complete})
            content = read_record(path, EpochRecord)
            scene_of = self._scenes(reader, content["shards"])
            joined |= set(scene_of)
            yield self._divide(scene_of)[0].rows
            if content["complete"]:
                return

    def joined(self) -> set[int]:
        """Shards that have joined in epochs begun so far."""
        begun = (self.out / GROWTH).glob("epoch-*.json")
        return {shard for path in begun for shard in read_record(path, EpochRecord)["shards"]}

    def validation_rows(self, url: str, shards: Collection[int]) -> tuple[set[int], dict[int, np.ndarray]]:
        """The readable ones among some shards, and their validation rows by shard.

        Raises:
            ShardError: As `epochs`.
        """
        scene_of = self._scenes(ShardReader(url), sorted(shards))
        return set(scene_of), self._divide(scene_of)[1].rows

    def _scenes(self, reader: ShardReader, shards: list[int]) -> dict[int, np.ndarray]:
        if set(shards) - {*reader.committed}:
            reader.refresh()
        skip, objects = self.config.loader.skip_bad_shards, self.config.objects
        return read_scenes(reader, shards, skip=skip, objects=objects)[0]

    def _divide(self, scene_of: Mapping[int, np.ndarray]) -> tuple[Split, Split]:
        drawn = draw_validation_scenes(scenes_in(scene_of), self.config.validation.scene_fraction, self.config.seed)
        return divide(scene_of, np.union1d(self.record.validation_scenes, drawn))


def wait_for_dataset(url: str) -> None:
    """Wait until the rendering of a dataset has begun.

    Raises:
        StorageError: A file stands in its place.
    """
    store, warned = open_store(url), False
    while store.get(GROUP) is None:
        store.list_names()  # raises for a file, which will never be a dataset
        if not warned:
            log.warning("%s: no dataset here yet, waiting for one; Ctrl-C ends that", url)
            warned = True
        time.sleep(POLL_S)


def wait_for_start(reader: ShardReader, config: TrainConfig, n_shards_needed: int) -> None:
    """Wait until a growing dataset has enough shards to begin with, or is complete.

    Enough is a number of shards to train on, one for each loader process, and a validation scene.

    Raises:
        ShardError: A shard cannot be read and `loader.skip_bad_shards` is off.
    """
    scene_of: dict[int, np.ndarray] = {}
    reported = ""
    while not reader.complete:
        new = sorted({*reader.committed} - set(scene_of))
        scene_of |= read_scenes(reader, new, skip=config.loader.skip_bad_shards, objects=config.objects)[0]
        drawn = draw_validation_scenes(scenes_in(scene_of), config.validation.scene_fraction, config.seed)
        training, validation = divide(scene_of, drawn)
        n_training = len(training.rows)
        if n_training >= n_shards_needed and validation.scenes:
            return
        lacking = f"{n_training} of {n_shards_needed} shards to train on, {validation.scenes} of 1 scene to validate on"
        if lacking != reported:
            log.warning("%s: waiting, there are %s", reader.url, lacking)
            reported = lacking
        time.sleep(POLL_S)
        reader.refresh()


def _write_once(path: Path, content: Mapping[str, object]) -> None:
    """Write a JSON file atomically, unless another process has written it."""
    temporary = path.with_name(f".{path.name}.{os.getpid()}.tmp")
    write_atomic(temporary, json.dumps(content).encode())
    try:
        os.link(temporary, path)
    except FileExistsError:
        pass
    except OSError as error:
        raise storage_error(path, error) from error
    finally:
        temporary.unlink(missing_ok=True)
