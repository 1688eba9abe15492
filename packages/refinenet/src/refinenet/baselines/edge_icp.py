"""Edge ICP: silhouette and inner edges of the render are aligned with image edges along their normals.

A normal search as in RAPID (Harris 1990) with several candidates per point (Vacchetti 2004), robust Gauss-Newton, and a
search range that shrinks while the resolution grows. The paper's "2D edge-based ICP".
"""

from dataclasses import dataclass

import cv2
import numpy as np
from jaxtyping import Bool, Float, UInt8

from refinenet.baselines.base import NOT_VISIBLE, Baseline, failed, refined
from refinenet.baselines.gauss_newton import apply_step, projection_jacobian, step, tukey_weight
from refinenet.baselines.patch import (
    EDGE_BLUR_PX,
    Edges,
    ObjectPatch,
    TrackedObject,
    finest_px,
    inner_edges,
    render_and_crop,
    silhouette_edges,
)
from refinenet.refiner import Frame, Refinement

LEVELS = ((0.35, 0.12), (0.6, 0.07), (1.0, 0.035))
"""Patch side as a fraction of the finest, search range as a fraction of that side. Like all below: tuned on renders."""
FINEST_PX = 256
LEAST_PATCH_PX = 40
LEAST_REACH_PX = 2.0
SILHOUETTE_POINTS = 400
INNER_POINTS = 800
CANDIDATES = 4
MIN_GRADIENT = 2.5
"""Grey levels a pixel, after blurring, below which there is no edge."""
MIN_ALIGNMENT = 0.8
"""Least cosine between the image's gradient and the normal."""
MIN_COLOUR_COSINE = 0.5
"""Least cosine between the colour steps of render and image across an inner edge: same sign, similar colours."""
HALF_STRENGTH = 15.0
"""Grey levels a pixel at which an edge has half of the largest weight."""
MIN_POINTS = 20
MIN_SUPPORT = 0.2
"""Fraction of the points that must have an image edge within `SUPPORT_PX` at the refined pose."""
SUPPORT_PX = 1.5
STEPS = 10
"""Gauss-Newton steps between two renders."""
LEAST_SIGMA_PX = 0.4
DAMPING = 1e-4


class EdgeIcp(Baseline):
    """`--method edge-icp`."""

    name = "edge-icp"

    def _refine(self, frame: Frame, T_cam_obj: Float[np.ndarray, "4 4"], target: TrackedObject) -> Refinement:
        return refine_by_edges(frame.image, frame.K, T_cam_obj, target, self.iterations)


