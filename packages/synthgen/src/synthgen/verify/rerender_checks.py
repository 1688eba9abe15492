"""Checks against the mesh, projected and rendered again."""

import cv2
import numpy as np
from jaxtyping import Bool, Float
from posecore import se3
from posecore.camera import project
from posecore.shard import BIT_VISIBLE

from synthgen.verify.check import CheckList
from synthgen.verify.contour_checks import depth_error_m
from synthgen.verify.facts import SampleBatch

_RIM = np.ones((5, 5), np.uint8)
_FREE_PX = 2
_VERTICES = 2000  # of each object that are projected
CHECKS = CheckList()


@CHECKS.register(
    "vertices", 0.02, "fraction of vertices", "parts thinner than a pixel may have no mask pixel", rerendered=True
)
def vertices(batch: SampleBatch) -> Float[np.ndarray, " n"]:
    """The mesh's vertices, projected without a renderer, fall into both silhouettes, within 2 pixels."""
    fraction = np.full(len(batch), np.inf)
    for i, obj_id in enumerate(batch["obj_id"].tolist()):
        if obj_id not in batch.facts.meshes:
            continue
        mesh = batch.facts.meshes[obj_id]
        used = np.unique(mesh.faces)
        points = mesh.vertices_m[used[:: max(1, len(used) // _VERTICES)]]
        K = batch["K_crop"][i]
        gt = _stray_fraction(points, batch["T_cam_obj"][i], K, batch.object_mask[i])
        fraction[i] = max(gt, _stray_fraction(points, batch["T_cam_obj_hypothesis"][i], K, batch.hypothesis_mask[i]))
    return fraction


_OTHER_GL = "2 pixels are free: the pixels that an edge covers depend on the GL driver"


@CHECKS.register("ground truth re-rendered", 0.05, "fraction of the contour", _OTHER_GL, rerendered=True)
def ground_truth_silhouette(batch: SampleBatch) -> Float[np.ndarray, " n"]:
    """The object's mask bit is the mesh's silhouette at the ground truth (differing over contour pixels)."""
    return _silhouette_difference(batch.object_mask, batch.gt_rendered_m > 0, batch.scene_contour)


@CHECKS.register("hypothesis re-rendered", 0.05, "fraction of the contour", _OTHER_GL, rerendered=True)
def hypothesis_silhouette(batch: SampleBatch) -> Float[np.ndarray, " n"]:
    """The hypothesis' depth has the silhouette of the mesh rendered at the hypothesis."""
    return _silhouette_difference(batch.hypothesis_mask, batch.hypothesis_rendered_m > 0, batch.hypothesis_contour)


@CHECKS.register("scene depth re-rendered", 0.01, "fraction of pixels", _OTHER_GL, rerendered=True)
def scene_depth(batch: SampleBatch) -> Float[np.ndarray, " n"]:
    """Where the object is visible, scene depth is the rendered depth within one step."""
    visible = (batch["scene_mask"] & BIT_VISIBLE > 0) & (batch.gt_rendered_m > 0)
    return _depth_difference(batch, "scene_depth_m", batch.gt_rendered_m, visible)


@CHECKS.register("hypothesis depth re-rendered", 0.01, "fraction of pixels", _OTHER_GL, rerendered=True)
def hypothesis_depth(batch: SampleBatch) -> Float[np.ndarray, " n"]:
    """Hypothesis depth is the rendered depth within one step."""
    both = batch.hypothesis_mask & (batch.hypothesis_rendered_m > 0)
    return _depth_difference(batch, "hypothesis_depth_m", batch.hypothesis_rendered_m, both)


@CHECKS.register("contour on surface", 0.1, "fraction of points", _OTHER_GL, rerendered=True)
def contour_on_surface(batch: SampleBatch) -> Float[np.ndarray, " n"]:
    """Contour points lie on the rendered surface within one depth step, hidden ones too."""
    limit_m = 1.01 * batch.facts.step("hypothesis_depth_m")
    fractions = []
    for name, rendered_m in (
        ("scene_contour_cam_m", batch.gt_rendered_m),
        ("hypothesis_contour_cam_m", batch.hypothesis_rendered_m),
    ):
        fractions.append(
            (depth_error_m(batch, name, rendered_m, np.ones_like(rendered_m, bool)) > limit_m).mean(axis=1)
        )
    return np.maximum(*fractions)


def _stray_fraction(
    points_m: Float[np.ndarray, "v 3"],
    T_cam_obj: Float[np.ndarray, "4 4"],
    K: Float[np.ndarray, "3 3"],
    mask: Bool[np.ndarray, "p p"],
) -> float:
    """Fraction of vertices that project into the patch but outside the silhouette."""
    uv = np.nan_to_num(np.floor(project(K, se3.apply(T_cam_obj, points_m))), nan=-1, posinf=-1, neginf=-1)
    inside = ((uv >= 0) & (uv < len(mask))).all(axis=1)
    column, row = uv.clip(0, len(mask) - 1).astype(int).T
    return float((inside & (cv2.dilate(mask.astype(np.uint8), _RIM) == 0)[row, column]).mean())


def _silhouette_difference(
    stored: Bool[np.ndarray, "n p p"], rendered: Bool[np.ndarray, "n p p"], contour: Bool[np.ndarray, "n p p"]
) -> Float[np.ndarray, " n"]:
    return ((stored != rendered).sum(axis=(1, 2)) - _FREE_PX).clip(0) / contour.sum(axis=(1, 2)).clip(1)


def _depth_difference(
    batch: SampleBatch, name: str, rendered_m: Float[np.ndarray, "n p p"], where: Bool[np.ndarray, "n p p"]
) -> Float[np.ndarray, " n"]:
    unequal = where & (np.abs(batch[name] - rendered_m) > 1.01 * batch.facts.step(name))
    return (unequal.sum(axis=(1, 2)) - _FREE_PX).clip(0) / where.sum(axis=(1, 2)).clip(1)
