"""Region tracking: the silhouette that parts the object's colours from the background's best.

Global colour histograms, pixel-wise posteriors and a smoothed step over the silhouette's signed distance as in PWP3D
(Prisacariu and Reid 2012), optimised by Gauss-Newton from coarse to fine as in Tjaden, Schwanecke and Schoemer 2016.
"""

from dataclasses import dataclass

import cv2
import numpy as np
from jaxtyping import Bool, Float, UInt8
from posecore.camera import back_project
from posecore.contour import contour_mask
from scipy.ndimage import distance_transform_edt, gaussian_filter

from refinenet.baselines.outcome import Baseline, failed, refined
from refinenet.baselines.solve import moved, projection_jacobian, step
from refinenet.baselines.view import Target, View, finest_px, look
from refinenet.methods import Frame, Refinement

Array = np.ndarray
LEVELS = (0.3, 0.55, 1.0)
"""Patch side as a share of the finest. Like all below: chosen on renders."""
FINEST_PX = 200
LEAST_PATCH_PX = 48
BINS = 32
BAND_PX = 8.0
"""Pixels this near the silhouette count."""
SHARPNESS = 1.0
"""Of the smoothed step, per pixel."""
ADAPTATION = 0.25
"""Weight of the newest histograms after each level, as the silhouette fits better then."""
MIN_CONTOUR = 20
MIN_PIXELS = 40
MIN_SEPARATION = 0.02
"""Least difference of the mean posterior inside and outside: without one the colours say nothing."""
LEAST_COST = 0.05
DAMPING = 1e-3
STEPS_A_RENDER = 2


class RegionTracker(Baseline):
    """`--method region`."""

    name = "region"

    def _refine(self, frame: Frame, T_cam_obj: Float[Array, "4 4"], target: Target) -> Refinement:
        return refine_by_regions(frame.image, frame.K, T_cam_obj, target, self.iterations)


