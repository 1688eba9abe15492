"""Training pairs cut out of annotated images, real or rendered, in place of rendered scenes.

Hypotheses are drawn around the annotated poses, or read from a result file: a refiner can so be trained on the errors
that it will meet, a detector's or its own. Silhouettes, depth and contours are those of the mesh at the annotated pose;
what hides it comes from the dataset's visible masks, or from the other annotated objects where there are none.
"""

import hashlib
import math
from collections import Counter, defaultdict
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Bool, Float
from posecore import config as config_tools
from posecore import se3, shard
from posecore.bop import BopDataset, GroundTruth, read_results
from posecore.camera import Camera, crop_K
from posecore.contour import contour_mask, distance_transform_px, sample_contour
from posecore.errors import DatasetError
from posecore.mesh import Mesh
from posecore.raster import Instance, Rasteriser
from posecore.shard import BIT_FOREGROUND, BIT_OBJECT, BIT_VISIBLE
from posecore.window import Window, cut, diameter_window, fixed_side_px, fixed_window, silhouette_box

from synthgen.config import CutConfig
from synthgen.dataset import DEPTH_STEPS, FINEST_DEPTH_STEP_M, UNITS, package_versions
from synthgen.draw.sampling import draw_hypothesis
from synthgen.draw.streams import Purpose, Subject, stream
from synthgen.draw.target import hull
from synthgen.image.region import holds, inside_image

Array = np.ndarray
_CAMERA_PX = 1e-6
"""Cameras that differ by less are one."""


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
    T_cam_obj_hypothesis: Float[Array, "4 4"]
    window: Window


@dataclass(frozen=True, kw_only=True, eq=False)
class Image:
    """One annotated image and the pairs to be cut out of it; all of them are one scene of the dataset."""

    scene_id: int
    im_id: int
    scene_index: int
    camera: Camera
    pairs: Sequence[Pair]


@dataclass(frozen=True, kw_only=True, eq=False)
class Plan:
    """All that is to be cut, decided before an image is read.

    Attributes:
        images: In the order in which they fill shards.
        meshes: Objects that have a pair.
        windows_px: Side of each object's window in the full image.
        left_out: Why poses and hypotheses have no pair, with their number.
    """

    images: Sequence[Image]
    meshes: Mapping[int, Mesh]
    windows_px: Mapping[int, float]
    left_out: Mapping[str, int]

    @property
    def n(self) -> int:
        """Number of pairs."""
        return sum(len(image.pairs) for image in self.images)


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
    left_out: Counter[str] = Counter()
    poses: list[tuple[int, int, Camera, list[GroundTruth]]] = []
    for scene_id in dataset.scene_ids:
        for im_id in dataset.im_ids(scene_id):
            if given is None or (scene_id, im_id) in given:
                usable = _usable(dataset.gt(scene_id, im_id), config, left_out)
                poses.append((scene_id, im_id, dataset.camera(scene_id, im_id), usable))
    _require_one_size(dataset, poses)
    meshes = {obj_id: dataset.mesh(obj_id) for obj_id in sorted({gt.obj_id for *_, all_ in poses for gt in all_})}
    hulls_m = {obj_id: hull(mesh) for obj_id, mesh in meshes.items()}
    windows_px = _windows_px(poses, meshes, hulls_m, config)
    images = []
    order = stream(config.seed, Purpose.ANNOTATED, Subject.KIND).permutation(len(poses))
    for scene_index in order.tolist():
        scene_id, im_id, camera, usable = poses[scene_index]
        address = (config.seed, Purpose.ANNOTATED, Subject.HYPOTHESIS, scene_index)
        found = (
            _drawn(usable, meshes, config, address)
            if given is None
            else _nearest(given[scene_id, im_id], usable, meshes, left_out)
        )
        pairs: list[Pair] = []
        for number, gt, guess in found:
            window = _window(
                gt, guess, meshes[gt.obj_id], hulls_m[gt.obj_id], camera, windows_px[gt.obj_id], config, left_out
            )
            if window is not None:
                pairs.append(Pair(number=number, gt=gt, T_cam_obj_hypothesis=guess, window=window))
        if pairs:
            images.append(
                Image(scene_id=scene_id, im_id=im_id, scene_index=scene_index, camera=camera, pairs=tuple(pairs))
            )
    if not images:
        why = "; ".join(f"{count} {reason}" for reason, count in left_out.most_common()) or "no pose is annotated"
        raise DatasetError(f"{dataset.split_path}: there is no pair to cut ({why})")
    kept = {pair.gt.obj_id for image in images for pair in image.pairs}
    return Plan(
        images=tuple(images),
        meshes={obj_id: mesh for obj_id, mesh in meshes.items() if obj_id in kept},
        windows_px={obj_id: side for obj_id, side in windows_px.items() if obj_id in kept},
        left_out=dict(left_out),
    )


