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
class Refined:
    """A refined result file in memory.

    Attributes:
        estimates: In the order of the start poses. Those that failed are left out, and evaluation counts them as
            missing; or they are the start poses as they were, with score 0.
        start_lines: Line in the start file of each of them.
        failures: Why poses failed, by their line in the start file.
        converged: How many stopped on a small update.
        tried: Every pose that the method weighed, of all start poses, those that failed too.
    """

    estimates: list[Estimate]
    start_lines: list[int]
    failures: dict[int, str] = field(default_factory=dict)
    converged: int = 0
    tried: list[Estimate] = field(default_factory=list)


def refine_estimates(
    dataset: BopDataset,
    starts: Sequence[Estimate],
    method: PoseRefiner,
    *,
    keep_failed: bool = False,
    overlay: Path | None = None,
    on_image: Callable[[int], None] | None = None,
) -> Refined:
    """Refine every start pose in its image.

    Args:
        dataset: Images and cameras.
        starts: Start poses.
        method: With the meshes of all their objects.
        keep_failed: Whether a start pose whose refinement failed is an estimate, with score 0, or left out.
        overlay: Folder for one picture an image, start contours red, refined ones green.
        on_image: Called after each image with the number of poses in it.

    Returns:
        Estimates whose score is the method's confidence (the start's score where it has none), and whose time is that
        of refining all poses of their image, rendering included, reading excluded.

    Raises:
        DatasetError: The method needs depth, and an image has none.
        CameraError: An image's camera is that of an image of another size.
    """
    results: list[tuple[Refinement, float] | None] = [None] * len(starts)
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
                results[i] = result, taken_s
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
    pairs = [(start, *result) for start, result in zip(starts, results, strict=True) if result is not None]
    kept = [(start, result, taken_s) for start, result, taken_s in pairs if keep_failed or not result.failed]
    return Refined(
        estimates=[_estimate(start, result, taken_s) for start, result, taken_s in kept],
        start_lines=[start.line for start, _, _ in kept],
        failures={start.line: result.failure or "" for start, result, _ in pairs if result.failed},
        tried=[_estimate(start, one, taken_s) for start, result, taken_s in pairs for one in result.tried],
        converged=sum(result.status is Status.CONVERGED for _, result, _ in kept),
    )


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


def _estimate(start: Estimate, result: Refinement, taken_s: float) -> Estimate:
    unfailed = start.score if result.confidence is None else result.confidence
    score = 0.0 if result.failed else unfailed
    return replace(start, T_cam_obj=np.asarray(result.T_cam_obj), score=float(score), time_s=taken_s)


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
        "start_lines": refined.start_lines,
        "failed_lines": list(refined.failures),
        "failures": {str(line): why for line, why in refined.failures.items()},
    }
    return sidecar | ({CARRIED: start_sidecar[CARRIED]} if CARRIED in start_sidecar else {})
