"""Files of a BOP split's annotations and images: scene folders, for a single sensor or several."""

import os
import re
from collections import OrderedDict
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, Literal, Protocol, runtime_checkable

import numpy as np
from jaxtyping import Bool

from posecore.bop.file_slice import StoredFile
from posecore.bop.images import COLOUR_EXTENSIONS, DEPTH_EXTENSIONS, find_image, read_mask
from posecore.bop.jsonfile import id_of, integer_keys, parse_bop_json
from posecore.errors import DatasetError

Kind = Literal["camera", "gt", "gt_info"]
Layer = Literal["colour", "depth"]
MaskKind = Literal["mask", "mask_visib"]
KEPT_BYTES = 1 << 26
"""JSON text whose parsed form a dataset keeps: the scenes used last, and always the one in use."""
_CAMERA_FILE = re.compile(r"scene_camera(?:_(.+))?\.json")


@runtime_checkable
class Source(Protocol):
    """Annotations and images of a split. Errors are DatasetErrors that name file and image."""

    scene_ids: list[int]

    def im_ids(self, scene_id: int, kind: Kind) -> list[int]:
        """Images of a scene that have an entry of this kind."""
        ...

    def has(self, scene_id: int, kind: Kind) -> bool:
        """Whether a scene has entries of this kind at all."""
        ...

    def entry(self, scene_id: int, im_id: int, kind: Kind) -> tuple[Any, str]:
        """Annotation of an image, and its location for errors."""
        ...

    def annotation(self, scene_id: int, kind: Kind) -> str:
        """Location of a scene's entries of this kind, for errors; it need not exist."""
        ...

    def image(self, scene_id: int, im_id: int, layer: Layer) -> StoredFile | None:
        """The image file, or None where there is none."""
        ...

    def mask(
        self, scene_id: int, im_id: int, gt_index: int, kind: MaskKind
    ) -> tuple[Bool[np.ndarray, "h w"], str] | None:
        """An annotated silhouette and its file, or None where there is none."""
        ...

    def scene_path(self, scene_id: int) -> Path:
        """Folder of a scene; it need not exist where scenes lie in tar files."""
        ...

    def files(self, scene_id: int) -> list[Path]:
        """Files that hold a scene's annotations."""
        ...

    def forget(self, scene_id: int) -> None:
        """Free a scene's annotations in memory."""
        ...


