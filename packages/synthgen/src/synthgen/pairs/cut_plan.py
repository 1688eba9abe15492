"""Which training pairs to cut out of annotated images, real or rendered; `synthgen.pairs.cut` cuts them.

Hypotheses are drawn around the annotated poses, or read from a result file: a refiner can so be trained on the errors
that it will meet, a detector's or its own.
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
from synthgen.draw.random_streams import Purpose, Subject, stream
from synthgen.draw.scene_draw import draw_hypothesis, share_inside
from synthgen.draw.target import hull
from synthgen.image.region import holds

Array = np.ndarray
Pose = Float[Array, "4 4"]


@dataclass(frozen=True, kw_only=True, eq=False)
class Pair:
    """One pair to be cut.

    Attributes:
        number: Which of the pose's hypotheses.
        gt: The annotated pose, its rotation made orthonormal.
        T_cam_obj_hypothesis: Where it is thought to be.
        window: Where both patches are cut.
    """

    number: int
    gt: GroundTruth
    T_cam_obj_hypothesis: Pose
    window: Window


@dataclass(frozen=True, kw_only=True, eq=False)
class Image:
    """One annotated image and the pairs to be cut out of it.

    Attributes:
        scene_id, im_id: In the source.
        number: Position among the source's images: the address of its draws.
        scene_index: Its scene in the dataset, see `CutConfig.images_per_scene`.
        camera: Its camera.
        annotated: All that is annotated in it with a pose in front of the camera.
        pairs: What is cut.
    """

    scene_id: int
    im_id: int
    number: int
    scene_index: int
    camera: Camera
    annotated: Sequence[GroundTruth]
    pairs: Sequence[Pair] = ()


@dataclass(frozen=True, kw_only=True, eq=False)
class Plan:
    """All that is to be cut, decided before an image is read.

    Attributes:
        images: In the order in which they fill shards.
        meshes: Objects that have a pair.
        windows_px: Side of each object's fixed window in the full image.
        left_out: Why poses and hypotheses have no pair, with their number.
        digest: Hash of the source, so that a run goes on with the same one: image files by their size, cameras, poses,
            hypotheses.
    """

    images: Sequence[Image]
    meshes: Mapping[int, Mesh]
    windows_px: Mapping[int, float]
    left_out: Mapping[str, int]
    digest: str

    @property
    def n(self) -> int:
        """Number of pairs."""
        return sum(len(image.pairs) for image in self.images)


class _Picker:
    """What decides the pairs of one image."""

    def __init__(self, config: CutConfig, meshes: Mapping[int, Mesh], images: Sequence[Image]) -> None:
        self.meshes = meshes
        self.left_out: Counter[str] = Counter()
        self._config = config
        self._hulls_m = {obj_id: hull(mesh) for obj_id, mesh in meshes.items()}
        self.windows_px = self._fixed_windows(images)

    def usable(self, image: Image, gt: GroundTruth) -> str:
        """Why an annotated pose is not to be cut; empty where it is."""
        least = self._config.min_visible
        if gt.visib_fract is not None and gt.visib_fract < least:
            return f"poses are visible by less than {least:g}"
        box = silhouette_box(self._hulls_m[gt.obj_id], image.camera.K, gt.T_cam_obj)
        if share_inside(box, image.camera) < max(least, 1e-6):
            return f"poses lie in the image by less than {least:g}"
        return ""

    def pairs(self, image: Image, given: Sequence[tuple[int, Pose]] | None) -> Iterator[Pair]:
        """Pairs of an image, with the hypotheses that are given there, or drawn."""
        why = {gt.gt_index: self.usable(image, gt) for gt in image.annotated}
        self.left_out.update(reason for reason in why.values() if reason)
        found = self._drawn(image) if given is None else self._nearest(image, given)
        for number, gt, guess in found:
            if why[gt.gt_index]:
                if given is not None:
                    self.left_out["hypotheses are of poses that are left out"] += 1
                continue
            window = self._window(image.camera, gt, guess)
            if window is not None:
                yield Pair(number=number, gt=gt, T_cam_obj_hypothesis=guess, window=window)

    def _fixed_windows(self, images: Sequence[Image]) -> dict[int, float]:
        """A side for every object, large enough for the nearest pose that is seen under the longest focal length."""
        nearest: dict[int, tuple[float, Array, float]] = {}
        for image in images:
            K = image.camera.K
            for gt in image.annotated:
                if self.usable(image, gt):
                    continue
                z = float(centre_m(gt.T_cam_obj, self.meshes[gt.obj_id])[2])
                closeness = max(K[0, 0], K[1, 1]) / z
                if gt.obj_id not in nearest or closeness > nearest[gt.obj_id][0]:
                    nearest[gt.obj_id] = closeness, K, z
        return {
            obj_id: fixed_side_px(self._hulls_m[obj_id] - self.meshes[obj_id].center_m, K, z, self._config.padding)
            for obj_id, (_, K, z) in sorted(nearest.items())
        }

    def _drawn(self, image: Image) -> Iterator[tuple[int, GroundTruth, Pose]]:
        config = self._config
        for gt in image.annotated:
            for number in range(config.hypotheses_per_pose):
                address = (image.number, gt.gt_index, number)
                rng = stream(config.seed, Purpose.ANNOTATED, Subject.HYPOTHESIS, *address)
                yield number, gt, draw_hypothesis(rng, config.perturbation, gt.T_cam_obj, self.meshes[gt.obj_id])

    def _nearest(self, image: Image, given: Sequence[tuple[int, Pose]]) -> Iterator[tuple[int, GroundTruth, Pose]]:
        """Hypotheses with the annotated instance whose centre lies nearest to theirs."""
        seen: Counter[int] = Counter()
        for obj_id, guess in given:
            instances = [gt for gt in image.annotated if gt.obj_id == obj_id]
            if not instances:
                self.left_out["hypotheses are of objects that are not annotated there"] += 1
                continue
            mesh = self.meshes[obj_id]
            away_m = [np.linalg.norm(centre_m(gt.T_cam_obj, mesh) - centre_m(guess, mesh)) for gt in instances]
            gt = instances[int(np.argmin(away_m))]
            yield seen[gt.gt_index], gt, guess
            seen[gt.gt_index] += 1

    def _window(self, camera: Camera, gt: GroundTruth, guess: Pose) -> Window | None:
        """The window of a pair, None where it does not hold both silhouettes or one of them is too small."""
        mesh, hull_m, config = self.meshes[gt.obj_id], self._hulls_m[gt.obj_id], self._config
        boxes = [silhouette_box(hull_m, camera.K, T) for T in (gt.T_cam_obj, guess)]
        if not np.isfinite(boxes).all():
            self.left_out["pairs reach behind the camera"] += 1
            return None
        if config.window == "fixed":
            window = fixed_window(hull_m, camera.K, guess, self.windows_px[gt.obj_id])
        else:
            window = diameter_window(camera.K, guess, mesh.center_m, mesh.diameter_m, config.scale)
        if not all(holds(window, box) for box in boxes):
            self.left_out["pairs do not fit into their windows (more scale, or padding of fixed ones, helps)"] += 1
            return None
        area_px = min(_hull_area_px(camera.K, se3.apply(T, hull_m)) for T in (gt.T_cam_obj, guess))
        if area_px * min(1.0, (config.patch_px / window.side_px) ** 2) < config.min_area_px:
            self.left_out[f"pairs show an object on less than {config.min_area_px:g} pixels"] += 1
            return None
        return window


def centre_m(T_cam_obj: Pose, mesh: Mesh) -> Float[Array, "3"]:
    """The object's box centre in the camera frame."""
    return np.asarray(T_cam_obj[:3, :3] @ mesh.center_m + T_cam_obj[:3, 3])


