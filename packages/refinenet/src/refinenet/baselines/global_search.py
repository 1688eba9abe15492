"""Search for the pose whose edges run as the image's do, around a start that may be far off; then edge ICP.

How well the gradient orientations of render and image agree tells the true pose from others sharply: so sharply that
nothing leads there from afar. So tens of thousands of poses are drawn around the start, and again around the best of
them, ever closer, while an edge of the image counts from less and less far away. These spread orientations are those of
LINE-2D (Hinterstoisser et al., PAMI 2012), in response maps made once for all poses; the draws are an evolution
strategy. What agrees best is often not the truth, but the truth is mostly among the poses that agree well: edge ICP
starts from several, a network follows where one is given, and renders decide, with the network where it was trained to.

What hides an object has edges of its own, which count against the truth and for other poses. Often it is an object that
is looked for as well: what was found is known for those that were not, and they are searched for once more. Fewer edges
agree more easily by chance, so this is left to a network that tells closeness: most poses that gradients alone found so
in crowded rendered frames were wrong.
"""

import zlib
from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any

import cv2
import numpy as np
from jaxtyping import Float
from posecore import se3
from posecore.mesh import Mesh
from posecore.raster import Instance, Rasteriser
from posecore.simplify import simplified

from refinenet.baselines.base import Baseline, failed
from refinenet.baselines.edge_icp import refine_by_edges
from refinenet.baselines.patch import Target, View, look
from refinenet.baselines.viewpoint_model import SparseViews, sparse_views
from refinenet.image.edge_gradients import SCENE_EDGE, gradient_agreement, gradients
from refinenet.refiner import Frame, NetworkRefiner, Refinement, Request, Status

Array = np.ndarray
ORIENTATIONS = 16
"""Bins of half a turn. Like all below: chosen on renders."""
PATCH_PX, JUDGE_PX = 96, 112
WINDOW_SCALE = 1.9
MAX_FACES = PATCH_PX**2
FIRST_DRAWN, FIRST_KEPT, FIRST_SPREAD_PX = 20_000, 400, 3
MAX_ANGLE_RAD = np.deg2rad(70)
SHIFT, STRETCH = 0.13, 0.1
"""Standard deviations of the first draws: across the image in diameters, and of the logarithm of the depth."""
ROUNDS = ((8000, 200, 2), (6000, 150, 2), (4000, 100, 1), (4000, 100, 1))
"""Drawn, kept, and from how many pixels away an edge of the image counts."""
POLISH = ((400, 1, 1), (400, 1, 0), (400, 1, 0))
"""The same around each candidate alone."""
SIGMA = np.array([0.15, 0.15, 0.15, 0.04, 0.04, 0.035])
"""Standard deviations after the first draws: turns in radians, shifts, stretch."""
SHRINK = 0.65
"""Factor on them from round to round."""
CANDIDATES = 10
APART = 0.12
"""Candidates differ by so many diameters in the mean of points around the centre, before each is searched around."""
TRIAL_ITERATIONS = 3
"""Of edge ICP from each of them."""
LEASH = 0.01
"""Agreement that a pose must have more for a standard deviation further from the start, squared."""
BEYOND_RAD = 0.2
"""The standard deviation of angles beyond the largest that was drawn; under it, all are as likely."""
OWN = 0.5
"""A found pose of the same object is another one's if it is so many diameters aside of the start."""
MIN_AGREEMENT, MIN_FIT = 0.4, 0.5
"""In the end, below which a pose is more likely wrong than right, and mostly worse than its start: the agreement of
gradients, or its mean with the closeness that a network tells."""


