"""Schemas of a dataset's own files: the data card and the lines of the manifest."""

from collections.abc import Mapping
from typing import Annotated, Any, Literal

from msgspec import UNSET, Meta, Struct, UnsetType

from posecore.errors import PoseError, ShardError
from posecore.schema import check, check_entries

LARGEST_SHARD_PX = 1 << 31
"""Patch pixels of a shard: more would not fit into memory when decoded."""
MOST_SHARDS = 1 << 22
ADVICE = "the dataset is damaged, delete it and render it again"

Text = Annotated[str, Meta(max_length=4096, pattern=r"^[^\x00-\x1f\x7f]*\Z")]
Name = Annotated[str, Meta(max_length=255, pattern=r"^[^\x00-\x1f\x7f]*\Z")]
_Hash = Annotated[str, Meta(pattern=r"^[0-9a-f]{64}\Z")]
_Model = Annotated[str, Meta(max_length=255, pattern=r"^models/[A-Za-z0-9_-][A-Za-z0-9_.-]*\Z")]
Count = Annotated[int, Meta(ge=0, le=2**53)]
_Length = Annotated[float, Meta(gt=0, le=1e6)]
_Side = Annotated[int, Meta(ge=1, le=1 << 16)]
_Focal = Annotated[float, Meta(ge=1e-2, le=1e7)]
_Centre = Annotated[float, Meta(ge=-1e7, le=1e7)]


class ObjectEntry(Struct):
    """An object: its model lies in the dataset's `models/`."""

    name: Name
    path: _Model
    diameter_m: _Length
    window_side_px: _Length
    sha256: Name
    texture: _Model | None = None


class CameraEntry(Struct):
    """The full image."""

    width_px: _Side
    height_px: _Side
    fx: _Focal
    fy: _Focal
    cx: _Centre
    cy: _Centre
    shared: bool = True


class AssetEntry(Struct):
    """Files that scenes drew from: their number under one of three names, and their hash."""

    sha256: Name
    photos: Count = 0
    files: Count = 0
    meshes: Count = 0


class SourceEntry(Struct):
    """Images that pairs were cut from."""

    dataset: Text
    split: Text
    images: Count
    hypotheses: Literal["drawn", "given"]
    sha256: Name
    left_out: dict[Text, Count]


class MergedEntry(Struct):
    """A dataset that was merged, with its own card."""

    digest: Name
    card: dict[str, Any]

    def __post_init__(self) -> None:
        check_entries("card", {self.digest: self.card}, Card)


class Card(Struct):
    """The data card. Keys with a default are those of datasets made by `synthgen`."""

    schema: Name
    schema_version: int
    n: Annotated[int, Meta(ge=1, le=10**9)]
    shard_size: Annotated[int, Meta(ge=1, le=1_000_000)]
    patch_px: Annotated[int, Meta(ge=2, le=4096)]
    contour_points: Annotated[int, Meta(ge=1, le=100_000)]
    depth_step_m: Annotated[float, Meta(gt=0, le=10)]
    seed: int | list[Any]
    objects: dict[str, Any] | UnsetType = UNSET
    camera: CameraEntry | UnsetType = UNSET
    config: dict[str, Any] | UnsetType = UNSET
    cut: dict[str, Any] | UnsetType = UNSET
    source: SourceEntry | UnsetType = UNSET
    merged: list[MergedEntry] | UnsetType = UNSET
    windows: Name | UnsetType = UNSET
    units: dict[Name, Name] | UnsetType = UNSET
    versions: dict[Name, Name] | UnsetType = UNSET
    backgrounds: AssetEntry | UnsetType | None = UNSET
    hdris: AssetEntry | UnsetType | None = UNSET
    occluders: AssetEntry | UnsetType | None = UNSET

    def __post_init__(self) -> None:
        if self.shard_size * self.patch_px**2 > LARGEST_SHARD_PX:
            raise ValueError(
                f"shard_size is {self.shard_size} with patch_px {self.patch_px}, expected at most {LARGEST_SHARD_PX} "
                "pixels in a shard"
            )
        if self.n > MOST_SHARDS * self.shard_size:
            raise ValueError(f"n is {self.n}, expected at most {MOST_SHARDS} shards of {self.shard_size}")
        if isinstance(self.objects, dict):
            if not self.objects or not all(_is_object_id(key) for key in self.objects):
                raise ValueError(
                    f"objects has the keys {', '.join(map(repr, list(self.objects)[:9])) or 'none'}, "
                    "expected object ids"
                )
            check_entries("objects", self.objects, ObjectEntry)


class ManifestLine(Struct):
    """A committed shard."""

    shard: Count
    n: Annotated[int, Meta(ge=1, le=1_000_000)]
    rejected: int  # the sum of a field that `synthgen verify` checks
    sha256: _Hash
    bytes: dict[Name, Count]
    quarantined: list[Count] = []


def check_card(card: Mapping[str, Any], where: str, advice: str = ADVICE, error: type[PoseError] = ShardError) -> None:
    """Hold a data card against its schema.

    Raises:
        PoseError: Of the class `error`; the message has `where`, the key and `advice`.
    """
    check(card, Card, where, error, advice)


def _is_object_id(key: str) -> bool:
    return key.isascii() and key.isdigit() and len(key) <= 10 and int(key) < 2**31 and key == str(int(key))
