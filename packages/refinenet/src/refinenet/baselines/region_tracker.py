"""Region tracking: the silhouette that best separates the colours of object and background.

Global colour histograms, pixel-wise posteriors and a smoothed step over the silhouette's signed distance as in PWP3D
(Prisacariu and Reid 2012), optimised by Gauss-Newton from coarse to fine as in Tjaden, Schwanecke and Schoemer 2016.
"""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, UInt8
from posecore.camera import back_project
from posecore.contour import contour_mask
from scipy.ndimage import distance_transform_edt, gaussian_filter

from refinenet.baselines.base import NOT_VISIBLE, Baseline, failed, refined
from refinenet.baselines.gauss_newton import apply_step, projection_jacobian, step
from refinenet.baselines.patch import ObjectPatch, TrackedObject, finest_px, render_and_crop
from refinenet.refiner import Frame, Refinement

LEVELS = ((0.3, 0.09), (0.55, 0.045), (1.0, 0.01))
"""Patch side as a fraction of the finest, and the margin along the silhouette that the histograms leave out, as a
fraction of that side. Like all below: tuned on renders."""
FINEST_PX = 200
LEAST_PATCH_PX = 48
BINS = 32
BAND_PX = 10.0
"""Pixels this near the silhouette count."""
SHARPNESS = 1.0
"""Slope of the smoothed step, per pixel."""
RENDER_WEIGHT = 0.4
"""Weight of the render's colours in the object's histogram: the render needs no margin along its edge."""
MIN_CONTOUR = 20
MIN_PIXELS = 40
MIN_SEPARATION = 0.02
"""Least difference of the mean posterior inside and outside: below it the colours hold no evidence."""
LEAST_COST = 0.05
DAMPING = 1e-3
STEPS_A_RENDER = 2


class RegionTracker(Baseline):
    """`--method region`."""

    name = "region"

    def _refine(self, frame: Frame, T_cam_obj: Float[np.ndarray, "4 4"], target: TrackedObject) -> Refinement:
        return refine_by_regions(frame.image, frame.K, T_cam_obj, target, self.iterations)


