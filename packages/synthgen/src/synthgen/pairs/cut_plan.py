"""Plan of the training pairs to cut out of annotated images, real or rendered; `synthgen.pairs.cut` cuts them.

Hypotheses are drawn around the annotated poses, or read from a result file, so that a refiner can be trained on the
errors of a detector or on its previous results.
"""

import hashlib
from collections import Counter, defaultdict
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import cv2
import numpy as np
from jaxtyping import Float
from posecore import se3
from posecore.bop import BopDataset, GroundTruth, read_results
from posecore.camera import Camera, project
from posecore.errors import DatasetError
from posecore.mesh import Mesh
from posecore.window import Window, diameter_window, fixed_side_px, fixed_window, silhouette_box

from synthgen.config import CutConfig
from synthgen.draw.poses import draw_hypothesis, fraction_inside
from synthgen.draw.random_streams import Purpose, Subject, stream
from synthgen.draw.target import hull
from synthgen.image.region import contains

Pose = Float[np.ndarray, "4 4"]


@dataclass(frozen=True, kw_only=True, eq=False)
class PairToCut:
    """One pair to cut.

    Attributes:
        number: Number of the hypothesis among those of the pose.
        gt: The annotated pose, its rotation made orthonormal.
        T_cam_obj_hypothesis: The hypothesis.
        window: Crop window of both patches.
    """

    number: int
    gt: GroundTruth
    T_cam_obj_hypothesis: Pose
    window: Window


@dataclass(frozen=True, kw_only=True, eq=False)
class AnnotatedImage:
    """One annotated image with its pairs.

    Attributes:
        scene_id, im_id: BOP scene and image in the source.
        number: Position among the source's images, the address of the draws.
        scene_index: Scene in the dataset of pairs, see `CutConfig.images_per_scene`.
        camera: Camera of the image.
        annotated: Annotated poses in front of the camera.
        pairs: Pairs to cut.
    """

    scene_id: int
    im_id: int
    number: int
    scene_index: int
    camera: Camera
    annotated: Sequence[GroundTruth]
    pairs: Sequence[PairToCut] = ()


@dataclass(frozen=True, kw_only=True, eq=False)
class Plan:
    """All pairs to cut, decided before any image is read.

    Attributes:
        images: Images in the order in which they fill shards.
        meshes: Meshes of the objects with pairs, by object id.
        windows_px: Side of each object's fixed window in the full image.
        left_out: Number of poses and hypotheses without a pair, by reason.
        digest: Hash of the source, by which a continued run recognises it: sizes of image files, cameras, poses,
            hypotheses.
    """

    images: Sequence[AnnotatedImage]
    meshes: Mapping[int, Mesh]
    windows_px: Mapping[int, float]
    left_out: Mapping[str, int]
    digest: str

    @property
    def n(self) -> int:
        """Number of pairs."""
        return sum(len(image.pairs) for image in self.images)


