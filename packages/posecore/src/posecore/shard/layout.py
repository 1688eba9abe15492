"""The group's own files: the data card, the arrays' metadata and the manifest."""

import json
from collections.abc import Mapping
from typing import Any

from posecore.errors import ShardError
from posecore.schema import check, parse_json
from posecore.shard import sharding_codec
from posecore.shard.card_schema import ADVICE, ManifestLine, check_card
from posecore.shard.fields import Field, field_table, schema
from posecore.store import Store

MANIFEST = "manifest.jsonl"
GROUP = "zarr.json"
TEST_SET = "test_bop"
"""Folder in a local dataset with its test images, a BOP dataset of other scenes."""


def n_shards(card: Mapping[str, Any]) -> int:
    """Shards in the complete dataset."""
    return -(-int(card["n"]) // int(card["shard_size"]))


def samples_in(card: Mapping[str, Any], shard_id: int) -> int:
    """Samples in a shard: the last one may be shorter."""
    return min(int(card["shard_size"]), int(card["n"]) - shard_id * int(card["shard_size"]))


def shard_key(field: Field, shard_id: int) -> str:
    """Store key of a shard's file for a field."""
    return "/".join([field.name, "c", str(shard_id), *["0"] * len(field.shape)])


def chunk_shape(field: Field, card: Mapping[str, Any]) -> tuple[int, ...]:
    """Shape of a field's inner chunks, samples in front."""
    size = field.size(card["patch_px"], card["contour_points"])
    return (sharding_codec.chunk_samples(field.shape, int(card["shard_size"])), *size)


def metadata(card: Mapping[str, Any]) -> dict[str, bytes]:
    """Metadata of the Zarr v3 group and its arrays, by key."""
    group = {"zarr_format": 3, "node_type": "group", "attributes": dict(card)}
    return {
        **{f"{field.name}/{GROUP}": _json(_array_metadata(field, card)) for field in field_table()},
        GROUP: _json(group),
    }


def _array_metadata(field: Field, card: Mapping[str, Any]) -> dict[str, Any]:
    chunk = chunk_shape(field, card)
    sharding = {
        "chunk_shape": list(chunk),
        "codecs": sharding_codec.codecs(field.codec, field.dtype, len(chunk)),
        "index_codecs": [{"name": "bytes", "configuration": {"endian": "little"}}, {"name": "crc32c"}],
        "index_location": "end",
    }
    grid = {"chunk_shape": [int(card["shard_size"]), *chunk[1:]]}
    return {
        "zarr_format": 3,
        "node_type": "array",
        "shape": [int(card["n"]), *chunk[1:]],
        "data_type": field.dtype,
        "chunk_grid": {"name": "regular", "configuration": grid},
        "chunk_key_encoding": {"name": "default", "configuration": {"separator": "/"}},
        "fill_value": 0.0 if field.dtype.startswith("float") else 0,
        "codecs": [{"name": "sharding_indexed", "configuration": sharding}],
        "dimension_names": ["sample", *[s if isinstance(s, str) else f"axis{i}" for i, s in enumerate(field.shape)]],
        "attributes": {
            "unit": field.unit,
            "scale": field.step(card),
            "squared": field.squared,
            "text": field.text,
        },
        "storage_transformers": [],
    }


def _json(content: Mapping[str, Any]) -> bytes:
    return json.dumps(content, indent=2).encode()


def read_card(url: str, group: bytes) -> dict[str, Any]:
    """The data card of a group's metadata.

    Raises:
        ShardError: It is none, of another schema, or has a value out of bounds.
    """
    where = f"{url}/{GROUP}"
    content = parse_json(group, where, ShardError, ADVICE)
    card = content.get("attributes") if isinstance(content, dict) else None
    if not isinstance(card, dict):
        raise ShardError(f"{where}: not the metadata of a Zarr v3 group; {ADVICE}")
    name, version = schema()
    stored = (card.get("schema"), card.get("schema_version"))
    if stored != (name, version):
        raise ShardError(
            f"{url}: schema {stored[0]} version {stored[1]}, expected {name} version {version}; "
            "render the dataset again with this version, or use the version that made it"
        )
    check_card(card, where)
    return card


def read_manifest(url: str, store: Store, card: Mapping[str, Any]) -> list[dict[str, Any]]:
    """The manifest's lines in their order. See `parse_manifest`."""
    return parse_manifest(url, store.get(MANIFEST) or b"", card)


def parse_manifest(url: str, data: bytes, card: Mapping[str, Any]) -> list[dict[str, Any]]:
    """The lines of a manifest's content.

    Args:
        url: Dataset, for messages.
        data: The manifest.
        card: Data card of the dataset.

    Raises:
        ShardError: A line is broken, or of a shard that the dataset does not have or that an earlier line is of.
    """
    lines: list[dict[str, Any]] = []
    seen: set[int] = set()
    advice = "delete the line and render again"
    for number, text in enumerate(data.splitlines(), start=1):
        where = f"{url}/{MANIFEST}, line {number}"
        line = parse_json(text, where, ShardError, advice)
        check(line, ManifestLine, where, ShardError, advice)
        if line["shard"] in seen or line["shard"] >= n_shards(card):
            raise ShardError(
                f"{where}: shard {line['shard']} is listed twice, or beyond the {n_shards(card)} shards of the data "
                f"card; {advice}"
            )
        seen.add(line["shard"])
        lines.append(line)
    return lines


def check_same_card(url: str, stored: Mapping[str, Any], requested: Mapping[str, Any]) -> None:
    """Raise the first difference between two cards as a ShardError."""
    difference = _first_difference(stored, requested, "")
    if difference:
        raise ShardError(
            f"{url}: holds another dataset ({difference}); choose another --out, or delete that folder, "
            "or start with the same settings to resume"
        )


def _first_difference(stored: Any, requested: Any, path: str) -> str | None:
    if isinstance(stored, Mapping) and isinstance(requested, Mapping):
        for key in sorted({*stored, *requested}):
            difference = _first_difference(stored.get(key), requested.get(key), f"{path}.{key}" if path else key)
            if difference:
                return difference
        return None
    return None if stored == requested else f"{path} is {stored!r} there and {requested!r} here"
