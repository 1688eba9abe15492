"""Pairs of held-out scenes: made once and kept, so that the same are measured every time."""

from collections.abc import Collection, Iterator, Sequence
from typing import Any

from posecore.errors import ShardError

from refinenet.batch import Batch
from refinenet.config import TrainConfig
from refinenet.data.growing_split import GrowingSplit
from refinenet.data.pair_stream import PairSource
from refinenet.data.split import Split, spread_rows


class ValidationSet:
    """The pairs that a run is measured on, without a GL context of their own once they are made.

    Of a growing dataset more of them join, until there are as many as the configuration asks for.

    Args:
        url: Shard dataset.
        config: Of the run.
        split: Held-out rows of the shards that the run began with.
        growth: Knows which shards have joined since; None where none can.
        joined: Those that had been taken in when a resumed run was saved.

    Attributes:
        batches: Of pairs.
        joined: Shards that have been taken in since the run began.
        skipped: What is wrong with shards that cannot be read.

    Raises:
        ShardError: None can be read.
    """

    def __init__(
        self, url: str, config: TrainConfig, split: Split, growth: GrowingSplit | None, joined: Collection[int] = ()
    ) -> None:
        self._url, self._config, self._growth = url, config, growth
        self._rows = dict(split.rows)
        self.joined: set[int] = set()
        self.batches: list[Batch] = []
        self.skipped: tuple[str, ...] = ()
        self._take_in(joined)
        self._make()

    def grow(self) -> bool:
        """Take in what has joined since; whether anything did, so that errors before and after do not compare.

        Raises:
            ShardError: A shard that joined cannot be read.
        """
        if self._growth is None or sum(map(len, self._rows.values())) >= self._config.validation.pairs:
            return False
        grown = self._take_in(self._growth.joined() - self.joined)
        if grown:
            self._make()
        return grown

    def _take_in(self, shards: Collection[int]) -> bool:
        """Whether any of these shards has held-out rows."""
        if self._growth is None or not shards:
            return False
        read, rows = self._growth.validation_rows(self._url, shards)
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
            raise ShardError(f"{self._url}: no held-out pair can be read; render its damaged shards again")
        self.skipped = tuple(message for batch in self.batches for message in batch.skipped)


def validation_batches(source: PairSource, split: Split, batch: int) -> Iterator[Batch]:
    """Batches of a split in the order of its rows, the same at every call."""
    keys: list[tuple[int, int, int]] = []
    samples: list[dict[str, Any]] = []
    for shard, rows in sorted(split.rows.items()):
        arrays = source.load([shard]).get(shard, {})
        for row in rows if arrays else ():
            keys.append((0, shard, int(row)))
            # copies, so that the shard need not stay in memory for the few rows of it that are measured
            samples.append({name: values[row].copy() for name, values in arrays.items()})
            if len(keys) == batch:
                yield from _made(source, keys, samples)
                keys, samples = [], []
    if keys:
        yield from _made(source, keys, samples)


def _made(
    source: PairSource, keys: Sequence[tuple[int, int, int]], samples: Sequence[dict[str, Any]]
) -> Iterator[Batch]:
    """The batch of these samples; none when no object can be seen in any."""
    made = source.batch(keys, samples)
    if made is not None:
        yield made
