"""Region tracking: the silhouette that parts the object's colours from the background's best.

Global colour histograms, pixel-wise posteriors and a smoothed step over the silhouette's signed distance as in PWP3D
(Prisacariu and Reid 2012), optimised by Gauss-Newton from coarse to fine as in Tjaden, Schwanecke and Schoemer 2016.
"""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, UInt8
from posecore.camera import back_project
from posecore.contour import contour_mask
from scipy.ndimage import distance_transform_edt, gaussian_filter

from refinenet.baselines.base import Baseline, failed, refined
from refinenet.baselines.gauss_newton import moved, projection_jacobian, step
from refinenet.baselines.patch import Target, View, finest_px, look
from refinenet.refiner import Frame, Refinement

Array = np.ndarray
LEVELS = ((0.3, 0.09), (0.55, 0.045), (1.0, 0.01))
"""Patch side as a share of the finest, and the margin along the silhouette whose colours are not learnt, as a share of
that side. Like all below: chosen on renders."""
FINEST_PX = 200
LEAST_PATCH_PX = 48
BINS = 32
BAND_PX = 10.0
"""Pixels this near the silhouette count."""
SHARPNESS = 1.0
"""Of the smoothed step, per pixel."""
RENDER_SHARE = 0.4
"""Weight of the render's colours among the object's: parts along its edge are in no margin there."""
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


def colours_of(view: View, margin_px: float) -> Colours | None:
    """Histograms of the silhouette and of what is beside it; None where one has too few pixels.

    A margin on either side of the silhouette's edge is left out: where the silhouette is a little off, each side's
    margin has the other's colours, and colours that are to be seen nowhere else would hold it where it is.
    """
    phi = signed_distance_px(view.mask)[0]
    inside, outside = view.mask & view.seeable, (phi < -margin_px) & view.seeable
    inside &= phi > min(margin_px, 0.5 * float(phi.max()))
    if inside.sum() < MIN_PIXELS or outside.sum() < MIN_PIXELS:
        return None
    seen, rendered = _histogram(view.scene_rgb[inside]), _histogram(view.rgb[view.mask])
    return Colours(
        object=(1 - RENDER_SHARE) * seen + RENDER_SHARE * rendered, background=_histogram(view.scene_rgb[outside])
    )


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
        T_cam_obj: Start pose, metres; its silhouette gives the first histograms, the pose of each level the next ones.
        target: Object.
        iterations: Times `STEPS_A_RENDER` renders, each with one Gauss-Newton step, at each of three resolutions.
    """
    before = pose = np.asarray(T_cam_obj, np.float64)
    finest = finest_px(K, pose, target.mesh, FINEST_PX)
    if not finest:
        return failed(T_cam_obj, 0, "the start pose shows nothing of the object in the image")
    length_m, done, probable = target.mesh.diameter_m / 2, 0, image
    for share, margin in LEVELS:
        patch_px = max(LEAST_PATCH_PX, round(share * finest))
        view = look(image, K, pose, target, finest)
        if view is None:
            return failed(T_cam_obj, done, "the object is not in the image")
        colours = colours_of(view, margin * finest)
        if colours is None:
            return failed(T_cam_obj, done, f"under {MIN_PIXELS} pixels of object or background to learn colours from")
        probable = _as_image(colours.posterior(image))
        for _ in range(STEPS_A_RENDER * iterations):
            view = look(probable, K, pose, target, patch_px)
            if view is None:
                return failed(T_cam_obj, done, "the object is not in the image")
            if (contour_mask(view.mask) & view.seeable).sum() < MIN_CONTOUR:
                return failed(T_cam_obj, done, f"the silhouette has under {MIN_CONTOUR} pixels of contour in the image")
            before, pose = pose, moved(pose, _update(view, pose, length_m), length_m)
            done += 1
    view = look(probable, K, pose, target, finest)
    if view is None:
        return failed(T_cam_obj, done, "the object left the image")
    at = view.scene_rgb[..., 0] / 255
    separation = at[view.mask & view.seeable].mean() - at[~view.mask & view.seeable].mean()
    if separation < MIN_SEPARATION:
        return failed(T_cam_obj, done, "object and background have the same colours")
    return refined(T_cam_obj, before, pose, done, target.mesh.diameter_m)


def _as_image(probable: Float[Array, "h w"]) -> UInt8[Array, "h w 3"]:
    """Posteriors as grey levels, cut and scaled like an image: colours are looked up before they are blended."""
    return np.repeat(np.round(255 * probable).astype(np.uint8)[..., None], 3, axis=2)


def signed_distance_px(mask: Bool[Array, "p p"]) -> tuple[Float[Array, "p p"], Array]:
    """Distance to the silhouette's edge, positive inside, and (2, p, p) row and column of the nearest contour pixel.

    The edge runs half a pixel outside of the contour pixels' centres.
    """
    distance, nearest = distance_transform_edt(~contour_mask(mask), return_indices=True)
    return np.where(mask, distance + 0.5, 0.5 - distance), nearest


def _update(view: View, pose: Float[Array, "4 4"], length_m: float) -> Float[Array, "6"]:
    """One Gauss-Newton step on the summed negative log likelihood of the pixels around the silhouette.

    The view's image holds posteriors, see `_as_image`.
    """
    phi, nearest = signed_distance_px(view.mask)
    row, column = np.nonzero((np.abs(phi) < BAND_PX) & view.seeable)
    probable = view.scene_rgb[row, column, 0] / 255
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
