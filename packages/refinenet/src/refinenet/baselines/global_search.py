"""Global pose search by gradient orientations around an initial pose that may be far off, then edge ICP.

The gradient-orientation score has a narrow basin of attraction: local optimisation from a distant initial pose fails.
So tens of thousands of poses are drawn around the initial pose, and resampled around the best, while the reach of an
image edge shrinks. The spread orientations are those of LINE-2D (Hinterstoisser et al., PAMI 2012), in response maps
that all poses share; the draws are an evolution strategy. The pose with the highest score is often wrong, but another
pose with a high score is mostly near the ground truth: edge ICP starts from several candidates, a network follows where
there is one, and a render scores the results, together with the network if it predicts pose quality.

Edges of an occluder lower the ground truth's score and raise that of other poses. The occluder is often another
requested object: the refined poses are rendered as known occluders, and failed poses are searched again. Fewer edges
match by chance more easily, so this needs a network that predicts pose quality: most poses that gradients alone gave
this way in crowded rendered frames were wrong.
"""

import dataclasses
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

from refinenet.baselines.base import NOT_VISIBLE, Baseline, failed
from refinenet.baselines.edge_icp import refine_by_edges
from refinenet.baselines.patch import ObjectPatch, TrackedObject, render_and_crop
from refinenet.baselines.pose_sampling import PoseSampler, prior_distance
from refinenet.baselines.search_config import SearchConfig
from refinenet.baselines.viewpoint_model import ViewpointModel, make_viewpoint_model
from refinenet.image.edge_gradients import SCENE_EDGE, gradient_similarity, orientation_gradients
from refinenet.refiner import Frame, NetworkRefiner, Refinement, Request, ScoreKind, Status

DEFAULTS = SearchConfig()


