"""Shard datasets: a Zarr v3 group, one row of shard files the unit of work, of commit and of retry.

Shard i is the i-th shard file of every field's array. It is complete or absent: each file is written under a
temporary name and renamed, and its line in `manifest.jsonl` comes last. The group's attributes are the data card.
Fields come from `data_specs/shard_fields.yaml`.
"""

import hashlib
import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cache, cached_property
from typing import Any

import numpy as np
import zarr
from zarr.codecs import BloscCodec, BloscShuffle, ZstdCodec
from zarr.core.buffer import default_buffer_prototype
from zarr.core.sync import sync
from zarr.storage import MemoryStore

from posecore.config import load_yaml
from posecore.errors import ShardError
from posecore.files import data_spec
from posecore.store import Store, open_store

Array = np.ndarray
BIT_OBJECT, BIT_VISIBLE, BIT_FOREGROUND = 1, 2, 4
"""Bits of `scene_mask`: the object's whole silhouette, its visible part, and anything in front of the background."""

MANIFEST = "manifest.jsonl"
GROUP = "zarr.json"


@dataclass(frozen=True, kw_only=True)
class Field:
    """One row of the field table.

    Attributes:
        name: Array name in the group; ends in its unit where it has one.
        dtype: On disk.
        shape: Without the sample axis; "P" patch_px, "C" contour_points.
        unit: Of the decoded value.
        codec: Inner codec, `zstd` or `shuffle+zstd`.
        text: One sentence.
        scale: Decoded value = stored x scale; a name for that entry of the data card; None when stored as it is.
    """

    name: str
    dtype: str
    shape: tuple[str | int, ...]
    unit: str
    codec: str
    text: str
    scale: float | str | None = None

    def size(self, patch_px: int, contour_points: int) -> tuple[int, ...]:
        """Shape of one sample's value."""
        symbols = {"P": patch_px, "C": contour_points}
        return tuple(symbols[s] if isinstance(s, str) else s for s in self.shape)

    def step(self, card: Mapping[str, Any]) -> float | None:
        """What one step of the stored integer is worth in `unit`; None when values are stored as they are.

        Raises:
            ShardError: The card lacks the entry that `scale` names.
        """
        if not isinstance(self.scale, str):
            return self.scale
        if self.scale not in card:
            raise ShardError(f"the data card has no {self.scale}, which {self.name} is stored in; render again")
        return float(card[self.scale])

    def encode(self, values: Array, card: Mapping[str, Any]) -> Array:
        """Values in `unit` to what is stored; rounds to the nearest step and refuses what does not fit."""
        step = self.step(card)
        if step is None:
            return np.asarray(values, self.dtype)
        stored = np.rint(np.asarray(values, np.float64) / step)
        limit = np.iinfo(self.dtype).max
        if not (stored >= 0).all() or not (stored <= limit).all():  # NaN fails both
            raise ShardError(
                f"{self.name}: values from {np.min(values)} to {np.max(values)} {self.unit}, "
                f"expected 0 to {limit * step:g} {self.unit} (what {self.dtype} steps of {step:g} hold)"
            )
        return np.asarray(stored.astype(self.dtype))

    def decode(self, stored: Array, card: Mapping[str, Any]) -> Array:
        """What is stored to values in `unit` (float32 where scaled)."""
        step = self.step(card)
        return np.asarray(stored) if step is None else np.asarray(stored.astype(np.float32) * np.float32(step))


@cache
def field_table() -> tuple[Field, ...]:
    """The fields of a sample, in the table's order."""
    rows = load_yaml(data_spec("shard_fields.yaml"))["fields"]
    return tuple(Field(name=name, **{**row, "shape": tuple(row["shape"])}) for name, row in rows.items())


@cache
def schema() -> tuple[str, int]:
    """Name and version of the shard schema that this code reads and writes."""
    table = load_yaml(data_spec("shard_fields.yaml"))
    return table["schema"], table["schema_version"]


