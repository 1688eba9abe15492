"""Shard datasets: a Zarr v3 group, one row of shard files the unit of work, of commit and of retry.

Shard i is the i-th shard file of every field's array. It is complete or absent: each file is written under a
temporary name and renamed (an object store writes a whole object or none), and its line in `manifest.jsonl` comes
last. The group's attributes are the data card. Fields come from `data_specs/shard_fields.yaml`.
"""

from posecore.shard.fields import BIT_FOREGROUND, BIT_OBJECT, BIT_VISIBLE, Field, field_table, schema
from posecore.shard.layout import GROUP, MANIFEST, n_shards, samples_in
from posecore.shard.objects import MODELS_INFO, load_meshes, model_keys
from posecore.shard.reader import ShardReader
from posecore.shard.writer import Encoded, ShardWriter, encode

__all__ = [
    "BIT_FOREGROUND",
    "BIT_OBJECT",
    "BIT_VISIBLE",
    "GROUP",
    "MANIFEST",
    "MODELS_INFO",
    "Encoded",
    "Field",
    "ShardReader",
    "ShardWriter",
    "encode",
    "field_table",
    "load_meshes",
    "model_keys",
    "n_shards",
    "samples_in",
    "schema",
]
