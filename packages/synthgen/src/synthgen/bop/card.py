"""The card of a BOP dataset that `synthgen bop` makes, `synthgen.json` beside its folders."""

from pathlib import Path
from typing import Annotated, Any

from msgspec import Meta, Struct
from posecore.errors import DatasetError
from posecore.files import read_regular
from posecore.schema import check, check_entries, parse_json
from posecore.shard.card_schema import AssetEntry, CameraEntry, Count, Name

CARD = "synthgen.json"
_ADVICE = "it is not the card of a dataset that `synthgen bop` made, or damaged: delete the folder and render it again"


class _Object(Struct):
    name: Name
    sha256: Name


class _Config(Struct):
    camera: CameraEntry
    seed: Annotated[int, Meta(ge=0)]


class _BopCard(Struct):
    split: Name
    frames: Count
    objects: dict[str, Any]
    config: _Config
    versions: dict[Name, Name]
    frames_per_scene: Count | None = None
    sequences: Count | None = None
    backgrounds: AssetEntry | None = None
    hdris: AssetEntry | None = None
    occluders: AssetEntry | None = None

    def __post_init__(self) -> None:
        check_entries("objects", self.objects, _Object)


def read_card(folder: Path) -> dict[str, Any]:
    """The card of a dataset.

    Raises:
        DatasetError: It is damaged; the message names the key.
        OSError: It cannot be read.
    """
    file = folder / CARD
    card: dict[str, Any] = parse_json(read_regular(file), str(file), DatasetError, _ADVICE)
    check(card, _BopCard, str(file), DatasetError, _ADVICE)
    return card
