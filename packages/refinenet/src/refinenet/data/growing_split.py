"""Training on a dataset that is still being rendered.

A run that follows a growing dataset adds one small file an epoch to what `data.json` fixed at its start, written by
whichever process comes there first and read by all: so ranks, loader processes and resumed runs agree on what an epoch
holds. Each scene is on one side of the split for good, whenever its shard comes.
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
from refinenet.data.split import GROWTH, DataRecord, Split, divide, drawn_out, read_scenes, scenes_in

Array = np.ndarray
POLL_S = 2.0
"""Time between looks at a growing dataset that has too little to begin with."""

log = logging.getLogger(__name__)


@dataclass(frozen=True, kw_only=True)
class GrowingSplit:
    """Takes new shards of a growing dataset into a run, an epoch at a time.

    Attributes:
        out: Folder of the run, the same for all its processes.
        record: What the run began with.
        config: Of the run: which scenes are held out, which objects count, whether a new shard that cannot be read is
            left for a later epoch or is an error.
    """

    out: Path
    record: DataRecord
    config: TrainConfig

    def epochs(self, url: str) -> Iterator[dict[int, Array]]:
        """Training rows by shard that join at each epoch from epoch 1 on, until the dataset is complete.

        Raises:
            ShardError: A new shard cannot be read, or is gone from the manifest.
            StorageError: The file of an epoch cannot be written.
        """
        reader = ShardReader(url)
        skip = self.config.loader.skip_bad_shards
        known = set(self.record.shards)
        for epoch in itertools.count(1):
            path = self.out / GROWTH / f"epoch-{epoch:06d}.json"
            if not path.exists():
                reader.refresh()
                new, _ = read_scenes(reader, sorted({*reader.committed} - known), skip=skip)
                complete = len(known | set(new)) == n_shards(reader.card)
                _write_once(path, {"shards": sorted(new), "complete": complete})
            found = json.loads(path.read_text())
            scene_of = self._scenes(reader, found["shards"])
            known |= set(scene_of)
            yield self._divide(scene_of)[0].rows
            if found["complete"]:
                return

    def joined(self) -> set[int]:
        """Shards that have joined in epochs begun so far."""
        begun = (self.out / GROWTH).glob("epoch-*.json")
        return {shard for path in begun for shard in json.loads(path.read_text())["shards"]}

    def validation_rows(self, url: str, shards: Collection[int]) -> tuple[set[int], dict[int, Array]]:
        """Those of some shards that can be read, and their held-out rows by shard.

        Raises:
            ShardError: As `epochs`.
        """
        scene_of = self._scenes(ShardReader(url), sorted(shards))
        return set(scene_of), self._divide(scene_of)[1].rows

    def _scenes(self, reader: ShardReader, shards: list[int]) -> dict[int, Array]:
        if set(shards) - {*reader.committed}:
            reader.refresh()
        skip, objects = self.config.loader.skip_bad_shards, self.config.objects
        return read_scenes(reader, shards, skip=skip, objects=objects)[0]

    def _divide(self, scene_of: Mapping[int, Array]) -> tuple[Split, Split]:
        drawn = drawn_out(scenes_in(scene_of), self.config.validation.scene_fraction, self.config.seed)
        return divide(scene_of, np.union1d(self.record.validation_scenes, drawn))


def wait_for_dataset(url: str) -> None:
    """Wait until whoever renders a dataset has begun it.

    Raises:
        StorageError: A file stands in its place.
    """
    store, told = open_store(url), False
    while store.get(GROUP) is None:
        store.list_names()  # raises for a file, in which nothing will ever be
        if not told:
            log.warning("%s: no dataset here yet, waiting for one; Ctrl-C ends that", url)
            told = True
        time.sleep(POLL_S)


def wait_for_start(reader: ShardReader, config: TrainConfig, wanted: int) -> None:
    """Wait until a growing dataset has enough to begin with, or all it will ever have.

    That is a number of shards to train on, one for each loader process, and a scene that is held out.

    Raises:
        ShardError: A shard cannot be read and `loader.skip_bad_shards` is off.
    """
    scene_of: dict[int, Array] = {}
    told = ""
    while not reader.complete:
        new = sorted({*reader.committed} - set(scene_of))
        scene_of |= read_scenes(reader, new, skip=config.loader.skip_bad_shards, objects=config.objects)[0]
        drawn = drawn_out(scenes_in(scene_of), config.validation.scene_fraction, config.seed)
        training, held = divide(scene_of, drawn)
        if len(training.rows) >= wanted and held.scenes:
            return
        lacking = f"{len(training.rows)} of {wanted} shards to train on, {held.scenes} of 1 scene to hold out"
        if lacking != told:
            log.warning("%s: waiting, there are %s", reader.url, lacking)
            told = lacking
        time.sleep(POLL_S)
        reader.refresh()


def _write_once(path: Path, content: Mapping[str, object]) -> None:
    """Write a JSON file whole, unless another process has done so."""
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
