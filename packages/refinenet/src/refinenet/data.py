"""Streaming of shards: whole shards in shuffled order, samples shuffled within a group of shards, batches of tensors.

Which sample comes when is a pure function of (seed, epoch, rank, worker), worked out before anything is read. So a
run resumes in the middle of an epoch by arithmetic, and a pair's pose does not depend on the number of workers.
"""

import itertools
import os
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import cv2
import numpy as np
import torch
from jaxtyping import Int
from posecore.errors import ConfigError, PoseError, ShardError
from posecore.raster import Rasteriser
from posecore.shard import ShardReader
from torch import Tensor
from torch.utils.data import DataLoader, IterableDataset, get_worker_info

from refinenet.config import AugmentConfig, HypothesisConfig, TrainConfig
from refinenet.hypothesis import PairArrays, PairMaker
from refinenet.loss import Target
from refinenet.network import Pair
from refinenet.objects import load_meshes
from refinenet.stored import STORED_FIELDS, stored_pairs

Array = np.ndarray
RECUT_FIELDS = (
    "scene_rgb", "scene_mask", "scene_contour_cam_m", "T_cam_obj", "T_cam_obj_hypothesis", "K", "window_px", "obj_id",
)  # fmt: skip
ORDER, SHUFFLE, SAMPLE, SPLIT = range(4)
"""First key of each random stream, so that no two streams of a run share draws."""


class Batch(NamedTuple):
    """What a step consumes; `sample_ids` holds shard and row of every pair."""

    pair: Pair
    target: Target
    sample_ids: Int[Tensor, "b 2"]

    def to(self, device: torch.device) -> "Batch":
        """The same on another device."""
        pair, target = Pair(*(x.to(device) for x in self.pair)), Target(*(x.to(device) for x in self.target))
        return Batch(pair, target, self.sample_ids)


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


def split_by_scene(reader: ShardReader, validation_share: float, seed: int) -> tuple[Split, Split]:
    """Divide a dataset's samples into training and validation by scene, never by sample.

    Args:
        reader: The dataset.
        validation_share: Share of scenes held out, at least one.
        seed: Of the choice.

    Raises:
        ShardError: No shard is there, or fewer than two scenes.
    """
    if not reader.committed:
        raise ShardError(f"{reader.url}: no finished shard; let `synthgen render` write one first")
    scene_of = {shard: reader.read(shard, ["scene_index"])["scene_index"] for shard in reader.committed}
    scenes = np.unique(np.concatenate(list(scene_of.values())))
    if len(scenes) < 2:
        raise ShardError(f"{reader.url}: {len(scenes)} scene, expected at least 2 to hold one out; render more samples")
    held = max(1, min(len(scenes) - 1, round(validation_share * len(scenes))))
    validation = np.random.default_rng([seed, SPLIT]).permutation(scenes)[:held]

    def side(inside: bool, count: int) -> Split:
        rows = {s: np.flatnonzero(np.isin(index, validation) == inside) for s, index in scene_of.items()}
        return Split(rows={s: r for s, r in rows.items() if len(r)}, scenes=count)

    return side(False, len(scenes) - held), side(True, held)


def spread_rows(split: Split, count: int) -> Split:
    """At most `count` rows, spread evenly over the split."""
    keys = [(shard, row) for shard, rows in sorted(split.rows.items()) for row in rows]
    chosen = [keys[i] for i in np.unique(np.linspace(0, len(keys) - 1, min(count, len(keys))).astype(int))]
    by_shard = itertools.groupby(chosen, key=lambda key: key[0])
    return Split(rows={shard: np.array([row for _, row in rows]) for shard, rows in by_shard}, scenes=split.scenes)


