"""Refinement of a BOP result file: estimates in, estimates out, image by image."""

import itertools
import time
from collections.abc import Callable, Sequence
from contextlib import closing, nullcontext
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
from posecore.bop import BopDataset, Estimate
from posecore.bop.images import write_image
from posecore.errors import DatasetError

from refinenet import __version__
from refinenet.checkpoint import Checkpoint
from refinenet.methods import Frame, PoseRefiner, Refinement, Request, Status
from refinenet.overlay import REFINED_RGB, START_RGB, Overlay

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


def refine_estimates(
    dataset: BopDataset,
    starts: Sequence[Estimate],
    method: PoseRefiner,
    refined: Refined,
    *,
    overlay: Path | None = None,
    on_image: Callable[[int], None] | None = None,
) -> None:
    """Refine every start pose in its image, adding to `refined` as it goes, so that an error loses nothing.

    An estimate's score is the method's confidence (the start's score where it has none), its time that of refining all
    poses of its image, rendering included, reading excluded.

    Args:
        dataset: Images and cameras.
        starts: Start poses.
        method: With the meshes of all their objects.
        refined: Filled.
        overlay: Folder for one picture an image, start contours red, refined ones green.
        on_image: Called after each image with the number of poses in it.

    Raises:
        DatasetError: The method needs depth, and an image has none.
        CameraError: An image's camera is that of an image of another size.
    """
    order = sorted(range(len(starts)), key=lambda i: (starts[i].scene_id, starts[i].im_id))
    drawing = closing(Overlay({i: dataset.mesh(i) for i in sorted({s.obj_id for s in starts})})) if overlay else None
    with drawing or nullcontext() as painter:
        for (scene_id, im_id), group in itertools.groupby(order, key=lambda i: (starts[i].scene_id, starts[i].im_id)):
            rows = list(group)
            frame = load_frame(dataset, scene_id, im_id, method)
            requests = [Request(obj_id=starts[i].obj_id, T_cam_obj=starts[i].T_cam_obj) for i in rows]
            begun = time.perf_counter()
            found = method.refine_batch(frame, requests)
            taken_s = time.perf_counter() - begun
            for i, result in zip(rows, found, strict=True):
                refined.done[i] = One(start=starts[i], result=result, taken_s=taken_s)
            if painter is not None and overlay is not None:
                picture = painter.draw(frame.image, frame.K, requests, START_RGB)
                good = [
                    Request(obj_id=request.obj_id, T_cam_obj=result.T_cam_obj)
                    for request, result in zip(requests, found, strict=True)
                    if not result.failed
                ]
                picture = painter.draw(picture, frame.K, good, REFINED_RGB)
                write_image(overlay / f"{scene_id:06d}_{im_id:06d}.png", picture)
            if on_image is not None:
                on_image(len(rows))


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
    return Frame(image=image, K=dataset.camera(scene_id, im_id).K, depth_m=depth_m)


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

    `start_lines` holds the start file's line of every estimate, `failed_lines` those of the poses that failed. What
    the start file's own sidecar says about how its poses were perturbed is carried over.
    """
    sidecar: dict[str, Any] = {"dataset": str(dataset.root.resolve()), "split": dataset.split, "method": name}
    if loaded is not None:
        sidecar |= {"checkpoint": loaded.path.name, "checkpoint_sha256": loaded.sha256}
    sidecar |= {
        "settings": {"refinenet": __version__, **method.settings},
        "init": start_path.name,
        "start_lines": [one.start.line for one in refined.kept],
        "failed_lines": list(refined.failures),
        "failures": {str(line): why for line, why in refined.failures.items()},
    }
    return sidecar | ({CARRIED: start_sidecar[CARRIED]} if CARRIED in start_sidecar else {})