def _require_one_size(dataset: BopDataset, poses: Sequence[tuple[int, int, Camera, list[GroundTruth]]]) -> None:
    first: dict[tuple[int, int], str] = {}
    for scene_id, im_id, camera, _ in poses:
        first.setdefault((camera.width_px, camera.height_px), f"image {im_id} of scene {scene_id}")
    if len(first) > 1:
        (size, image), (other, different) = list(first.items())[:2]
        raise DatasetError(
            f"{dataset.split_path}: {image} is {size[0]} x {size[1]} pixels and {different} {other[0]} x {other[1]}, "
            "expected images of one size; cut other sizes in a dataset or --sensor of their own"
        )


def _hypotheses_by_image(
    dataset: BopDataset, file: str | Path
) -> dict[tuple[int, int], list[tuple[int, Float[Array, "4 4"]]]]:
    """Object and pose of every line of a result file, by image."""
    by_image = defaultdict(list)
    for one in read_results(file, dataset):
        by_image[one.scene_id, one.im_id].append((one.obj_id, rigid(one.T_cam_obj)))
    if not by_image:
        raise DatasetError(f"{file}: holds no pose, expected hypotheses; leave --hypotheses out to have them drawn")
    return by_image


def rigid(T: Float[Array, "4 4"]) -> Float[Array, "4 4"]:
    """The pose with the nearest rotation: files give only some digits of theirs."""
    return se3.make_T(se3.nearest_rotation(T[:3, :3]), T[:3, 3])


def _usable(all_: Sequence[GroundTruth], config: CutConfig, left_out: Counter[str]) -> list[GroundTruth]:
    usable = []
    for gt in all_:
        if not gt.has_pose or gt.T_cam_obj[2, 3] <= 0:
            left_out["poses are unknown or behind the camera"] += 1
        elif gt.visib_fract is not None and gt.visib_fract < config.min_visible:
            left_out[f"poses are visible by less than {config.min_visible:g}"] += 1
        else:
            usable.append(
                GroundTruth(
                    obj_id=gt.obj_id, T_cam_obj=rigid(gt.T_cam_obj), visib_fract=gt.visib_fract, gt_index=gt.gt_index
                )
            )
    return usable


def _windows_px(
    poses: Sequence[tuple[int, int, Camera, list[GroundTruth]]],
    meshes: Mapping[int, Mesh],
    hulls_m: Mapping[int, Array],
    config: CutConfig,
) -> dict[int, float]:
    """The fixed window of every object: large enough for the nearest of its poses under the longest focal length."""
    nearest: dict[int, tuple[float, Array]] = {}
    for _, _, camera, usable in poses:
        for gt in usable:
            z = float((gt.T_cam_obj[:3, :3] @ meshes[gt.obj_id].center_m + gt.T_cam_obj[:3, 3])[2])
            focal = max(camera.K[0, 0], camera.K[1, 1])
            if gt.obj_id not in nearest or focal / z > nearest[gt.obj_id][0]:
                nearest[gt.obj_id] = (focal / z, np.append(camera.K.ravel(), z))
    return {
        obj_id: fixed_side_px(
            hulls_m[obj_id] - meshes[obj_id].center_m, found[:9].reshape(3, 3), float(found[9]), config.padding
        )
        for obj_id, (_, found) in sorted(nearest.items())
    }


