"""Validation pairs: made once and kept, so that every validation uses the same pairs."""

from collections.abc import Collection, Iterator, Sequence
from typing import Any

import numpy as np
from posecore.errors import ShardError

from refinenet.batch import Batch
from refinenet.config import TrainConfig
from refinenet.data.growing_split import GrowingSplit
from refinenet.data.pair_stream import PairSource
from refinenet.data.split import Split, spread_rows


class ValidationSet:
    """Validation pairs of a run; once they are made, no GL context stays open.

    More pairs of a growing dataset join, until there are as many as configured.

    Args:
        url: Shard dataset.
        config: Configuration of the run.
        split: Validation rows of the shards that the run began with.
        growing: Shards that have joined since; None for a complete dataset.
        joined: Shards that had joined when a resumed run was saved.

    Attributes:
        batches: Batches of pairs.
        joined: Shards that have joined since the run began.
        skipped: Errors of shards that cannot be read.

    Raises:
        ShardError: No pair can be read.
    """

    def __init__(
        self, url: str, config: TrainConfig, split: Split, growing: GrowingSplit | None, joined: Collection[int] = ()
    ) -> None:
        self._url, self._config, self._growing = url, config, growing
        self._rows: dict[int, np.ndarray] = dict(split.rows)
        self.joined: set[int] = set()
        self.batches: list[Batch] = []
        self.skipped: tuple[str, ...] = ()
        self._add(joined)
        self._make()

    def grow(self) -> bool:
        """Add pairs of shards that have joined; whether there were any: errors before and after are not comparable.

        Raises:
            ShardError: A shard that joined cannot be read.
        """
        if self._growing is None or sum(map(len, self._rows.values())) >= self._config.validation.pairs:
            return False
        grown = self._add(self._growing.joined() - self.joined)
        if grown:
            self._make()
        return grown

    def _add(self, shards: Collection[int]) -> bool:
        """Add these shards; whether they have validation rows."""
        if self._growing is None or not shards:
            return False
        read, rows = self._growing.validation_rows(self._url, shards)
        self.joined |= read
        self._rows |= rows
        return bool(rows)

    def _make(self) -> None:
        source = PairSource(self._url, self._config, training=False)
        try:
            chosen = spread_rows(Split(rows=self._rows, scenes=0), self._config.validation.pairs)
            self.batches = list(validation_batches(source, chosen, self._config.batch))
        finally:
            source.close()
        if not self.batches:
            raise ShardError(f"{self._url}: no validation pair can be read; render its damaged shards again")
        self.skipped = tuple(message for batch in self.batches for message in batch.skipped)


def validation_batches(source: PairSource, split: Split, batch: int) -> Iterator[Batch]:
    """Batches of a split in the order of its rows, the same at every call."""
    keys: list[tuple[int, int, int]] = []
    samples: list[dict[str, Any]] = []
    for shard, rows in sorted(split.rows.items()):
        arrays = source.load([shard]).get(shard, {})
        for row in rows if arrays else ():
            keys.append((0, shard, int(row)))
            # copies, so that the shard need not stay in memory for a few rows
            samples.append({name: values[row].copy() for name, values in arrays.items()})
            if len(keys) == batch:
                yield from _made(source, keys, samples)
                keys, samples = [], []
    if keys:
        yield from _made(source, keys, samples)


def _made(
    source: PairSource, keys: Sequence[tuple[int, int, int]], samples: Sequence[dict[str, Any]]
) -> Iterator[Batch]:
    """The batch of these samples; none when no object is visible."""
    made = source.batch(keys, samples)
    if made is not None:
        yield made