class GradientSearch(Baseline):
    """`--method search`. Every pose of an object has the same draws.

    Args:
        meshes: Objects by id.
        iterations: Iterations of the final edge ICP.
        network: Refines the result of edge ICP for each candidate; closed with this object. A network that predicts
            pose quality also scores the candidates, beside gradient similarity, and failed poses are searched again.
        min_confidence: Least confidence of the result; `config.min_similarity` by default, `config.min_combined_score`
            with a network that predicts pose quality.
        config: Constants of the search.
    """

    name = "search"
    score_kind: ScoreKind = "search"

    def __init__(
        self,
        meshes: Mapping[int, Mesh],
        *,
        iterations: int = 5,
        network: NetworkRefiner | None = None,
        min_confidence: float | None = None,
        config: SearchConfig = DEFAULTS,
    ) -> None:
        super().__init__(meshes, iterations=iterations)
        self._network = network
        if network is not None:
            self.name = f"{self.name} with {network.name}"
        self._config = config
        self._has_quality = network is not None and network.predicts_pose_quality
        default = config.min_combined_score if self._has_quality else config.min_similarity
        self._min_confidence = default if min_confidence is None else min_confidence
        self._simplified = Rasteriser({})
        """Simplified meshes of the objects in `_models`."""
        self._models: dict[int, ViewpointModel] = {}

    @property
    def settings(self) -> dict[str, Any]:
        """Settings for the sidecar, with the constants that differ from the defaults."""
        settings = super().settings | {"min_confidence": self._min_confidence}
        config, defaults = dataclasses.asdict(self._config), dataclasses.asdict(DEFAULTS)
        if changed := {key: value for key, value in config.items() if value != defaults[key]}:
            settings["search"] = changed
        return settings | ({} if self._network is None else {"network": self._network.settings})

    def close(self) -> None:
        """Free the renderers, and close the network."""
        if self._network is not None:
            self._network.close()
        self._simplified.close()
        super().close()

    def _refine_all(self, frame: Frame, requests: Sequence[Request]) -> list[Refinement]:
        """Refine poses in an image, each by itself.

        With predicted pose quality, failed poses are searched again behind the refined ones.
        """
        results = super()._refine_all(frame, requests)
        before = 0
        while self._has_quality and before < (count := sum(not r.failed for r in results)) < len(results):
            before = count
            refined = [
                Request(obj_id=request.obj_id, T_cam_obj=result.T_cam_obj)
                for request, result in zip(requests, results, strict=True)
                if not result.failed
            ]
            for i, (request, result) in enumerate(zip(requests, results, strict=True)):
                if result.failed:
                    known_depth_m = self._known_depth_m(frame, request, refined)
                    target = replace(self._tracked_object(request), known_depth_m=known_depth_m)
                    results[i] = _better(result, self._refine_if_renderable(frame, request.T_cam_obj, target))
        return results

    def _known_depth_m(self, frame: Frame, request: Request, refined: Sequence[Request]) -> Float[np.ndarray, "h w"]:
        """Camera z of refined poses beside a requested object, 0 elsewhere.

        Poses of the same object near the initial pose are left out: they may be the same instance, reached from another
        initial pose.
        """
        mesh = self._frames.meshes[request.obj_id]
        initial_m = se3.apply(request.T_cam_obj, mesh.center_m[None])[0]
        occluders = []
        for other in refined:
            centre_m = se3.apply(other.T_cam_obj, self._frames.meshes[other.obj_id].center_m[None])[0]
            across_m = np.linalg.norm(centre_m[:2] * initial_m[2] / centre_m[2] - initial_m[:2])
            if other.obj_id != request.obj_id or across_m > self._config.same_instance_distance * mesh.diameter_m:
                occluders.append(Instance(obj_id=other.obj_id, T_cam_obj=other.T_cam_obj))
        height_px, width_px = frame.image.shape[:2]
        if not occluders:
            return np.zeros((height_px, width_px), np.float32)
        return self._simplified.render_scene(occluders, frame.K, width_px, height_px, rgb=False).depth_m

    def _refine(self, frame: Frame, T_cam_obj: Float[np.ndarray, "4 4"], target: TrackedObject) -> Refinement:
        config = self._config
        initial = np.ascontiguousarray(T_cam_obj, np.float64)
        patch = render_and_crop(frame.image, frame.K, initial, target, config.patch_px, config.window_scale)
        if patch is None:
            return failed(T_cam_obj, 0, NOT_VISIBLE)
        model, simple = self._model(target), replace(target, rasteriser=self._simplified)
        rng = np.random.default_rng(target.obj_id)  # of the pose's digits, it would depend on where the origin lies
        poses = [initial, *search(patch, initial, target.mesh, model, rng, config)]
        by_edges = [self._by_edges(frame, T, simple, config.trial_iterations) for T in poses]
        candidates = self._by_network(frame, by_edges, simple)
        scores = [
            _confidence(candidate)
            - config.prior_weight * prior_distance(initial, candidate.T_cam_obj, target.mesh, config)
            for candidate in candidates
        ]
        chosen = candidates[int(np.argmax(scores))].T_cam_obj
        (best,) = self._by_network(frame, [self._by_edges(frame, chosen, target, self.iterations)], target)
        scored = (*candidates, best)
        rounds = 1 + len(config.rounds) + len(config.local_rounds)
        iterations = rounds + sum(candidate.iterations for candidate in scored)
        if _confidence(best) < self._min_confidence:
            score = "its combined score is" if self._has_quality else "its gradient similarity is"
            reason = f"{score} {_confidence(best):.3f} at most, below the minimum of {self._min_confidence:g}"
            return replace(failed(T_cam_obj, iterations, reason), candidates=scored)
        return replace(best, iterations=iterations, candidates=scored)

    def _model(self, target: TrackedObject) -> ViewpointModel:
        if target.obj_id not in self._models:
            mesh = simplified(target.mesh, self._config.max_faces)
            self._simplified.add(target.obj_id, mesh)
            self._models[target.obj_id] = make_viewpoint_model(target.obj_id, mesh, self._simplified)
        return self._models[target.obj_id]

    def _by_edges(
        self, frame: Frame, pose: Float[np.ndarray, "4 4"], target: TrackedObject, iterations: int
    ) -> Refinement:
        """Edge ICP from a pose; the pose itself where that has the higher similarity."""
        by_edges = refine_by_edges(frame.image, frame.K, pose, target, iterations)
        before = similarity_at(frame, pose, target, self._config)
        if by_edges.failed:
            count = by_edges.iterations
            return Refinement(T_cam_obj=pose, status=Status.STOPPED, iterations=count, confidence=before)
        after = similarity_at(frame, by_edges.T_cam_obj, target, self._config)
        best = by_edges.T_cam_obj if after > before else pose
        return replace(by_edges, T_cam_obj=best, confidence=max(after, before))

    def _by_network(self, frame: Frame, poses: Sequence[Refinement], target: TrackedObject) -> list[Refinement]:
        """Network refinement of poses, where there is a network.

        A network without predicted pose quality is followed only to a higher similarity.
        """
        if self._network is None:
            return list(poses)
        requests = self._frames.own_requests(
            [Request(obj_id=target.obj_id, T_cam_obj=pose.T_cam_obj) for pose in poses]
        )
        by_network = self._frames.results(self._network.refine_batch(frame, requests), requests)
        results = []
        for before, after in zip(poses, by_network, strict=True):
            similarity = 0.0 if after.failed else similarity_at(frame, after.T_cam_obj, target, self._config)
            score = (similarity + _confidence(after)) / 2 if self._has_quality else similarity
            best = after if (self._has_quality and not after.failed) or score > _confidence(before) else before
            confidence = score if best is after else _confidence(before) / (2 if self._has_quality else 1)
            results.append(replace(best, confidence=confidence, iterations=before.iterations + after.iterations))
        return results