def _drawn(
    usable: Sequence[GroundTruth],
    meshes: Mapping[int, Mesh],
    config: CutConfig,
    address: tuple[int, Purpose, Subject, int],
) -> Iterator[tuple[int, GroundTruth, Float[Array, "4 4"]]]:
    for gt in usable:
        for number in range(config.hypotheses_per_pose):
            rng = stream(*address, gt.gt_index, number)
            yield number, gt, draw_hypothesis(rng, config.perturbation, gt.T_cam_obj, meshes[gt.obj_id])


def _nearest(
    guesses: Sequence[tuple[int, Float[Array, "4 4"]]],
    usable: Sequence[GroundTruth],
    meshes: Mapping[int, Mesh],
    left_out: Counter[str],
) -> Iterator[tuple[int, GroundTruth, Float[Array, "4 4"]]]:
    """Hypotheses with the annotated instance whose centre lies nearest to theirs."""
    seen: Counter[int] = Counter()
    for obj_id, guess in guesses:
        instances = [gt for gt in usable if gt.obj_id == obj_id]
        if not instances:
            left_out["hypotheses are of objects that are not annotated there, or left out"] += 1
            continue
        center_m = meshes[obj_id].center_m
        gt = min(instances, key=lambda one: _distance_m(one.T_cam_obj, guess, center_m))
        yield seen[gt.gt_index], gt, guess
        seen[gt.gt_index] += 1


def _distance_m(T: Float[Array, "4 4"], other: Float[Array, "4 4"], point_m: Float[Array, "3"]) -> float:
    difference = T - other
    return float(np.linalg.norm(difference[:3, :3] @ point_m + difference[:3, 3]))


def _window(
    gt: GroundTruth,
    guess: Float[Array, "4 4"],
    mesh: Mesh,
    hull_m: Float[Array, "h 3"],
    camera: Camera,
    side_px: float,
    config: CutConfig,
    left_out: Counter[str],
) -> Window | None:
    """The window of a pair, None where it does not hold both silhouettes or one of them is too small."""
    boxes = [silhouette_box(hull_m, camera.K, T) for T in (gt.T_cam_obj, guess)]
    if not np.isfinite(boxes).all():
        left_out["pairs reach behind the camera"] += 1
        return None
    if config.window == "fixed":
        window = fixed_window(hull_m, camera.K, guess, side_px)
    else:
        window = diameter_window(camera.K, guess, mesh.center_m, mesh.diameter_m, config.scale)
    if not all(holds(window, box) for box in boxes):
        left_out["pairs do not fit into their windows (more scale, or padding of fixed ones, gives larger ones)"] += 1
        return None
    shortest_px = min(max(box[2] - box[0], box[3] - box[1]) for box in boxes) * config.patch_px / window.side_px
    if shortest_px < config.min_side_px:
        left_out[f"pairs show less than {config.min_side_px:g} px of an object"] += 1
        return None
    return window