def _hull_area_px(K: Float[Array, "3 3"], points_m: Float[Array, "h 3"]) -> float:
    """Area of the convex hull of a silhouette."""
    return float(cv2.contourArea(cv2.convexHull(project(K, points_m).astype(np.float32))))


def plan(dataset: BopDataset, config: CutConfig, hypotheses: str | Path | None = None) -> Plan:
    """Decide which pairs to cut.

    Args:
        dataset: Images with ground truth.
        config: Recipe.
        hypotheses: Result file; each line is a hypothesis of the nearest annotated instance of its object.

    Raises:
        DatasetError: There is no ground truth, images are of several sizes, or nothing is left to cut.
        ResultFileError: The result file is broken, or of other images.
    """
    given = None if hypotheses is None else _hypotheses_by_image(dataset, hypotheses)
    images = _images(dataset, None if given is None else set(given), config)
    _require_one_size(dataset, images, one_focal_length=config.window == "fixed")
    meshes = {i: dataset.mesh(i) for i in sorted({gt.obj_id for image in images for gt in image.annotated})}
    picker = _Picker(config, meshes, images)
    planned, digest = [], hashlib.sha256()
    for image in images:
        there = None if given is None else given[image.scene_id, image.im_id]
        pairs = tuple(picker.pairs(image, there))
        if pairs:
            planned.append(replace(image, pairs=pairs))
            digest.update(_described(dataset, image, pairs))
    if not planned:
        reasons = "; ".join(f"{count} {reason}" for reason, count in picker.left_out.most_common())
        raise DatasetError(f"{dataset.split_path}: there is no pair to cut ({reasons or 'no pose is annotated'})")
    kept = {pair.gt.obj_id for image in planned for pair in image.pairs}
    return Plan(
        images=tuple(planned),
        meshes={obj_id: mesh for obj_id, mesh in meshes.items() if obj_id in kept},
        windows_px={obj_id: side for obj_id, side in picker.windows_px.items() if obj_id in kept},
        left_out=dict(picker.left_out),
        digest=digest.hexdigest(),
    )


