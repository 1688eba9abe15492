"""Tracking of a whole sequence: frames in, result file and annotated video out."""

import time
from collections.abc import Callable, Mapping, Sequence
from contextlib import ExitStack, closing
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from jaxtyping import Float
from posecore.bop import Estimate, write_results
from posecore.errors import ConfigError, PoseError
from posecore.files import require_writable
from posecore.mesh import Mesh, Units

from refinenet import __version__
from refinenet.models import checkpoint as checkpoints
from refinenet.models.checkpoint import Checkpoint
from refinenet.refine.overlay import Overlay
from refinenet.refine.registry import WITH_CONFIDENCE, WITH_NETWORK, MethodSettings, make_refiner
from refinenet.refiner import PoseRefiner
from refinenet.tracking.frame_sources import BopScene, FrameSequence, open_images, open_scene
from refinenet.tracking.inputs import InitialPoses, load_models
from refinenet.tracking.state import TrackingConfig, TrackState
from refinenet.tracking.tracker import Tracked, Tracker, default_config
from refinenet.tracking.video import VideoWriter, annotated


@dataclass(frozen=True, kw_only=True)
class TrackJob:
    """Tracking of a sequence.

    Attributes:
        method: Method and settings.
        dataset: BOP dataset with the images; None with `source`.
        source: Folder of images, or video file; None with `dataset`.
        out: Poses, a BOP result file; its sidecar lies beside it.
        init: BOP result file with initial poses at their images; None with `pose`.
        pose: List of `scene_gt.json` with initial poses for any image; None with `init`.
        split: Split of a BOP dataset.
        scene: Scene of a BOP dataset, or scene id of images in the result file.
        camera: BOP `camera.json` of images or a video.
        mesh_files: Meshes for images or a video.
        units: Unit of the meshes.
        objects: Objects to track; all when empty.
        motion_model: Whether poses are predicted at constant velocity.
        tracking_threshold: Least confidence for the state `tracking`; None takes the method's default, also below.
        accept_threshold: Least confidence of an accepted pose.
        patience: Consecutive frames without an accepted pose until an object is lost.
        depth_step: Fraction of its depth by which each hypothesis is also shifted nearer and farther.
        video: Video file with contours and states.
        fps: Frames per second of the video.
        name: Method's name in the sidecar; None takes the method's own.
        threads: Torch threads; 0 leaves torch's choice.

    Raises:
        ConfigError: Not exactly one source of images or of initial poses, or a setting has no effect for the method.
    """

    method: MethodSettings
    out: Path
    dataset: Path | None = None
    source: Path | None = None
    init: Path | None = None
    pose: Path | None = None
    split: str | None = None
    scene: int | None = None
    camera: Path | None = None
    mesh_files: tuple[Path, ...] = ()
    units: Units = "mm"
    objects: tuple[int, ...] = ()
    motion_model: bool = False
    tracking_threshold: float | None = None
    accept_threshold: float | None = None
    patience: int = 5
    depth_step: float | None = None
    video: Path | None = None
    fps: float = 30.0
    name: str | None = None
    threads: int = 0

    def __post_init__(self) -> None:
        method = self.method.method
        if method in WITH_NETWORK and self.method.checkpoint is not None:
            raise ConfigError(f"--method {method} takes no --checkpoint")
        if (self.dataset is None) == (self.source is None):
            raise ConfigError("give SOURCE, a folder of images or a video file, or else --dataset DIR")
        if (self.init is None) == (self.pose is None):
            raise ConfigError("give either --init or --pose: the initial poses of the objects")
        for name in ("tracking_threshold", "accept_threshold", "depth_step"):
            if getattr(self, name) is not None and method not in WITH_CONFIDENCE:
                option = f"--{name.replace('_', '-')}"
                raise ConfigError(
                    f"{option} has no effect for --method {method}, which has no confidences; leave it out"
                )


