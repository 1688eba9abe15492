"""BOP in webdataset shards: tar files with `KEY.rgb.jpg`, `KEY.camera.json`, read without unpacking.

KEY is SCENE_IMAGE (`000001_000023`), as bop_toolkit writes it. Masks are run lengths in `KEY.mask_visib.json`.
"""

import re
import tarfile
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Bool

from posecore.bop.file_slice import StoredFile
from posecore.bop.images import COLOUR_EXTENSIONS, DEPTH_EXTENSIONS
from posecore.bop.jsonfile import id_of, integer, integer_keys, parse_bop_json
from posecore.bop.sources import Kind, Layer, MaskKind, some
from posecore.errors import DatasetError
from posecore.files import open_regular
from posecore.schema import shown

BLOCK = 512
LARGEST_MASK_PX = 1 << 28
_KEY = re.compile(r"([0-9]+)_([0-9]+)")
_Member = tuple[int, str, int, int]  # shard, member's name, offset, size


def shard_files(folder: Path) -> list[Path]:
    """The tar files of a split."""
    return sorted(folder.glob("*.tar"))


class ShardSource:
    """A split in tar files. Their index is read once; images and annotations on demand."""

    def __init__(self, split_path: Path) -> None:
        """Index the shards.

        Args:
            split_path: folder with the tar files.

        Raises:
            DatasetError: a shard is cut off or no tar file, or a member occurs twice or belongs to no image.
        """
        self.split_path = split_path
        self.shards = shard_files(split_path)
        self._index: dict[int, dict[int, dict[str, _Member]]] = {}
        for number, shard in enumerate(self.shards):
            for name, offset, size in _members(shard):
                self._add(number, name, offset, size)
        self.scene_ids = sorted(self._index)

    def _add(self, shard: int, name: str, offset: int, size: int) -> None:
        key, _, extension = name.rsplit("/", 1)[-1].partition(".")
        match = _KEY.fullmatch(key)
        scene_id, im_id = (None, None) if match is None else map(id_of, match.groups())
        if scene_id is None or im_id is None:
            if extension == "camera.json":
                raise DatasetError(f"{self.shards[shard]}:{name}: its key is not SCENE_IMAGE, such as 000001_000023")
            return
        image = self._index.setdefault(scene_id, {}).setdefault(im_id, {})
        if extension in image:
            other = image[extension]
            raise DatasetError(
                f"{self.shards[shard]}:{name}: is in {self.shards[other[0]].name} as {other[1]} too; remove one"
            )
        image[extension] = shard, name, offset, size

    def scene_path(self, scene_id: int) -> Path:
        """Folder of the scene if it were unpacked."""
        return self.split_path / f"{scene_id:06d}"

    def _stored(self, scene_id: int, im_id: int, extension: str) -> StoredFile | None:
        located = self._index.get(scene_id, {}).get(im_id, {}).get(extension)
        if located is None:
            return None
        shard, name, offset, size = located
        return StoredFile(path=self.shards[shard], member=name, offset=offset, size=size)

    def im_ids(self, scene_id: int, kind: Kind) -> list[int]:
        """Images of the scene with such a member."""
        return sorted(im_id for im_id, image in self._index[scene_id].items() if f"{kind}.json" in image)

    def has(self, scene_id: int, kind: Kind) -> bool:
        """Whether any image of the scene has such a member."""
        return any(f"{kind}.json" in image for image in self._index[scene_id].values())

    def annotation(self, scene_id: int, kind: Kind) -> str:
        """Names of the members."""
        return f"{self.split_path}/*.tar:{scene_id:06d}_*.{kind}.json"

    def files(self, scene_id: int) -> list[Path]:
        """The shards that hold a part of the scene."""
        numbers = {member[0] for image in self._index[scene_id].values() for member in image.values()}
        return [self.shards[number] for number in sorted(numbers)]

    def entry(self, scene_id: int, im_id: int, kind: Kind) -> tuple[Any, str]:
        """Content of the image's member."""
        file = self._stored(scene_id, im_id, f"{kind}.json")
        if file is None:
            there = some(self.im_ids(scene_id, kind))
            raise DatasetError(f"{self.annotation(scene_id, kind)}: no entry for image {im_id}; there are {there}")
        return parse_bop_json(file.read(), str(file), dict if kind == "camera" else list), str(file)

    def forget(self, scene_id: int) -> None:
        """Do nothing: no annotation is kept."""

    def image(self, scene_id: int, im_id: int, layer: Layer) -> StoredFile | None:
        """The first that exists of rgb and gray (depth for depth), png, jpg and tif."""
        names = ("rgb", "gray") if layer == "colour" else ("depth",)
        extensions = COLOUR_EXTENSIONS if layer == "colour" else DEPTH_EXTENSIONS
        choices = (self._stored(scene_id, im_id, f"{name}.{ending}") for name in names for ending in extensions)
        return next((file for file in choices if file is not None), None)

    def mask(
        self, scene_id: int, im_id: int, gt_index: int, kind: MaskKind
    ) -> tuple[Bool[np.ndarray, "h w"], str] | None:
        """The mask from its run lengths."""
        file = self._stored(scene_id, im_id, f"{kind}.json")
        if file is None:
            return None
        masks = integer_keys(parse_bop_json(file.read(), str(file)), str(file))
        where = f"{file}, mask {gt_index}"
        return None if gt_index not in masks else (decode_runs(masks[gt_index], where), where)