def _images(dataset: BopDataset, wanted: set[tuple[int, int]] | None, config: CutConfig) -> list[Image]:
    """Images that may have a pair, evenly spread where there are more than `config.images`; 0 takes all."""
    listed = [(scene_id, im_id) for scene_id in dataset.scene_ids for im_id in dataset.im_ids(scene_id)]
    numbered = [(number, *one) for number, one in enumerate(listed) if wanted is None or one in wanted]
    if config.images and len(numbered) > config.images:
        numbered = [numbered[i] for i in np.linspace(0, len(numbered) - 1, config.images).round().astype(int)]
    scenes = _scene_indices(dataset, config.images_per_scene)
    images = []
    for number, scene_id, im_id in numbered:
        all_ = [gt for gt in dataset.gt(scene_id, im_id) if gt.has_pose]
        meshes = {gt.obj_id: dataset.mesh(gt.obj_id) for gt in all_}
        annotated = [replace(gt, T_cam_obj=rigid(gt.T_cam_obj)) for gt in all_]
        images.append(
            Image(
                scene_id=scene_id,
                im_id=im_id,
                number=number,
                scene_index=scenes[scene_id, im_id],
                camera=dataset.camera(scene_id, im_id),
                annotated=[gt for gt in annotated if centre_m(gt.T_cam_obj, meshes[gt.obj_id])[2] > 0],
            )
        )
    return images


def _scene_indices(dataset: BopDataset, images_per_scene: int) -> dict[tuple[int, int], int]:
    """Number of the scene that each image counts to, see `CutConfig.images_per_scene`."""
    own = images_per_scene or (1 if len(dataset.scene_ids) == 1 else None)
    parts: dict[tuple[int, int], int] = {}
    indices = {}
    for scene_id in dataset.scene_ids:
        for place, im_id in enumerate(dataset.im_ids(scene_id)):
            part = (scene_id, 0 if own is None else place // own)
            indices[scene_id, im_id] = parts.setdefault(part, len(parts))
    return indices


def _described(dataset: BopDataset, image: Image, pairs: Sequence[Pair]) -> bytes:
    """What decides the pairs of an image, in few bytes: its file by its size, its masks by one of them."""
    file = dataset.image_file(image.scene_id, image.im_id)
    size = file.path.stat().st_size if file.size is None else file.size
    mask = dataset.mask(image.scene_id, image.im_id, pairs[0].gt.gt_index, visible=True)
    seen = None if mask is None else int(mask.sum())
    poses = [image.camera.K, *(gt.T_cam_obj for gt in image.annotated), *(pair.T_cam_obj_hypothesis for pair in pairs)]
    text = f"{image.scene_id} {image.im_id} {size} {seen} {[gt.obj_id for gt in image.annotated]}"
    return text.encode() + b"".join(np.ascontiguousarray(np.round(one, 9) + 0.0).tobytes() for one in poses)


def _require_one_size(dataset: BopDataset, images: Sequence[Image], *, one_focal_length: bool) -> None:
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
            "expected images of one size; cut other sizes in a dataset or --sensor of their own"
        )
    raise DatasetError(
        f"{dataset.split_path}: {where} has fx {size[2]:g} and {different} {other[2]:g}, expected one focal length for "
        "fixed windows; leave --set window=fixed out, or cut each camera as a dataset of its own"
    )


def _hypotheses_by_image(dataset: BopDataset, file: str | Path) -> dict[tuple[int, int], list[tuple[int, Pose]]]:
    """Object and pose of every line of a result file, by image; equal ones once."""
    by_image = defaultdict(list)
    seen: set[tuple[int, int, int, bytes]] = set()
    for one in read_results(file, dataset):
        pose = rigid(one.T_cam_obj)
        key = one.scene_id, one.im_id, one.obj_id, pose.tobytes()
        if key not in seen:
            seen.add(key)
            by_image[one.scene_id, one.im_id].append((one.obj_id, pose))
    if not by_image:
        raise DatasetError(f"{file}: holds no pose, expected hypotheses; leave --hypotheses out to have them drawn")
    return by_image


def rigid(T: Pose) -> Pose:
    """The pose with the nearest rotation: files give only some digits of theirs."""
    return se3.make_T(se3.nearest_rotation(T[:3, :3]), T[:3, 3])
