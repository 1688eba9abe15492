"""Depth ICP: point-to-plane alignment of the render's visible surface with the depth image, by small_gicp."""

from dataclasses import dataclass

import numpy as np
import small_gicp
from jaxtyping import Float
from posecore import se3
from posecore.camera import back_project
from posecore.errors import DatasetError

from refinenet.baselines.base import NOT_VISIBLE, Baseline, failed, refined
from refinenet.baselines.patch import ObjectPatch, TrackedObject, finest_px, nearest_pixels, render_and_crop
from refinenet.refiner import Frame, Refinement

REACH = (0.3, 0.15, 0.08, 0.04)
"""Largest correspondence distances, one after the other, as fractions of the diameter. Like all below: tuned on
renders."""
PATCH_PX = 128
MODEL_POINTS = 1500
SCENE_POINTS = 8000
NEIGHBOURS = 12
MIN_POINTS = 50
MIN_SUPPORT = 0.1
"""Fraction of the rendered pixels whose depth the image must confirm at the refined pose."""
SUPPORT = 0.05
"""A depth is confirmed within this fraction of the diameter."""
STEPS = 10
GRID_M = 2.0**-24
"""Points are rounded to 60 nm. Neighbours in a depth image are equally far from a point: without that, the last bits of
floats would decide which are the nearest, and the pose would depend on them by micrometres."""


class DepthIcp(Baseline):
    """`--method depth-icp`."""

    name = "depth-icp"
    needs_depth = True

    def _refine(self, frame: Frame, T_cam_obj: Float[np.ndarray, "4 4"], target: TrackedObject) -> Refinement:
        if frame.depth_m is None:
            raise DatasetError("depth-icp needs depth, and this image has none; use edge-icp or region for RGB")
        return refine_by_depth(frame, frame.depth_m, T_cam_obj, target, self.iterations)


@dataclass(frozen=True, kw_only=True, eq=False)
class Attempt:
    """An ICP run: pose, pose before the last update, updates, and fraction of the render that the depth confirms."""

    pose: Float[np.ndarray, "4 4"]
    before: Float[np.ndarray, "4 4"]
    iterations: int
    support: float


def refine_by_depth(
    frame: Frame,
    depth_m: Float[np.ndarray, "h w"],
    T_cam_obj: Float[np.ndarray, "4 4"],
    target: TrackedObject,
    iterations: int = 5,
) -> Refinement:
    """Refine from the initial pose, and from the same shifted along its ray to the measured depth; keep the better.

    Args:
        frame: Image and camera.
        depth_m: Camera z, 0 where unknown.
        T_cam_obj: Initial pose, metres.
        target: Object.
        iterations: Largest number of renders at each of four correspondence distances.
    """
    initial = np.asarray(T_cam_obj, np.float64)
    patch = _patch(frame, initial, target)
    if patch is None:
        return failed(T_cam_obj, 0, NOT_VISIBLE)
    on_surface = _shifted_to_surface(initial, patch, _scene_depth_m(patch, depth_m), target.mesh.diameter_m)
    attempts = [a for s in (initial, on_surface) if (a := _run(frame, depth_m, s, target, iterations)) is not None]
    if not attempts:
        return failed(T_cam_obj, 0, f"under {MIN_POINTS} points of depth near the object")
    best = max(attempts, key=lambda attempt: attempt.support)
    if best.support < MIN_SUPPORT:
        reason = f"depth confirms {best.support:.0%} of the surface in the end, {MIN_SUPPORT:.0%} needed"
        return failed(T_cam_obj, best.iterations, reason)
    return refined(T_cam_obj, best.before, best.pose, best.iterations, target.mesh.diameter_m)


def _patch(frame: Frame, pose: Float[np.ndarray, "4 4"], target: TrackedObject) -> ObjectPatch | None:
    patch_px = finest_px(frame.K, pose, target.mesh, PATCH_PX)
    return render_and_crop(frame.image, frame.K, pose, target, patch_px) if patch_px else None