def make_card(
    dataset: BopDataset, planned: Plan, config: CutConfig, hypotheses: str | Path | None = None
) -> dict[str, Any]:
    """The data card: nothing in it depends on time or machine.

    Raises:
        DatasetError: The objects are too far away to be stored.
    """
    camera = planned.images[0].camera
    deepest_m = max(
        float(pose[2, 3]) + 2 * planned.meshes[pair.gt.obj_id].diameter_m
        for image in planned.images
        for pair in image.pairs
        for pose in (pair.gt.T_cam_obj, pair.T_cam_obj_hypothesis)
    )
    shared = all(np.abs(image.camera.K - camera.K).max() < _CAMERA_PX for image in planned.images)
    return {
        "n": planned.n,
        "shard_size": config.shard_size,
        "patch_px": config.patch_px,
        "contour_points": config.contour_points,
        "depth_step_m": FINEST_DEPTH_STEP_M
        * 2 ** max(0, math.ceil(math.log2(deepest_m / (DEPTH_STEPS * FINEST_DEPTH_STEP_M)))),
        "seed": config.seed,
        "source": {
            "dataset": dataset.name,
            "split": dataset.split,
            "images": len(planned.images),
            "hypotheses_sha256": None
            if hypotheses is None
            else hashlib.sha256(Path(hypotheses).read_bytes()).hexdigest(),
            "left_out": dict(planned.left_out),
        },
        "cut": config_tools.to_dict(config),
        "windows": config.window,
        "objects": {
            str(obj_id): {
                "name": Path(mesh.path).name,
                "path": f"models/obj_{obj_id:06d}.ply",
                "texture": None if mesh.texture_rgb is None else f"models/obj_{obj_id:06d}.png",
                "sha256": mesh.sha256,
                "diameter_m": mesh.diameter_m,
                "window_side_px": planned.windows_px[obj_id],
            }
            for obj_id, mesh in planned.meshes.items()
        },
        "camera": {
            "width_px": camera.width_px,
            "height_px": camera.height_px,
            "fx": float(camera.K[0, 0]),
            "fy": float(camera.K[1, 1]),
            "cx": float(camera.K[0, 2]),
            "cy": float(camera.K[1, 2]),
            "shared": shared,
        },
        "units": UNITS,
        "versions": package_versions(),
    }


def cut_pairs(
    dataset: BopDataset,
    planned: Plan,
    config: CutConfig,
    writer: shard.ShardWriter,
    on_shard: Callable[[int], None] = lambda n: None,
) -> None:
    """Cut every pair whose shard is missing or damaged, and commit shard by shard.

    Args:
        dataset: Images.
        planned: What.
        config: The recipe that it was planned with.
        writer: Where to.
        on_shard: Told the pairs of every shard, those that were there too.
    """
    there = set(writer.committed()) - set(writer.damaged())
    seen = {gt.obj_id for image in planned.images for gt in dataset.gt(image.scene_id, image.im_id) if gt.has_pose}
    with Rasteriser({obj_id: dataset.mesh(obj_id) for obj_id in sorted(seen)}) as rasteriser:
        cutter = _Cutter(dataset, config, rasteriser)
        listed = [(image, pair) for image in planned.images for pair in image.pairs]
        for shard_id in range(shard.n_shards(writer.card)):
            part = listed[shard_id * config.shard_size : (shard_id + 1) * config.shard_size]
            if shard_id not in there:
                rows = [cutter.sample(image, pair) for image, pair in part]
                arrays = {name: np.stack([row[name] for row in rows]) for name in rows[0]}
                writer.commit(writer.encode(shard_id, arrays))
            on_shard(len(part))


@dataclass(frozen=True, kw_only=True, eq=False)
class _Layers:
    """One image, with what hides and surrounds its objects.

    Attributes:
        rgb: The image.
        depth_m: Camera z of the nearest annotated object.
        front: Pixels that show any of them.
        hidden: By position in the ground truth, pixels of the object's silhouette that show something else.
    """

    rgb: Array
    depth_m: Float[Array, "h w"]
    front: Bool[Array, "h w"]
    hidden: Mapping[int, Bool[Array, "h w"]]