class _PairSelector:
    """Selects the pairs of images."""

    def __init__(self, config: CutConfig, meshes: Mapping[int, Mesh], images: Sequence[AnnotatedImage]) -> None:
        self.meshes = meshes
        self.left_out: Counter[str] = Counter()
        self._config = config
        self._hulls_m = {obj_id: hull(mesh) for obj_id, mesh in meshes.items()}
        self.windows_px = self._fixed_windows(images)

    def rejection(self, image: AnnotatedImage, gt: GroundTruth) -> str:
        """Reason why an annotated pose is left out; empty where it is used."""
        least = self._config.min_visible
        if gt.visib_fract is not None and gt.visib_fract < least:
            return f"poses are visible by less than {least:g}"
        box = silhouette_box(self._hulls_m[gt.obj_id], image.camera.K, gt.T_cam_obj)
        if fraction_inside(box, image.camera) < max(least, 1e-6):
            return f"poses lie in the image by less than {least:g}"
        return ""

    def pairs(self, image: AnnotatedImage, hypotheses: Sequence[tuple[int, Pose]] | None) -> Iterator[PairToCut]:
        """Pairs of an image with the hypotheses of a file (object id and pose), or with drawn ones (None)."""
        reasons = {gt.gt_index: self.rejection(image, gt) for gt in image.annotated}
        self.left_out.update(reason for reason in reasons.values() if reason)
        candidates = self._drawn(image) if hypotheses is None else self._nearest(image, hypotheses)
        for number, gt, T_hypothesis in candidates:
            if reasons[gt.gt_index]:
                if hypotheses is not None:
                    self.left_out["hypotheses are of poses that are left out"] += 1
                continue
            window = self._window(image.camera, gt, T_hypothesis)
            if window is not None:
                yield PairToCut(number=number, gt=gt, T_cam_obj_hypothesis=T_hypothesis, window=window)

    def _fixed_windows(self, images: Sequence[AnnotatedImage]) -> dict[int, float]:
        """Window side of every object, large enough for its largest pose in the images (focal length over distance)."""
        nearest: dict[int, tuple[float, np.ndarray, float]] = {}
        for image in images:
            K = image.camera.K
            for gt in image.annotated:
                if self.rejection(image, gt):
                    continue
                z = float(self.meshes[gt.obj_id].center_cam_m(gt.T_cam_obj)[2])
                magnification = max(K[0, 0], K[1, 1]) / z
                if gt.obj_id not in nearest or magnification > nearest[gt.obj_id][0]:
                    nearest[gt.obj_id] = magnification, K, z
        return {
            obj_id: fixed_side_px(self._hulls_m[obj_id] - self.meshes[obj_id].center_m, K, z, self._config.padding)
            for obj_id, (_, K, z) in sorted(nearest.items())
        }

    def _drawn(self, image: AnnotatedImage) -> Iterator[tuple[int, GroundTruth, Pose]]:
        config = self._config
        for gt in image.annotated:
            for number in range(config.hypotheses_per_pose):
                address = (image.number, gt.gt_index, number)
                rng = stream(config.seed, Purpose.ANNOTATED, Subject.HYPOTHESIS, *address)
                yield number, gt, draw_hypothesis(rng, config.perturbation, gt.T_cam_obj, self.meshes[gt.obj_id])

    def _nearest(
        self, image: AnnotatedImage, hypotheses: Sequence[tuple[int, Pose]]
    ) -> Iterator[tuple[int, GroundTruth, Pose]]:
        """Hypotheses, each with the annotated instance whose centre is nearest."""
        counts: Counter[int] = Counter()
        for obj_id, T_hypothesis in hypotheses:
            instances = [gt for gt in image.annotated if gt.obj_id == obj_id]
            if not instances:
                self.left_out["hypotheses are of objects that are not annotated there"] += 1
                continue
            mesh = self.meshes[obj_id]
            centre = mesh.center_cam_m(T_hypothesis)
            distances_m = [np.linalg.norm(mesh.center_cam_m(gt.T_cam_obj) - centre) for gt in instances]
            gt = instances[int(np.argmin(distances_m))]
            yield counts[gt.gt_index], gt, T_hypothesis
            counts[gt.gt_index] += 1

    def _window(self, camera: Camera, gt: GroundTruth, T_hypothesis: Pose) -> Window | None:
        """The window of a pair, None where a silhouette is outside the window or too small."""
        mesh, hull_m, config = self.meshes[gt.obj_id], self._hulls_m[gt.obj_id], self._config
        boxes = [silhouette_box(hull_m, camera.K, T) for T in (gt.T_cam_obj, T_hypothesis)]
        if not np.isfinite(boxes).all():
            self.left_out["pairs reach behind the camera"] += 1
            return None
        if config.window == "fixed":
            window = fixed_window(hull_m, camera.K, T_hypothesis, self.windows_px[gt.obj_id])
        else:
            window = diameter_window(camera.K, T_hypothesis, mesh.center_m, mesh.diameter_m, config.scale)
        if not all(contains(window, box) for box in boxes):
            self.left_out["pairs do not fit into their windows (more scale, or padding of fixed ones, helps)"] += 1
            return None
        area_px = min(_hull_area_px(camera.K, se3.apply(T, hull_m)) for T in (gt.T_cam_obj, T_hypothesis))
        if area_px * min(1.0, (config.patch_px / window.side_px) ** 2) < config.min_area_px:
            self.left_out[f"pairs show an object on less than {config.min_area_px:g} pixels"] += 1
            return None
        return window


