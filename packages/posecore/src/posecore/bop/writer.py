"""Writer of BOP datasets: frame by frame, images first, the JSON that lists them last."""

import json
import os
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from types import TracebackType
from typing import Any

import numpy as np
from jaxtyping import Bool, Float, UInt8

from posecore.bop.dataset import BopTarget, GroundTruth
from posecore.bop.images import write_image
from posecore.bop.jsonfile import as_list, integer_keys, read_json, write_json
from posecore.bop.models_info import MM, ModelInfo, save_models_info
from posecore.camera import Camera
from posecore.errors import DatasetError
from posecore.files import read_regular, storage_error, write_atomic
from posecore.mesh import Mesh, save_ply

SCENE_FILES = ("scene_gt_info.json", "scene_camera.json", "scene_gt.json")
"""In writing order: scene_gt.json, which lists the frames, is the last."""
JOURNAL = ".frames.jsonl"


@dataclass(frozen=True, kw_only=True, eq=False)
class FrameEntry:
    """Entries of a frame in the three JSON files of its scene. Plain data, so that another process can make it."""

    info: list[dict[str, Any]]
    camera: dict[str, Any]
    gt: list[dict[str, Any]]


@dataclass(frozen=True, kw_only=True, eq=False)
class FrameRecord:
    """One image with its ground truth.

    Attributes:
        rgb: Colour image.
        depth_m: Camera z, 0 where unknown; None for a dataset without depth.
        camera: Intrinsics of this image.
        gts: Annotated objects.
        masks: Full silhouette of each object, as if nothing occluded it. A mask may be larger than the image, so that
            boxes and pixel counts cover parts outside the image.
        masks_visib: Visible part of each silhouette.
        mask_origin_px: Column and row in `masks` of the image's top left pixel.
        T_cam_world: Pose of the world that the frames of a scene share, metres, for BOP's optional `cam_R_w2c` and
            `cam_t_w2c`.
    """

    rgb: UInt8[np.ndarray, "h w 3"]
    depth_m: Float[np.ndarray, "dh dw"] | None
    camera: Camera
    gts: Sequence[GroundTruth]
    masks: Sequence[Bool[np.ndarray, "mh mw"]]
    masks_visib: Sequence[Bool[np.ndarray, "vh vw"]]
    mask_origin_px: tuple[int, int] = (0, 0)
    T_cam_world: Float[np.ndarray, "4 4"] | None = None


