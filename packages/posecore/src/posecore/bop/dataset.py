"""A BOP dataset folder: cameras, images, ground truth, models and targets, in metres."""

from collections.abc import Iterator
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Bool, Float, UInt8

from posecore.bop.annotations import BopTarget, GroundTruth, camera_matrix, depth_scale, ground_truth, visib_fract
from posecore.bop.file_slice import StoredFile
from posecore.bop.images import image_size, read_depth, read_rgb
from posecore.bop.jsonfile import integer, read_json
from posecore.bop.models_info import MM, ModelInfo, load_models_info
from posecore.bop.sources import Kind, MaskKind, some
from posecore.bop.splits import choose_split, open_source
from posecore.bop.webdataset import ShardSource
from posecore.camera import Camera
from posecore.errors import CameraError, DatasetError
from posecore.mesh import Mesh, load_mesh

__all__ = ["BopDataset", "BopTarget", "GroundTruth"]


class BopDataset:
    """One split of a BOP dataset. Files are read on demand; annotations of the last scenes are cached."""

    def __init__(self, root: str | Path, split: str | None = None, sensor: str | None = None) -> None:
        """Open a dataset folder.

        Args:
            root: folder with `models/` and split folders.
            split: split folder's name; by default test, val, train_pbr, train or the only one, in this order. A name
                with a type (`test_primesense`) counts as the plain one where it is the only one of its kind. A split
                is a folder of scene folders, or of webdataset shards (`*.tar`).
            sensor: which camera of several (`cam1` for `scene_camera_cam1.json` and `rgb_cam1/`). Where scenes differ
                (HOT3D: `rgb,gray1`), of names with commas between them the first that a scene has; scenes without are
                left out. By default the camera without a name, else the only one.

        Raises:
            DatasetError: no such folder, no split with scenes in it, several and none preferred, no such sensor, or
                several and none named.
        """
        self.root = Path(root)
        if not self.root.is_dir():
            raise DatasetError(f"{self.root}: no such folder; give the folder of a BOP dataset")
        self.split = split or choose_split(self.root)
        self.split_path = self.root / self.split
        self.sensor = sensor
        self._source, self.sensors = open_source(self.split_path, sensor)
        self.scene_ids: list[int] = self._source.scene_ids
        self._scenes = set(self.scene_ids)
        self._meshes: dict[Path, Mesh] = {}

    @property
    def name(self) -> str:
        """The folder's name."""
        return self.root.resolve().name

    @property
    def is_sharded(self) -> bool:
        """Whether the split lies in tar files."""
        return isinstance(self._source, ShardSource)

    def scene_path(self, scene_id: int) -> Path:
        """Folder of a scene; it does not exist where scenes lie in tar files.

        Raises:
            DatasetError: there is no such scene.
        """
        self._require(scene_id)
        return self._source.scene_path(scene_id)

    def _require(self, scene_id: int) -> None:
        if scene_id not in self._scenes:
            raise DatasetError(f"{self.split_path}: no scene {scene_id}; there are {some(self.scene_ids)}")

    def files(self, scene_id: int) -> list[Path]:
        """Files that hold a scene's annotations: its JSON files, or the shards it is in."""
        self._require(scene_id)
        return self._source.files(scene_id)

    def forget(self, scene_id: int) -> None:
        """Free a scene's annotations in memory; they are read again when they are needed."""
        self._source.forget(scene_id)

    def im_ids(self, scene_id: int) -> list[int]:
        """Annotated images of a scene; every image with a camera where the scene has no ground truth."""
        return self._source.im_ids(scene_id, "gt" if self.has_gt(scene_id) else "camera")

    def annotation(self, scene_id: int, kind: Kind) -> str:
        """Location of a scene's entries of a kind, for errors; it need not exist."""
        self._require(scene_id)
        return self._source.annotation(scene_id, kind)

    def annotated_by(self, scene_id: int, kind: Kind = "gt") -> str:
        """Annotation that lists the images of a scene, for errors."""
        if kind == "gt" and self.has_gt(scene_id):
            return f"ground truth in {self._source.annotation(scene_id, 'gt')}"
        return f"camera in {self._source.annotation(scene_id, 'camera')}"

    def has_gt(self, scene_id: int) -> bool:
        """Whether the scene comes with ground truth poses."""
        self._require(scene_id)
        return self._source.has(scene_id, "gt")

    def entry(self, scene_id: int, im_id: int, kind: Kind) -> tuple[Any, str] | None:
        """Unparsed annotation of an image and its location for errors; None where the scene has none of this kind.

        Args:
            scene_id: scene.
            im_id: image.
            kind: camera, gt or gt_info.

        Raises:
            DatasetError: the image has no entry, or its JSON is broken.
        """
        self._require(scene_id)
        return self._source.entry(scene_id, im_id, kind) if self._source.has(scene_id, kind) else None

    def annotated_im_ids(self, scene_id: int, kind: Kind) -> list[int]:
        """Images that have an entry of this kind."""
        self._require(scene_id)
        return self._source.im_ids(scene_id, kind) if self._source.has(scene_id, kind) else []

    @cached_property
    def targets(self) -> list[BopTarget]:
        """Objects to be estimated: the split's targets file (BOP19, else BOP24), else all ground truth with a pose.

        Targets without an object (BOP24 detection) are filled in from ground truth.

        Raises:
            DatasetError: the targets name a scene that is not there, or neither targets nor ground truth exist.
        """
        for edition in ("bop19", "bop24"):
            file = self.targets_file(edition)
            if file is not None:
                return sorted(self._listed_targets(file))
        images = [(scene_id, im_id) for scene_id in self.scene_ids for im_id in self.im_ids(scene_id)]
        return [target for image in images for target in self._annotated_targets(*image)]

    def targets_file(self, edition: str) -> Path | None:
        """The split's targets of an edition (bop19, bop24), or None.

        A split with a type (`test_primesense`) has its own or those of the plain split (`test`).
        """
        names = dict.fromkeys((self.split, self.split.split("_")[0]))
        files = [self.root / f"{name}_targets_{edition}.json" for name in names]
        return next((file for file in files if file.is_file()), None)

    def target_images(self, edition: str = "bop24") -> list[tuple[int, int]]:
        """Scene and image of every target of an edition, each once; all images where there is no such file.

        Raises:
            DatasetError: the targets name a scene that is not there.
        """
        file = self.targets_file(edition)
        if file is None:
            return [(scene_id, im_id) for scene_id in self.scene_ids for im_id in self.im_ids(scene_id)]
        return sorted({(scene_id, im_id) for _, scene_id, im_id, _ in self._target_entries(file)})

    def _target_entries(self, file: Path) -> Iterator[tuple[dict[str, Any], int, int, str]]:
        for index, entry in enumerate(read_json(file, list)):
            where = f"{file}, entry {index}"
            scene_id, im_id = integer(entry, "scene_id", where), integer(entry, "im_id", where)
            if scene_id not in self._scenes:
                raise DatasetError(f"{where}: scene {scene_id} is not in {self.split_path}; download or remove it")
            yield entry, scene_id, im_id, where

    def _listed_targets(self, file: Path) -> Iterator[BopTarget]:
        seen: dict[tuple[int, int, int], str] = {}
        for entry, scene_id, im_id, where in self._target_entries(file):
            if "obj_id" not in entry:
                yield from self._annotated_targets(scene_id, im_id)
                continue
            count = integer(entry, "inst_count", where) if "inst_count" in entry else 1
            target = BopTarget(scene_id=scene_id, im_id=im_id, obj_id=integer(entry, "obj_id", where), inst_count=count)
            key = (scene_id, im_id, target.obj_id)
            if key in seen:  # its poses would be expected twice
                raise DatasetError(f"{where}: repeats the object of {seen[key]}; remove one")
            seen[key] = f"entry {where.rsplit(' ', 1)[-1]}"
            yield target

    def _annotated_targets(self, scene_id: int, im_id: int) -> list[BopTarget]:
        annotated = [gt.obj_id for gt in self.gt(scene_id, im_id) if gt.has_pose]
        return [
            BopTarget(scene_id=scene_id, im_id=im_id, obj_id=obj_id, inst_count=annotated.count(obj_id))
            for obj_id in sorted(set(annotated))
        ]

    def camera(self, scene_id: int, im_id: int) -> Camera:
        """Intrinsics of an image; the size is that of the image file, else that in `camera.json`.

        Raises:
            DatasetError: the image has no camera, it is not a pinhole camera, or its size is given nowhere.
        """
        self._require(scene_id)
        entry, where = self._source.entry(scene_id, im_id, "camera")
        K = camera_matrix(entry, where)
        width, height = self._size(scene_id, im_id, entry, where)
        try:
            return Camera(K=K, width_px=width, height_px=height)
        except CameraError as error:
            raise DatasetError(f"{where}: {error}") from error

    def _size(self, scene_id: int, im_id: int, entry: Any, where: str) -> tuple[int, int]:
        image = self._source.image(scene_id, im_id, "colour") or self._source.image(scene_id, im_id, "depth")
        if image is not None:
            return image_size(image)
        model = entry.get("cam_model") if isinstance(entry, dict) else None
        if isinstance(model, dict):
            return integer(model, "image_width", where), integer(model, "image_height", where)
        file = self.camera_file
        about = read_json(file) if file is not None else {}
        if "width" not in about or "height" not in about:
            named = self.root / "camera.json" if file is None else file
            raise DatasetError(f"{self.scene_path(scene_id)}: image {im_id} has no file, and {named} gives no size")
        return integer(about, "width", str(file)), integer(about, "height", str(file))

    @property
    def camera_file(self) -> Path | None:
        """The dataset's `camera.json`, that of the sensor or of the split's type where there is one; else None."""
        kind = self.split.partition("_")[2]
        names = [f"camera_{name}.json" for name in (*self.sensors, kind) if name] + ["camera.json"]
        return next((self.root / name for name in names if (self.root / name).is_file()), None)

    def image_file(self, scene_id: int, im_id: int) -> StoredFile:
        """The colour (else gray) image: png, jpg or tif.

        Raises:
            DatasetError: there is none.
        """
        self._require(scene_id)
        file = self._source.image(scene_id, im_id, "colour")
        if file is None:
            scene = self.scene_path(scene_id)
            raise DatasetError(f"{scene}: no image {im_id:06d} as png, jpg or tif in rgb/ or gray/")
        return file

    def rgb(self, scene_id: int, im_id: int) -> UInt8[np.ndarray, "h w 3"]:
        """The image in RGB; gray is repeated three times."""
        return read_rgb(self.image_file(scene_id, im_id))

    def depth_file(self, scene_id: int, im_id: int) -> StoredFile | None:
        """The depth image: png or tif; None where there is none."""
        self._require(scene_id)
        return self._source.image(scene_id, im_id, "depth")

    def depth_m(self, scene_id: int, im_id: int) -> Float[np.ndarray, "h w"] | None:
        """Camera z in metres, 0 where unknown; None where the image has no depth file.

        What is not finite or below 0 in a floating-point depth image counts as unknown.

        Raises:
            DatasetError: the file is damaged, its scale is not above 0, or its size is not that of the colour image.
        """
        file = self.depth_file(scene_id, im_id)
        if file is None:
            return None
        scale = self.depth_scale(scene_id, im_id)
        raw = read_depth(file)
        colour = self._source.image(scene_id, im_id, "colour")
        size = (raw.shape[1], raw.shape[0])
        if colour is not None and image_size(colour) != size:
            width, height = image_size(colour)
            raise DatasetError(f"{file}: is {size[0]} x {size[1]} pixels, expected {width} x {height} as {colour}")
        depth_m = np.asarray(raw, np.float32) * np.float32(scale * MM)
        return np.where(np.isfinite(depth_m) & (depth_m > 0), depth_m, np.float32(0))

    def depth_scale(self, scene_id: int, im_id: int) -> float:
        """Millimetres for one step of the image's depth; 1 where the files give none.

        Raises:
            DatasetError: it is not above 0.
        """
        self._require(scene_id)
        return depth_scale(*self._source.entry(scene_id, im_id, "camera"))

    def mask(
        self, scene_id: int, im_id: int, gt_index: int, *, visible: bool = False
    ) -> Bool[np.ndarray, "h w"] | None:
        """Annotated silhouette of an object, whole or its visible part; None where the dataset has none.

        Raises:
            DatasetError: the mask is damaged.
        """
        located = self.mask_and_location(scene_id, im_id, gt_index, "mask_visib" if visible else "mask")
        return None if located is None else located[0]

    def mask_and_location(
        self, scene_id: int, im_id: int, gt_index: int, kind: MaskKind
    ) -> tuple[Bool[np.ndarray, "h w"], str] | None:
        """As `mask`, with the file that holds it, for errors."""
        self._require(scene_id)
        return self._source.mask(scene_id, im_id, gt_index, kind)

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
        entries, where = self._source.entry(scene_id, im_id, "gt")
        if not isinstance(entries, list):
            raise DatasetError(f"{where}: found a {type(entries).__name__}, expected a list of objects")
        visibility = self._visibility(scene_id, im_id, len(entries))
        return [
            ground_truth(entry, index, visibility[index], f"{where}, entry {index}")
            for index, entry in enumerate(entries)
        ]

    def instances(self, target: BopTarget) -> list[GroundTruth]:
        """Annotated instances that a target asks for, with a pose: the most visible ones, in that order.

        Raises:
            DatasetError: there is none.
        """
        annotated = [gt for gt in self.gt(target.scene_id, target.im_id) if gt.obj_id == target.obj_id and gt.has_pose]
        if not annotated:
            raise DatasetError(
                f"{self.scene_path(target.scene_id) / 'scene_gt.json'}: image {target.im_id} has no pose of object "
                f"{target.obj_id}, which the targets ask for"
            )
        return sorted(annotated, key=lambda gt: -(1.0 if gt.visib_fract is None else gt.visib_fract))[
            : target.inst_count
        ]

    def _visibility(self, scene_id: int, im_id: int, count: int) -> list[float | None]:
        if not self._source.has(scene_id, "gt_info"):
            return [None] * count
        entries, where = self._source.entry(scene_id, im_id, "gt_info")
        if not isinstance(entries, list) or len(entries) != count:
            raise DatasetError(f"{where}: does not list the {count} objects of the ground truth in the same order")
        return [visib_fract(entry, f"{where}, entry {index}") for index, entry in enumerate(entries)]

    @cached_property
    def models_info(self) -> dict[int, ModelInfo]:
        """Diameters and symmetries, from `models/`, else another models folder."""
        return load_models_info(self.models_info_file)

    @property
    def models_info_file(self) -> Path:
        """The file that `models_info` reads; it may be missing."""
        choices = [folder / "models_info.json" for folder in self.models_folders()]
        return next((file for file in choices if file.is_file()), self.root / "models" / "models_info.json")

    def models_folders(self, eval: bool = False) -> list[Path]:
        """Folders with models that exist, the preferred one first.

        They are `models`, then those of a type (`models_cad`) by name, then those for evaluation (`models_eval`);
        with `eval` these come first.
        """
        folders = sorted(path for path in self.root.glob("models*") if path.is_dir() and _is_models(path.name))
        plain = [path for path in folders if not path.name.endswith("_eval")]
        simplified = [path for path in folders if path.name.endswith("_eval")]
        return simplified + plain if eval else plain + simplified

    @property
    def obj_ids(self) -> list[int]:
        """Objects that `models_info.json` lists."""
        return sorted(self.models_info)

    def mesh_path(self, obj_id: int, eval: bool = False) -> Path:
        """File of a model; with `eval` from `models_eval/` where that holds it.

        Raises:
            DatasetError: there is no such model.
        """
        for folder in self.models_folders(eval):
            path = folder / f"obj_{obj_id:06d}.ply"
            if path.is_file():
                return path
        raise DatasetError(f"{self.root / 'models'}: no obj_{obj_id:06d}.ply; known objects are {some(self.obj_ids)}")

    def mesh(self, obj_id: int, eval: bool = False) -> Mesh:
        """A model in metres; with `eval` the simplified one that BOP scores with, where there is one."""
        return self.mesh_at(self.mesh_path(obj_id, eval))

    def mesh_at(self, path: Path) -> Mesh:
        """A file of a models folder in metres, read once."""
        if path not in self._meshes:
            self._meshes[path] = load_mesh(path, units="mm")
        return self._meshes[path]

    def center_m(self, obj_id: int) -> Float[np.ndarray, "3"]:
        """Centre of an object, in its frame, metres: `Mesh.center_m` of the full model.

        That of a simplified model differs, by up to 0.4 mm on LM-O.
        """
        return self.mesh(obj_id).center_m


def _is_models(name: str) -> bool:
    return name == "models" or name.startswith("models_")
