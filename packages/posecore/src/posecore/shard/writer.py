"""Writing: create a dataset, encode shards in any process, commit them in one."""

import hashlib
import json
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from posecore.errors import ShardError
from posecore.shard import sharding_codec
from posecore.shard.card_schema import check_card
from posecore.shard.fields import field_table, schema
from posecore.shard.layout import (
    GROUP,
    MANIFEST,
    check_same_card,
    chunk_shape,
    metadata,
    parse_manifest,
    read_card,
    read_manifest,
    samples_in,
    shard_key,
)
from posecore.store import open_store


@dataclass(frozen=True, kw_only=True)
class Encoded:
    """A shard ready to be written: file bytes by field, and its manifest line."""

    shard_id: int
    files: dict[str, bytes]
    line: dict[str, Any]


class ShardWriter:
    """Creates a dataset, encodes shards (in any process) and commits them (in one)."""

    def __init__(self, url: str, card: Mapping[str, Any]) -> None:
        self.url = str(url)
        self.card = dict(card)
        self._store = open_store(self.url)
        self._manifest = b""
        self._lines: dict[int, str] = {}

    @classmethod
    def create(cls, url: str, card: Mapping[str, Any]) -> "ShardWriter":
        """Create the dataset, or reopen the one with the same card.

        Args:
            url: Folder or fsspec URL.
            card: The data card. Must hold n, shard_size, patch_px, contour_points and depth_step_m; schema is
                added. Nothing in it may depend on time or machine, or resumed datasets would differ.

        Raises:
            ShardError: The card has a value out of bounds, or the place holds something else; the message names the
                first key.
            StorageError: The place cannot be reached or written.
        """
        # A run that was killed before it wrote the group's own file leaves only the folders of the fields.
        expected = {field.name for field in field_table()}
        name, version = schema()
        full = json.loads(json.dumps({"schema": name, "schema_version": version, **card}))
        check_card(full, str(url), "this cannot be stored")
        store = open_store(str(url))
        existing = store.get(GROUP)
        if existing is not None:
            check_same_card(str(url), read_card(str(url), existing), full)
        elif foreign := [entry for entry in store.list_names() if entry not in expected]:
            raise ShardError(
                f"{url}: the folder is not empty ({foreign[0]} is in it) and holds no dataset; "
                "choose an empty or new folder"
            )
        writer = cls(str(url), full)
        if existing is None:
            for key, data in metadata(full).items():  # the group's own file is the last: with it the dataset exists
                store.set(key, data)
        return writer

    def committed(self) -> list[int]:
        """Ids of the shards in the manifest, sorted."""
        return sorted(line["shard"] for line in read_manifest(self.url, self._store, self.card))

    def quarantined(self) -> list[int]:
        """Replacements of scenes that crash the renderer, sorted."""
        return sorted(
            scene for line in read_manifest(self.url, self._store, self.card) for scene in line.get("quarantined", ())
        )

    def damaged(self) -> dict[int, str]:
        """Faults of committed shards: a file is missing or its length differs from the manifest.

        The folders are listed, nothing is read.
        """
        lines = read_manifest(self.url, self._store, self.card)
        faults: dict[int, str] = {}
        for field in field_table():
            sizes = self._store.sizes(field.name) if lines else {}
            for line in lines:
                key, expected = shard_key(field, line["shard"]), line["bytes"].get(field.name)
                size = sizes.get(key)
                if size != expected:
                    there = "is missing" if size is None else f"has {size} bytes"
                    faults.setdefault(line["shard"], f"{key} {there}, expected {expected} bytes")
        return faults

    def encode(self, shard_id: int, arrays: Mapping[str, np.ndarray]) -> Encoded:
        """Compress one shard; needs no store, so workers do it.

        Args:
            shard_id: Its id.
            arrays: Every field of the table with the sample axis in front, in the field's unit.

        Raises:
            ShardError: A field is missing, of another shape than in the field table, or has values that do not fit.
        """
        return encode(self.card, shard_id, arrays)

    def commit(self, encoded: Encoded) -> None:
        """Write a shard's files, then its line in the manifest. Call from one process only."""
        for field in field_table():
            self._store.set(shard_key(field, encoded.shard_id), encoded.files[field.name])
        stored = self._store.get(MANIFEST) or b""
        if stored != self._manifest:  # thousands of lines: parsed again only when another process has changed them
            self._lines = {line["shard"]: _line_text(line) for line in parse_manifest(self.url, stored, self.card)}
        self._lines[encoded.shard_id] = _line_text(encoded.line)
        self._manifest = "".join(text for _, text in sorted(self._lines.items())).encode()
        self._store.set(MANIFEST, self._manifest)

    def add_file(self, key: str, data: bytes) -> None:
        """Put a further file (a mesh, models_info.json) into the dataset, once.

        Raises:
            ShardError: The dataset holds another file there.
        """
        stored = self._store.get(key)
        if stored is None:
            self._store.set(key, data)
        elif stored != data:
            raise ShardError(
                f"{self.url}/{key}: is not the file that these settings make; start with the same settings (objects, "
                "--models-info) to resume, or choose another --out"
            )


def _line_text(line: Mapping[str, Any]) -> str:
    return json.dumps(line, sort_keys=True) + "\n"


def encode(card: Mapping[str, Any], shard_id: int, arrays: Mapping[str, np.ndarray]) -> Encoded:
    """Compress one shard of the dataset with this card. See `ShardWriter.encode`."""
    count = samples_in(card, shard_id)
    packed: dict[str, bytes] = {}
    digest = hashlib.sha256()
    for field in field_table():
        chunk, *size = chunk_shape(field, card)
        shape = (count, *size)
        if field.name not in arrays or arrays[field.name].shape != shape:
            actual = arrays[field.name].shape if field.name in arrays else "nothing"
            raise ShardError(f"shard {shard_id}, {field.name}: found {actual}, expected shape {shape}")
        stored = field.encode(arrays[field.name], card)
        packed[field.name] = sharding_codec.pack(stored, field.codec, int(card["shard_size"]), chunk)
        digest.update(packed[field.name])
    line = {
        "shard": shard_id,
        "n": count,
        "rejected": int(arrays["rejected"].sum()),
        "sha256": digest.hexdigest(),
        "bytes": {name: len(data) for name, data in packed.items()},
    }
    return Encoded(shard_id=shard_id, files=packed, line=line)