@dataclass(frozen=True, kw_only=True)
class FrameFiles:
    """Writes the image files of frames, from any number of processes at once.

    Attributes:
        scene_path: Folder of the scene.
        depth_scale: Millimetres for one step of the 16-bit depth image.
        image_format: png or jpg.
        jpeg_quality: 1 to 100, for jpg.

    Raises:
        DatasetError: Another image format.
    """

    scene_path: Path
    depth_scale: float = 0.1
    image_format: str = "png"
    jpeg_quality: int = 95

    def __post_init__(self) -> None:
        if self.image_format not in ("png", "jpg"):
            raise DatasetError(f"image format: found '{self.image_format}', expected png or jpg")

    def write(self, im_id: int, frame: FrameRecord) -> FrameEntry:
        """Write colour, depth and masks of a frame, which counts once its entry is committed.

        Raises:
            DatasetError: counts or sizes disagree, or a depth does not fit into 16 bits.
        """
        gts, masks, masks_visib, depth_m = frame.gts, frame.masks, frame.masks_visib, frame.depth_m
        size = frame.rgb.shape[:2]
        where = f"{self.scene_path}, image {im_id}"
        if len(gts) != len(masks) or len(gts) != len(masks_visib):
            raise DatasetError(f"{where}: {len(gts)} objects, {len(masks)} masks, {len(masks_visib)} visible masks")
        width_px, height_px = frame.camera.width_px, frame.camera.height_px
        if size != (height_px, width_px):
            raise DatasetError(f"{where}: the image is {size[1]} x {size[0]}, the camera {width_px} x {height_px}")
        if depth_m is not None and depth_m.shape != size:
            raise DatasetError(
                f"{where}: the image is {size[1]} x {size[0]}, depth {depth_m.shape[1]} x {depth_m.shape[0]}"
            )
        column, row = frame.mask_origin_px
        cropped = [mask[row : row + size[0], column : column + size[1]] for mask in masks]
        if any(mask.shape != size for mask in [*cropped, *masks_visib]):
            raise DatasetError(f"{where}: a mask does not cover the image of {size[1]} x {size[0]} pixels")
        self._write_images(im_id, frame.rgb, depth_m, where)
        info = []
        for index, (full, inside, visible) in enumerate(zip(masks, cropped, masks_visib, strict=True)):
            self._write_mask("mask", im_id, index, inside)
            self._write_mask("mask_visib", im_id, index, visible)
            info.append(gt_info(full, inside, visible, depth_m, frame.mask_origin_px))
        entry: dict[str, Any] = {"cam_K": as_list(frame.camera.K), "depth_scale": self.depth_scale}
        if frame.T_cam_world is not None:
            R, t_m = frame.T_cam_world[:3, :3], frame.T_cam_world[:3, 3]
            entry |= {"cam_R_w2c": as_list(R), "cam_t_w2c": as_list(t_m / MM)}
        return FrameEntry(info=info, camera=entry, gt=[_gt_entry(gt) for gt in gts])

    def _write_images(
        self, im_id: int, rgb: UInt8[np.ndarray, "h w 3"], depth_m: Float[np.ndarray, "h w"] | None, where: str
    ) -> None:
        name = f"{im_id:06d}"
        write_image(self.scene_path / "rgb" / f"{name}.{self.image_format}", rgb, self.jpeg_quality)
        if depth_m is None:
            return
        steps = np.rint(np.asarray(depth_m, np.float64) / (MM * self.depth_scale))
        if steps.min() < 0 or steps.max() > 65535 or not np.isfinite(steps).all():
            limit = 65535 * self.depth_scale * MM
            raise DatasetError(f"{where}: a depth is outside 0 to {limit:.3g} m; choose a larger depth scale")
        write_image(self.scene_path / "depth" / f"{name}.png", steps.astype(np.uint16))

    def _write_mask(self, folder: str, im_id: int, index: int, mask: Bool[np.ndarray, "h w"]) -> None:
        write_image(self.scene_path / folder / f"{im_id:06d}_{index:06d}.png", mask.astype(np.uint8) * 255)