@dataclass(kw_only=True, eq=False)
class TrackLog:
    """Results of a sequence, possibly incomplete.

    Attributes:
        estimates: Accepted poses; the score is the confidence, the time that of tracking the whole frame.
        states: Frames in each state, over all objects.
        misses: Frame, object and reason where there is no pose.
        resets: Frames and objects where a track started from an initial pose, as `evalkit tracking` reads them.
        frames: Number of frames.
        tracking_s: Time of rendering, network and scoring.
        total_s: Time with reading and drawing.
    """

    estimates: list[Estimate] = field(default_factory=list)
    states: dict[TrackState, int] = field(default_factory=lambda: dict.fromkeys(TrackState, 0))
    misses: list[dict[str, Any]] = field(default_factory=list)
    resets: list[dict[str, int]] = field(default_factory=list)
    frames: int = 0
    tracking_s: float = 0.0
    total_s: float = 0.0

    def add(self, scene_id: int, number: int, tracked: Sequence[Tracked], time_s: float) -> None:
        """Add the results of a frame."""
        self.frames += 1
        self.tracking_s += time_s
        for result in tracked:
            ids = {"scene_id": scene_id, "im_id": number, "obj_id": result.obj_id}
            self.states[result.state] += 1
            if result.T_cam_obj is None:
                self.misses.append({**ids, "state": str(result.state), "why": result.failure})
                continue
            if result.restarted:
                self.resets.append(ids)
            self.estimates.append(Estimate(**ids, score=result.confidence, T_cam_obj=result.T_cam_obj, time_s=time_s))


@dataclass(frozen=True, kw_only=True, eq=False)
class TrackSummary:
    """Outcome of a job.

    Attributes:
        log: Results, as written.
        not_reached: Number of frames that were not reached; at least 1 after an early end, as the length of a video is
            inexact.
        stopped: Error or Ctrl-C that ended the job early; None where all frames were reached.
    """

    log: TrackLog
    not_reached: int = 0
    stopped: BaseException | None = None


def track_to_file(
    job: TrackJob, on_frame: Callable[[int, int | None], None] = lambda done, total: None
) -> TrackSummary:
    """Track objects through a sequence; write the poses with their sidecar, and the video if the job names it.

    An error or Ctrl-C after the first frame loses nothing: the finished poses are written, the sidecar counts the other
    frames as `not_reached`, and the summary holds the error. Before that, the error is raised and nothing is written.

    Args:
        job: Input, method and outputs.
        on_frame: Called before the first frame and after each frame, with the number of finished frames and of all;
            None where that is unknown.

    Raises:
        ConfigError: There is no initial pose or mesh of an object, or an option is for another kind of source.
        PoseError: An input is missing or damaged, an output cannot be written, or the method cannot be made.
    """
    if job.threads:
        torch.set_num_threads(job.threads)
    loaded = None if job.method.checkpoint is None else checkpoints.load(job.method.checkpoint)
    if job.dataset is not None:
        sequence: FrameSequence = open_scene(job.dataset, split=job.split, scene=job.scene, camera=job.camera)
    else:
        assert job.source is not None  # `TrackJob` requires one of both
        sequence = open_images(job.source, split=job.split, scene=job.scene, camera=job.camera)
    initial_poses = InitialPoses(sequence, job.init, job.pose, job.objects)
    meshes, infos = load_models(sequence, job.mesh_files, job.units, loaded, initial_poses.obj_ids)
    initial_poses.require_millimetres(meshes)
    for path in filter(None, (job.out, job.video)):
        require_writable(path)
    log, stopped, total = TrackLog(), None, len(sequence) or None
    with closing(make_refiner(_method_settings(job), meshes, loaded)) as refiner:
        config = _tracking_config(job, refiner)
        symmetries = {i: info for i, info in infos.items() if info.is_symmetric}
        tracker = Tracker(refiner, initial_poses.obj_ids, config, symmetries=symmetries, motion_model=job.motion_model)
        on_frame(0, total)
        try:
            track_sequence(
                sequence, tracker, initial_poses.at, log, meshes=meshes, video=job.video, fps=job.fps,
                on_frame=lambda: on_frame(log.frames, total),
            )  # fmt: skip
        except (KeyboardInterrupt, PoseError, OSError) as error:
            if not log.frames:
                raise
            stopped = error
    not_reached = 0 if stopped is None else max(len(sequence) - log.frames, 1)
    sidecar = _sidecar(job, sequence, refiner, loaded, config, log)
    write_results(job.out, log.estimates, sidecar | ({"not_reached": not_reached} if not_reached else {}))
    return TrackSummary(log=log, not_reached=not_reached, stopped=stopped)