@dataclass(frozen=True, kw_only=True, eq=False)
class Colours:
    """Colour histograms of object and background: (BINS, BINS, BINS) frequencies that sum to 1."""

    object: Float[np.ndarray, "bins bins bins"]
    background: Float[np.ndarray, "bins bins bins"]

    def posterior(self, rgb: UInt8[np.ndarray, "h w 3"]) -> Float[np.ndarray, "h w"]:
        """Posterior probability of the object at each pixel, with equal priors."""
        r, g, b = np.moveaxis(rgb.astype(np.int64) * BINS // 256, -1, 0)
        inside, outside = self.object[r, g, b], self.background[r, g, b]
        return np.asarray((inside + 1e-6) / (inside + outside + 2e-6))


def learn_colours(patch: ObjectPatch, margin_px: float) -> Colours | None:
    """Histograms inside and outside the silhouette; None where a side has too few pixels.

    A margin on either side of the silhouette's edge is left out. Where the silhouette is a little off, each margin has
    the other side's colours, and colours that occur nowhere else would hold the silhouette in place.
    """
    phi = signed_distance_px(patch.mask)[0]
    inside, outside = patch.mask & patch.visible, (phi < -margin_px) & patch.visible
    inside &= phi > min(margin_px, 0.5 * float(phi.max()))
    if inside.sum() < MIN_PIXELS or outside.sum() < MIN_PIXELS:
        return None
    observed, rendered = _histogram(patch.scene_rgb[inside]), _histogram(patch.rgb[patch.mask])
    return Colours(
        object=(1 - RENDER_WEIGHT) * observed + RENDER_WEIGHT * rendered,
        background=_histogram(patch.scene_rgb[outside]),
    )


def _histogram(rgb: UInt8[np.ndarray, "n 3"]) -> Float[np.ndarray, "bins bins bins"]:
    index = rgb.astype(np.int64) * BINS // 256
    counts = np.bincount(index @ np.array([BINS * BINS, BINS, 1]), minlength=BINS**3).reshape(BINS, BINS, BINS)
    smooth = gaussian_filter(counts.astype(np.float64), 0.7)
    return np.asarray(smooth / smooth.sum())


def refine_by_regions(
    image: UInt8[np.ndarray, "h w 3"],
    K: Float[np.ndarray, "3 3"],
    T_cam_obj: Float[np.ndarray, "4 4"],
    target: TrackedObject,
    iterations: int = 5,
) -> Refinement:
    """Refine a pose.

    Args:
        image: RGB.
        K: Camera matrix.
        T_cam_obj: Initial pose, metres; its silhouette gives the first histograms, the pose of each level the next.
        target: Object.
        iterations: `STEPS_A_RENDER` times as many renders, each with a Gauss-Newton step, at each of three resolutions.
    """
    before = pose = np.asarray(T_cam_obj, np.float64)
    finest = finest_px(K, pose, target.mesh, FINEST_PX)
    if not finest:
        return failed(T_cam_obj, 0, NOT_VISIBLE)
    length_m, done, probable = target.mesh.diameter_m / 2, 0, image
    for fraction, margin in LEVELS:
        patch_px = max(LEAST_PATCH_PX, round(fraction * finest))
        patch = render_and_crop(image, K, pose, target, finest)
        if patch is None:
            return failed(T_cam_obj, done, "the object is not in the image")
        colours = learn_colours(patch, margin * finest)
        if colours is None:
            return failed(T_cam_obj, done, f"under {MIN_PIXELS} pixels of object or background for the histograms")
        probable = _as_image(colours.posterior(image))
        for _ in range(STEPS_A_RENDER * iterations):
            patch = render_and_crop(probable, K, pose, target, patch_px)
            if patch is None:
                return failed(T_cam_obj, done, "the object is not in the image")
            if (contour_mask(patch.mask) & patch.visible).sum() < MIN_CONTOUR:
                return failed(T_cam_obj, done, f"the silhouette has under {MIN_CONTOUR} pixels of contour in the image")
            before, pose = pose, apply_step(pose, _update(patch, pose, length_m), length_m)
            done += 1
    patch = render_and_crop(probable, K, pose, target, finest)
    if patch is None:
        return failed(T_cam_obj, done, "the object left the image")
    posterior = patch.scene_rgb[..., 0] / 255
    separation = posterior[patch.mask & patch.visible].mean() - posterior[~patch.mask & patch.visible].mean()
    if separation < MIN_SEPARATION:
        return failed(T_cam_obj, done, "object and background have the same colours")
    return refined(T_cam_obj, before, pose, done, target.mesh.diameter_m)


def _as_image(probable: Float[np.ndarray, "h w"]) -> UInt8[np.ndarray, "h w 3"]:
    """Posteriors as grey levels, to crop and resample like an image: colours are classified before blending."""
    return np.repeat(np.round(255 * probable).astype(np.uint8)[..., None], 3, axis=2)


def signed_distance_px(mask: Bool[np.ndarray, "p p"]) -> tuple[Float[np.ndarray, "p p"], np.ndarray]:
    """Distance to the silhouette's edge, positive inside, and (2, p, p) row and column of the nearest contour pixel.

    The edge runs half a pixel outside the contour pixels' centres.
    """
    distance, nearest = distance_transform_edt(~contour_mask(mask), return_indices=True)
    return np.where(mask, distance + 0.5, 0.5 - distance), nearest


def _update(patch: ObjectPatch, pose: Float[np.ndarray, "4 4"], length_m: float) -> Float[np.ndarray, "6"]:
    """A Gauss-Newton step on the summed negative log likelihood of the pixels around the silhouette.

    The patch's image holds posteriors, see `_as_image`.
    """
    phi, nearest = signed_distance_px(patch.mask)
    row, column = np.nonzero((np.abs(phi) < BAND_PX) & patch.visible)
    probable = patch.scene_rgb[row, column, 0] / 255
    distance_px = phi[row, column]
    # Logistic, not the arc tangent of the paper, whose long tails let far pixels push the size.
    inside = 1 / (1 + np.exp(-SHARPNESS * distance_px))
    slope = SHARPNESS * inside * (1 - inside)
    likelihood = (inside * probable + (1 - inside) * (1 - probable)).clip(1e-3)
    cost = -np.log(likelihood)
    dy, dx = np.gradient(phi)
    edge_row, edge_column = nearest[:, row, column]
    uv_px = np.stack([edge_column, edge_row], -1) + 0.5
    points_m = back_project(patch.K, uv_px, patch.depth_m[edge_row, edge_column].astype(np.float64))
    by_pose = projection_jacobian(patch.K, points_m, pose[:3, 3], length_m)
    # The silhouette moves with its contour points: an outward motion increases the distances inside.
    outwards = -np.stack([dx[row, column], dy[row, column]], -1)
    grow = np.einsum("ni,nij->nj", outwards, by_pose)
    J = ((1 - 2 * probable) * slope / likelihood)[:, None] * grow
    # Weights 1 / cost turn the gradient of a sum of squares into that of the sum of costs (Tjaden 2016).
    cost = np.maximum(cost, LEAST_COST)
    return step(J, cost, 1 / cost, DAMPING)