def _scene_depth_m(patch: ObjectPatch, depth_m: Float[np.ndarray, "h w"]) -> Float[np.ndarray, "p p"]:
    """Depth of the image pixel nearest to each patch pixel; 0 outside the image."""
    return np.where(patch.visible, nearest_pixels(depth_m, patch.window, len(patch.depth_m)), 0.0)


def _shifted_to_surface(
    pose: Float[np.ndarray, "4 4"], patch: ObjectPatch, scene_m: Float[np.ndarray, "p p"], diameter_m: float
) -> Float[np.ndarray, "4 4"]:
    """The pose shifted along its ray by the median gap between rendered and measured depth."""
    both = patch.mask & (scene_m > 0)
    gap_m = (scene_m - patch.depth_m)[both]
    gap_m = gap_m[np.abs(gap_m) < diameter_m]
    out = pose.copy()
    if len(gap_m):
        out[:3, 3] *= 1 + float(np.median(gap_m)) / pose[2, 3]
    return out


def _run(
    frame: Frame,
    depth_m: Float[np.ndarray, "h w"],
    initial: Float[np.ndarray, "4 4"],
    target: TrackedObject,
    iterations: int,
) -> Attempt | None:
    """ICP with shrinking correspondence distance; None if the object is not visible or there is no depth near it."""
    pose = before = initial
    diameter_m, done = target.mesh.diameter_m, 0
    for reach in REACH:
        for _ in range(iterations):
            patch = _patch(frame, pose, target)
            if patch is None:
                return None
            aligned = _align(patch, _scene_depth_m(patch, depth_m), pose, reach * diameter_m, diameter_m)
            if aligned is None:
                return None
            before, pose = pose, aligned
            done += 1
            if np.abs(aligned - before).max() < 1e-4:
                break
    patch = _patch(frame, pose, target)
    if patch is None:
        return None
    visible = patch.mask & patch.visible
    confirmed = np.abs(_scene_depth_m(patch, depth_m) - patch.depth_m)[visible] < SUPPORT * diameter_m
    return Attempt(pose=pose, before=before, iterations=done, support=float(confirmed.mean()))


def _align(
    patch: ObjectPatch,
    scene_m: Float[np.ndarray, "p p"],
    pose: Float[np.ndarray, "4 4"],
    reach_m: float,
    diameter_m: float,
) -> Float[np.ndarray, "4 4"] | None:
    """An alignment of the visible surface with the scene's points near the object."""
    model = _points(patch, patch.depth_m.astype(np.float64), MODEL_POINTS)
    scene = _points(patch, scene_m.astype(np.float64), SCENE_POINTS)
    middle_m = (model.min(axis=0) + model.max(axis=0)) / 2
    scene = scene[np.linalg.norm(scene - middle_m, axis=1) < diameter_m / 2 + reach_m]
    if len(model) < MIN_POINTS or len(scene) < MIN_POINTS:
        return None
    source, goal = (small_gicp.PointCloud(np.round((points - middle_m) / GRID_M) * GRID_M) for points in (model, scene))
    small_gicp.estimate_normals(goal, num_neighbors=NEIGHBOURS)
    result = small_gicp.align(
        goal,
        source,
        registration_type="PLANE_ICP",
        max_correspondence_distance=reach_m,
        max_iterations=STEPS,
        translation_epsilon=1e-5,
    )
    if result.num_inliers < MIN_POINTS or not np.isfinite(result.T_target_source).all():
        return None
    there, back = se3.make_T(np.eye(3), middle_m), se3.make_T(np.eye(3), -middle_m)
    return np.asarray(there @ result.T_target_source @ back @ pose)


def _points(patch: ObjectPatch, depth_m: Float[np.ndarray, "p p"], n: int) -> Float[np.ndarray, "m 3"]:
    """At most `n` points of a depth patch, evenly over its pixels."""
    pixels = np.argwhere(depth_m > 0)
    if len(pixels) > n:
        pixels = pixels[(np.arange(n) * (len(pixels) / n)).astype(int)]
    return back_project(patch.K, pixels[:, ::-1] + 0.5, depth_m[pixels[:, 0], pixels[:, 1]])
