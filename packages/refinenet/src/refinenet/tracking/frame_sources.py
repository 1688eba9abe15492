"""Sources of frames to track: a BOP scene, a folder of images, a video file."""

import itertools
import re
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Protocol, runtime_checkable

import cv2
import numpy as np
from jaxtyping import Float, UInt8
from posecore.bop import BopDataset
from posecore.bop.images import COLOUR_EXTENSIONS, read_rgb
from posecore.bop.jsonfile import id_of, integer, numbers, read_json
from posecore.camera import Camera, intrinsics
from posecore.errors import CameraError, ConfigError, DatasetError
from posecore.files import require_regular

from refinenet.refine.image_poses import load_frame
from refinenet.refiner import Frame, PoseRefiner

MIN_FRAME_FRACTION = 0.9
"""Least fraction of the frame count in a video's header that must decode; containers count inexactly."""


@runtime_checkable
class FrameSequence(Protocol):
    """Frames in order, with the image numbers of the BOP result file."""

    @property
    def scene_id(self) -> int:
        """Scene in the result file."""
        ...

    def __len__(self) -> int:
        """Number of frames; of a video, the count in its header."""
        ...

    def frames(self, method: PoseRefiner) -> Iterator[tuple[int, Frame]]:
        """Yield image number and frame, with depth where the method needs it.

        Raises:
            DatasetError: A frame has no depth, or is damaged.
        """
        ...


@dataclass(frozen=True, kw_only=True, eq=False)
class BopScene:
    """A scene of a BOP dataset, its images in rising order."""

    dataset: BopDataset
    scene_id: int

    def __len__(self) -> int:
        return len(self._numbers())

    def frames(self, method: PoseRefiner) -> Iterator[tuple[int, Frame]]:
        """Yield image id and frame."""
        for im_id in self._numbers():
            yield im_id, load_frame(self.dataset, self.scene_id, im_id, method)

    def _numbers(self) -> list[int]:
        return sorted(self.dataset.annotated_im_ids(self.scene_id, "camera"))


@dataclass(frozen=True, kw_only=True, eq=False)
class ImageFolder:
    """The images of a folder, ordered by the numbers in their names: `f2` is before `f10`.

    Names that are numbers of 64 bits become the frame numbers, such as ROS stamps; others are numbered from 0.
    """

    folder: Path
    camera: "FileCamera"
    scene_id: int = 0

    def __post_init__(self) -> None:
        files = self._files()
        if not files:
            kinds = ", ".join(COLOUR_EXTENSIONS)
            raise DatasetError(f"{self.folder}: no images ({kinds}) in it; give a folder of images")
        for file, after in itertools.pairwise(files):
            if (number := id_of(file.stem)) is not None and number == id_of(after.stem):
                raise DatasetError(f"{self.folder}: {file.name} and {after.name} have one number; keep one file")

    def __len__(self) -> int:
        return len(self._files())

    def frames(self, method: PoseRefiner) -> Iterator[tuple[int, Frame]]:
        """Yield number and frame."""
        _refuse_depth(method, self.folder)
        files = self._files()
        ids = [id_of(file.stem) for file in files]
        are_ids = None not in ids
        for index, (file, im_id) in enumerate(zip(files, ids, strict=True)):
            yield index if im_id is None or not are_ids else im_id, self.camera.frame(read_rgb(file), str(file))

    def _files(self) -> list[Path]:
        images = (p for p in self.folder.iterdir() if p.suffix.lower().lstrip(".") in COLOUR_EXTENSIONS)
        return sorted(images, key=_with_numbers)


def _with_numbers(file: Path) -> tuple[list[tuple[str, int]], str]:
    """Sort key of a file name: text and numbers in turn."""
    return [(text, int(digits or 0)) for text, digits in re.findall(r"(\D*)(\d*)", file.stem)], file.name


@dataclass(frozen=True, kw_only=True, eq=False)
class VideoFile:
    """The frames of a video file, from 0, as OpenCV decodes them."""

    file: Path
    camera: "FileCamera"
    scene_id: int = 0

    def __post_init__(self) -> None:
        try:
            require_regular(self.file, None)
        except OSError as error:
            raise DatasetError(f"{self.file}: cannot be read ({error.strerror}); give a video file") from error
        video = cv2.VideoCapture(str(self.file))
        opened = video.isOpened()
        video.release()
        if not opened:
            raise DatasetError(f"{self.file}: OpenCV cannot open it as a video; convert it, or give a folder of images")

    def __len__(self) -> int:
        video = cv2.VideoCapture(str(self.file))
        count = int(video.get(cv2.CAP_PROP_FRAME_COUNT))
        video.release()
        return max(count, 0)

    def frames(self, method: PoseRefiner) -> Iterator[tuple[int, Frame]]:
        """Yield number and frame."""
        _refuse_depth(method, self.file)
        video = cv2.VideoCapture(str(self.file))
        try:
            number = 0
            while True:
                ok, image = video.read()
                if not ok:
                    break
                yield number, self.camera.frame(_rgb(image), str(self.file))
                number += 1
        finally:
            video.release()
        if number == 0:
            raise DatasetError(f"{self.file}: no frame can be decoded; convert it, or give a folder of images")
        if number < MIN_FRAME_FRACTION * len(self):
            raise DatasetError(
                f"{self.file}: ends after frame {number} of {len(self)}, it is damaged or cut off; "
                "copy or convert it anew"
            )


