"""Poses grouped by image, and their refinement image by image."""

import itertools
import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass

from posecore.bop import BopDataset, Estimate
from posecore.errors import CameraError, DatasetError

from refinenet.refiner import Frame, PoseRefiner, Refinement, Request


@dataclass(frozen=True, kw_only=True, eq=False)
class ImagePoses:
    """The initial poses in an image.

    Attributes:
        scene_id: Scene.
        im_id: Image number in the scene.
        indices: Index of each pose among all initial poses.
        requests: The poses, in the same order.
    """

    scene_id: int
    im_id: int
    indices: tuple[int, ...]
    requests: tuple[Request, ...]


@dataclass(frozen=True, kw_only=True, eq=False)
class ImageResults:
    """Refinements of all poses in an image, and their joint run time: with rendering, without reading."""

    refinements: tuple[Refinement, ...]
    time_s: float


def group_by_image(initial_poses: Sequence[Estimate]) -> list[ImagePoses]:
    """Initial poses image by image, in the order of scenes and images."""

    def image_of(index: int) -> tuple[int, int]:
        return initial_poses[index].scene_id, initial_poses[index].im_id

    images = []
    for (scene_id, im_id), group in itertools.groupby(sorted(range(len(initial_poses)), key=image_of), key=image_of):
        indices = tuple(group)
        requests = tuple(Request(obj_id=initial_poses[i].obj_id, T_cam_obj=initial_poses[i].T_cam_obj) for i in indices)
        images.append(ImagePoses(scene_id=scene_id, im_id=im_id, indices=indices, requests=requests))
    return images


def load_frame(dataset: BopDataset, scene_id: int, im_id: int, method: PoseRefiner) -> Frame:
    """An image with its camera, and with depth where the method needs it.

    Raises:
        DatasetError: There is no such image or no depth, or the image is damaged.
        CameraError: The camera does not fit the image.
    """
    depth_m = dataset.depth_m(scene_id, im_id) if method.needs_depth else None
    if method.needs_depth and depth_m is None:
        raise DatasetError(
            f"{dataset.scene_path(scene_id)}: image {im_id} has no depth, which {method.name} needs; "
            "choose a method that works on colour"
        )
    image = dataset.rgb(scene_id, im_id)
    try:
        return Frame(image=image, K=dataset.camera(scene_id, im_id).K, depth_m=depth_m)
    except CameraError as error:
        raise CameraError(f"{dataset.scene_path(scene_id)}: image {im_id}: {error}") from error


def refine_images(dataset: BopDataset, method: PoseRefiner, images: Sequence[ImagePoses]) -> Iterator[ImageResults]:
    """Results image by image, each computed when it is requested."""
    for image in images:
        frame = load_frame(dataset, image.scene_id, image.im_id, method)
        begun = time.perf_counter()
        refinements = method.refine_batch(frame, image.requests)
        yield ImageResults(refinements=tuple(refinements), time_s=time.perf_counter() - begun)