@dataclass(frozen=True, kw_only=True, eq=False)
class Colours:
    """How often each colour occurs: (BINS, BINS, BINS) shares that sum to 1, on the object and beside it."""

    object: Float[Array, "bins bins bins"]
    background: Float[Array, "bins bins bins"]

    def posterior(self, rgb: UInt8[Array, "h w 3"]) -> Float[Array, "h w"]:
        """How likely a pixel is the object's, if both were as likely before."""
        r, g, b = np.moveaxis(rgb.astype(np.int64) * BINS // 256, -1, 0)
        mine, other = self.object[r, g, b], self.background[r, g, b]
        return np.asarray((mine + 1e-6) / (mine + other + 2e-6))

    def mixed(self, newer: "Colours", share: float) -> "Colours":
        """A share of newer ones in these."""
        return Colours(
            object=(1 - share) * self.object + share * newer.object,
            background=(1 - share) * self.background + share * newer.background,
        )


def colours_of(view: View) -> Colours | None:
    """Histograms inside the silhouette and in the rest of the patch; None where one has too few pixels."""
    inside, outside = view.mask & view.in_image, ~view.mask & view.in_image
    if inside.sum() < MIN_PIXELS or outside.sum() < MIN_PIXELS:
        return None
    return Colours(object=_histogram(view.scene_rgb[inside]), background=_histogram(view.scene_rgb[outside]))


def _histogram(rgb: UInt8[Array, "n 3"]) -> Float[Array, "bins bins bins"]:
    index = rgb.astype(np.int64) * BINS // 256
    counts = np.bincount(index @ np.array([BINS * BINS, BINS, 1]), minlength=BINS**3).reshape(BINS, BINS, BINS)
    smooth = gaussian_filter(counts.astype(np.float64), 0.7)
    return np.asarray(smooth / smooth.sum())


def refine_by_regions(
    image: UInt8[Array, "h w 3"],
    K: Float[Array, "3 3"],
    T_cam_obj: Float[Array, "4 4"],
    target: Target,
    iterations: int = 5,
) -> Refinement:
    """Refine one pose.

    Args:
        image: RGB.
        K: Its camera.
        T_cam_obj: Start pose, metres; its silhouette gives the first histograms.
        target: Object.
        iterations: Times `STEPS_A_RENDER` renders, each with one Gauss-Newton step, at each of three resolutions.
    """
    before = pose = np.asarray(T_cam_obj, np.float64)
    finest = finest_px(K, pose, target.mesh, FINEST_PX)
    view = look(image, K, pose, target, finest) if finest else None
    if view is None:
        return failed(T_cam_obj, 0, "the start pose shows nothing of the object in the image")
    colours = colours_of(view)
    if colours is None:
        return failed(T_cam_obj, 0, f"under {MIN_PIXELS} pixels of object or background to learn colours from")
    length_m, done = target.mesh.diameter_m / 2, 0
    for share in LEVELS:
        patch_px = max(LEAST_PATCH_PX, round(share * finest))
        for _ in range(STEPS_A_RENDER * iterations):
            view = look(image, K, pose, target, patch_px)
            if view is None:
                return failed(T_cam_obj, done, "the object is not in the image")
            if (contour_mask(view.mask) & view.in_image).sum() < MIN_CONTOUR:
                return failed(T_cam_obj, done, f"the silhouette has under {MIN_CONTOUR} pixels of contour in the image")
            before, pose = pose, moved(pose, _update(view, colours, pose, length_m), length_m)
            done += 1
        view = look(image, K, pose, target, finest)
        newer = None if view is None else colours_of(view)
        if view is None or newer is None:
            return failed(T_cam_obj, done, "the object left the image")
        colours = colours.mixed(newer, ADAPTATION)
    probable = colours.posterior(view.scene_rgb)
    separation = probable[view.mask & view.in_image].mean() - probable[~view.mask & view.in_image].mean()
    if separation < MIN_SEPARATION:
        return failed(T_cam_obj, done, "object and background have the same colours")
    return refined(before, pose, done, target.mesh.diameter_m)


def signed_distance_px(mask: Bool[Array, "p p"]) -> tuple[Float[Array, "p p"], Array]:
    """Distance to the silhouette's edge, positive inside, and (2, p, p) row and column of the nearest contour pixel.

    The edge runs half a pixel outside of the contour pixels' centres.
    """
    distance, nearest = distance_transform_edt(~contour_mask(mask), return_indices=True)
    return np.where(mask, distance + 0.5, 0.5 - distance), nearest


def _update(view: View, colours: Colours, pose: Float[Array, "4 4"], length_m: float) -> Float[Array, "6"]:
    """One Gauss-Newton step on the summed negative log likelihood of the pixels around the silhouette."""
    phi, nearest = signed_distance_px(view.mask)
    row, column = np.nonzero((np.abs(phi) < BAND_PX) & view.in_image)
    probable = colours.posterior(cv2.GaussianBlur(view.scene_rgb, (0, 0), 0.7))[row, column]
    at = phi[row, column]
    # Logistic, not the arc tangent of the paper, whose long tails let far pixels push the size.
    inside = 1 / (1 + np.exp(-SHARPNESS * at))
    slope = SHARPNESS * inside * (1 - inside)
    likelihood = (inside * probable + (1 - inside) * (1 - probable)).clip(1e-3)
    cost = -np.log(likelihood)
    dy, dx = np.gradient(phi)
    edge_row, edge_column = nearest[:, row, column]
    uv_px = np.stack([edge_column, edge_row], -1) + 0.5
    points_m = back_project(view.K, uv_px, view.depth_m[edge_row, edge_column].astype(np.float64))
    by_pose = projection_jacobian(view.K, points_m, pose[:3, 3], length_m)
    # The silhouette moves with its contour points: where they go outwards, distances inside grow.
    outwards = -np.stack([dx[row, column], dy[row, column]], -1)
    grow = np.einsum("ni,nij->nj", outwards, by_pose)
    J = ((1 - 2 * probable) * slope / likelihood)[:, None] * grow
    # Weights 1 / cost turn the gradient of a sum of squares into that of the sum of costs (Tjaden 2016).
    cost = np.maximum(cost, LEAST_COST)
    return step(J, cost, 1 / cost, DAMPING)