class BopWriter:
    """Writes one scene. A scene that exists already is continued; a frame that exists is replaced.

    Frames are noted in a journal beside the images, one line each, and the scene's JSON files are made from it when
    the writer is closed: writing them anew for each frame would cost the square of their number. A journal that a
    killed process leaves behind is taken up by the next writer, but for a last line that was cut off.
    """

    def __init__(
        self,
        root: str | Path,
        split: str,
        scene_id: int,
        *,
        depth_scale: float = 0.1,
        image_format: str = "png",
        jpeg_quality: int = 95,
    ) -> None:
        """Open a scene for writing.

        Args:
            root: dataset folder.
            split: split folder's name.
            scene_id: number of the scene folder.
            depth_scale: millimetres for one step of the 16-bit depth image.
            image_format: png or jpg.
            jpeg_quality: 1 to 100, for jpg.

        Raises:
            DatasetError: another image format, or the scene's JSON files are broken.
        """
        self.root = Path(root)
        self.files = FrameFiles(
            scene_path=scene_folder(root, split, scene_id),
            depth_scale=depth_scale,
            image_format=image_format,
            jpeg_quality=jpeg_quality,
        )
        self.scene_path = self.files.scene_path
        self._journal = self.scene_path / JOURNAL
        self._entries: dict[int, tuple[str, ...]] = self._finished() | self._noted()
        self._is_closed = False

    def _finished(self) -> dict[int, tuple[str, ...]]:
        files = [self.scene_path / name for name in SCENE_FILES]
        if not files[-1].is_file():  # the last one written: without it none of the frames counts
            return {}
        contents = [integer_keys(read_json(file), file) for file in files]
        complete = set(contents[0]).intersection(*contents[1:])
        return {im_id: tuple(json.dumps(content[im_id]) for content in contents) for im_id in complete}

    def _noted(self) -> dict[int, tuple[str, ...]]:
        """The journal's frames; a partial last line is truncated."""
        try:
            data = read_regular(self._journal) if self._journal.is_file() else b""
            whole = data[: data.rfind(b"\n") + 1]
            if len(whole) < len(data):
                os.truncate(self._journal, len(whole))
        except OSError as error:
            raise storage_error(self._journal, error) from error
        noted: dict[int, tuple[str, ...]] = {}
        for number, line in enumerate(whole.splitlines(), 1):
            try:
                im_id, *entries = json.loads(line)
            except ValueError as error:
                raise DatasetError(f"{self._journal}:{number}: not JSON; delete it and start again") from error
            noted[int(im_id)] = tuple(json.dumps(entry) for entry in entries)
        return noted

    def __enter__(self) -> "BopWriter":
        """Use the writer in a with statement."""
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, at: TracebackType | None) -> None:
        """Close the scene, also after an error: its frames up to there count."""
        self.close()

    @property
    def im_ids(self) -> list[int]:
        """Frames that are complete on disk."""
        return sorted(self._entries)

    def add_frame(self, im_id: int, frame: FrameRecord) -> None:
        """Write one frame; it survives the process once this returns. See `FrameFiles.write`."""
        self.commit(im_id, self.files.write(im_id, frame))
        if not (self.root / "camera.json").exists():
            write_camera(self.root, frame.camera, self.files.depth_scale)

    def commit(self, im_id: int, entry: FrameEntry) -> None:
        """Note a frame whose files are written.

        Raises:
            DatasetError: the writer is closed.
            StorageError: the journal cannot be written.
        """
        if self._is_closed:
            raise DatasetError(f"{self.scene_path}, image {im_id}: the scene is closed; open it with another writer")
        entries = (entry.info, entry.camera, entry.gt)
        line = json.dumps([im_id, *entries]) + "\n"
        try:
            self._journal.parent.mkdir(parents=True, exist_ok=True)
            with self._journal.open("ab") as stream:
                stream.write(line.encode())
                stream.flush()
                os.fsync(stream.fileno())
        except OSError as error:
            raise storage_error(self._journal, error, len(line)) from error
        self._entries[im_id] = tuple(json.dumps(e) for e in entries)

    def close(self) -> None:
        """Write the scene's JSON files and remove the journal. Closing twice does nothing."""
        if self._is_closed:
            return
        self._is_closed = True
        if not self._journal.is_file():
            return
        for number, name in enumerate(SCENE_FILES):
            body = ",\n".join(f'  "{im_id}": {self._entries[im_id][number]}' for im_id in sorted(self._entries))
            write_atomic(self.scene_path / name, f"{{\n{body}\n}}\n".encode())
        try:
            self._journal.unlink()
        except OSError as error:
            raise storage_error(self._journal, error) from error


def scene_folder(root: str | Path, split: str, scene_id: int) -> Path:
    """Folder of a scene."""
    return Path(root) / split / f"{scene_id:06d}"


def gt_info(
    full: Bool[np.ndarray, "mh mw"],
    inside: Bool[np.ndarray, "h w"],
    visible: Bool[np.ndarray, "h w"],
    depth_m: Float[np.ndarray, "h w"] | None,
    mask_origin_px: tuple[int, int] = (0, 0),
) -> dict[str, Any]:
    """The entry of `scene_gt_info.json` for one object.

    Definitions are those of bop_toolkit's calc_gt_info: `px_count_all` counts the whole silhouette, also outside the
    image; `px_count_valid` its pixels in the image whose depth is known (all pixels without depth);
    `visib_fract` = visible / all; a box is x, y of its first pixel and last minus first pixel as width and height, and
    all -1 where nothing is visible.
    """
    count_all, count_visible = int(full.sum()), int(visible.sum())
    valid = inside if depth_m is None else inside & (depth_m > 0)
    return {
        "bbox_obj": _box(full, mask_origin_px) if count_visible else [-1] * 4,
        "bbox_visib": _box(visible, (0, 0)),
        "px_count_all": count_all,
        "px_count_valid": int(valid.sum()),
        "px_count_visib": count_visible,
        "visib_fract": count_visible / count_all if count_all else 0.0,
    }


