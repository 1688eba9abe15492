"""Tracking a whole sequence: frames in, result file and annotated video out."""

import time
from collections.abc import Callable, Mapping, Sequence
from contextlib import ExitStack, closing
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float
from posecore.bop import Estimate
from posecore.mesh import Mesh

from refinenet.refine.overlay import REFINED_RGB, START_RGB, Colour, Overlay, write_line
from refinenet.refiner import Frame, Request
from refinenet.tracking.frame_sources import FrameSequence, VideoWriter
from refinenet.tracking.state import TrackState
from refinenet.tracking.tracker import Tracked, Tracker

Array = np.ndarray
UNCERTAIN_RGB: Colour = (250, 200, 60)
COLOURS = {TrackState.TRACKING: REFINED_RGB, TrackState.UNCERTAIN: UNCERTAIN_RGB, TrackState.LOST: START_RGB}


@dataclass(kw_only=True, eq=False)
class TrackLog:
    """What came of a sequence so far.

    Attributes:
        estimates: Believed poses; the score is the confidence, the time that of tracking the whole frame.
        states: Frames in each state, over all objects.
        misses: Frame, object and reason where there is no pose.
        resets: Where a track was started from an offered pose, as `evalkit tracking` reads it.
        frames: How many.
        tracking_s: Time of rendering, network and judgement.
        total_s: That of reading and drawing too.
    """

    estimates: list[Estimate] = field(default_factory=list)
    states: dict[TrackState, int] = field(default_factory=lambda: dict.fromkeys(TrackState, 0))
    misses: list[dict[str, Any]] = field(default_factory=list)
    resets: list[dict[str, int]] = field(default_factory=list)
    frames: int = 0
    tracking_s: float = 0.0
    total_s: float = 0.0


def track_sequence(
    sequence: FrameSequence,
    tracker: Tracker,
    offered: Callable[[int], Mapping[int, Sequence[Float[Array, "4 4"]]]],
    log: TrackLog,
    *,
    meshes: Mapping[int, Mesh],
    video: Path | None = None,
    fps: float = 30.0,
    on_frame: Callable[[], None] | None = None,
) -> None:
    """Track every frame of a sequence, adding to `log` as it goes, so that what is done survives an interruption.

    Args:
        sequence: Frames.
        tracker: Objects.
        offered: Start poses by object id for a frame number.
        log: Filled.
        meshes: Of the objects, for the video.
        video: File for a video with contours and states.
        fps: Frames a second of that video.
        on_frame: Called after each frame.
    """
    begun = time.perf_counter()
    with ExitStack() as held:
        writer = held.enter_context(VideoWriter(video, fps)) if video else None
        painter = held.enter_context(closing(Overlay(meshes))) if video else None
        for number, frame in sequence.frames(tracker.refiner):
            started = time.perf_counter()
            found = tracker.step(number, frame, offered(number))
            taken_s = time.perf_counter() - started
            if writer is not None and painter is not None:
                writer.write(annotated(frame, number, found, painter))
            _note(log, sequence.scene_id, number, found, taken_s)
            log.total_s = time.perf_counter() - begun
            if on_frame is not None:
                on_frame()


def _note(log: TrackLog, scene_id: int, number: int, found: Sequence[Tracked], taken_s: float) -> None:
    log.frames += 1
    log.tracking_s += taken_s
    for tracked in found:
        ids = {"scene_id": scene_id, "im_id": number, "obj_id": tracked.obj_id}
        log.states[tracked.state] += 1
        if tracked.T_cam_obj is None:
            log.misses.append({**ids, "state": str(tracked.state), "why": tracked.failure})
            continue
        if tracked.restarted:
            log.resets.append(ids)
        log.estimates.append(Estimate(**ids, score=tracked.confidence, T_cam_obj=tracked.T_cam_obj, time_s=taken_s))


def annotated(frame: Frame, number: int, found: Sequence[Tracked], painter: Overlay) -> np.ndarray:
    """The frame with each object's contour in its state's colour, and a line of text for each."""
    picture = frame.image
    for tracked in found:
        if tracked.T_cam_obj is not None:
            pose = Request(obj_id=tracked.obj_id, T_cam_obj=tracked.T_cam_obj)
            picture = painter.draw(picture, frame.K, [pose], COLOURS[tracked.state])
    for line, tracked in enumerate(found):
        text = f"{number}  object {tracked.obj_id}  {tracked.state}  {tracked.confidence:.2f}"
        picture = write_line(picture, text, COLOURS[tracked.state], line)
    return picture
