"""Refinement of a BOP result file: estimates in, estimates out, image by image."""

import itertools
import time
from collections.abc import Callable, Sequence
from contextlib import closing, nullcontext
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from posecore.bop import BopDataset, Estimate
from posecore.bop.images import write_image

from refinenet import __version__
from refinenet.checkpoint import Checkpoint
from refinenet.overlay import REFINED_RGB, START_RGB, Overlay
from refinenet.refine import STOP_ANGLE_DEG, STOP_DISTANCE_M, Refiner

CARRIED = "perturbation"
"""What the start poses' sidecar says of how each was made goes over unchanged."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Refined:
    """A refined result file in memory.

    Attributes:
        estimates: In the order of the start poses, without the failed ones: evaluation counts them as missing.
        start_lines: Line in the start file of each of them.
        failed_lines: Line in the start file of each that failed.
        converged: How many stopped on a small update.
    """

    estimates: list[Estimate]
    start_lines: list[int]
    failed_lines: list[int]
    converged: int


def refine_estimates(
    dataset: BopDataset,
    starts: Sequence[Estimate],
    refiner: Refiner,
    *,
    iterations: int = 5,
    overlay: Path | None = None,
    on_image: Callable[[int], None] | None = None,
) -> Refined:
    """Refine every start pose in its image.

    Args:
        dataset: Images and cameras.
        starts: Start poses.
        refiner: With the meshes of all their objects.
        iterations: Most updates of a pose.
        overlay: Folder for one picture an image, start contours red, refined ones green.
        on_image: Called after each image with the number of poses in it.

    Returns:
        Estimates whose time is that of refining all poses of their image, rendering included, reading excluded.
    """
    refined: list[Estimate | None] = [None] * len(starts)
    converged = 0
    order = sorted(range(len(starts)), key=lambda i: (starts[i].scene_id, starts[i].im_id))
    drawing = closing(Overlay({i: dataset.mesh(i) for i in sorted({s.obj_id for s in starts})})) if overlay else None
    with drawing or nullcontext() as painter:
        for (scene_id, im_id), group in itertools.groupby(order, key=lambda i: (starts[i].scene_id, starts[i].im_id)):
            rows = list(group)
            image, K = dataset.rgb(scene_id, im_id), dataset.camera(scene_id, im_id).K
            T = np.stack([starts[i].T_cam_obj for i in rows])
            obj_id = np.array([starts[i].obj_id for i in rows])
            begun = time.perf_counter()
            result = refiner.refine(image, K, T, obj_id, iterations=iterations)
            taken_s = time.perf_counter() - begun
            for k, i in enumerate(rows):
                if not result.failed[k]:
                    refined[i] = replace(starts[i], T_cam_obj=result.T_cam_obj[k], time_s=taken_s)
            converged += int(result.converged.sum())
            if painter is not None and overlay is not None:
                picture = painter.draw(image, K, T, obj_id, START_RGB)
                picture = painter.draw(picture, K, result.T_cam_obj, obj_id, REFINED_RGB)
                write_image(overlay / f"{scene_id:06d}_{im_id:06d}.png", picture)
            if on_image is not None:
                on_image(len(rows))
    return Refined(
        estimates=[estimate for estimate in refined if estimate is not None],
        start_lines=[start.line for start, estimate in zip(starts, refined, strict=True) if estimate is not None],
        failed_lines=[start.line for start, estimate in zip(starts, refined, strict=True) if estimate is None],
        converged=converged,
    )


def make_sidecar(
    *,
    dataset: BopDataset,
    loaded: Checkpoint,
    start_path: Path,
    start_sidecar: dict[str, Any],
    method: str,
    iterations: int,
    refined: Refined,
) -> dict[str, Any]:
    """What is written beside a refined result file.

    `start_lines` holds the start file's line of every estimate, `failed_lines` those of the poses without one. What
    the start file's own sidecar says about how its poses were perturbed is carried over.
    """
    sidecar: dict[str, Any] = {
        "dataset": str(dataset.root.resolve()),
        "split": dataset.split,
        "method": method,
        "checkpoint": loaded.path.name,
        "checkpoint_sha256": loaded.sha256,
        "settings": {
            "refinenet": __version__,
            "preset": loaded.provenance.config.preset,
            "step": loaded.provenance.step,
            "iterations": iterations,
            "stop_angle_deg": STOP_ANGLE_DEG,
            "stop_distance_mm": 1e3 * STOP_DISTANCE_M,
        },
        "init": start_path.name,
        "start_lines": refined.start_lines,
        "failed_lines": refined.failed_lines,
    }
    return sidecar | ({CARRIED: start_sidecar[CARRIED]} if CARRIED in start_sidecar else {})