def _box(mask: Bool[np.ndarray, "h w"], origin_px: tuple[int, int]) -> list[int]:
    rows, columns = np.flatnonzero(mask.any(axis=1)), np.flatnonzero(mask.any(axis=0))
    if not len(rows):
        return [-1] * 4
    left, top = int(columns[0]) - origin_px[0], int(rows[0]) - origin_px[1]
    return [left, top, int(columns[-1] - columns[0]), int(rows[-1] - rows[0])]


def _gt_entry(gt: GroundTruth) -> dict[str, Any]:
    if not gt.has_pose:
        return {"cam_R_m2c": [-1.0] * 9, "cam_t_m2c": [-1.0] * 3, "obj_id": gt.obj_id}
    R, t_m = gt.T_cam_obj[:3, :3], gt.T_cam_obj[:3, 3]
    return {"cam_R_m2c": as_list(R), "cam_t_m2c": as_list(t_m / MM), "obj_id": gt.obj_id}


def write_camera(root: str | Path, camera: Camera, depth_scale: float = 0.1) -> None:
    """Write the dataset's `camera.json`: the image size and the first image's intrinsics."""
    fx, fy, cx, cy = (float(camera.K[i, j]) for i, j in ((0, 0), (1, 1), (0, 2), (1, 2)))
    content = {"cx": cx, "cy": cy, "depth_scale": depth_scale, "fx": fx, "fy": fy}
    write_json(Path(root) / "camera.json", content | {"width": camera.width_px, "height": camera.height_px})


def write_models(root: str | Path, meshes: Mapping[int, Mesh], infos: Mapping[int, ModelInfo] | None = None) -> None:
    """Write `models/obj_{id:06d}.ply` (millimetres) and `models_info.json`; symmetries come from `infos`."""
    folder = Path(root) / "models"
    for obj_id, mesh in meshes.items():
        save_ply(mesh, folder / f"obj_{obj_id:06d}.ply", units="mm")
    save_models_info(folder / "models_info.json", dict(meshes), dict(infos or {}))


def write_targets(root: str | Path, split: str, targets: Iterable[BopTarget]) -> None:
    """Write the split's targets in BOP19's format (objects and how often) and BOP24's (images only)."""
    ordered = sorted(targets)
    content = [
        {"im_id": target.im_id, "inst_count": target.inst_count, "obj_id": target.obj_id, "scene_id": target.scene_id}
        for target in ordered
    ]
    write_json(Path(root) / f"{split}_targets_bop19.json", content)
    images = sorted({(target.scene_id, target.im_id) for target in ordered})
    write_json(
        Path(root) / f"{split}_targets_bop24.json",
        [{"im_id": im_id, "scene_id": scene_id} for scene_id, im_id in images],
    )


def visible_targets(root: str | Path, split: str, scene_id: int, min_visible: float = 0.1) -> list[BopTarget]:
    """Targets of a scene: each object of an image with the number of instances that are visible enough.

    The rule is that of bop_toolkit's enumerate_test_targets: instances count from a visible fraction of 0.1, and an
    object without one is not a target.

    Args:
        root: dataset folder.
        split: split folder's name.
        scene_id: a finished scene.
        min_visible: smallest visible fraction.
    """
    folder = scene_folder(root, split, scene_id)
    annotated, info = read_json(folder / "scene_gt.json"), read_json(folder / "scene_gt_info.json")
    targets = []
    for im_id, gts in annotated.items():
        seen = Counter(
            gt["obj_id"] for gt, about in zip(gts, info[im_id], strict=True) if about["visib_fract"] >= min_visible
        )
        targets += [
            BopTarget(scene_id=scene_id, im_id=int(im_id), obj_id=obj_id, inst_count=count)
            for obj_id, count in seen.items()
        ]
    return sorted(targets)