class GradientSearch(Baseline):
    """`--method search`. Draws depend on the start pose alone.

    Args:
        meshes: Objects by id.
        iterations: Of the edge ICP in the end.
        network: Refines what edge ICP makes of each candidate; closed with this. One that tells closeness is asked
            which of them is right as well, beside the agreement of gradients, and what fails is looked for again.
        min_confidence: A pose that is less confident failed; `MIN_AGREEMENT` by default, `MIN_FIT` with a network that
            tells closeness.
    """

    name = "search"

    def __init__(
        self,
        meshes: Mapping[int, Mesh],
        *,
        iterations: int = 5,
        network: NetworkRefiner | None = None,
        min_confidence: float | None = None,
    ) -> None:
        super().__init__(meshes, iterations=iterations)
        self._network = network
        if network is not None:
            self.name = f"{self.name} with {network.name}"
        self._judged = network is not None and network.tells_closeness
        own = MIN_FIT if self._judged else MIN_AGREEMENT
        self._min_confidence = own if min_confidence is None else min_confidence
        self._quick = Rasteriser({})
        self._views: dict[int, SparseViews] = {}
        """Of the objects that were asked for; these are in the quick rasteriser too."""

    @property
    def settings(self) -> dict[str, Any]:
        """For the sidecar."""
        own = super().settings | {"min_confidence": self._min_confidence}
        return own | ({} if self._network is None else {"network": self._network.settings})

    def close(self) -> None:
        """Free what the renderers hold, and close the network."""
        if self._network is not None:
            self._network.close()
        self._quick.close()
        super().close()

    def refine_batch(self, frame: Frame, requests: Sequence[Request]) -> list[Refinement]:
        """Refine poses in one image: each for itself, then, if they are judged, those that failed, behind the found."""
        results = super().refine_batch(frame, requests)
        known = 0
        while self._judged and known < (found := sum(not result.failed for result in results)) < len(results):
            known = found
            poses = [
                Request(obj_id=request.obj_id, T_cam_obj=result.T_cam_obj)
                for request, result in zip(requests, results, strict=True)
                if not result.failed
            ]
            for i, (request, before) in enumerate(zip(requests, results, strict=True)):
                if before.failed:
                    target = replace(self._target(request), known_m=self._known_m(frame, request, poses))
                    again = self._seen(frame, request.T_cam_obj, target)
                    worse, better = sorted((again, before), key=_final_confidence)
                    done = before.iterations + again.iterations
                    results[i] = replace(better, iterations=done, tried=(*worse.tried, *better.tried))
        return results

    def _known_m(self, frame: Frame, request: Request, found: Sequence[Request]) -> Float[Array, "h w"]:
        """Camera z of what was found beside an object that is looked for, 0 elsewhere.

        Poses of the same object near the start pose are left out: they may be this one's, found from another start.
        """
        mesh = self._meshes[request.obj_id]
        start_m = se3.apply(request.T_cam_obj, mesh.center_m[None])[0]
        beside = []
        for other in found:
            centre_m = se3.apply(other.T_cam_obj, self._meshes[other.obj_id].center_m[None])[0]
            aside_m = np.linalg.norm(centre_m[:2] * start_m[2] / centre_m[2] - start_m[:2])
            if other.obj_id != request.obj_id or aside_m > OWN * mesh.diameter_m:
                beside.append(Instance(obj_id=other.obj_id, T_cam_obj=other.T_cam_obj))
        height_px, width_px = frame.image.shape[:2]
        if not beside:
            return np.zeros((height_px, width_px), np.float32)
        return self._quick.render_scene(beside, frame.K, width_px, height_px, rgb=False).depth_m

    def _refine(self, frame: Frame, T_cam_obj: Float[Array, "4 4"], target: Target) -> Refinement:
        start = np.ascontiguousarray(T_cam_obj, np.float64)
        view = look(frame.image, frame.K, start, target, PATCH_PX, WINDOW_SCALE)
        if view is None:
            return failed(T_cam_obj, 0, "the start pose shows nothing of the object in the image")
        obj_id = target.obj_id
        if obj_id not in self._views:
            simple = simplified(target.mesh, MAX_FACES)
            self._quick.add(obj_id, simple)
            self._views[obj_id] = sparse_views(obj_id, simple, self._quick)
        rng = np.random.default_rng([obj_id, zlib.crc32(start.tobytes())])
        quick = replace(target, rasteriser=self._quick)
        candidates = [start, *search(view, start, target.mesh, self._views[obj_id], rng)]
        tried = self._by_network(frame, [self._followed(frame, T, quick, TRIAL_ITERATIONS) for T in candidates], quick)
        scores = [_confidence(one) - LEASH * unlikely(start, one.T_cam_obj, target.mesh) for one in tried]
        chosen = tried[int(np.argmax(scores))].T_cam_obj
        (best,) = self._by_network(frame, [self._followed(frame, chosen, target, self.iterations)], target)
        done = 1 + len(ROUNDS) + len(POLISH) + sum(one.iterations for one in (*tried, best))
        weighed = (*tried, best)
        if _confidence(best) < self._min_confidence:
            what = "its fit is" if self._judged else "gradients agree with the image's by"
            why = f"{what} {_confidence(best):.3f} at most, {self._min_confidence:g} needed"
            return replace(failed(T_cam_obj, done, why), tried=weighed)
        return replace(best, iterations=done, tried=weighed)

    def _followed(self, frame: Frame, pose: Float[Array, "4 4"], target: Target, iterations: int) -> Refinement:
        """A pose, or what edge ICP makes of it where that agrees better."""
        by_edges = refine_by_edges(frame.image, frame.K, pose, target, iterations)
        agreement = agreement_of(frame, pose, target)
        if by_edges.failed:
            done = by_edges.iterations
            return Refinement(T_cam_obj=pose, status=Status.STOPPED, iterations=done, confidence=agreement)
        at_edges = agreement_of(frame, by_edges.T_cam_obj, target)
        best = by_edges.T_cam_obj if at_edges > agreement else pose
        return replace(by_edges, T_cam_obj=best, confidence=max(at_edges, agreement))

    def _by_network(self, frame: Frame, found: Sequence[Refinement], target: Target) -> list[Refinement]:
        """What the network, if there is one, makes of poses: one that cannot judge only where that agrees more."""
        if self._network is None:
            return list(found)
        requests = [Request(obj_id=target.obj_id, T_cam_obj=one.T_cam_obj) for one in found]
        result = []
        for before, after in zip(found, self._network.refine_batch(frame, requests), strict=True):
            agreement = 0.0 if after.failed else agreement_of(frame, after.T_cam_obj, target)
            fit = (agreement + _confidence(after)) / 2 if self._judged else agreement
            best = after if (self._judged and not after.failed) or fit > _confidence(before) else before
            confidence = fit if best is after else _confidence(before) / (2 if self._judged else 1)
            result.append(replace(best, confidence=confidence, iterations=before.iterations + after.iterations))
        return result