def _confidence(result: Refinement) -> float:
    return result.confidence or 0.0


def _better(before: Refinement, again: Refinement) -> Refinement:
    """The result with the higher score, failed or not, with the iterations and candidates of both."""
    worse, better = sorted((again, before), key=_final_score)
    iterations = before.iterations + again.iterations
    return replace(better, iterations=iterations, candidates=(*worse.candidates, *better.candidates))


def _final_score(result: Refinement) -> float:
    """Score of the chosen candidate, also where it was too low and the result failed."""
    return max(_confidence(result), _confidence(result.candidates[-1]) if result.candidates else 0.0)


def similarity_at(
    frame: Frame, T_cam_obj: Float[np.ndarray, "4 4"], target: TrackedObject, config: SearchConfig = DEFAULTS
) -> float:
    """Gradient similarity of image and render at a pose, in [0, 1]; 0 where the object is not visible."""
    patch = render_and_crop(frame.image, frame.K, T_cam_obj, target, config.score_patch_px)
    if patch is None:
        return 0.0
    return float(gradient_similarity(patch.scene_rgb[None], patch.rgb[None], patch.mask[None], patch.visible[None])[0])


def search(
    patch: ObjectPatch,
    initial: Float[np.ndarray, "4 4"],
    mesh: Mesh,
    model: ViewpointModel,
    rng: np.random.Generator,
    config: SearchConfig = DEFAULTS,
) -> list[Float[np.ndarray, "4 4"]]:
    """Poses with a high edge similarity that differ from each other, the best first.

    Args:
        patch: Patch at the initial pose.
        initial: Initial pose, metres.
        mesh: Object.
        model: Edges of the object.
        rng: Source of all draws.
        config: Constants of the search.
    """
    responses = {spread: response_maps(patch, spread, config.orientations) for spread in config.spreads_px}

    def score(T_cam_obj: Float[np.ndarray, "n 4 4"], spread_px: int) -> Float[np.ndarray, " n"]:
        return model.similarity(T_cam_obj, patch.K, patch.occluder_depth_m, responses[spread_px])

    return PoseSampler(initial, mesh, score, config, rng).candidates()


def response_maps(
    patch: ObjectPatch, spread_px: int, orientations: int = DEFAULTS.orientations
) -> Float[np.ndarray, "o p p"]:
    """Similarity of each edge orientation to the image's edges within `spread_px`, in [0, 1]."""
    unit, strength = orientation_gradients(patch.scene_rgb[None].astype(np.float32))
    x, y = unit[0, ..., 0], unit[0, ..., 1]
    edges = (strength[0] > SCENE_EDGE) & (patch.occluder_depth_m > 0)
    # doubled angles, which are equal for opposite gradients
    doubled = np.stack([x * x - y * y, 2 * x * y], axis=-1) * edges[..., None]
    angle_rad = 2 * np.pi * np.arange(orientations) / orientations
    maps = np.tensordot(np.stack([np.cos(angle_rad), np.sin(angle_rad)], axis=1), doubled, axes=(1, 2))
    maps = np.maximum(maps, 0).astype(np.float32)
    if spread_px:
        disc = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (2 * spread_px + 1,) * 2)
        maps = np.stack([cv2.dilate(response, disc) for response in maps])
    return np.asarray(maps)