class FolderSource:
    """Scene folders (`000001/scene_camera.json`, `rgb/`, `depth/`), or the files of a single sensor in these.

    With several sensors, annotations and image folders carry the sensor's name: `scene_camera_cam1.json`,
    `rgb_cam1/`, `mask_visib_cam1/`; in HOT3D the image folder is the name itself (`scene_gt_gray1.json`, `gray1/`).
    """

    def __init__(self, split_path: Path, scenes: Mapping[Path, frozenset[str]], sensors: Sequence[str]) -> None:
        """List the scenes.

        Args:
            split_path: folder of the split.
            scenes: scene folders, and the sensors that each has, as `scenes_of` gives them.
            sensors: sensors by preference; a scene without any is left out. The empty name stands for files without
                a sensor's name.

        Raises:
            DatasetError: two folders are the same scene.
        """
        self.split_path = split_path
        self._paths: dict[int, Path] = {}
        self._sensors: dict[int, str] = {}
        for scene, available in scenes.items():
            chosen = [sensor for sensor in sensors if sensor in available]
            if not chosen:
                continue
            number = int(scene.name)
            if number in self._paths:
                raise DatasetError(f"{scene}: is scene {number} as {self._paths[number].name} is; remove one")
            self._paths[number], self._sensors[number] = scene, chosen[0]
        self.scene_ids = sorted(self._paths)
        self._kept: OrderedDict[tuple[int, Kind], tuple[dict[int, Any], int]] = OrderedDict()

    def scene_path(self, scene_id: int) -> Path:
        """Folder of a scene."""
        return self._paths[scene_id]

    def _named(self, scene_id: int, name: str) -> str:
        """A file's or folder's name with that of the scene's sensor."""
        sensor = self._sensors[scene_id]
        return f"{name}_{sensor}" if sensor else name

    def _file(self, scene_id: int, kind: Kind) -> Path:
        return self._paths[scene_id] / f"{self._named(scene_id, f'scene_{kind}')}.json"

    def has(self, scene_id: int, kind: Kind) -> bool:
        """Whether the scene has the file."""
        return (scene_id, kind) in self._kept or self._file(scene_id, kind).is_file()

    def annotation(self, scene_id: int, kind: Kind) -> str:
        """Path of the JSON file."""
        return str(self._file(scene_id, kind))

    def files(self, scene_id: int) -> list[Path]:
        """The scene's JSON files that exist."""
        kinds: tuple[Kind, ...] = ("gt", "camera", "gt_info")
        return [self._file(scene_id, kind) for kind in kinds if self._file(scene_id, kind).is_file()]

    def im_ids(self, scene_id: int, kind: Kind) -> list[int]:
        """Keys of the file."""
        return sorted(self._content(scene_id, kind))

    def entry(self, scene_id: int, im_id: int, kind: Kind) -> tuple[Any, str]:
        """Value of the image's key."""
        content, file = self._content(scene_id, kind), self._file(scene_id, kind)
        if im_id not in content:
            raise DatasetError(f"{file}: no entry for image {im_id}; there are {some(sorted(content))}")
        return content[im_id], f"{file}, image {im_id}"

    def _content(self, scene_id: int, kind: Kind) -> dict[int, Any]:
        key = (scene_id, kind)
        if key in self._kept:
            self._kept.move_to_end(key)
            return self._kept[key][0]
        file = self._file(scene_id, kind)
        data = StoredFile(path=file).read()
        content = integer_keys(parse_bop_json(data, str(file)), file)
        self._kept[key] = content, len(data)
        self._make_room(scene_id)
        return content

    def _make_room(self, in_use: int) -> None:
        total = sum(size for _, size in self._kept.values())
        for key in [key for key in self._kept if key[0] != in_use]:
            if total <= KEPT_BYTES:
                return
            total -= self._kept.pop(key)[1]

    def forget(self, scene_id: int) -> None:
        """Free the scene's parsed JSON."""
        for key in [key for key in self._kept if key[0] == scene_id]:
            del self._kept[key]

    def image(self, scene_id: int, im_id: int, layer: Layer) -> StoredFile | None:
        """The first that exists of rgb, gray and the sensor's name (depth for depth), png, jpg and tif."""
        names = ["rgb", "gray"] if layer == "colour" else ["depth"]
        folders = [self._paths[scene_id] / self._named(scene_id, name) for name in names]
        if layer == "colour" and self._sensors[scene_id]:
            folders.append(self._paths[scene_id] / self._sensors[scene_id])
        extensions = COLOUR_EXTENSIONS if layer == "colour" else DEPTH_EXTENSIONS
        path = find_image(tuple(folders), f"{im_id:06d}", extensions)
        return None if path is None else StoredFile(path=path)

    def mask(
        self, scene_id: int, im_id: int, gt_index: int, kind: MaskKind
    ) -> tuple[Bool[np.ndarray, "h w"], str] | None:
        """The mask's PNG."""
        folder = self._paths[scene_id] / self._named(scene_id, kind)
        path = find_image((folder,), f"{im_id:06d}_{gt_index:06d}", ("png",))
        return None if path is None else (read_mask(path), str(path))


def scenes_of(split_path: Path) -> dict[Path, frozenset[str]]:
    """Scene folders of a split, and the sensors each has cameras of.

    The empty name stands for `scene_camera.json`. A scene without any camera has none.

    Raises:
        DatasetError: a scene folder cannot be listed.
    """
    return {scene: _sensors_of(scene) for scene in scene_folders(split_path)}


def has_scenes(folder: Path) -> bool:
    """Whether a folder holds a scene with a camera."""
    return any(_sensors_of(scene) for scene in scene_folders(folder))


def scene_folders(split_path: Path) -> list[Path]:
    """Folders with a scene's number for a name."""
    try:
        names = sorted(entry.name for entry in os.scandir(split_path) if entry.is_dir())
    except (OSError, ValueError):
        return []
    return [split_path / name for name in names if id_of(name) is not None]


def _sensors_of(scene: Path) -> frozenset[str]:
    try:
        names = os.listdir(scene)
    except OSError as error:
        raise DatasetError(f"{scene}: cannot be listed ({error.strerror}); change its rights") from error
    matches = (_CAMERA_FILE.fullmatch(name) for name in names)
    return frozenset(match[1] or "" for match in matches if match)


def some(ids: list[int], limit: int = 8) -> str:
    """Ids in words, the first few of many."""
    return ", ".join(map(str, ids[:limit])) + (f", ... ({len(ids)} in all)" if len(ids) > limit else "")