class _Cutter:
    """Cuts pairs; keeps the layers of the image that it cut last."""

    def __init__(self, dataset: BopDataset, config: CutConfig, rasteriser: Rasteriser) -> None:
        self._dataset = dataset
        self._config = config
        self._rasteriser = rasteriser
        self._last: tuple[Image, _Layers] | None = None

    def sample(self, image: Image, pair: Pair) -> dict[str, Array]:
        """Every field of the shard table."""
        if self._last is None or self._last[0] is not image:
            self._last = (image, self._layers(image))
        layers = self._last[1]
        p, gt, window, n = self._config.patch_px, pair.gt, pair.window, self._config.contour_points
        K_crop = crop_K(image.camera.K, window, p)
        truth = self._rasteriser.render(gt.obj_id, K_crop, gt.T_cam_obj[None], p, p, rgb=False).depth_m[0]
        guess = self._rasteriser.render(gt.obj_id, K_crop, pair.T_cam_obj_hypothesis[None], p, p)
        assert guess.rgb is not None
        depth = guess.depth_m[0]
        amodal, shape = truth > 0, depth > 0
        hidden = cut(layers.hidden[gt.gt_index].astype(np.uint8), window, p, interpolation="nearest") > 0
        visible = amodal & inside_image(window, p, image.camera) & ~hidden
        other_m = cut(layers.depth_m, window, p, interpolation="nearest")
        shown = cut(layers.front.astype(np.uint8), window, p, interpolation="nearest") > 0
        other_m = np.where(shown & ~(amodal & ~hidden), other_m, np.float32(0))
        scene_depth_m = np.where(visible, truth, other_m).astype(np.float32)
        mask = amodal * BIT_OBJECT + visible * BIT_VISIBLE + (scene_depth_m > 0) * BIT_FOREGROUND
        rng = stream(self._config.seed, Purpose.ANNOTATED, Subject.CONTOUR, image.scene_index, gt.gt_index, pair.number)
        values = {
            "scene_rgb": cut(layers.rgb, window, p, interpolation="area"),
            "hypothesis_rgb": guess.rgb[0],
            "scene_depth_m": scene_depth_m,
            "hypothesis_depth_m": depth,
            "scene_mask": mask.astype(np.uint8),
            "scene_contour_cam_m": sample_contour(amodal, truth, K_crop, n, rng),
            "hypothesis_contour_cam_m": sample_contour(shape, depth, K_crop, n, rng),
            "scene_distance_px": distance_transform_px(contour_mask(amodal)),
            "hypothesis_distance_px": distance_transform_px(contour_mask(shape)),
            "T_cam_obj": gt.T_cam_obj,
            "T_cam_obj_hypothesis": pair.T_cam_obj_hypothesis,
            "K": image.camera.K,
            "K_crop": K_crop,
            "window_px": window.as_array(),
            "visible_fraction": np.float32(visible.sum() / amodal.sum()),
            "obj_id": np.int32(gt.obj_id),
            "scene_index": np.int64(image.scene_index),
            "rejected": np.int32(0),
        }
        return {name: np.asarray(value) for name, value in values.items()}

    def _layers(self, image: Image) -> _Layers:
        """Read an image and its masks, and draw its annotated objects."""
        scene_id, im_id, camera = image.scene_id, image.im_id, image.camera
        width, height = camera.width_px, camera.height_px
        all_ = [gt for gt in self._dataset.gt(scene_id, im_id) if gt.has_pose]
        drawn = self._rasteriser.render_scene(
            [Instance(obj_id=gt.obj_id, T_cam_obj=gt.T_cam_obj) for gt in all_], camera.K, width, height, rgb=False
        )
        wanted = {pair.gt.gt_index for pair in image.pairs}
        front, hidden = np.zeros((height, width), bool), {}
        for index, gt in enumerate(all_):
            seen = self._dataset.mask(scene_id, im_id, gt.gt_index, visible=True)
            if seen is None:
                seen = drawn.instance == index
            front |= seen
            if gt.gt_index in wanted:
                whole = self._rasteriser.render(gt.obj_id, camera.K, gt.T_cam_obj[None], width, height, rgb=False)
                hidden[gt.gt_index] = whole.mask[0] & ~seen
        return _Layers(
            rgb=self._dataset.rgb(scene_id, im_id),
            depth_m=drawn.depth_m,
            front=front & (drawn.depth_m > 0),
            hidden=hidden,
        )