def _refuse_depth(method: PoseRefiner, source: Path) -> None:
    if method.needs_depth:
        raise DatasetError(f"{source}: images and videos have no depth, which {method.name} needs; give a BOP dataset")


def open_scene(dataset: Path, *, split: str | None, scene: int | None, camera: Path | None) -> BopScene:
    """A scene of a BOP dataset.

    Args:
        dataset: Folder.
        split: Split.
        scene: Scene; optional where there is only one.
        camera: None; those of images and videos are refused.

    Raises:
        DatasetError: There is no such folder, or it holds no scene.
        ConfigError: It is no BOP dataset, the scene is ambiguous, or an option is for the other kind of source.
    """
    _require_existing(dataset)
    if not _is_bop_dataset(dataset):
        raise ConfigError(f"--dataset {dataset}: found no models folder in it, expected a BOP dataset")
    if camera is not None:
        raise ConfigError("--camera is for images and videos; a BOP dataset brings its own cameras")
    opened = BopDataset(dataset, split)
    if scene is None and len(opened.scene_ids) > 1:
        some = ", ".join(map(str, opened.scene_ids[:10]))
        raise ConfigError(f"{dataset}: has {len(opened.scene_ids)} scenes ({some}); choose one with --scene")
    sequence = BopScene(dataset=opened, scene_id=opened.scene_ids[0] if scene is None else scene)
    opened.scene_path(sequence.scene_id)
    return sequence


def open_images(source: Path, *, split: str | None, scene: int | None, camera: Path | None) -> ImageFolder | VideoFile:
    """The images of a folder, or of a video file.

    Args:
        source: Folder or file.
        split: None; that of a BOP dataset is refused.
        scene: Scene in the result file.
        camera: BOP `camera.json`.

    Raises:
        DatasetError: There is no such path, or it holds no frames.
        ConfigError: A camera is missing, the folder is a BOP dataset, or an option is for one.
        CameraError: The file holds no camera.
    """
    _require_existing(source)
    if _is_bop_dataset(source):
        raise ConfigError(f"track {source} is now track --dataset {source}, since it is a BOP dataset")
    if split is not None:
        raise ConfigError(f"--split is for BOP datasets; {source} has no models folder, so it is none")
    if camera is None:
        raise ConfigError(f"{source}: images and videos need --camera, a BOP camera.json with fx, fy, cx, cy")
    file_camera = read_camera(camera)
    if source.is_dir():
        return ImageFolder(folder=source, camera=file_camera, scene_id=scene or 0)
    return VideoFile(file=source, camera=file_camera, scene_id=scene or 0)


def _require_existing(path: Path) -> None:
    if not path.exists():
        raise DatasetError(f"{path}: no such folder or file; give a BOP dataset, a folder of images or a video")


def _is_bop_dataset(path: Path) -> bool:
    """Whether a folder has one of models, `models` or `models_eval`, as BOP datasets do."""
    return any(folder.is_dir() for name in ("models", "models_*") for folder in path.glob(name))


@dataclass(frozen=True, kw_only=True, eq=False)
class FileCamera:
    """A camera from a file.

    Attributes:
        file: Camera file.
        K: Camera matrix.
        size_px: Width and height of the images; None where the file has no size.
    """

    file: Path
    K: Float[np.ndarray, "3 3"]
    size_px: tuple[int, int] | None = None

    def frame(self, image: UInt8[np.ndarray, "h w 3"], name: str) -> Frame:
        """An image from this camera as a frame.

        Raises:
            CameraError: The image has another size than the camera.
        """
        size_px = (image.shape[1], image.shape[0])
        if self.size_px is not None and size_px != self.size_px:
            raise CameraError(
                f"{name}: found {size_px[0]} x {size_px[1]} px, expected {self.size_px[0]} x {self.size_px[1]} px as "
                f"in {self.file}; give the camera of these images"
            )
        try:
            return Frame(image=image, K=self.K)
        except CameraError as error:
            raise CameraError(f"{name}, with {self.file}: {error}") from error


def read_camera(file: Path) -> FileCamera:
    """Read a BOP `camera.json`: fx, fy, cx, cy in pixels, optionally width and height.

    Raises:
        CameraError: The file is missing, not JSON, or lacks a focal length or principal point.
    """
    try:
        content = read_json(file)
        fx, fy, cx, cy = (float(numbers(content, key, 1, str(file))[0]) for key in ("fx", "fy", "cx", "cy"))
        has_size = {"width", "height"} <= content.keys()
        width_px, height_px = (integer(content, key, str(file)) if has_size else 1 for key in ("width", "height"))
        camera = Camera(K=intrinsics(fx, fy, cx, cy), width_px=width_px, height_px=height_px)
    except DatasetError as error:
        raise CameraError(f"{error}; give a BOP camera.json") from error
    except CameraError as error:
        raise CameraError(f"{file}: {error}") from error
    return FileCamera(file=file, K=camera.K, size_px=(width_px, height_px) if has_size else None)


def _rgb(image: UInt8[np.ndarray, "h w 3"]) -> UInt8[np.ndarray, "h w 3"]:
    return np.asarray(cv2.cvtColor(image, cv2.COLOR_BGR2RGB))