@dataclass(frozen=True, kw_only=True)
class Encoded:
    """A shard ready to be written: file bytes by field (none for a field that is all zero), and its manifest line."""

    shard_id: int
    files: dict[str, bytes]
    line: dict[str, Any]


class ShardWriter:
    """Creates a dataset, encodes shards (in any process) and commits them (in one)."""

    def __init__(self, url: str, card: Mapping[str, Any]) -> None:
        self.url = str(url)
        self.card = dict(card)
        self._store = open_store(self.url)

    @classmethod
    def create(cls, url: str, card: Mapping[str, Any]) -> "ShardWriter":
        """Create the dataset, or reopen the one with the same card.

        Args:
            url: Folder or fsspec URL.
            card: The data card. Must hold n, shard_size, patch_px, contour_points and depth_step_m; schema is
                added. Nothing in it may depend on time or machine, or resumed datasets would differ.

        Raises:
            ShardError: The place holds something else; the message names the first key that differs.
        """
        # The folders of the fields alone are what a run leaves that was killed before the group's own file was written.
        own = {field.name for field in field_table()}
        name, version = schema()
        full = json.loads(json.dumps({"schema": name, "schema_version": version, **card}))
        store = open_store(str(url))
        existing = store.get(GROUP)
        if existing is not None:
            _same_card(str(url), _card(str(url), existing), full)
        elif foreign := [entry for entry in store.list_names() if entry not in own]:
            raise ShardError(
                f"{url}: the folder is not empty ({foreign[0]} is in it) and holds no dataset; "
                "choose an empty or new folder"
            )
        writer = cls(str(url), full)
        if existing is None:
            scratch = MemoryStore()
            _make_group(scratch, full)
            files = {key: value for key, value in _contents(scratch).items() if key.endswith(GROUP)}
            for key in sorted(files, key=lambda k: (k == GROUP, k)):  # the group's own file last: it says "exists"
                store.set(key, files[key])
        return writer

    def committed(self) -> list[int]:
        """Ids of the shards in the manifest, sorted."""
        return sorted(line["shard"] for line in _manifest(self.url, self._store))

    def encode(self, shard_id: int, arrays: Mapping[str, Array]) -> Encoded:
        """Compress one shard; needs no store, so workers do it.

        Args:
            shard_id: Which one.
            arrays: Every field of the table with the sample axis in front, in the field's unit.

        Raises:
            ShardError: A field is missing, or of another shape than the table says.
        """
        return encode(self.card, shard_id, arrays)

    def commit(self, encoded: Encoded) -> None:
        """Write a shard's files, then its line in the manifest. Call from one process only."""
        for name, data in encoded.files.items():
            self._store.set(_shard_key(name, encoded.shard_id, self.card), data)
        lines = {line["shard"]: line for line in _manifest(self.url, self._store)}
        lines[encoded.shard_id] = encoded.line
        text = "".join(json.dumps(lines[i], sort_keys=True) + "\n" for i in sorted(lines))
        self._store.set(MANIFEST, text.encode())

    def add_file(self, key: str, data: bytes) -> None:
        """Put a further file (a mesh, models_info.json) into the dataset, once.

        Raises:
            ShardError: The dataset holds another file there.
        """
        found = self._store.get(key)
        if found is None:
            self._store.set(key, data)
        elif found != data:
            raise ShardError(
                f"{self.url}/{key}: is not the file that these settings make; start with the same settings (objects, "
                "--models-info) to resume, or choose another --out"
            )