def _confidence(found: Refinement) -> float:
    return found.confidence or 0.0


def _final_confidence(found: Refinement) -> float:
    """Also of one that failed, for not being confident enough."""
    return max(_confidence(found), _confidence(found.tried[-1]) if found.tried else 0.0)


def agreement_of(frame: Frame, T_cam_obj: Float[Array, "4 4"], target: Target) -> float:
    """How well a pose fits in the end, in [0, 1]."""
    view = look(frame.image, frame.K, T_cam_obj, target, JUDGE_PX)
    if view is None:
        return 0.0
    return float(gradient_agreement(view.scene_rgb[None], view.rgb[None], view.mask[None], view.seeable[None])[0])


def search(
    view: View, start: Float[Array, "4 4"], mesh: Mesh, views: SparseViews, rng: np.random.Generator
) -> list[Float[Array, "4 4"]]:
    """Poses that agree well, each unlike the others; the best first.

    Args:
        view: The start, looked at.
        start: Start pose, metres.
        mesh: Object.
        views: Its edges.
        rng: Source of every draw.
    """
    responses = {spread: response_maps(view, spread) for spread in {FIRST_SPREAD_PX} | {r[2] for r in ROUNDS + POLISH}}

    def best_of(moves: Float[Array, "n 6"], kept: int, spread_px: int) -> tuple[Array, Array]:
        T = moved_by(start, moves, mesh)
        agreement = views.agreement(T, view.K, view.seen_until_m, responses[spread_px])
        order = np.argsort(-agreement, kind="stable")[:kept]
        return moves[order], agreement[order]

    def drawn_again(best: Array, sigma: Array, rounds: tuple[tuple[int, int, int], ...]) -> tuple[Array, Array, Array]:
        agreement = np.zeros(len(best))
        for drawn, kept, spread_px in rounds:
            around = best[rng.integers(len(best), size=drawn)] + rng.normal(size=(drawn, 6)) * sigma
            best, agreement = best_of(np.concatenate([best, around]), kept, spread_px)
            sigma = sigma * SHRINK
        return best, agreement, sigma

    best, _ = best_of(_first_moves(rng), FIRST_KEPT, FIRST_SPREAD_PX)
    best, _, sigma = drawn_again(best, SIGMA, ROUNDS)
    found = [drawn_again(best[i : i + 1], sigma, POLISH) for i in unlike(moved_by(start, best, mesh), mesh)]
    found.sort(key=lambda one: -one[1][0])
    return [moved_by(start, moves, mesh)[0] for moves, _, _ in found]


