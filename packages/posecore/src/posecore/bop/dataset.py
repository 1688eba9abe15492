"""A BOP dataset folder: cameras, images, ground truth, models and targets, in metres."""

from collections.abc import Iterator
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from jaxtyping import Float, UInt8

from posecore import se3
from posecore.bop.images import COLOUR_FILES, DEPTH_FILES, find_image, image_size, read_image, read_rgb
from posecore.bop.jsonfile import integer, integer_keys, numbers, read_json
from posecore.bop.models_info import MM, ROTATION_TOLERANCE, ModelInfo, load_models_info
from posecore.camera import Camera
from posecore.errors import DatasetError
from posecore.mesh import Mesh, load_mesh

Array = np.ndarray
PREFERRED_SPLITS = ("test", "val", "train_pbr", "train")
NO_POSE_MM = -1.0


@dataclass(frozen=True, kw_only=True, eq=False)
class GroundTruth:
    """One annotated object of one image.

    Attributes:
        obj_id: object.
        T_cam_obj: (4, 4) pose, metres, as in the file (real annotations are orthonormal to about 0.01 only); all NaN
            where BOP says there is no pose.
        visib_fract: visible share of the silhouette in [0, 1], or None where `scene_gt_info.json` is missing.
        gt_index: position in the image's list, the number in mask file names.
        has_pose: False where BOP marks the pose as unknown (t = -1, -1, -1).
    """

    obj_id: int
    T_cam_obj: Float[Array, "4 4"]
    visib_fract: float | None = None
    gt_index: int = 0
    has_pose: bool = True


@dataclass(frozen=True, kw_only=True, order=True)
class Target:
    """An object to be found in an image, `inst_count` times."""

    scene_id: int
    im_id: int
    obj_id: int
    inst_count: int = 1