class ShardReader:
    """Reads a dataset, complete or still growing.

    Raises:
        ShardError: Not a dataset, of another schema, or with a broken manifest.
    """

    def __init__(self, url: str) -> None:
        self.url = str(url)
        self._store = open_store(self.url)
        group = self._store.get(GROUP)
        if group is None:
            raise ShardError(
                f"{self.url}: no {GROUP} here, so this is no shard dataset; make one with `synthgen render`"
            )
        self.card = _card(self.url, group)
        self.refresh()

    def refresh(self) -> None:
        """Read the manifest again: a dataset may grow while it is read."""
        self._lines = {line["shard"]: line for line in _manifest(self.url, self._store)}

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
        """Ids of the shards that are there, sorted."""
        return sorted(self._lines)

    @property
    def complete(self) -> bool:
        """Whether every shard is there."""
        return len(self._lines) == n_shards(self.card)

    def n_samples(self, shard_id: int) -> int:
        """Samples in a shard."""
        return samples_in(self.card, shard_id)

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

    def read(self, shard_id: int, fields: Sequence[str] | None = None) -> dict[str, Array]:
        """Decode a whole shard, or some of its fields, into physical units.

        Raises:
            ShardError: Not committed, or a file is missing, of another length, or does not decode; when the whole shard
                is read, also if its checksum differs.
        """
        if shard_id not in self._lines:
            raise ShardError(f"{self.url}: shard {shard_id} is not in {MANIFEST}; there are {len(self._lines)} shards")
        table = {f.name: f for f in field_table()}
        wanted = list(table) if fields is None else list(fields)
        scratch = MemoryStore()
        digest = hashlib.sha256()
        expected = self._lines[shard_id]["bytes"]
        for name in wanted:
            key = _shard_key(name, shard_id, self.card)
            if expected.get(name) == 0:  # all zero, which Zarr stores as no file
                continue
            data = self._store.get(key)
            found = "no file" if data is None else f"{len(data)} bytes"
            if data is None or len(data) != expected.get(name):
                raise ShardError(
                    f"{self.url}/{key}: found {found}, expected {expected.get(name)} bytes; the shard is damaged: "
                    f"delete its line (shard {shard_id}) from {MANIFEST} and run the same `synthgen render` again"
                )
            digest.update(data)
            _put(scratch, _shard_key(name, 0, self.card), data)
        _make_group(scratch, {**self.card, "n": self.shard_size}, wanted)
        group: Any = zarr.open_group(scratch, mode="r")
        values = {}
        for name in wanted:
            try:
                stored = np.asarray(group[name][: self.n_samples(shard_id)])
            except Exception as error:  # whatever the codecs raise on damaged bytes
                key = _shard_key(name, shard_id, self.card)
                raise ShardError(
                    f"{self.url}/{key}: does not decode ({type(error).__name__}); the shard is damaged: "
                    f"delete its line (shard {shard_id}) from {MANIFEST} and run the same `synthgen render` again"
                ) from error
            values[name] = table[name].decode(stored, self.card)
        if fields is None and digest.hexdigest() != self._lines[shard_id].get("sha256"):
            raise ShardError(
                f"{self.url}: shard {shard_id} differs from its checksum in {MANIFEST}; the shard is damaged: "
                "delete its line and run the same `synthgen render` again"
            )
        return values


def encode(card: Mapping[str, Any], shard_id: int, arrays: Mapping[str, Array]) -> Encoded:
    """Compress one shard of the dataset with this card. See `ShardWriter.encode`."""
    count = samples_in(card, shard_id)
    scratch = MemoryStore()
    _make_group(scratch, {**card, "n": card["shard_size"]})
    group: Any = zarr.open_group(scratch, mode="r+")
    for field in field_table():
        shape = (count, *field.size(card["patch_px"], card["contour_points"]))
        if field.name not in arrays or arrays[field.name].shape != shape:
            found = arrays[field.name].shape if field.name in arrays else "nothing"
            raise ShardError(f"shard {shard_id}, {field.name}: found {found}, expected shape {shape}")
        group[field.name][:count] = field.encode(arrays[field.name], card)
    contents = _contents(scratch)
    keys = {f.name: _shard_key(f.name, 0, card) for f in field_table()}
    files = {name: contents[key] for name, key in keys.items() if key in contents}
    digest = hashlib.sha256()
    for data in files.values():
        digest.update(data)
    line = {
        "shard": shard_id,
        "n": count,
        "rejected": int(arrays["rejected"].sum()),
        "sha256": digest.hexdigest(),
        "bytes": {name: len(files.get(name, b"")) for name in keys},
    }
    return Encoded(shard_id=shard_id, files=files, line=line)