def track_sequence(
    sequence: FrameSequence,
    tracker: Tracker,
    initial_poses: Callable[[int], Mapping[int, Sequence[Float[np.ndarray, "4 4"]]]],
    log: TrackLog,
    *,
    meshes: Mapping[int, Mesh],
    video: Path | None = None,
    fps: float = 30.0,
    on_frame: Callable[[], None] | None = None,
) -> None:
    """Track every frame of a sequence, and add each to `log`, so that finished frames survive an interruption.

    Args:
        sequence: Frames.
        tracker: Tracker of the objects.
        initial_poses: Initial poses by object id for a frame number.
        log: Results; changed in place.
        meshes: Meshes of the objects, for the video.
        video: Video file with contours and states.
        fps: Frames per second of the video.
        on_frame: Called after each frame.
    """
    begun = time.perf_counter()
    with ExitStack() as stack:
        writer = stack.enter_context(VideoWriter(video, fps)) if video else None
        overlay = stack.enter_context(closing(Overlay(meshes))) if video else None
        for number, frame in sequence.frames(tracker.refiner):
            started = time.perf_counter()
            tracked = tracker.step(number, frame, initial_poses(number))
            time_s = time.perf_counter() - started
            if writer is not None and overlay is not None:
                writer.write(annotated(frame, number, tracked, overlay))
            log.add(sequence.scene_id, number, tracked, time_s)
            log.total_s = time.perf_counter() - begun
            if on_frame is not None:
                on_frame()


def _method_settings(job: TrackJob) -> MethodSettings:
    """The job's method; a global search fails below the accept threshold."""
    if job.method.method in WITH_NETWORK and job.accept_threshold is not None:
        return replace(job.method, min_confidence=job.accept_threshold)
    return job.method


def _tracking_config(job: TrackJob, refiner: PoseRefiner) -> TrackingConfig:
    """The method's default thresholds, overridden by those of the job."""
    names = ("tracking_threshold", "accept_threshold", "depth_step")
    overrides = {name: value for name in names if (value := getattr(job, name)) is not None}
    return replace(default_config(refiner), patience=job.patience, **overrides)


def _sidecar(
    job: TrackJob,
    sequence: FrameSequence,
    refiner: PoseRefiner,
    loaded: Checkpoint | None,
    config: TrackingConfig,
    log: TrackLog,
) -> dict[str, Any]:
    sidecar: dict[str, Any] = {"method": job.name or f"{refiner.name}, tracking"}
    if isinstance(sequence, BopScene):
        sidecar |= {"dataset": str(sequence.dataset.root.resolve()), "split": sequence.dataset.split}
    if loaded is not None:
        sidecar |= {"checkpoint": loaded.path.name, "checkpoint_sha256": loaded.sha256}
    return sidecar | {
        "settings": {
            "refinenet": __version__,
            **refiner.settings,
            "motion_model": job.motion_model,
            "tracking_threshold": config.tracking_threshold,
            "accept_threshold": config.accept_threshold,
            "patience_frames": config.patience,
            "depth_step": config.depth_step,
        },
        "init": next(file.name for file in (job.init, job.pose) if file is not None),
        "states": {str(state): count for state, count in log.states.items()},
        "resets": log.resets,
        "misses": log.misses,
    }