def _hull_area_px(K: Float[np.ndarray, "3 3"], points_m: Float[np.ndarray, "h 3"]) -> float:
    """Area of a silhouette's convex hull."""
    return float(cv2.contourArea(cv2.convexHull(project(K, points_m).astype(np.float32))))


def plan(dataset: BopDataset, config: CutConfig, hypotheses: str | Path | None = None) -> Plan:
    """Plan the pairs to cut.

    Args:
        dataset: Images with ground truth.
        config: Configuration.
        hypotheses: Result file; each line is a hypothesis of the nearest annotated instance of its object.

    Raises:
        DatasetError: There is no ground truth, images are of several sizes, or there is no pair to cut.
        ResultFileError: The result file is broken, or of other images.
    """
    by_image = None if hypotheses is None else _hypotheses_by_image(dataset, hypotheses)
    images = _images(dataset, None if by_image is None else set(by_image), config)
    _require_one_size(dataset, images, one_focal_length=config.window == "fixed")
    meshes = {i: dataset.mesh(i) for i in sorted({gt.obj_id for image in images for gt in image.annotated})}
    selector = _PairSelector(config, meshes, images)
    planned, digest = [], hashlib.sha256()
    for image in images:
        poses = None if by_image is None else by_image[image.scene_id, image.im_id]
        pairs = tuple(selector.pairs(image, poses))
        if pairs:
            planned.append(replace(image, pairs=pairs))
            digest.update(_fingerprint(dataset, image, pairs))
    if not planned:
        reasons = "; ".join(f"{count} {reason}" for reason, count in selector.left_out.most_common())
        raise DatasetError(f"{dataset.split_path}: there is no pair to cut ({reasons or 'no pose is annotated'})")
    obj_ids = {pair.gt.obj_id for image in planned for pair in image.pairs}
    return Plan(
        images=tuple(planned),
        meshes={obj_id: mesh for obj_id, mesh in meshes.items() if obj_id in obj_ids},
        windows_px={obj_id: side for obj_id, side in selector.windows_px.items() if obj_id in obj_ids},
        left_out=dict(selector.left_out),
        digest=digest.hexdigest(),
    )


def _images(dataset: BopDataset, subset: set[tuple[int, int]] | None, config: CutConfig) -> list[AnnotatedImage]:
    """Images of the dataset or of a subset, evenly spaced where there are more than `config.images`; 0 takes all."""
    ids = [(scene_id, im_id) for scene_id in dataset.scene_ids for im_id in dataset.im_ids(scene_id)]
    numbered = [(number, *image) for number, image in enumerate(ids) if subset is None or image in subset]
    if config.images and len(numbered) > config.images:
        numbered = [numbered[i] for i in np.linspace(0, len(numbered) - 1, config.images).round().astype(int)]
    scenes = _scene_indices(dataset, config.images_per_scene)
    images = []
    for number, scene_id, im_id in numbered:
        all_ = [gt for gt in dataset.gt(scene_id, im_id) if gt.has_pose]
        meshes = {gt.obj_id: dataset.mesh(gt.obj_id) for gt in all_}
        annotated = [replace(gt, T_cam_obj=rigid(gt.T_cam_obj, meshes[gt.obj_id])) for gt in all_]
        images.append(
            AnnotatedImage(
                scene_id=scene_id,
                im_id=im_id,
                number=number,
                scene_index=scenes[scene_id, im_id],
                camera=dataset.camera(scene_id, im_id),
                annotated=[gt for gt in annotated if meshes[gt.obj_id].center_cam_m(gt.T_cam_obj)[2] > 0],
            )
        )
    return images


