"""Streaming of shards: whole shards in shuffled order, samples shuffled within a group of shards, batches of tensors.

The order of samples is a pure function of (seed, epoch, rank, worker), computed before anything is read: a run resumes
in the middle of an epoch by arithmetic, and a pair's pose does not depend on the number of workers.
"""

import itertools
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import torch
from posecore.errors import ConfigError, ShardError
from posecore.raster import Rasteriser
from posecore.shard import ShardReader, load_meshes
from torch import Tensor
from torch.utils.data import IterableDataset, get_worker_info

from refinenet.batch import Batch, LossTarget, NetworkInput
from refinenet.config import AugmentConfig, HypothesisConfig, TrainConfig
from refinenet.data.growing_split import GrowingSplit
from refinenet.data.objects import for_patches, load_models, pivot_frames, symmetries_of
from refinenet.data.online_pairs import OnlinePairMaker, PairArrays
from refinenet.data.precomputed_pairs import PRECOMPUTED_FIELDS, precomputed_pairs
from refinenet.data.split import ORDER, SAMPLE, SHUFFLE, STAND_IN, Split
from refinenet.image.crops import fixed_sides_px

ONLINE_FIELDS = (
    "scene_rgb", "scene_mask", "scene_contour_cam_m", "T_cam_obj", "T_cam_obj_hypothesis", "K", "window_px", "obj_id",
)  # fmt: skip


class PairSource:
    """Source of batches of tensors from rows of shards; opened in the process that uses it.

    Attributes:
        reader: Dataset.
        frames: Frames of the pivots, which poses in batches are of.
    """

    def __init__(self, url: str, config: TrainConfig, *, training: bool) -> None:
        self.reader = ShardReader(url)
        self._config = config
        if config.window.kind == "fixed" and self.reader.card.get("windows", "fixed") != "fixed":
            raise ConfigError(
                f"{url}: windows differ in side between poses of an object, preset {config.preset} expects fixed ones; "
                "cut pairs with --set window=fixed, and merge only datasets with the same windows"
            )
        self._object_index = {obj_id: i for i, obj_id in enumerate(sorted(int(k) for k in self.reader.card["objects"]))}
        self._augment = config.augment if training else AugmentConfig()
        self._cache_mb = config.loader.cache_mb if training else 0  # validation reads each shard once
        self._cache: dict[int, dict[str, np.ndarray]] = {}
        self._bad: dict[int, str] = {}
        self._unreported: list[str] = []
        self._rasteriser: Rasteriser | None = None
        self.frames = pivot_frames(load_meshes(self.reader), config.pivot)
        if config.makes_pairs_online:
            meshes = self.frames.meshes
            models = self.frames.models(load_models(self.reader))
            self._rasteriser = Rasteriser(for_patches(meshes))
            self._make = OnlinePairMaker(
                meshes=meshes,
                rasteriser=self._rasteriser,
                patch_px=config.network.patch_px,
                window=config.window,
                fixed_sides_px=fixed_sides_px(self.reader.card["objects"]) if config.window.kind == "fixed" else None,
                contour_points=config.loss.contour_points,
                hypothesis=config.hypothesis if training else _validation_hypotheses(config),
                augment_config=self._augment,
                symmetries=symmetries_of(meshes, models, config.loss.symmetry_step_deg),
            )

    def close(self) -> None:
        """Free the rasteriser."""
        if self._rasteriser is not None:
            self._rasteriser.close()

    def load(self, shards: Sequence[int]) -> dict[int, dict[str, np.ndarray]]:
        """Read whole shards, only the fields that are used.

        With `loader.skip_bad_shards`, unreadable shards are left out, and reported with the next batch.

        Raises:
            ShardError: A shard cannot be read or a sample cannot be used, without that setting.
        """
        fields: tuple[str, ...] = ONLINE_FIELDS if self._rasteriser is not None else PRECOMPUTED_FIELDS
        if self._rasteriser is None and (self._config.network.confidence or self._config.network.uses_depth):
            fields += ("hypothesis_depth_m",)
        if set(shards) - {*self.reader.committed}:
            self.reader.refresh()
        read: dict[int, dict[str, np.ndarray]] = {}
        for shard in shards:
            try:
                read[shard] = self._cache.get(shard) or self._about_pivots(self.reader.read_checked(shard, fields))
            except ShardError as error:
                if not self._config.loader.skip_bad_shards:
                    raise
                if shard not in self._bad:
                    self._bad[shard] = str(error)
                    self._unreported.append(str(error))
        room = self._cache_mb * 2**20 - sum(map(_bytes, self._cache.values()))
        for shard, arrays in read.items():
            # Cached shards stay: replacing the oldest would miss every time when an epoch does not fit.
            if shard not in self._cache and _bytes(arrays) <= room:
                self._cache[shard] = arrays
                room -= _bytes(arrays)
        return read

    def batch(self, keys: Sequence[tuple[int, int, int]], samples: Sequence[dict[str, Any]]) -> Batch | None:
        """Pairs of these samples; None when no object is visible.

        Args:
            keys: (epoch, shard, row) of each sample, the seed of its draws.
            samples: As many rows.
        """
        rngs = [np.random.default_rng([self._config.seed, SAMPLE, *key]) for key in keys]
        if self._rasteriser is None:
            arrays: PairArrays | None = precomputed_pairs(samples, rngs, self._config, self._augment, self.reader.url)
        else:
            arrays = self._make(samples, rngs)
        if arrays is None:
            return None
        if not self._config.network.uses_depth:
            arrays = replace(arrays, hypothesis_depth_m=None)
        batch = _tensors(arrays, [keys[i][1:] for i in arrays.kept], self._object_index)
        skipped, self._unreported = tuple(self._unreported), []
        return batch._replace(skipped=skipped)

    def _about_pivots(self, arrays: dict[str, np.ndarray]) -> dict[str, np.ndarray]:
        """A shard's arrays with poses of the pivots; shards hold poses of the objects' own origins."""
        poses = ("T_cam_obj", "T_cam_obj_hypothesis")
        return arrays | {name: self.frames.poses(arrays[name], arrays["obj_id"]) for name in poses}