def decode_runs(entry: Any, where: str) -> Bool[np.ndarray, "h w"]:
    """A mask from its run lengths: pixels column by column, off and on in turn, off first (COCO's, uncompressed).

    Raises:
        DatasetError: no size, or lengths that do not add up to it.
    """
    size = entry.get("size") if isinstance(entry, dict) else None
    if not isinstance(size, list) or len(size) != 2:
        raise DatasetError(f"{where}: 'size' is {shown(size)}, expected height and width")
    named = {"height": size[0], "width": size[1]}
    height, width = integer(named, "height", where), integer(named, "width", where)
    counts = entry.get("counts")
    if isinstance(counts, str):
        raise DatasetError(f"{where}: its run lengths are compressed; write them as a list of numbers")
    if not isinstance(counts, list):
        raise DatasetError(f"{where}: 'counts' is {shown(counts)}, expected a list of run lengths")
    runs = [integer({"counts": count}, "counts", where) for count in counts]
    if sum(runs) != height * width or height * width > LARGEST_MASK_PX:
        raise DatasetError(f"{where}: its run lengths add up to {sum(runs)}, expected {height} x {width} pixels")
    on = np.repeat(np.arange(len(runs)) % 2 == 1, runs)
    return np.ascontiguousarray(on.reshape(width, height).T)


def _members(shard: Path) -> Iterator[tuple[str, int, int]]:
    """Name, offset and size of each file in a tar file.

    Raises:
        DatasetError: the tar file is cut off, compressed, or none.
    """
    advice = "copy it again (shards are uncompressed tar files)"
    try:
        size = shard.stat().st_size
        with open_regular(shard, None) as stream, tarfile.open(fileobj=stream, mode="r:") as tar:
            for member in tar:
                if member.offset_data + member.size > size:
                    raise DatasetError(f"{shard}:{member.name}: reaches beyond the file's end, it is cut off; {advice}")
                if member.isreg():
                    yield member.name, member.offset_data, member.size
            end = tar.offset
        rest = StoredFile(path=shard, offset=end).read()
    except (tarfile.TarError, OSError, EOFError, ValueError, OverflowError) as error:
        if isinstance(error, DatasetError):
            raise
        raise DatasetError(f"{shard}: cannot be read as a tar file ({error}); {advice}") from error
    # Without its end mark a file may have been cut off between two members, which tarfile takes for the end.
    if len(rest) < BLOCK:
        raise DatasetError(f"{shard}: has no end mark, so it is cut off; {advice}")
    if rest.strip(b"\0"):
        raise DatasetError(f"{shard}: goes on after its end mark (byte {end}), as joined tar files do; join them anew")
