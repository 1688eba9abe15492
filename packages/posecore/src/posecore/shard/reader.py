"""Reading: shards of a dataset, complete or still growing, as arrays in physical units."""

import hashlib
import json
from collections.abc import Mapping, Sequence
from functools import cached_property
from typing import Any

import numpy as np

from posecore.errors import ShardError
from posecore.shard import sharding_codec
from posecore.shard.fields import Field, field_table
from posecore.shard.layout import (
    GROUP,
    MANIFEST,
    chunk_shape,
    n_shards,
    read_card,
    read_manifest,
    samples_in,
    shard_key,
)
from posecore.shard.sample_checks import first_fault
from posecore.store import open_store


class ShardReader:
    """Reads a dataset, complete or still growing.

    Raises:
        ShardError: Not a dataset, of another schema, or with a broken manifest.
        StorageError: The place cannot be reached or read.
    """

    def __init__(self, url: str) -> None:
        self.url = str(url)
        self._store = open_store(self.url)
        group = self._store.get(GROUP)
        if group is None:
            raise ShardError(
                f"{self.url}: no {GROUP} here, so this is not a shard dataset; make one with `synthgen render`"
            )
        self.card = read_card(self.url, group)
        self.refresh()

    def refresh(self) -> None:
        """Read the manifest again: a dataset may grow while it is read."""
        self._lines = {line["shard"]: line for line in read_manifest(self.url, self._store, self.card)}

    @property
    def n(self) -> int:
        """Samples in the complete dataset."""
        return int(self.card["n"])

    @property
    def shard_size(self) -> int:
        """Samples in every shard but the last."""
        return int(self.card["shard_size"])

    @property
    def committed(self) -> list[int]:
        """Ids of the committed shards, sorted."""
        return sorted(self._lines)

    @property
    def complete(self) -> bool:
        """Whether every shard is committed."""
        return len(self._lines) == n_shards(self.card)

    @property
    def manifest_lines(self) -> Mapping[int, Mapping[str, Any]]:
        """Lines of the manifest by shard id, sorted."""
        return {shard_id: self._lines[shard_id] for shard_id in self.committed}

    def n_samples(self, shard_id: int) -> int:
        """Samples in a shard."""
        return samples_in(self.card, shard_id)

    def require(self, *keys: str) -> None:
        """Require entries of the data card that all datasets of `synthgen` have.

        Raises:
            ShardError: One is missing.
        """
        missing = [key for key in keys if key not in self.card]
        if missing:
            raise ShardError(f"{self.url}: the data card has no {missing[0]}; make it with `synthgen render` or `cut`")

    @cached_property
    def digest(self) -> str:
        """Hash of the card and the manifest: names the dataset's content."""
        lines = json.dumps([self._lines[i] for i in sorted(self._lines)], sort_keys=True)
        return hashlib.sha256((json.dumps(self.card, sort_keys=True) + lines).encode()).hexdigest()

    def file(self, key: str) -> bytes:
        """Bytes of a further file of the dataset, such as `models/models_info.json`.

        Raises:
            ShardError: It is missing.
        """
        data = self._store.get(key)
        if data is None:
            raise ShardError(f"{self.url}/{key}: missing from the dataset; render it again")
        return data

    def read(self, shard_id: int, fields: Sequence[str] | None = None) -> dict[str, np.ndarray]:
        """Decode a whole shard, or some of its fields, into physical units.

        Every chunk is held against its CRC-32C.

        Raises:
            ShardError: Not committed, or a file is missing, of another length, or does not decode; when the whole shard
                is read, also if its SHA-256 differs.
        """
        if shard_id not in self._lines:
            raise ShardError(f"{self.url}: shard {shard_id} is not in {MANIFEST}; there are {len(self._lines)} shards")
        table = {field.name: field for field in field_table()}
        line = self._lines[shard_id]
        digest = hashlib.sha256()
        values = {}
        for name in table if fields is None else fields:
            data = self._field_bytes(table[name], shard_id, line)
            if fields is None:
                digest.update(data)
            values[name] = self._decode(table[name], shard_id, data)
        if fields is None and digest.hexdigest() != line.get("sha256"):
            first = shard_key(next(iter(table.values())), shard_id)
            raise self._changed(first, f"shard {shard_id} differs from its checksum in {MANIFEST}")
        return values

    def read_checked(self, shard_id: int, fields: Sequence[str] | None = None) -> dict[str, np.ndarray]:
        """As `read`; every sample can be used: finite numbers, poses, cameras, objects of the data card.

        Raises:
            ShardError: As `read`, or a sample cannot be used; the message names it.
        """
        values = self.read(shard_id, fields)
        fault = first_fault(values, {int(key) for key in self.card["objects"]} if "objects" in self.card else None)
        if fault is not None:
            row, reason = fault
            raise ShardError(
                f"{self.url}: shard {shard_id}, sample {shard_id * self.shard_size + row}: {reason}; delete a file of "
                "this shard and run the same `synthgen render` or `synthgen cut` again, or make the dataset anew"
            )
        return values

    def _field_bytes(self, field: Field, shard_id: int, line: Mapping[str, Any]) -> bytes:
        key = shard_key(field, shard_id)
        data, expected = self._store.get(key), line["bytes"].get(field.name)
        if data is None or len(data) != expected:
            actual = "no file" if data is None else f"{len(data)} bytes"
            raise ShardError(
                f"{self.url}/{key}: found {actual}, expected {expected} bytes; the shard is damaged: run the same "
                "`synthgen render` again, which renders damaged shards anew"
            )
        return data

    def _decode(self, field: Field, shard_id: int, data: bytes) -> np.ndarray:
        chunk, *size = chunk_shape(field, self.card)
        values = np.empty((self.n_samples(shard_id), *size), field.decoded_dtype)
        for first in range(0, len(values), chunk):
            try:
                stored = sharding_codec.unpack(data, field.codec, field.dtype, (chunk, *size), self.shard_size, first)
            except (ValueError, RuntimeError) as error:
                raise self._changed(shard_key(field, shard_id), f"does not decode ({error})") from error
            field.decode(stored[: len(values) - first], self.card, values[first : first + chunk])
        return values

    def _changed(self, key: str, what: str) -> ShardError:
        return ShardError(
            f"{self.url}/{key}: {what}; the shard is damaged: delete this file and run the same `synthgen render` "
            "again, which renders shards anew that miss one"
        )
