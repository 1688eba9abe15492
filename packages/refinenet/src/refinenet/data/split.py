"""Split of a dataset into training and validation, by scene.

A run fixes at its start, in `data.json`, which scenes are for validation and which shards it begins with.
"""

import itertools
import json
import shutil
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from posecore.errors import ShardError
from posecore.files import write_atomic
from posecore.shard import ShardReader

from refinenet.models.checkpoint_schema import SplitRecord, read_record

ORDER, SHUFFLE, SAMPLE, SPLIT, STAND_IN, ON_POLICY = range(6)
"""First key of each random stream, so that no two streams of a run share draws."""

RECORD, GROWTH = "data.json", "growth"
OTHER_OBJECT = -1
"""Scene number of samples whose object is not trained on."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Split:
    """Rows of every shard that belong to one side of the split.

    Attributes:
        rows: row numbers by shard; shards without a row are left out.
        scenes: number of scenes.
    """

    rows: dict[int, np.ndarray]
    scenes: int

    @property
    def n(self) -> int:
        """Number of samples."""
        return sum(len(rows) for rows in self.rows.values())


@dataclass(frozen=True, kw_only=True)
class DataRecord:
    """Split that a run fixed when it started.

    Attributes:
        shards: shards that were there.
        validation_scenes: scenes that are never trained on.
    """

    shards: tuple[int, ...]
    validation_scenes: tuple[int, ...]

    def save(self, out: Path) -> None:
        """Write the record into a run's folder, and remove an earlier run's files of a growing dataset.

        Raises:
            StorageError: No rights or no space.
        """
        shutil.rmtree(out / GROWTH, ignore_errors=True)
        text = json.dumps({"shards": self.shards, "validation_scenes": self.validation_scenes})
        write_atomic(out / RECORD, text.encode())

    @classmethod
    def load(cls, out: Path) -> "DataRecord":
        """Read the record from a run's folder.

        Raises:
            CheckpointError: It is missing or damaged.
        """
        record = read_record(out / RECORD, SplitRecord)
        return cls(shards=tuple(record["shards"]), validation_scenes=tuple(record["validation_scenes"]))


def read_scenes(
    reader: ShardReader, shards: Sequence[int], *, skip: bool = False, objects: Sequence[int] = ()
) -> tuple[dict[int, np.ndarray], dict[int, str]]:
    """Scene of every sample by shard, and the error of each shard that cannot be read.

    Samples of objects outside `objects` have scene `OTHER_OBJECT`.

    Args:
        reader: The dataset.
        shards: Shards to read.
        skip: Continue without shards that cannot be read.
        objects: Ids to keep; empty keeps all.

    Raises:
        ShardError: A shard cannot be read and `skip` is off.
    """
    scenes, bad = {}, {}
    for shard in shards:
        try:
            read = reader.read_checked(shard, ["scene_index", "obj_id"] if objects else ["scene_index"])
        except ShardError as error:
            if not skip:
                raise
            bad[shard] = str(error)
            continue
        index = read["scene_index"].astype(np.int64)
        scenes[shard] = np.where(np.isin(read["obj_id"], objects), index, OTHER_OBJECT) if objects else index
    return scenes, bad


def choose_validation_scenes(
    url: str, scene_of: Mapping[int, np.ndarray], fraction: float, seed: int, *, growing: bool = False
) -> np.ndarray:
    """Scenes for validation, at least one.

    Args:
        url: Dataset, for messages.
        scene_of: Scene of every sample by shard.
        fraction: Fraction of the scenes.
        seed: Seed of the choice.
        growing: Use `draw_validation_scenes`, which needs no complete list of scenes, unless one side would be empty.

    Raises:
        ShardError: There is no shard, or fewer than two scenes.
    """
    if not scene_of:
        raise ShardError(f"{url}: no finished shard; let `synthgen render` write one first, or wait with --follow")
    scenes = scenes_in(scene_of)
    if len(scenes) < 2:
        raise ShardError(
            f"{url}: {len(scenes)} scene, expected at least 2 to keep one for validation; render more samples, or cut "
            "with a smaller images_per_scene"
        )
    if growing and 0 < len(drawn := draw_validation_scenes(scenes, fraction, seed)) < len(scenes):
        return drawn
    count = max(1, min(len(scenes) - 1, round(fraction * len(scenes))))
    return np.asarray(np.random.default_rng([seed, SPLIT]).permutation(scenes)[:count])


def draw_validation_scenes(scenes: np.ndarray, fraction: float, seed: int) -> np.ndarray:
    """Validation scenes of a growing dataset: each is drawn independently, with probability `fraction`."""
    draws = [np.random.default_rng([seed, SPLIT, int(scene)]).random() for scene in scenes]
    return np.asarray(scenes[np.array(draws) < fraction])


def divide(scene_of: Mapping[int, np.ndarray], validation_scenes: Sequence[int] | np.ndarray) -> tuple[Split, Split]:
    """Samples for training and for validation."""
    is_validation = np.isin(scenes_in(scene_of), validation_scenes)

    def side(validation: bool) -> Split:
        rows = {
            s: np.flatnonzero((index != OTHER_OBJECT) & (np.isin(index, validation_scenes) == validation))
            for s, index in scene_of.items()
        }
        scenes = int((is_validation == validation).sum())
        return Split(rows={s: r for s, r in rows.items() if len(r)}, scenes=scenes)

    return side(False), side(True)


def scenes_in(scene_of: Mapping[int, np.ndarray]) -> np.ndarray:
    """Numbers of the scenes that samples belong to, sorted."""
    scenes = np.unique(np.concatenate([np.array([], np.int64), *scene_of.values()]))
    return np.asarray(scenes[scenes != OTHER_OBJECT])


def spread_rows(split: Split, count: int) -> Split:
    """At most `count` rows, spread evenly over the split."""
    keys = [(shard, row) for shard, rows in sorted(split.rows.items()) for row in rows]
    chosen = [keys[i] for i in np.unique(np.linspace(0, len(keys) - 1, min(count, len(keys))).astype(int))]
    by_shard = itertools.groupby(chosen, key=lambda key: key[0])
    return Split(rows={shard: np.array([row for _, row in rows]) for shard, rows in by_shard}, scenes=split.scenes)
