"""Pictures of single poses: the image around the object, with the contours of ground truth and estimate."""

import base64
from collections.abc import Sequence

import cv2
import numpy as np
from jaxtyping import Bool, Float, UInt8
from posecore.camera import Camera, crop_K
from posecore.errors import DatasetError, StorageError
from posecore.window import Window, cut, silhouette_box

from evalkit.evaluation.evaluator import Evaluator

SIDE_PX = 300
GT_RGB = (0, 224, 110)
ESTIMATE_RGB = (255, 64, 160)
DASH_PX, GAP_PX = 9, 6
"""The estimate's contour is dashed, for readers who do not distinguish the colours."""
MARGIN = 1.35
LARGEST_OVER_GT = 3.0
"""Largest side over the ground truth's: a distant estimate may leave the picture, the object stays visible."""


def common_window(
    evaluator: Evaluator,
    obj_id: int,
    camera: Camera,
    T_gt: Float[np.ndarray, "4 4"],
    poses: Sequence[Float[np.ndarray, "4 4"]],
) -> Window:
    """A square around the ground truth and, as far as possible, all estimates."""
    vertices = evaluator.mesh(obj_id).vertices_m
    boxes = [silhouette_box(vertices, camera.K, T_cam_obj) for T_cam_obj in (T_gt, *poses)]
    box_gt = boxes[0] if np.isfinite(boxes[0]).all() else np.array([0.0, 0.0, camera.width_px, camera.height_px])
    near = np.stack([box_gt, *[box for box in boxes[1:] if np.isfinite(box).all()]])
    low, high = near[:, :2].min(axis=0), near[:, 2:].max(axis=0)
    gt_side = float((box_gt[2:] - box_gt[:2]).max())
    side = max(float((high - low).max()), gt_side, 16.0)
    limit = LARGEST_OVER_GT * max(gt_side, 16.0)
    center = (low + high) / 2 if side <= limit else (box_gt[:2] + box_gt[2:]) / 2
    side = min(side, limit) * MARGIN
    return Window(x0_px=float(center[0] - side / 2), y0_px=float(center[1] - side / 2), side_px=side)


def overlay(
    evaluator: Evaluator,
    rgb: UInt8[np.ndarray, "h w 3"],
    camera: Camera,
    window: Window,
    obj_id: int,
    T_gt: Float[np.ndarray, "4 4"],
    T_est: Float[np.ndarray, "4 4"] | None,
) -> UInt8[np.ndarray, "s s 3"]:
    """The image in a window, with the ground-truth contour in green and the estimated one above, dashed and pink."""
    shrinks = window.side_px > SIDE_PX
    patch = np.ascontiguousarray(cut(rgb, window, SIDE_PX, interpolation="area" if shrinks else "linear", fill=235))
    poses = [T_gt] if T_est is None else [T_gt, T_est]
    K = crop_K(camera.K, window, SIDE_PX)
    masks = evaluator.rasteriser.render(obj_id, K, np.stack(poses), SIDE_PX, SIDE_PX, rgb=False).mask
    _draw(patch, _outlines(masks[0]), True, GT_RGB)
    if T_est is not None:
        dashes = [dash for outline in _outlines(masks[1]) for dash in _dashes(outline)]
        _draw(patch, dashes, False, ESTIMATE_RGB)
    return patch


def _outlines(mask: Bool[np.ndarray, "s s"]) -> Sequence[np.ndarray]:
    return cv2.findContours(mask.astype(np.uint8), cv2.RETR_CCOMP, cv2.CHAIN_APPROX_NONE)[0]


def _dashes(outline: np.ndarray) -> list[np.ndarray]:
    """Pieces of a closed outline of adjacent pixels, as many as fit with equal gaps."""
    count = max(1, round(len(outline) / (DASH_PX + GAP_PX)))
    starts = np.linspace(0, len(outline), count, endpoint=False).astype(int)
    length = max(2, len(outline) * DASH_PX // (count * (DASH_PX + GAP_PX)))
    return [outline[start : start + length] for start in starts]


def _draw(
    patch: UInt8[np.ndarray, "s s 3"], lines: Sequence[np.ndarray], closed: bool, colour: tuple[int, int, int]
) -> None:
    cv2.polylines(patch, lines, closed, (20, 20, 20), 4, cv2.LINE_AA)
    cv2.polylines(patch, lines, closed, colour, 2, cv2.LINE_AA)


def read_image(evaluator: Evaluator, scene_id: int, im_id: int) -> UInt8[np.ndarray, "h w 3"] | None:
    """The image, or None where the dataset comes without it."""
    try:
        return evaluator.dataset.rgb(scene_id, im_id)
    except DatasetError:
        return None


def data_url(image: UInt8[np.ndarray, "h w 3"], quality: int = 82) -> str:
    """The image as a JPEG inside a URL."""
    ok, data = cv2.imencode(".jpg", cv2.cvtColor(image, cv2.COLOR_RGB2BGR), [cv2.IMWRITE_JPEG_QUALITY, quality])
    if not ok:
        raise StorageError(f"a picture of shape {image.shape} cannot be encoded as JPEG")
    return "data:image/jpeg;base64," + base64.b64encode(data.tobytes()).decode()