class PairSource:
    """Turns rows of shards into batches of tensors; opened in the process that uses it."""

    def __init__(self, url: str, config: TrainConfig, *, training: bool) -> None:
        self.reader = ShardReader(url)
        self._config = config
        self._object_index = {obj_id: i for i, obj_id in enumerate(sorted(int(k) for k in self.reader.card["objects"]))}
        self._augment = config.augment if training else AugmentConfig()
        self._cache: dict[int, dict[str, Array]] = {}
        self._rasteriser: Rasteriser | None = None
        if config.window.kind == "diameter":
            meshes = load_meshes(self.reader)
            self._rasteriser = Rasteriser(meshes)
            self._make = PairMaker(
                meshes=meshes,
                rasteriser=self._rasteriser,
                patch_px=config.network.patch_px,
                window_scale=config.window.scale,
                contour_points=config.loss.contour_points,
                hypothesis=config.hypothesis if training else _steady(config),
                augment_config=self._augment,
            )

    def close(self) -> None:
        """Free what the rasteriser holds."""
        if self._rasteriser is not None:
            self._rasteriser.close()

    def load(self, shards: Sequence[int]) -> dict[int, dict[str, Array]]:
        """Read whole shards, only the fields that are used."""
        fields = RECUT_FIELDS if self._rasteriser is not None else STORED_FIELDS
        read = {shard: self._cache.get(shard) or self.reader.read(shard, fields) for shard in shards}
        room = self._config.loader.cache_mb * 2**20 - sum(map(_bytes, self._cache.values()))
        for shard, arrays in read.items():
            # What is in stays in: replacing the oldest would miss every time when an epoch does not fit.
            if shard not in self._cache and _bytes(arrays) <= room:
                self._cache[shard] = arrays
                room -= _bytes(arrays)
        return read

    def batch(self, keys: Sequence[tuple[int, int, int]], samples: Sequence[dict[str, Any]]) -> Batch | None:
        """Pairs of these samples; None when no object can be seen in any.

        Args:
            keys: (epoch, shard, row) of each, which seed its draws.
            samples: As many rows.
        """
        rngs = [np.random.default_rng([self._config.seed, SAMPLE, *key]) for key in keys]
        if self._rasteriser is None:
            arrays: PairArrays | None = stored_pairs(samples, rngs, self._config, self._augment, self.reader.url)
        else:
            arrays = self._make(samples, rngs)
        if arrays is None:
            return None
        return _tensors(arrays, [keys[i][1:] for i in arrays.kept], self._object_index)


def _bytes(arrays: dict[str, Array]) -> int:
    return sum(values.nbytes for values in arrays.values())


def _steady(config: TrainConfig) -> HypothesisConfig:
    """Hypotheses for validation: over the whole range, scenes as they are."""
    return replace(config.hypothesis, easy_share=0.0, in_plane=False)


def _tensors(arrays: PairArrays, ids: Sequence[tuple[int, int]], object_index: dict[int, int]) -> Batch:
    def image(rgb: Array) -> Tensor:
        return torch.from_numpy(np.ascontiguousarray(rgb.transpose(0, 3, 1, 2)))

    def real(values: Array) -> Tensor:
        return torch.from_numpy(np.ascontiguousarray(values, dtype=np.float32))

    start, K_crop = real(arrays.T_cam_obj_hypothesis), real(arrays.K_crop)
    target = Target(
        T_cam_obj=real(arrays.T_cam_obj),
        T_cam_obj_hypothesis=start,
        K_crop=K_crop,
        scene_contour_m=real(arrays.scene_contour_m),
        hypothesis_contour_m=real(arrays.hypothesis_contour_m),
        scene_distance_px=real(arrays.scene_distance_px),
        hypothesis_distance_px=real(arrays.hypothesis_distance_px),
        object_index=torch.tensor([object_index[int(i)] for i in arrays.obj_id]),
    )
    pair = Pair(image(arrays.scene_rgb), image(arrays.hypothesis_rgb), start, K_crop)
    return Batch(pair, target, torch.tensor(np.array(ids, np.int64)))