def _first_moves(rng: np.random.Generator) -> Float[Array, "n 6"]:
    """Turns about any axis and by any angle up to the largest, and shifts; the first of them is none."""
    axis = rng.normal(size=(FIRST_DRAWN, 3))
    angle_rad = rng.uniform(0, MAX_ANGLE_RAD, (FIRST_DRAWN, 1))
    shifts = rng.normal(size=(FIRST_DRAWN, 3)) * np.array([SHIFT, SHIFT, STRETCH])
    moves = np.concatenate([axis / np.linalg.norm(axis, axis=1, keepdims=True) * angle_rad, shifts], axis=1)
    moves[0] = 0
    return np.asarray(moves)


def unlike(T_cam_obj: Float[Array, "n 4 4"], mesh: Mesh) -> list[int]:
    """Indices of the first poses that are far from those before."""
    points_m = se3.apply(T_cam_obj, mesh.center_m + 0.3 * mesh.diameter_m * se3.even_directions(32))
    chosen: list[int] = []
    for i, points in enumerate(points_m):
        distance_m = np.linalg.norm(points_m[chosen] - points, axis=-1).mean(axis=-1)
        if (distance_m > APART * mesh.diameter_m).all():
            chosen.append(i)
        if len(chosen) == CANDIDATES:
            break
    return chosen


def moved_by(start: Float[Array, "4 4"], moves: Float[Array, "n 6"], mesh: Mesh) -> Float[Array, "n 4 4"]:
    """Poses turned in camera axes about the mesh's centre, moved across the image (diameters) and in depth (log)."""
    centre_m = start[:3, :3] @ mesh.center_m + start[:3, 3]
    across_m = np.pad(mesh.diameter_m * moves[:, 3:5], ((0, 0), (0, 1)))
    R = se3.rotation_from_rotvec(moves[:, :3]) @ start[:3, :3]
    t = np.exp(moves[:, 5:]) * (centre_m + across_m) - R @ mesh.center_m
    return se3.make_T(R, t)


def unlikely(start: Float[Array, "4 4"], T_cam_obj: Float[Array, "4 4"], mesh: Mesh) -> float:
    """How far a pose is from the start for the distribution of the first draws: standard deviations, squared."""
    before_m, after_m = (T[:3, :3] @ mesh.center_m + T[:3, 3] for T in (start, T_cam_obj))
    across_m = after_m[:2] * before_m[2] / after_m[2] - before_m[:2]
    beyond_rad = max(0.0, float(se3.rotation_angle_rad(T_cam_obj[:3, :3] @ start[:3, :3].T)) - MAX_ANGLE_RAD)
    shifts = np.append(across_m / (SHIFT * mesh.diameter_m), np.log(after_m[2] / before_m[2]) / STRETCH)
    return float(np.square(shifts).sum() + (beyond_rad / BEYOND_RAD) ** 2)


def response_maps(view: View, spread_px: int) -> Float[Array, "o p p"]:
    """For each orientation of an edge, how well the image's edges within `spread_px` agree with it, in [0, 1]."""
    unit, strength = gradients(view.scene_rgb[None].astype(np.float32))
    x, y = unit[0, ..., 0], unit[0, ..., 1]
    edges = (strength[0] > SCENE_EDGE) & (view.seen_until_m > 0)
    # of doubled angle: opposite gradients have the same
    doubled = np.stack([x * x - y * y, 2 * x * y], axis=-1) * edges[..., None]
    angle_rad = 2 * np.pi * np.arange(ORIENTATIONS) / ORIENTATIONS
    maps = np.tensordot(np.stack([np.cos(angle_rad), np.sin(angle_rad)], axis=1), doubled, axes=(1, 2))
    maps = np.maximum(maps, 0).astype(np.float32)
    if spread_px:
        disc = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (2 * spread_px + 1,) * 2)
        maps = np.stack([cv2.dilate(one, disc) for one in maps])
    return np.asarray(maps)
