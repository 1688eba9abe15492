"""Refinement of a BOP result file: initial poses in, refined poses out, image by image."""

from collections.abc import Callable, Mapping, Sequence
from contextlib import ExitStack, closing
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from posecore.bop import BopDataset, Estimate, read_results, read_sidecar, write_results
from posecore.errors import ConfigError, PoseError
from posecore.files import require_writable

from refinenet import __version__
from refinenet.models import checkpoint as checkpoints
from refinenet.models.checkpoint import Checkpoint
from refinenet.refine.image_poses import ImagePoses, ImageResults, group_by_image, refine_images
from refinenet.refine.overlay import OverlayFolder
from refinenet.refine.registry import WITH_NETWORK, MethodSettings, make_refiner
from refinenet.refine.workers import WorkerSettings, refine_images_in_workers
from refinenet.refiner import PoseRefiner, Refinement, Status

PERTURBATION = "perturbation"
"""Sidecar key of the initial poses' perturbations, copied unchanged."""


@dataclass(frozen=True, kw_only=True)
class RefineJob:
    """Refinement of a result file.

    Attributes:
        method: Method and settings.
        dataset: BOP dataset with the images and meshes.
        init: Initial poses, a BOP result file.
        out: Refined poses, a BOP result file; its sidecar lies beside it.
        split: Split folder; None takes test, val, train_pbr, train or the only one.
        objects: Objects to refine; all when empty.
        keep_failed: Whether a failed pose is written as it was, with score 0, instead of left out.
        name: Method's name in the sidecar; None takes the method's own.
        overlay: Folder for a picture per image with the initial and refined contours.
        candidates: Result file for all poses that a global search scored.
        workers: Processes.
        threads: Torch threads; 0 leaves torch's choice, and 1 to each of several processes.
        run: Training run that these poses are the result of, for the sidecar.

    Raises:
        ConfigError: The method has no candidates.
    """

    method: MethodSettings
    dataset: Path
    init: Path
    out: Path
    split: str | None = None
    objects: tuple[int, ...] = ()
    keep_failed: bool = False
    name: str | None = None
    overlay: Path | None = None
    candidates: Path | None = None
    workers: int = 1
    threads: int = 0
    run: Path | None = None

    def __post_init__(self) -> None:
        if self.candidates is not None and self.method.method not in WITH_NETWORK:
            raise ConfigError(f"--candidates is for --method {WITH_NETWORK[0]}, {self.method.method} follows one pose")


@dataclass(frozen=True, kw_only=True, eq=False)
class RefinedPose:
    """An initial pose, its refinement, and the image's run time."""

    initial: Estimate
    result: Refinement
    time_s: float

    def estimate(self, refinement: Refinement) -> Estimate:
        """A pose that came from this initial pose, as a line of a result file.

        The score is the method's confidence, or the initial pose's score where the method has none.
        """
        score = self.initial.score if refinement.confidence is None else refinement.confidence
        return replace(
            self.initial, T_cam_obj=np.asarray(refinement.T_cam_obj), time_s=self.time_s,
            score=0.0 if refinement.failed else float(score),
        )  # fmt: skip


@dataclass(kw_only=True, eq=False)
class RefinedFile:
    """Refined poses of a result file, possibly incomplete.

    Attributes:
        keep_failed: Whether a failed pose is written as it was, with score 0, or left out, so that evaluation counts it
            as missing.
        by_index: Refined poses by the index of their initial pose.
    """

    keep_failed: bool = False
    by_index: dict[int, RefinedPose] = field(default_factory=dict)

    def add(self, image: ImagePoses, results: ImageResults, initial_poses: Sequence[Estimate]) -> None:
        """Add the results of an image."""
        for index, refinement in zip(image.indices, results.refinements, strict=True):
            self.by_index[index] = RefinedPose(initial=initial_poses[index], result=refinement, time_s=results.time_s)

    @property
    def poses(self) -> list[RefinedPose]:
        """All poses, in the order of the initial poses."""
        return [self.by_index[index] for index in sorted(self.by_index)]

    @property
    def written(self) -> list[RefinedPose]:
        """Poses that the result file holds."""
        return [pose for pose in self.poses if self.keep_failed or not pose.result.failed]

    @property
    def estimates(self) -> list[Estimate]:
        """Lines of the result file."""
        return [pose.estimate(pose.result) for pose in self.written]

    @property
    def failed(self) -> list[RefinedPose]:
        """Poses whose refinement failed."""
        return [pose for pose in self.poses if pose.result.failed]

    @property
    def converged(self) -> int:
        """Number of poses whose last update was small."""
        return sum(pose.result.status is Status.CONVERGED for pose in self.poses)

    @property
    def candidates(self) -> list[Estimate]:
        """All poses that the method scored, those of failed initial poses included."""
        return [pose.estimate(candidate) for pose in self.poses for candidate in pose.result.candidates]


@dataclass(frozen=True, kw_only=True, eq=False)
class RefineSummary:
    """Outcome of a job.

    Attributes:
        refined: Refined poses, as written.
        not_reached: Number of initial poses that were not reached.
        stopped: Error or Ctrl-C that ended the job early; None where all poses were reached.
    """

    refined: RefinedFile
    not_reached: int = 0
    stopped: BaseException | None = None