def n_shards(card: Mapping[str, Any]) -> int:
    """Shards in the complete dataset."""
    return -(-int(card["n"]) // int(card["shard_size"]))


def samples_in(card: Mapping[str, Any], shard_id: int) -> int:
    """Samples in a shard: the last one may be shorter."""
    return min(int(card["shard_size"]), int(card["n"]) - shard_id * int(card["shard_size"]))


def _make_group(store: MemoryStore, card: Mapping[str, Any], names: Sequence[str] | None = None) -> None:
    group = zarr.open_group(store, mode="a", zarr_format=3)
    group.attrs.update(dict(card))
    n, shard = int(card["n"]), int(card["shard_size"])
    for field in field_table():
        if names is not None and field.name not in names:
            continue
        size = field.size(card["patch_px"], card["contour_points"])
        # a patch is read alone (chunk = one sample); small fields are read whole
        samples = 1 if "P" in field.shape else shard
        group.create_array(
            field.name,
            shape=(n, *size),
            chunks=(samples, *size),
            shards=(shard, *size),
            dtype=field.dtype,
            compressors=_compressor(field.codec),
            filters=None,
            dimension_names=[
                "sample",
                *[str(s) if isinstance(s, str) else f"axis{i}" for i, s in enumerate(field.shape)],
            ],
            attributes={"unit": field.unit, "scale": field.step(card), "text": field.text},
        )


def _compressor(codec: str) -> BloscCodec | ZstdCodec:
    if codec == "zstd":
        return ZstdCodec(level=3)
    return BloscCodec(cname="zstd", clevel=3, shuffle=BloscShuffle.shuffle)


def _shard_key(name: str, shard_id: int, card: Mapping[str, Any]) -> str:
    field = next(f for f in field_table() if f.name == name)
    return "/".join([name, "c", str(shard_id), *["0"] * len(field.shape)])


def _contents(store: MemoryStore) -> dict[str, bytes]:
    return {key: value.to_bytes() for key, value in store._store_dict.items()}


def _put(store: MemoryStore, key: str, data: bytes) -> None:
    sync(store.set(key, default_buffer_prototype().buffer.from_bytes(data)))


def _card(url: str, group: bytes) -> dict[str, Any]:
    try:
        card = dict(json.loads(group)["attributes"])
    except (ValueError, KeyError, TypeError) as error:
        raise ShardError(
            f"{url}/{GROUP}: not the metadata of a Zarr v3 group; the dataset is damaged, delete it and render it again"
        ) from error
    name, version = schema()
    found = (card.get("schema"), card.get("schema_version"))
    if found != (name, version):
        raise ShardError(
            f"{url}: schema {found[0]} version {found[1]}, expected {name} version {version}; "
            "render the dataset again with this version, or use the version that made it"
        )
    return card


def _manifest(url: str, store: Store) -> list[dict[str, Any]]:
    lines = []
    for number, text in enumerate((store.get(MANIFEST) or b"").decode("utf-8", "replace").splitlines(), start=1):
        try:
            line = json.loads(text)
            lines.append({**line, "shard": int(line["shard"]), "bytes": dict(line["bytes"])})
        except (ValueError, KeyError, TypeError) as error:
            raise ShardError(
                f"{url}/{MANIFEST}, line {number}: not a shard's JSON record; delete the line and render again"
            ) from error
    return lines


def _same_card(url: str, found: Mapping[str, Any], wanted: Mapping[str, Any]) -> None:
    difference = _first_difference(found, wanted, "")
    if difference:
        raise ShardError(
            f"{url}: holds another dataset ({difference}); choose another --out, or delete that folder, "
            "or start with the same settings to resume"
        )


def _first_difference(found: Any, wanted: Any, path: str) -> str | None:
    if isinstance(found, Mapping) and isinstance(wanted, Mapping):
        for key in sorted({*found, *wanted}):
            difference = _first_difference(found.get(key), wanted.get(key), f"{path}.{key}" if path else key)
            if difference:
                return difference
        return None
    return None if found == wanted else f"{path} is {found!r} there and {wanted!r} here"