class BopDataset:
    """One split of a BOP dataset. Files are read when asked for, JSON and meshes once."""

    def __init__(self, root: str | Path, split: str | None = None) -> None:
        """Open a dataset folder.

        Args:
            root: folder with `models/` and split folders.
            split: split folder's name; by default test, val, train_pbr, train or the only one, in this order.

        Raises:
            DatasetError: no such folder, no split with scenes in it, or several and none preferred.
        """
        self.root = Path(root)
        if not self.root.is_dir():
            raise DatasetError(f"{self.root}: no such folder; give the folder of a BOP dataset")
        self.split = split or _choose_split(self.root)
        self.split_path = self.root / self.split
        self.scene_ids: list[int] = sorted(int(scene.name) for scene in _scenes(self.split_path))
        if not self.scene_ids:
            raise DatasetError(f"{self.split_path}: no scene folder (000001, ...) with a scene_camera.json in it")
        self._scene_paths = {int(scene.name): scene for scene in _scenes(self.split_path)}
        self._json: dict[Path, Any] = {}
        self._meshes: dict[Path, Mesh] = {}

    @property
    def name(self) -> str:
        """The folder's name."""
        return self.root.resolve().name

    def scene_path(self, scene_id: int) -> Path:
        """Folder of a scene.

        Raises:
            DatasetError: there is no such scene.
        """
        if scene_id not in self._scene_paths:
            raise DatasetError(f"{self.split_path}: no scene {scene_id}; there are {_some(self.scene_ids)}")
        return self._scene_paths[scene_id]

    def im_ids(self, scene_id: int) -> list[int]:
        """Annotated images of a scene; every image with a camera where the split has no ground truth."""
        annotated = "scene_gt.json" if self.has_gt(scene_id) else "scene_camera.json"
        return sorted(self._scene_json(scene_id, annotated))

    def has_gt(self, scene_id: int) -> bool:
        """Whether the scene comes with ground truth poses."""
        return (self.scene_path(scene_id) / "scene_gt.json").is_file()

    @cached_property
    def targets(self) -> list[Target]:
        """What is to be found: the split's targets file (BOP19, else BOP24), else all ground truth with a pose.

        Targets without an object (BOP24 detection) are filled in from ground truth.

        Raises:
            DatasetError: the targets name a scene that is not there, or neither targets nor ground truth exist.
        """
        for edition in ("bop19", "bop24"):
            file = self.root / f"{self.split}_targets_{edition}.json"
            if file.is_file():
                return sorted(self._listed_targets(file))
        images = [(scene_id, im_id) for scene_id in self.scene_ids for im_id in self.im_ids(scene_id)]
        return [target for image in images for target in self._annotated_targets(*image)]

    def _listed_targets(self, file: Path) -> Iterator[Target]:
        for index, entry in enumerate(read_json(file, list)):
            where = f"{file}, entry {index}"
            scene_id, im_id = integer(entry, "scene_id", where), integer(entry, "im_id", where)
            if scene_id not in self._scene_paths:
                raise DatasetError(f"{where}: scene {scene_id} is not in {self.split_path}; download or remove it")
            if "obj_id" not in entry:
                yield from self._annotated_targets(scene_id, im_id)
                continue
            count = integer(entry, "inst_count", where) if "inst_count" in entry else 1
            yield Target(scene_id=scene_id, im_id=im_id, obj_id=integer(entry, "obj_id", where), inst_count=count)

    def _annotated_targets(self, scene_id: int, im_id: int) -> list[Target]:
        found = [gt.obj_id for gt in self.gt(scene_id, im_id) if gt.has_pose]
        return [
            Target(scene_id=scene_id, im_id=im_id, obj_id=obj_id, inst_count=found.count(obj_id))
            for obj_id in sorted(set(found))
        ]

    def camera(self, scene_id: int, im_id: int) -> Camera:
        """Intrinsics of one image; its size is that of the image file, else the one in `camera.json`.

        Raises:
            DatasetError: the image has no camera, or its size is nowhere to be found.
        """
        entry, where = self._entry(scene_id, im_id, "scene_camera.json")
        width, height = self._size(scene_id, im_id)
        return Camera(K=numbers(entry, "cam_K", 9, where).reshape(3, 3), width_px=width, height_px=height)

    def _size(self, scene_id: int, im_id: int) -> tuple[int, int]:
        path = find_image(self.scene_path(scene_id), im_id, COLOUR_FILES + DEPTH_FILES)
        if path is not None:
            return image_size(path)
        file = self.root / "camera.json"
        entry = read_json(file) if file.is_file() else {}
        if "width" not in entry or "height" not in entry:
            raise DatasetError(f"{self.scene_path(scene_id)}: image {im_id} has no file, and {file} gives no size")
        return integer(entry, "width", str(file)), integer(entry, "height", str(file))

    def image_path(self, scene_id: int, im_id: int) -> Path:
        """The colour (else gray) image: png, jpg or tif.

        Raises:
            DatasetError: there is none.
        """
        scene = self.scene_path(scene_id)
        path = find_image(scene, im_id, COLOUR_FILES)
        if path is None:
            raise DatasetError(f"{scene}: no image {im_id:06d} as png, jpg or tif in rgb/ or gray/")
        return path

    def rgb(self, scene_id: int, im_id: int) -> UInt8[Array, "h w 3"]:
        """The image in RGB; gray is repeated three times."""
        return read_rgb(self.image_path(scene_id, im_id))

    def depth_m(self, scene_id: int, im_id: int) -> Float[Array, "h w"] | None:
        """Camera z in metres, 0 where unknown; None where the image has no depth file."""
        path = find_image(self.scene_path(scene_id), im_id, DEPTH_FILES)
        if path is None:
            return None
        entry, where = self._entry(scene_id, im_id, "scene_camera.json")
        scale = float(numbers(entry, "depth_scale", 1, where)[0]) if "depth_scale" in entry else 1.0
        raw = read_image(path, cv2.IMREAD_UNCHANGED)
        if raw.ndim != 2:
            raise DatasetError(f"{path}: found {raw.ndim} axes, expected a depth image with one channel")
        return np.asarray(raw, np.float32) * np.float32(scale * MM)

    def gt(self, scene_id: int, im_id: int) -> list[GroundTruth]:
        """Annotated objects of an image, in the file's order.

        Raises:
            DatasetError: the scene or the image has no ground truth, or a pose is not one.
        """
        if not self.has_gt(scene_id):
            raise DatasetError(
                f"{self.scene_path(scene_id)}: no scene_gt.json, so there is nothing to compare with; "
                "use a split whose ground truth is public"
            )
        entries, where = self._entry(scene_id, im_id, "scene_gt.json")
        if not isinstance(entries, list):
            raise DatasetError(f"{where}: found a {type(entries).__name__}, expected a list of objects")
        visibility = self._visibility(scene_id, im_id, len(entries))
        return [
            _ground_truth(entry, index, visibility[index], f"{where}, entry {index}")
            for index, entry in enumerate(entries)
        ]

    def _visibility(self, scene_id: int, im_id: int, count: int) -> list[float | None]:
        file = self.scene_path(scene_id) / "scene_gt_info.json"
        if not file.is_file():
            return [None] * count
        entries, where = self._entry(scene_id, im_id, "scene_gt_info.json")
        if not isinstance(entries, list) or len(entries) != count:
            raise DatasetError(f"{where}: does not list the {count} objects of scene_gt.json in the same order")
        return [float(entry["visib_fract"]) if "visib_fract" in entry else None for entry in entries]

    @cached_property
    def models_info(self) -> dict[int, ModelInfo]:
        """Diameters and symmetries, from `models/`, else `models_eval/`."""
        choices = [self.root / folder / "models_info.json" for folder in ("models", "models_eval")]
        return load_models_info(next((file for file in choices if file.is_file()), choices[0]))

    @property
    def obj_ids(self) -> list[int]:
        """Objects that `models_info.json` lists."""
        return sorted(self.models_info)

    def mesh_path(self, obj_id: int, eval: bool = False) -> Path:
        """File of a model; with `eval` from `models_eval/` where that holds it.

        Raises:
            DatasetError: there is no such model.
        """
        folders = ("models_eval", "models") if eval else ("models", "models_eval")
        for folder in folders:
            path = self.root / folder / f"obj_{obj_id:06d}.ply"
            if path.is_file():
                return path
        raise DatasetError(f"{self.root / 'models'}: no obj_{obj_id:06d}.ply; known objects are {_some(self.obj_ids)}")

    def mesh(self, obj_id: int, eval: bool = False) -> Mesh:
        """A model in metres; with `eval` the simplified one that BOP scores with, where there is one."""
        path = self.mesh_path(obj_id, eval)
        if path not in self._meshes:
            self._meshes[path] = load_mesh(path, units="mm")
        return self._meshes[path]

    def _scene_json(self, scene_id: int, name: str) -> dict[int, Any]:
        file = self.scene_path(scene_id) / name
        if file not in self._json:
            self._json[file] = integer_keys(read_json(file), file)
        content: dict[int, Any] = self._json[file]
        return content

    def _entry(self, scene_id: int, im_id: int, name: str) -> tuple[Any, str]:
        content = self._scene_json(scene_id, name)
        file = self.scene_path(scene_id) / name
        if im_id not in content:
            raise DatasetError(f"{file}: no entry for image {im_id}; there are {_some(sorted(content))}")
        return content[im_id], f"{file}, image {im_id}"


