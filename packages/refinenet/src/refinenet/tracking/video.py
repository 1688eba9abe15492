"""Annotated video of a track."""

from collections.abc import Sequence
from pathlib import Path

import cv2
import numpy as np
from jaxtyping import UInt8
from posecore.errors import DatasetError

from refinenet.refine.overlay import INITIAL_RGB, REFINED_RGB, Colour, Overlay, write_line
from refinenet.refiner import Frame, Request
from refinenet.tracking.state import TrackState
from refinenet.tracking.tracker import Tracked

UNCERTAIN_RGB: Colour = (250, 200, 60)
COLOURS = {TrackState.TRACKING: REFINED_RGB, TrackState.UNCERTAIN: UNCERTAIN_RGB, TrackState.LOST: INITIAL_RGB}


def annotated(frame: Frame, number: int, tracked: Sequence[Tracked], overlay: Overlay) -> UInt8[np.ndarray, "h w 3"]:
    """The frame with each object's contour in the colour of its state, and a line of text per object."""
    picture = frame.image
    for result in tracked:
        if result.T_cam_obj is not None:
            pose = Request(obj_id=result.obj_id, T_cam_obj=result.T_cam_obj)
            picture = overlay.draw(picture, frame.K, [pose], COLOURS[result.state])
    for line, result in enumerate(tracked):
        text = f"{number}  object {result.obj_id}  {result.state}  {result.confidence:.2f}"
        picture = write_line(picture, text, COLOURS[result.state], line)
    return picture


class VideoWriter:
    """Writes RGB frames to a video file until it is closed; a context manager.

    Args:
        file: Path; the suffix selects the container (.mp4, .avi, ...).
        fps: Frames per second.
    """

    def __init__(self, file: Path, fps: float) -> None:
        self._file, self._fps = file, fps
        self._writer: cv2.VideoWriter | None = None

    def __enter__(self) -> "VideoWriter":
        return self

    def __exit__(self, *_: object) -> None:
        if self._writer is not None:
            self._writer.release()

    def write(self, image: UInt8[np.ndarray, "h w 3"]) -> None:
        """Append a frame; all frames have the size of the first.

        Raises:
            DatasetError: OpenCV has no encoder for this kind of file, or the frame has another size.
        """
        height_px, width_px = image.shape[:2]
        if self._writer is None:
            self._file.parent.mkdir(parents=True, exist_ok=True)
            code = cv2.VideoWriter.fourcc(*("MJPG" if self._file.suffix.lower() == ".avi" else "mp4v"))
            self._writer = cv2.VideoWriter(str(self._file), code, self._fps, (width_px, height_px))
            self._size = (width_px, height_px)
            if not self._writer.isOpened():
                raise DatasetError(
                    f"{self._file}: OpenCV cannot write such a video; choose a name ending in .mp4 or .avi"
                )
        if (width_px, height_px) != self._size:
            first = f"{self._size[0]} x {self._size[1]}"
            raise DatasetError(
                f"{self._file}: a frame has {width_px} x {height_px} px, the first had {first} px; a video has one size"
            )
        self._writer.write(cv2.cvtColor(image, cv2.COLOR_RGB2BGR))