def refine_result_file(
    job: RefineJob, on_image: Callable[[int, int], None] = lambda done, total: None
) -> RefineSummary:
    """Refine the poses of a result file; write the refined file with its sidecar, and what else the job names.

    An error or Ctrl-C after the first image loses nothing: the finished poses are written, the sidecar counts the
    others as `not_reached`, and the summary holds the error. Before that, the error is raised and nothing is written.

    Args:
        job: Input, method and outputs.
        on_image: Called before the first image and after each image, with the number of finished poses and of all.

    Raises:
        ConfigError: There are no poses, or none of a requested object.
        PoseError: An input is missing or damaged, an output cannot be written, or the method cannot be made.
    """
    if job.threads:
        torch.set_num_threads(job.threads)
    loaded = None if job.method.checkpoint is None else checkpoints.load(job.method.checkpoint)
    dataset = BopDataset(job.dataset, job.split)
    initial_poses = _initial_poses(job, dataset)
    initial_sidecar = read_sidecar(job.init) or {}
    for path in filter(None, (job.out, job.candidates, job.overlay and job.overlay / "overlay.png")):
        require_writable(path)
    obj_ids = tuple(sorted({pose.obj_id for pose in initial_poses}))
    method = make_refiner(job.method, {i: dataset.mesh(i) for i in obj_ids}, loaded)
    refined, stopped, images = RefinedFile(keep_failed=job.keep_failed), None, group_by_image(initial_poses)
    try:
        with ExitStack() as stack:
            stack.enter_context(closing(method))
            pictures = job.overlay and stack.enter_context(closing(OverlayFolder(dataset, obj_ids, job.overlay)))
            on_image(0, len(initial_poses))
            if (workers := min(job.workers, len(images))) > 1:
                settings = WorkerSettings(
                    method=job.method, dataset=job.dataset, split=dataset.split, obj_ids=obj_ids, threads=job.threads
                )
                results = stack.enter_context(refine_images_in_workers(settings, images, workers))
            else:
                results = refine_images(dataset, method, images)
            for image, result in zip(images, results, strict=True):
                refined.add(image, result, initial_poses)
                if pictures:
                    pictures.write(image, result)
                on_image(len(refined.by_index), len(initial_poses))
    except (KeyboardInterrupt, PoseError, OSError) as error:
        if not refined.by_index:
            raise
        stopped = error
    not_reached = len(initial_poses) - len(refined.by_index)
    sidecar = _sidecar(job, dataset, method, loaded, initial_sidecar, refined)
    _write(job, refined, sidecar | ({"not_reached": not_reached} if not_reached else {}))
    return RefineSummary(refined=refined, not_reached=not_reached, stopped=stopped)


def _initial_poses(job: RefineJob, dataset: BopDataset) -> list[Estimate]:
    estimates = read_results(job.init, dataset, images="camera")
    if not estimates:
        raise ConfigError(f"{job.init}: no poses in it, there is nothing to refine")
    chosen = [pose for pose in estimates if not job.objects or pose.obj_id in job.objects]
    if missing := sorted(set(job.objects) - {pose.obj_id for pose in chosen}):
        raise ConfigError(f"{job.init}: no pose of object {', '.join(map(str, missing))}; change --object")
    return chosen


def _write(job: RefineJob, refined: RefinedFile, sidecar: Mapping[str, Any]) -> None:
    write_results(job.out, refined.estimates, dict(sidecar))
    if job.candidates is not None:
        common = {key: sidecar[key] for key in ("dataset", "split", "settings", "init")}
        write_results(job.candidates, refined.candidates, common | {"method": f"{sidecar['method']}, all candidates"})


def _sidecar(
    job: RefineJob,
    dataset: BopDataset,
    method: PoseRefiner,
    loaded: Checkpoint | None,
    initial_sidecar: Mapping[str, Any],
    refined: RefinedFile,
) -> dict[str, Any]:
    """Sidecar of the refined result file.

    `initial_lines` holds the line of each estimate in the initial file, `failed_lines` the lines of failed poses. The
    perturbations in the initial file's sidecar are copied.
    """
    sidecar: dict[str, Any] = {
        "dataset": str(dataset.root.resolve()),
        "split": dataset.split,
        "method": job.name or method.name,
    }
    if loaded is not None:
        sidecar |= {"checkpoint": loaded.path.name, "checkpoint_sha256": loaded.sha256}
    if job.run is not None:
        sidecar["run"] = str(job.run.resolve())
    failures = {pose.initial.line: pose.result.failure or "" for pose in refined.failed}
    sidecar |= {
        "settings": {"refinenet": __version__, **method.settings},
        "init": job.init.name,
        "initial_lines": [pose.initial.line for pose in refined.written],
        "failed_lines": list(failures),
        "failures": {str(line): reason for line, reason in failures.items()},
    }
    return sidecar | ({PERTURBATION: initial_sidecar[PERTURBATION]} if PERTURBATION in initial_sidecar else {})