def refine_by_edges(
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
        T_cam_obj: Initial pose, metres.
        target: Object.
        iterations: Renders at each of three resolutions.
    """
    before = pose = np.asarray(T_cam_obj, np.float64)
    finest = finest_px(K, pose, target.mesh, FINEST_PX)
    if not finest:
        return failed(T_cam_obj, 0, NOT_VISIBLE)
    length_m, done = target.mesh.diameter_m / 2, 0
    for fraction, reach in LEVELS:
        patch_px = max(LEAST_PATCH_PX, round(fraction * finest))
        reach_px = max(LEAST_REACH_PX, reach * patch_px)
        for _ in range(iterations):
            patch = render_and_crop(image, K, pose, target, patch_px)
            if patch is None:
                return failed(T_cam_obj, done, "the object is not in the image")
            matches = match_edges(patch, reach_px)
            if (count := int(matches.exists.any(axis=1).sum())) < MIN_POINTS:
                return failed(T_cam_obj, done, f"{count} of its edges are near an image edge, {MIN_POINTS} needed")
            before, pose = pose, align(pose, patch.K, matches, reach_px, length_m)
            done += 1
    patch = render_and_crop(image, K, pose, target, finest)
    if patch is None:
        return failed(T_cam_obj, done, "the object left the image")
    near = match_edges(patch, SUPPORT_PX)
    support = float(near.exists.any(axis=1).mean()) if len(near.exists) else 0.0
    if support < MIN_SUPPORT:
        return failed(T_cam_obj, done, f"{support:.0%} of its edges end on an image edge, {MIN_SUPPORT:.0%} needed")
    return refined(T_cam_obj, before, pose, done, target.mesh.diameter_m)


@dataclass(frozen=True, kw_only=True, eq=False)
class Matches:
    """Edge points of the render, and candidate image edges for each.

    Attributes:
        edges: Edge points of the render.
        offset_px: (n, k) candidates' positions along the normal, best first.
        score: (n, k) candidates' likelihood in [0, 1], higher for a strong and near edge.
        exists: (n, k) whether there is a k-th candidate.
    """

    edges: Edges
    offset_px: Float[np.ndarray, "n k"]
    score: Float[np.ndarray, "n k"]
    exists: Bool[np.ndarray, "n k"]


def match_edges(patch: ObjectPatch, reach_px: float) -> Matches:
    """Image edges on the normals of the render's edges, at most `reach_px` away."""
    outline = silhouette_edges(patch, SILHOUETTE_POINTS)
    inner, colour_step = inner_edges(patch, INNER_POINTS, MIN_GRADIENT)
    edges = Edges(
        p_cam_m=np.concatenate([outline.p_cam_m, inner.p_cam_m]),
        uv_px=np.concatenate([outline.uv_px, inner.uv_px]),
        normal=np.concatenate([outline.normal, inner.normal]),
    )
    offsets = np.arange(-np.ceil(reach_px) - 1, np.ceil(reach_px) + 2)
    uv_px = edges.uv_px[:, None] + offsets[:, None] * edges.normal[:, None]
    across, along = _gradients_at(patch, uv_px, edges.normal)
    strength = np.linalg.norm(across, axis=-1)
    aligned = strength > MIN_ALIGNMENT * np.hypot(strength, np.linalg.norm(along, axis=-1))
    # Beside the silhouette is the background, of unknown colour; at inner edges both sides are the object's.
    n = len(outline.uv_px)
    aligned[n:] &= np.einsum("nsc,nc->ns", across[n:], colour_step) > MIN_COLOUR_COSINE * strength[n:]
    pixel = np.floor(uv_px).astype(int).clip(0, len(patch.visible) - 1)
    strength = np.where(aligned & patch.visible[pixel[..., 1], pixel[..., 0]], strength, 0.0)

    behind, middle, ahead = strength[:, :-2], strength[:, 1:-1], strength[:, 2:]
    peak = (middle >= behind) & (middle > ahead) & (middle > MIN_GRADIENT)
    bend = np.minimum(behind - 2 * middle + ahead, -1e-6)
    offset_px = offsets[1:-1] + ((behind - ahead) / (2 * bend)).clip(-0.5, 0.5)
    nearness = np.exp(-0.5 * np.square(offsets[1:-1] / (0.5 * reach_px)))
    score = np.where(peak, middle / (middle + HALF_STRENGTH) * nearness, 0.0)
    best = np.argsort(-score, axis=1, kind="stable")[:, :CANDIDATES]
    offset_px, score, exists = (np.take_along_axis(values, best, axis=1) for values in (offset_px, score, peak))
    return Matches(edges=edges, offset_px=offset_px, score=score, exists=exists)


def _gradients_at(
    patch: ObjectPatch, uv_px: Float[np.ndarray, "n s 2"], normal: Float[np.ndarray, "n 2"]
) -> tuple[Float[np.ndarray, "n s 3"], Float[np.ndarray, "n s 3"]]:
    """Gradient of the blurred image along and across the normal, per channel, grey levels a pixel."""
    smooth = cv2.GaussianBlur(patch.scene_rgb.astype(np.float32), (0, 0), EDGE_BLUR_PX)
    position = (uv_px - 0.5).astype(np.float32)
    dx, dy = (
        cv2.remap(
            cv2.Sobel(smooth, cv2.CV_32F, *order, ksize=3, scale=1 / 8),
            np.ascontiguousarray(position[..., 0]),
            np.ascontiguousarray(position[..., 1]),
            cv2.INTER_LINEAR,
            borderMode=cv2.BORDER_REPLICATE,
        )
        for order in ((1, 0), (0, 1))
    )
    x, y = normal[:, None, :1], normal[:, None, 1:]
    return dx * x + dy * y, dy * x - dx * y


def align(
    pose: Float[np.ndarray, "4 4"], K: Float[np.ndarray, "3 3"], matches: Matches, reach_px: float, length_m: float
) -> Float[np.ndarray, "4 4"]:
    """The pose that aligns each edge with a candidate: at first with the likeliest, then with the nearest."""
    edges, exists = matches.edges, matches.exists
    by_pose = projection_jacobian(K, edges.p_cam_m, pose[:3, 3], length_m)
    J = np.einsum("ni,nij->nj", edges.normal, by_pose)
    x, sigma_px = np.zeros(6), reach_px / 3
    for i in range(STEPS):
        gap_px = (J @ x)[:, None] - matches.offset_px
        cost = np.where(exists, np.abs(gap_px) if i else -matches.score, np.inf)
        chosen = cost.argmin(axis=1)[:, None]
        residual_px, score = (np.take_along_axis(v, chosen, axis=1)[:, 0] for v in (gap_px, matches.score))
        x = x + step(J, residual_px, tukey_weight(residual_px, sigma_px) * score, DAMPING)
        sigma_px = max(LEAST_SIGMA_PX, 0.7 * sigma_px)
    return apply_step(pose, x, length_m)
