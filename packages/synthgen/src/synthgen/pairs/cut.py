"""Training pairs cut out of annotated images: patches and labels.

Silhouettes, depth and contours are those of the mesh at the annotated pose; what hides it comes from the dataset's
visible masks, or from the other annotated objects where there are none.
"""

from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from typing import Any

import cv2
import numpy as np
from jaxtyping import Bool, Float
from posecore import shard
from posecore.bop import BopDataset
from posecore.camera import crop_K
from posecore.contour import contour_mask, distance_transform_px, sample_contour
from posecore.errors import DatasetError, RenderError
from posecore.processes import behave_as_worker, in_order, spawned
from posecore.raster import Instance, Rasteriser
from posecore.shard import BIT_FOREGROUND, BIT_OBJECT, BIT_VISIBLE
from posecore.window import cut, cut_rgb

from synthgen.config import CutConfig
from synthgen.draw.random_streams import Purpose, Subject, stream
from synthgen.image.region import inside_image
from synthgen.pairs.cut_plan import Image, Pair, Plan
from synthgen.pairs.pair_maker import limit_threads

Array = np.ndarray
_RIM = np.ones((3, 3), np.uint8)
"""A visible mask may miss the mesh's silhouette by a pixel."""

_BEYOND = np.ones((9, 9), np.uint8)
"""What a visible mask shows beyond the mesh has the depth of the mesh beside it, so far."""


def cut_pairs(
    dataset: BopDataset,
    planned: Plan,
    config: CutConfig,
    writer: shard.ShardWriter,
    on_shard: Callable[[int], None] = lambda n: None,
    *,
    workers: int = 1,
) -> None:
    """Cut every pair whose shard is missing or damaged, and commit shard by shard.

    Args:
        dataset: Images.
        planned: What.
        config: The recipe that it was planned with.
        writer: Where to.
        on_shard: Told the pairs of every shard, those that were there too.
        workers: Processes. The bytes do not depend on it.

    Raises:
        DatasetError: An image or a mask is damaged or of the wrong size.
        RenderError: No EGL device, a silhouette without a pixel, or a worker process died.
        StorageError: The place cannot be written.
    """
    there = set(writer.committed()) - set(writer.damaged())
    for shard_id in sorted(there):
        on_shard(shard.samples_in(writer.card, shard_id))
    seen = sorted({gt.obj_id for image in planned.images for gt in image.annotated})
    source = _Source(dataset=dataset, obj_ids=tuple(seen), config=config, card=writer.card)
    tasks = [(i, part) for i, part in enumerate(_parts(planned, config.shard_size)) if i not in there]
    with _mapped(source, tasks, workers) as found:
        for encoded in found:
            writer.commit(encoded)
            on_shard(encoded.line["n"])


def _parts(planned: Plan, shard_size: int) -> list[list[Image]]:
    """Images of every shard, with the pairs that fall into it."""
    parts: list[list[Image]] = []
    room = 0
    for image in planned.images:
        first = 0
        while first < len(image.pairs):
            if room == 0:
                parts.append([])
                room = shard_size
            pairs = image.pairs[first : first + room]
            parts[-1].append(replace(image, pairs=pairs))
            first, room = first + len(pairs), room - len(pairs)
    return parts


@dataclass(frozen=True, kw_only=True, eq=False)
class _Source:
    """What a process needs to cut any shard."""

    dataset: BopDataset
    obj_ids: tuple[int, ...]
    config: CutConfig
    card: Mapping[str, Any]


class _ShardCutter:
    """Cuts shards, in the thread that made it."""

    def __init__(self, source: _Source) -> None:
        self._card = source.card
        self._rasteriser = Rasteriser({obj_id: source.dataset.mesh(obj_id) for obj_id in source.obj_ids})
        self._patches = _Patches(source.dataset, source.config, self._rasteriser)

    def cut(self, shard_id: int, images: Sequence[Image]) -> shard.Encoded:
        """One shard, encoded."""
        rows = [self._patches.sample(image, pair) for image in images for pair in image.pairs]
        return shard.encode(self._card, shard_id, {name: np.stack([row[name] for row in rows]) for name in rows[0]})

    def close(self) -> None:
        """Free what was uploaded."""
        self._rasteriser.close()


_worker: list[_ShardCutter] = []


def _start_worker(source: _Source) -> None:
    behave_as_worker()
    limit_threads(1)
    _worker[:] = [_ShardCutter(source)]


def _in_worker(task: tuple[int, Sequence[Image]]) -> shard.Encoded:
    return _worker[0].cut(*task)


