"""Which samples are trained on and which are held out, by scene.

A run fixes at its start which scenes are held out and which shards it begins with, in `data.json`.
"""

import itertools
import json
import shutil
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from posecore.errors import CheckpointError, ShardError
from posecore.files import write_atomic
from posecore.shard import ShardReader

from refinenet.models.migration import migrated_record

Array = np.ndarray
ORDER, SHUFFLE, SAMPLE, SPLIT, STAND_IN, OWN = range(6)
"""First key of each random stream, so that no two streams of a run share draws."""

RECORD, GROWTH = "data.json", "growth"
OTHER_OBJECT = -1  # in place of a scene, for samples of objects that are not trained on


@dataclass(frozen=True, kw_only=True, eq=False)
class Split:
    """Rows of every shard that belong to one side of the split by scene.

    Attributes:
        rows: row numbers by shard; shards without a row are left out.
        scenes: how many scenes.
    """

    rows: dict[int, Array]
    scenes: int

    @property
    def n(self) -> int:
        """Number of samples."""
        return sum(len(rows) for rows in self.rows.values())


@dataclass(frozen=True, kw_only=True)
class DataRecord:
    """What a run fixed about its data when it started.

    Attributes:
        shards: shards that were there.
        validation_scenes: scenes that are validated on and never trained on.
    """

    shards: tuple[int, ...]
    validation_scenes: tuple[int, ...]

    def save(self, out: Path) -> None:
        """Write it into a run's folder, and drop what an earlier run left of a growing dataset.

        Raises:
            StorageError: No rights or no space.
        """
        shutil.rmtree(out / GROWTH, ignore_errors=True)
        text = json.dumps({"shards": self.shards, "validation_scenes": self.validation_scenes})
        write_atomic(out / RECORD, text.encode())

    @classmethod
    def load(cls, out: Path) -> "DataRecord":
        """Read it from a run's folder.

        Raises:
            CheckpointError: It is missing or damaged.
        """
        try:
            record = migrated_record(json.loads((out / RECORD).read_text()))
            return cls(shards=tuple(record["shards"]), validation_scenes=tuple(record["validation_scenes"]))
        except (OSError, ValueError, KeyError, TypeError) as error:
            raise CheckpointError(
                f"{out / RECORD}: missing or damaged ({type(error).__name__}), so nobody knows which scenes this run "
                "held out; start a new run in another --out"
            ) from error


def read_scenes(
    reader: ShardReader, shards: Sequence[int], *, skip: bool = False, objects: Sequence[int] = ()
) -> tuple[dict[int, Array], dict[int, str]]:
    """Scene of every sample by shard, and what is wrong with the shards that cannot be read.

    Samples of other objects than those asked for have `OTHER_OBJECT`.

    Args:
        reader: The dataset.
        shards: Which shards.
        skip: Whether to go on without shards that cannot be read.
        objects: Ids to keep; empty keeps all.

    Raises:
        ShardError: One cannot be read and `skip` is off.
    """
    scenes, bad = {}, {}
    for shard in shards:
        try:
            read = reader.read(shard, ["scene_index", "obj_id"] if objects else ["scene_index"])
        except ShardError as error:
            if not skip:
                raise
            bad[shard] = str(error)
            continue
        index = read["scene_index"].astype(np.int64)
        scenes[shard] = np.where(np.isin(read["obj_id"], objects), index, OTHER_OBJECT) if objects else index
    return scenes, bad


def validation_scenes(
    url: str, scene_of: Mapping[int, Array], share: float, seed: int, *, growing: bool = False
) -> Array:
    """Scenes to hold out, at least one.

    Args:
        url: Of the dataset, for messages.
        scene_of: Scene of every sample by shard.
        share: Of the scenes.
        seed: Of the choice.
        growing: Take those that `drawn_out` says, which does not ask for all scenes at once; where that leaves nothing
            on one side, as of a complete dataset.

    Raises:
        ShardError: No shard is there, or fewer than two scenes.
    """
    if not scene_of:
        raise ShardError(f"{url}: no finished shard; let `synthgen render` write one first, or wait with --follow")
    scenes = scenes_in(scene_of)
    if len(scenes) < 2:
        raise ShardError(
            f"{url}: {len(scenes)} scene, expected at least 2 to hold one out; render more samples, or cut with a "
            "smaller images_per_scene"
        )
    if growing and 0 < len(drawn := drawn_out(scenes, share, seed)) < len(scenes):
        return drawn
    held = max(1, min(len(scenes) - 1, round(share * len(scenes))))
    return np.asarray(np.random.default_rng([seed, SPLIT]).permutation(scenes)[:held])


def drawn_out(scenes: Array, share: float, seed: int) -> Array:
    """Scenes of a growing dataset that are held out: each is drawn by itself, with probability `share`."""
    draws = [np.random.default_rng([seed, SPLIT, int(scene)]).random() for scene in scenes]
    return np.asarray(scenes[np.array(draws) < share])


def divide(scene_of: Mapping[int, Array], held_out: Sequence[int] | Array) -> tuple[Split, Split]:
    """Samples for training and for validation."""
    held = np.isin(scenes_in(scene_of), held_out)

    def side(inside: bool) -> Split:
        rows = {
            s: np.flatnonzero((index != OTHER_OBJECT) & (np.isin(index, held_out) == inside))
            for s, index in scene_of.items()
        }
        return Split(rows={s: r for s, r in rows.items() if len(r)}, scenes=int((held == inside).sum()))

    return side(False), side(True)


def scenes_in(scene_of: Mapping[int, Array]) -> Array:
    """Numbers of the scenes that samples belong to."""
    found = np.unique(np.concatenate([np.array([], np.int64), *scene_of.values()]))
    return np.asarray(found[found != OTHER_OBJECT])


def spread_rows(split: Split, count: int) -> Split:
    """At most `count` rows, spread evenly over the split."""
    keys = [(shard, row) for shard, rows in sorted(split.rows.items()) for row in rows]
    chosen = [keys[i] for i in np.unique(np.linspace(0, len(keys) - 1, min(count, len(keys))).astype(int))]
    by_shard = itertools.groupby(chosen, key=lambda key: key[0])
    return Split(rows={shard: np.array([row for _, row in rows]) for shard, rows in by_shard}, scenes=split.scenes)