@dataclass(frozen=True, kw_only=True)
class PairStream(IterableDataset[Batch]):
    """Endless training batches, of this rank, from batch `start` on.

    Attributes:
        url: Dataset.
        config: Decides seed, batch, shuffling and how pairs are made.
        split: Rows to train on.
        rank: This process among `world`; ranks and workers take disjoint shards within an epoch.
        world: Number of training processes.
        workers: Number of loader streams of each rank, at least 1.
        start: Batches of this rank that were consumed before.
    """

    url: str
    config: TrainConfig
    split: Split
    rank: int = 0
    world: int = 1
    workers: int = 1
    start: int = 0

    def __post_init__(self) -> None:
        slots = self.world * self.workers
        if len(self.split.rows) < slots:
            raise ConfigError(
                f"loader.workers: {len(self.split.rows)} shards for {self.world} x {self.workers} loader processes, "
                f"expected one each; lower loader.workers, or render with a smaller shard size"
            )

    def groups(self, slot: int) -> Iterator[list[tuple[int, int, int]]]:
        """Shuffled groups of (epoch, shard, row) of one of `world * workers` slots, without end."""
        seed, size = self.config.seed, self.config.loader.shuffle_shards
        for epoch in itertools.count():
            order = np.random.default_rng([seed, ORDER, epoch]).permutation(sorted(self.split.rows))
            mine = order[slot :: self.world * self.workers]
            for first in range(0, len(mine), size):
                keys = [(epoch, int(s), int(r)) for s in mine[first : first + size] for r in self.split.rows[int(s)]]
                shuffle = np.random.default_rng([seed, SHUFFLE, epoch, slot, first]).permutation(len(keys))
                yield [keys[i] for i in shuffle]

    def __iter__(self) -> Iterator[Batch]:
        """Batches of one worker; workers interleave, so worker k of w holds every w-th batch."""
        info = get_worker_info()
        position = 0 if info is None else info.id
        # After a resume the loader starts with its worker 0 again, which then stands in for the one whose turn it was.
        worker = (position + self.start) % self.workers
        done = len(range(worker, self.start, self.workers))
        source = PairSource(self.url, self.config, training=True)
        try:
            yield from self._batches(source, self.rank * self.workers + worker, done * self.config.batch)
        finally:
            source.close()

    def _batches(self, source: PairSource, slot: int, skip: int) -> Iterator[Batch]:
        keys: list[tuple[int, int, int]] = []
        samples: list[dict[str, Any]] = []
        for group in self.groups(slot):
            if skip >= len(group):
                skip -= len(group)
                continue
            group, skip = group[skip:], 0
            arrays = source.load(sorted({shard for _, shard, _ in group}))
            for epoch, shard, row in group:
                keys.append((epoch, shard, row))
                samples.append({name: values[row] for name, values in arrays[shard].items()})
                if len(keys) == self.config.batch:
                    batch = source.batch(keys, samples)
                    keys, samples = [], []
                    if batch is None:
                        raise ShardError(f"{self.url}: no object can be seen in any of {self.config.batch} samples")
                    yield batch


def prepare_worker(threads: int = 1) -> None:
    """Keep a loader process to its own core: the software rasteriser, OpenCV and torch each start threads for all."""
    os.environ["LP_NUM_THREADS"] = str(threads)
    cv2.setNumThreads(threads)
    torch.set_num_threads(threads)


def _init_worker(_: int) -> None:
    prepare_worker()


class _Loader(DataLoader[Batch]):
    """A loader whose processes' errors arrive as they were raised, not wrapped with a traceback into the message."""

    def __iter__(self) -> Any:
        try:
            yield from super().__iter__()
        except PoseError as error:
            *wrapped, last = str(error).strip().splitlines()
            raise (type(error)(last.partition(": ")[2]) if wrapped else error) from None


def make_loader(stream: PairStream) -> DataLoader[Batch]:
    """A loader of the stream's batches; processes are spawned, since a GL context does not survive a fork."""
    loader = stream.config.loader
    if loader.workers == 0:
        return _Loader(stream, batch_size=None)
    return _Loader(
        stream,
        batch_size=None,
        num_workers=stream.workers,
        prefetch_factor=loader.prefetch,
        multiprocessing_context="spawn",
        worker_init_fn=_init_worker,
    )


def validation_batches(source: PairSource, split: Split, batch: int) -> Iterator[Batch]:
    """Batches of a split in the order of its rows, the same at every call."""
    for shard, rows in sorted(split.rows.items()):
        arrays = source.load([shard])[shard]
        for first in range(0, len(rows), batch):
            chosen = rows[first : first + batch]
            samples = [{name: values[row] for name, values in arrays.items()} for row in chosen]
            made = source.batch([(0, shard, int(row)) for row in chosen], samples)
            if made is not None:
                yield made