def _bytes(arrays: dict[str, np.ndarray]) -> int:
    return sum(values.nbytes for values in arrays.values())


def _validation_hypotheses(config: TrainConfig) -> HypothesisConfig:
    """Hypotheses for validation: over the whole range, all drawn online, without rotation of the scene."""
    return replace(config.hypothesis, easy_fraction=0.0, precomputed_fraction=0.0, in_plane=False)


def _tensors(arrays: PairArrays, ids: Sequence[tuple[int, int]], object_index: dict[int, int]) -> Batch:
    def image(rgb: np.ndarray) -> Tensor:
        return torch.from_numpy(np.ascontiguousarray(rgb.transpose(0, 3, 1, 2)))

    def real(values: np.ndarray) -> Tensor:
        return torch.from_numpy(np.ascontiguousarray(values, dtype=np.float32))

    hypothesis, K_crop = real(arrays.T_cam_obj_hypothesis), real(arrays.K_crop)
    target = LossTarget(
        T_cam_obj=real(arrays.T_cam_obj),
        T_cam_obj_hypothesis=hypothesis,
        K_crop=K_crop,
        scene_contour_m=real(arrays.scene_contour_m),
        hypothesis_contour_m=real(arrays.hypothesis_contour_m),
        scene_distance_px=real(arrays.scene_distance_px),
        hypothesis_distance_px=real(arrays.hypothesis_distance_px),
        object_index=torch.tensor([object_index[int(i)] for i in arrays.obj_id]),
        scene_bits=torch.from_numpy(np.ascontiguousarray(arrays.scene_bits)),
        visible_iou=None if arrays.visible_iou is None else real(arrays.visible_iou),
    )
    depth_m = None if arrays.hypothesis_depth_m is None else real(arrays.hypothesis_depth_m)
    inputs = NetworkInput(image(arrays.scene_rgb), image(arrays.hypothesis_rgb), hypothesis, K_crop, depth_m)
    return Batch(
        inputs, target, torch.tensor(np.array(ids, np.int64)),
        visible_fraction=real(arrays.visible_fraction), render_colours=real(arrays.render_colours),
    )  # fmt: skip