@contextmanager
def _mapped(
    source: _Source, tasks: Sequence[tuple[int, Sequence[Image]]], workers: int
) -> Iterator[Iterator[shard.Encoded]]:
    """Shards in the order of the tasks, from this process or from a pool of spawned ones."""
    workers = min(workers, len(tasks))
    if workers <= 1:
        limit_threads(1)
        cutter = _ShardCutter(source)
        try:
            yield (cutter.cut(*task) for task in tasks)
        finally:
            cutter.close()
        return
    died = "a process that cuts died; start again, which goes on, with fewer --workers"
    with spawned(workers, _start_worker, (source,), died) as pool:
        yield in_order(pool, _in_worker, tasks, 2 * workers)  # shards that wait to be written take memory


@dataclass(frozen=True, kw_only=True, eq=False)
class _Layers:
    """One image, with what hides and surrounds its objects.

    Attributes:
        rgb: The image.
        depth_m: Camera z of the nearest annotated object where one is seen, 0 elsewhere.
        hidden: By position in the ground truth, pixels of the object's silhouette that show something else.
    """

    rgb: Array
    depth_m: Float[Array, "h w"]
    hidden: Mapping[int, Bool[Array, "h w"]]


class _Patches:
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
        if not amodal.any() or not shape.any():
            raise RenderError(
                f"{self._dataset.split_path}: scene {image.scene_id}, image {image.im_id}, object {gt.obj_id}: a "
                "silhouette covers no pixel of its patch; raise min_area_px, which leaves such pairs out"
            )
        hidden = cut(layers.hidden[gt.gt_index].astype(np.uint8), window, p, interpolation="nearest") > 0
        visible = amodal & inside_image(window, p, image.camera) & ~hidden
        other_m = cut(layers.depth_m, window, p, interpolation="nearest")
        scene_depth_m = np.where(visible, truth, np.where(amodal & ~hidden, np.float32(0), other_m))
        mask = amodal * BIT_OBJECT + visible * BIT_VISIBLE + (scene_depth_m > 0) * BIT_FOREGROUND
        rng = stream(self._config.seed, Purpose.ANNOTATED, Subject.CONTOUR, image.number, gt.gt_index, pair.number)
        values = {
            "scene_rgb": cut_rgb(layers.rgb, window, p),
            "hypothesis_rgb": guess.rgb[0],
            "scene_depth_m": scene_depth_m.astype(np.float32),
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
        drawn = self._rasteriser.render_scene(
            [Instance(obj_id=gt.obj_id, T_cam_obj=gt.T_cam_obj) for gt in image.annotated],
            camera.K, width, height, rgb=False,
        )  # fmt: skip
        wanted = {pair.gt.gt_index for pair in image.pairs}
        front, hidden = np.zeros((height, width), bool), {}
        for index, gt in enumerate(image.annotated):
            found = self._dataset.mask_and_location(scene_id, im_id, gt.gt_index, "mask_visib")
            seen, place = (drawn.instance == index, "") if found is None else found
            if seen.shape != front.shape:
                raise DatasetError(
                    f"{place}: is {seen.shape[1]} x {seen.shape[0]} pixels, expected {width} x {height} as its image"
                )
            front |= seen
            if gt.gt_index in wanted:
                whole = self._rasteriser.render(gt.obj_id, camera.K, gt.T_cam_obj[None], width, height, rgb=False)
                hidden[gt.gt_index] = _hidden(whole.mask[0], seen)
        depth_m = np.where(drawn.depth_m > 0, drawn.depth_m, cv2.dilate(drawn.depth_m, _BEYOND))
        rgb = self._dataset.rgb(scene_id, im_id)
        return _Layers(rgb=rgb, depth_m=np.where(front, depth_m, np.float32(0)), hidden=hidden)


def _hidden(whole: Bool[Array, "h w"], seen: Bool[Array, "h w"]) -> Bool[Array, "h w"]:
    """Where a silhouette shows something else, and a pixel beyond its rim there.

    A patch's exact silhouette reaches beyond the image's pixels: its rim is hidden where the nearest pixels are. Lines
    of one or two pixels are what mask and mesh differ by.
    """
    differing = whole & ~seen
    core = cv2.morphologyEx(differing.astype(np.uint8), cv2.MORPH_OPEN, _RIM)
    hidden = differing & (cv2.dilate(core, _RIM) > 0)
    return np.asarray(hidden | ((cv2.dilate(hidden.astype(np.uint8), _RIM) > 0) & ~whole))