def _ground_truth(entry: Any, index: int, visib_fract: float | None, where: str) -> GroundTruth:
    obj_id = integer(entry, "obj_id", where)
    t_mm = numbers(entry, "cam_t_m2c", 3, where)
    if np.all(t_mm == NO_POSE_MM):
        nowhere = np.full((4, 4), np.nan)
        return GroundTruth(obj_id=obj_id, T_cam_obj=nowhere, visib_fract=visib_fract, gt_index=index, has_pose=False)
    R = numbers(entry, "cam_R_m2c", 9, where).reshape(3, 3)
    if not bool(se3.is_rotation(R, ROTATION_TOLERANCE)):
        raise DatasetError(f"{where}: 'cam_R_m2c' is not a rotation (9 numbers by rows, determinant +1)")
    return GroundTruth(obj_id=obj_id, T_cam_obj=se3.make_T(R, t_mm * MM), visib_fract=visib_fract, gt_index=index)


def _scenes(split_path: Path) -> list[Path]:
    if not split_path.is_dir():
        return []
    return [path for path in split_path.iterdir() if path.name.isdigit() and (path / "scene_camera.json").is_file()]


def _choose_split(root: Path) -> str:
    splits = sorted(path.name for path in root.iterdir() if path.is_dir() and _scenes(path))
    preferred = [name for name in PREFERRED_SPLITS if name in splits]
    if preferred or len(splits) == 1:
        return (preferred or splits)[0]
    if not splits:
        hint = "; this is a split folder, give the one above" if _scenes(root) else ""
        raise DatasetError(f"{root}: no split with scenes (test/000001/scene_camera.json, ...) in it{hint}")
    raise DatasetError(f"{root}: several splits ({', '.join(splits)}); say which one with --split")


def _some(ids: list[int], limit: int = 8) -> str:
    return ", ".join(map(str, ids[:limit])) + (f", ... ({len(ids)} in all)" if len(ids) > limit else "")
