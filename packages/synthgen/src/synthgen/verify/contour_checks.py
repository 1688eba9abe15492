"""Checks of contour points and distance transforms."""

import numpy as np
from jaxtyping import Bool, Float
from posecore.camera import project
from posecore.contour import distance_transform_px
from posecore.shard import BIT_VISIBLE

from synthgen.verify.check import CheckList
from synthgen.verify.facts import SampleBatch

CHECKS = CheckList()


@CHECKS.register("distance zeros", 0, "pixels", "a distance between two pixel centres is 0 or at least 1")
def distance_zeros(batch: SampleBatch) -> Float[np.ndarray, " n"]:
    """Both distance transforms are zero on the silhouette's contour and nowhere else."""
    wrong = (batch["scene_distance_px"] == 0) != batch.scene_contour
    wrong_hypothesis = (batch["hypothesis_distance_px"] == 0) != batch.hypothesis_contour
    return np.asarray((wrong.sum(axis=(1, 2)) + wrong_hypothesis.sum(axis=(1, 2))), np.float64)


@CHECKS.register(
    "contour pixels", 0.01, "px", "points are contour pixels' centres; float32 metres project back within 1e-4 px"
)
def contour_pixels(batch: SampleBatch) -> Float[np.ndarray, " n"]:
    """Every contour point projects to the centre of a contour pixel."""
    error_px = _contour_error_px(batch, "scene_contour_cam_m", batch.scene_contour)
    return np.maximum(error_px, _contour_error_px(batch, "hypothesis_contour_cam_m", batch.hypothesis_contour))


@CHECKS.register(
    "contour depth", 0.55, "depth steps", "depth is rounded to the nearest step; float32 adds 0.01 at most"
)
def contour_depth(batch: SampleBatch) -> Float[np.ndarray, " n"]:
    """Contour points have the stored depth of their pixels: all of the hypothesis, the visible ones of the scene."""
    visible = batch["scene_mask"] & BIT_VISIBLE > 0
    scene_m = depth_error_m(batch, "scene_contour_cam_m", batch["scene_depth_m"], visible).max(axis=1)
    hypothesis_m = depth_error_m(batch, "hypothesis_contour_cam_m", batch["hypothesis_depth_m"], batch.hypothesis_mask)
    return np.maximum(scene_m, hypothesis_m.max(axis=1)) / batch.facts.step("hypothesis_depth_m")


@CHECKS.register("distance values", 0, "px^2", "squared distances of pixel centres are whole numbers", rerendered=True)
def distance_values(batch: SampleBatch) -> Float[np.ndarray, " n"]:
    """Both distance transforms equal those recomputed from the stored silhouettes."""
    error = np.zeros(len(batch))
    for name, contours in (
        ("scene_distance_px", batch.scene_contour),
        ("hypothesis_distance_px", batch.hypothesis_contour),
    ):
        for i, contour in enumerate(contours):
            if contour.any():
                expected = np.rint(np.square(distance_transform_px(contour)))
                error[i] = max(error[i], float(np.abs(np.rint(np.square(batch[name][i])) - expected).max()))
            else:
                error[i] = np.inf
    return error


def depth_error_m(
    batch: SampleBatch, name: str, depth_m: Float[np.ndarray, "n p p"], where: Bool[np.ndarray, "n p p"]
) -> Float[np.ndarray, "n c"]:
    """Difference between the z of each contour point and a depth map at its pixel, metres; 0 outside `where`."""
    row, column, _ = _pixels(batch, name)
    index = (np.arange(len(batch))[:, None], row, column)
    return np.where(where[index], np.abs(batch[name][..., 2].astype(np.float64) - depth_m[index]), 0.0)


def _contour_error_px(batch: SampleBatch, name: str, contour: Bool[np.ndarray, "n p p"]) -> Float[np.ndarray, " n"]:
    row, column, uv = _pixels(batch, name)
    error = np.maximum(np.abs(uv[..., 0] - column - 0.5), np.abs(uv[..., 1] - row - 0.5))
    hit = contour[np.arange(len(batch))[:, None], row, column]
    return np.asarray(np.where(hit & np.isfinite(error), error, np.inf).max(axis=1))


def _pixels(batch: SampleBatch, name: str) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Row and column of each contour point's pixel, clipped to the patch, and the projection."""
    uv = project(batch["K_crop"], batch[name].astype(np.float64))
    inside = np.nan_to_num(np.floor(uv), nan=-1).clip(0, batch.facts.patch_px - 1).astype(int)
    return inside[..., 1], inside[..., 0], uv