def _scene_indices(dataset: BopDataset, images_per_scene: int) -> dict[tuple[int, int], int]:
    """Scene index of each image, see `CutConfig.images_per_scene`."""
    length = images_per_scene or (1 if len(dataset.scene_ids) == 1 else None)
    parts: dict[tuple[int, int], int] = {}
    indices = {}
    for scene_id in dataset.scene_ids:
        for position, im_id in enumerate(dataset.im_ids(scene_id)):
            part = (scene_id, 0 if length is None else position // length)
            indices[scene_id, im_id] = parts.setdefault(part, len(parts))
    return indices


def _fingerprint(dataset: BopDataset, image: AnnotatedImage, pairs: Sequence[PairToCut]) -> bytes:
    """Everything that decides the pairs of an image, in few bytes: the file by its size, the masks by the first."""
    file = dataset.image_file(image.scene_id, image.im_id)
    size = file.path.stat().st_size if file.size is None else file.size
    mask = dataset.mask(image.scene_id, image.im_id, pairs[0].gt.gt_index, visible=True)
    mask_px = None if mask is None else int(mask.sum())
    arrays = [image.camera.K, *(gt.T_cam_obj for gt in image.annotated), *(pair.T_cam_obj_hypothesis for pair in pairs)]
    text = f"{image.scene_id} {image.im_id} {size} {mask_px} {[gt.obj_id for gt in image.annotated]}"
    return text.encode() + b"".join(np.ascontiguousarray(np.round(array, 9) + 0.0).tobytes() for array in arrays)


def _require_one_size(dataset: BopDataset, images: Sequence[AnnotatedImage], *, one_focal_length: bool) -> None:
    first: dict[tuple[float, ...], str] = {}
    for image in images:
        camera = image.camera
        focal = (round(camera.K[0, 0], 3), round(camera.K[1, 1], 3)) if one_focal_length else ()
        first.setdefault((camera.width_px, camera.height_px, *focal), f"image {image.im_id} of scene {image.scene_id}")
    if len(first) <= 1:
        return
    (size, where), (other, different) = list(first.items())[:2]
    if size[:2] != other[:2]:
        raise DatasetError(
            f"{dataset.split_path}: {where} is {size[0]} x {size[1]} pixels and {different} {other[0]} x {other[1]}, "
            "expected images of equal size; cut each size as a dataset of its own, or choose one with --sensor"
        )
    raise DatasetError(
        f"{dataset.split_path}: {where} has fx {size[2]:g} and {different} {other[2]:g}, expected one focal length for "
        "fixed windows; leave --set window=fixed out, or cut each camera as a dataset of its own"
    )


def _hypotheses_by_image(dataset: BopDataset, file: str | Path) -> dict[tuple[int, int], list[tuple[int, Pose]]]:
    """Object id and pose of every line of a result file, by image, without duplicates."""
    by_image = defaultdict(list)
    unique: set[tuple[int, int, int, bytes]] = set()
    for estimate in read_results(file, dataset):
        pose = rigid(estimate.T_cam_obj, dataset.mesh(estimate.obj_id))
        key = estimate.scene_id, estimate.im_id, estimate.obj_id, pose.tobytes()
        if key not in unique:
            unique.add(key)
            by_image[estimate.scene_id, estimate.im_id].append((estimate.obj_id, pose))
    if not by_image:
        raise DatasetError(f"{file}: holds no pose, expected hypotheses; without --hypotheses they are drawn")
    return by_image


def rigid(T: Pose, mesh: Mesh) -> Pose:
    """The pose with the nearest rotation about the object's centre, because files have few digits."""
    R = se3.nearest_rotation(T[:3, :3])
    return se3.make_T(R, mesh.center_cam_m(T) - R @ mesh.center_m)
