"""Refinement of a BOP result file: estimates in, estimates out, image by image."""

import itertools
from collections.abc import Callable, Collection, Iterable, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
from posecore.bop import BopDataset, Estimate
from posecore.bop.images import write_image
from posecore.errors import CameraError, DatasetError

from refinenet import __version__
from refinenet.models.checkpoint import Checkpoint
from refinenet.refine.overlay import REFINED_RGB, START_RGB, Overlay
from refinenet.refiner import Frame, PoseRefiner, Refinement, Request, Status

CARRIED = "perturbation"
"""What the start poses' sidecar says of how each was made goes over unchanged."""


@dataclass(frozen=True, kw_only=True, eq=False)
class One:
    """One start pose, what came of it, and how long its image took."""

    start: Estimate
    result: Refinement
    taken_s: float

    def estimate(self, found: Refinement) -> Estimate:
        """A pose that was found from the start, as a line of a result file."""
        unfailed = self.start.score if found.confidence is None else found.confidence
        score = 0.0 if found.failed else float(unfailed)
        return replace(self.start, T_cam_obj=np.asarray(found.T_cam_obj), score=score, time_s=self.taken_s)


@dataclass(kw_only=True, eq=False)
class Refined:
    """A refined result file in memory, as far as it has come.

    Attributes:
        keep_failed: Whether a start pose whose refinement failed is an estimate as it was, with score 0, or left out,
            so that evaluation counts it as missing.
        done: By the place of the start pose.
    """

    keep_failed: bool = False
    done: dict[int, One] = field(default_factory=dict)

    @property
    def all(self) -> list[One]:
        """In the order of the start poses."""
        return [self.done[place] for place in sorted(self.done)]

    @property
    def kept(self) -> list[One]:
        """Those that are estimates."""
        return [one for one in self.all if self.keep_failed or not one.result.failed]

    @property
    def estimates(self) -> list[Estimate]:
        """Lines of the result file."""
        return [one.estimate(one.result) for one in self.kept]

    @property
    def failures(self) -> dict[int, str]:
        """Why poses failed, by their line in the start file."""
        return {one.start.line: one.result.failure or "" for one in self.all if one.result.failed}

    @property
    def converged(self) -> int:
        """How many stopped on a small update."""
        return sum(one.result.status is Status.CONVERGED for one in self.all)

    @property
    def tried(self) -> list[Estimate]:
        """Every pose that the method weighed, from all start poses, those that failed too."""
        return [one.estimate(found) for one in self.all for found in one.result.tried]


@dataclass(frozen=True, kw_only=True, eq=False)
class ImageStarts:
    """The start poses in one image.

    Attributes:
        scene_id: Its scene.
        im_id: Its number there.
        places: Of the start poses among all.
        requests: The poses to refine, in that order.
    """

    scene_id: int
    im_id: int
    places: tuple[int, ...]
    requests: tuple[Request, ...]


@dataclass(frozen=True, kw_only=True, eq=False)
class Results:
    """What came of the poses of one image, and how long all of them took, rendering included, reading excluded."""

    found: tuple[Refinement, ...]
    taken_s: float


def by_image(starts: Sequence[Estimate]) -> list[ImageStarts]:
    """Start poses image by image, in the order of scenes and images."""
    order = sorted(range(len(starts)), key=lambda i: (starts[i].scene_id, starts[i].im_id))
    images = []
    for (scene_id, im_id), group in itertools.groupby(order, key=lambda i: (starts[i].scene_id, starts[i].im_id)):
        places = tuple(group)
        requests = tuple(Request(obj_id=starts[i].obj_id, T_cam_obj=starts[i].T_cam_obj) for i in places)
        images.append(ImageStarts(scene_id=scene_id, im_id=im_id, places=places, requests=requests))
    return images


def add_results(
    refined: Refined,
    starts: Sequence[Estimate],
    images: Sequence[ImageStarts],
    results: Iterable[Results],
    *,
    on_image: Callable[[ImageStarts, Results], None],
) -> None:
    """Add what comes of image after image to `refined`, so that an error on the way loses nothing.

    An estimate's score is the method's confidence (the start's score where it has none), its time that of refining all
    poses of its image.

    Args:
        refined: Filled.
        starts: Start poses.
        images: These, image by image.
        results: For each image.
        on_image: Called after each.
    """
    for image, result in zip(images, results, strict=True):
        for place, one in zip(image.places, result.found, strict=True):
            refined.done[place] = One(start=starts[place], result=one, taken_s=result.taken_s)
        on_image(image, result)


class OverlayFolder:
    """Pictures of images with the start poses' contours in red, and those of refined ones in green.

    Args:
        dataset: With the images and meshes.
        obj_ids: Objects that are drawn.
        folder: For one picture an image.
    """

    def __init__(self, dataset: BopDataset, obj_ids: Collection[int], folder: Path) -> None:
        self._dataset = dataset
        self._folder = folder
        self._overlay = Overlay({i: dataset.mesh(i) for i in sorted(obj_ids)})

    def close(self) -> None:
        """Free what the renderer holds."""
        self._overlay.close()

    def write(self, image: ImageStarts, results: Results) -> None:
        """Draw one image."""
        K = self._dataset.camera(image.scene_id, image.im_id).K
        rgb = self._dataset.rgb(image.scene_id, image.im_id)
        good = [
            Request(obj_id=request.obj_id, T_cam_obj=one.T_cam_obj)
            for request, one in zip(image.requests, results.found, strict=True)
            if not one.failed
        ]
        picture = self._overlay.draw(self._overlay.draw(rgb, K, image.requests, START_RGB), K, good, REFINED_RGB)
        write_image(self._folder / f"{image.scene_id:06d}_{image.im_id:06d}.png", picture)


def load_frame(dataset: BopDataset, scene_id: int, im_id: int, method: PoseRefiner) -> Frame:
    """An image with its camera, and with its depth where the method needs that.

    Raises:
        DatasetError: There is none, or it is damaged.
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


def make_sidecar(
    *,
    dataset: BopDataset,
    method: PoseRefiner,
    name: str,
    loaded: Checkpoint | None,
    start_path: Path,
    start_sidecar: dict[str, Any],
    refined: Refined,
) -> dict[str, Any]:
    """What is written beside a refined result file.

    `initial_lines` holds the start file's line of every estimate, `failed_lines` those of the poses that failed. What
    the start file's own sidecar says about how its poses were perturbed is carried over.
    """
    sidecar: dict[str, Any] = {"dataset": str(dataset.root.resolve()), "split": dataset.split, "method": name}
    if loaded is not None:
        sidecar |= {"checkpoint": loaded.path.name, "checkpoint_sha256": loaded.sha256}
    sidecar |= {
        "settings": {"refinenet": __version__, **method.settings},
        "init": start_path.name,
        "initial_lines": [one.start.line for one in refined.kept],
        "failed_lines": list(refined.failures),
        "failures": {str(line): why for line, why in refined.failures.items()},
    }
    return sidecar | ({CARRIED: start_sidecar[CARRIED]} if CARRIED in start_sidecar else {})