@dataclass(frozen=True, kw_only=True)
class PairStream(IterableDataset[Batch]):
    """Endless training batches, of this rank, from batch `start` on.

    Attributes:
        url: Dataset.
        config: Configuration: seed, batch, shuffling, pairs.
        split: Rows to train on.
        rank: Index of this process; ranks and workers take disjoint shards within an epoch.
        world: Number of training processes.
        workers: Number of loader streams of each rank, at least 1.
        start: Batches of this rank that were consumed before.
        growing: Source of new shards between epochs; None for a complete dataset.
    """

    url: str
    config: TrainConfig
    split: Split
    rank: int = 0
    world: int = 1
    workers: int = 1
    start: int = 0
    growing: GrowingSplit | None = None

    def __post_init__(self) -> None:
        slots = self.world * self.workers
        if len(self.split.rows) < slots:
            raise ConfigError(
                f"loader.workers: {len(self.split.rows)} shards for {self.world} x {self.workers} loader processes, "
                f"expected one each; lower loader.workers, or render with a smaller shard size"
            )

    def _epochs(self) -> Iterator[tuple[int, dict[int, np.ndarray]]]:
        """Number and rows by shard of every epoch."""
        rows = dict(self.split.rows)
        joining = iter(()) if self.growing is None else self.growing.epochs(self.url)
        for epoch in itertools.count():
            if epoch > 0:
                rows |= next(joining, {})
            yield epoch, rows

    def groups(self, slot: int) -> Iterator[list[tuple[int, int, int]]]:
        """Shuffled groups of (epoch, shard, row) for a slot among `world * workers`, without end."""
        seed, size = self.config.seed, self.config.loader.shuffle_shards
        for epoch, rows in self._epochs():
            order = np.random.default_rng([seed, ORDER, epoch]).permutation(sorted(rows))
            mine = order[slot :: self.world * self.workers]
            for first in range(0, len(mine), size):
                keys = [(epoch, int(s), int(r)) for s in mine[first : first + size] for r in rows[int(s)]]
                shuffle = np.random.default_rng([seed, SHUFFLE, epoch, slot, first]).permutation(len(keys))
                yield [keys[i] for i in shuffle]

    def __iter__(self) -> Iterator[Batch]:
        """Batches of this worker; workers interleave: worker k among w makes every w-th batch."""
        info = get_worker_info()
        position = 0 if info is None else info.id
        # After a resume the loader starts with its worker 0 again, which then replaces the next worker in turn.
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
            arrays = source.load(sorted({shard for _, shard, _ in group}))
            group, skip = self._with_stand_ins(source, group, arrays)[skip:], 0
            for epoch, shard, row in group:
                keys.append((epoch, shard, row))
                samples.append({name: values[row] for name, values in arrays[shard].items()})
                if len(keys) == self.config.batch:
                    batch = source.batch(keys, samples)
                    keys, samples = [], []
                    if batch is None:
                        raise ShardError(
                            f"{self.url}: no object is visible in {self.config.batch} samples; render other poses"
                        )
                    yield batch

    def _with_stand_ins(
        self, source: PairSource, group: list[tuple[int, int, int]], arrays: dict[int, dict[str, np.ndarray]]
    ) -> list[tuple[int, int, int]]:
        """The group, with samples of readable shards in place of samples of unreadable shards.

        Leaving these out would shift all later batches, and a run could not be resumed by arithmetic.
        """
        if all(shard in arrays for _, shard, _ in group):
            return group
        pool = [key for key in group if key[1] in arrays]
        others = iter(sorted(self.split.rows))
        while not pool:
            shard = next(others, None)
            if shard is None:
                raise ShardError(f"{self.url}: none of its shards can be read; render the dataset again")
            arrays |= source.load([shard])
            pool = [(group[0][0], shard, int(row)) for row in self.split.rows[shard] if shard in arrays]
        return [
            key
            if key[1] in arrays
            else pool[np.random.default_rng([self.config.seed, STAND_IN, *key]).integers(len(pool))]
            for key in group
        ]
