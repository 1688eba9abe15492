"""Online pairs: a new hypothesis for a stored scene, rendered, with an online crop of the scene to match.

A shard stores the scene with one window. Here the scene is rotated about the optical axis with its ground truth, a
hypothesis is drawn nearby, and the window that inference would cut for that hypothesis is resampled from the stored
patch: one affine warp, because rotating the camera about its optical axis and moving the window are both affine in the
image.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import Bool, Float, UInt8
from posecore import contour, se3
from posecore.camera import crop_K
from posecore.mesh import Mesh
from posecore.raster import Rasteriser
from posecore.shard import BIT_FOREGROUND, BIT_OBJECT
from posecore.window import Window

from refinenet.config import AugmentConfig, HypothesisConfig, WindowConfig
from refinenet.image import augmentation
from refinenet.image.crops import crop_affine, hypothesis_window, optical_axis_rotation, warp
from refinenet.image.masks import visible_fraction, visible_mask_iou

MIN_CONTOUR_PX = 12
"""Smallest contour from which a pose can be estimated; below, the hypothesis is drawn again, nearer."""

ATTEMPTS = 4


@dataclass(frozen=True, kw_only=True, eq=False)
class PairArrays:
    """One batch of pairs, every label in its patch's pixels; see `LossTarget` for the fields' meaning.

    `kept` are the input samples of the rows: a sample whose object is not visible is replaced by another.
    """

    scene_rgb: UInt8[np.ndarray, "b p p 3"]
    hypothesis_rgb: UInt8[np.ndarray, "b p p 3"]
    T_cam_obj: Float[np.ndarray, "b 4 4"]
    T_cam_obj_hypothesis: Float[np.ndarray, "b 4 4"]
    K_crop: Float[np.ndarray, "b 3 3"]
    scene_contour_m: Float[np.ndarray, "b n 3"]
    hypothesis_contour_m: Float[np.ndarray, "b n 3"]
    scene_distance_px: Float[np.ndarray, "b p p"]
    hypothesis_distance_px: Float[np.ndarray, "b p p"]
    hypothesis_depth_m: Float[np.ndarray, "b p p"] | None
    scene_bits: UInt8[np.ndarray, "b p p"]
    visible_iou: Float[np.ndarray, " b"] | None
    render_colours: Float[np.ndarray, "b 3 3"]
    obj_id: np.ndarray
    kept: np.ndarray

    @property
    def visible_fraction(self) -> Float[np.ndarray, " b"]:
        """Visible fraction of each object in its patch, after augmentation."""
        return visible_fraction(self.scene_bits)


@dataclass(frozen=True, kw_only=True, eq=False)
class _Draft:
    """A pair before its hypothesis is rendered."""

    index: int
    sample: Mapping[str, Any]
    T_cam_obj: Float[np.ndarray, "4 4"]
    T_cam_obj_hypothesis: Float[np.ndarray, "4 4"]
    K_crop: Float[np.ndarray, "3 3"]
    rotation: Float[np.ndarray, "3 3"]
    patch_from_stored: Float[np.ndarray, "2 3"]
    scene_distance_px: Float[np.ndarray, "p p"]
    scene_bits: UInt8[np.ndarray, "p p"]
    valid: Bool[np.ndarray, "p p"]


def draw_hypothesis(
    T_cam_obj: Float[np.ndarray, "4 4"],
    diameter_m: float,
    config: HypothesisConfig,
    rng: np.random.Generator,
    reach: float = 1,
) -> Float[np.ndarray, "4 4"]:
    """A pose near the ground truth: angle and distance uniform up to their limits, axis and direction uniform.

    It is rotated about its origin, which is the object's centre in training. The translation along the ray from the
    camera to that point is then scaled by `depth_stretch`.

    Angle and distance are scaled down independently: after one update, a pose is well positioned in the image and still
    rotated, which is the input of a refinement's later iterations.

    Args:
        T_cam_obj: Ground truth.
        diameter_m: Object diameter.
        config: Limits.
        rng: Source of every draw.
        reach: Factor on both limits.
    """
    angle_scale, distance_scale = (rng.random() if rng.random() < config.easy_fraction else 1.0 for _ in range(2))
    angle_rad = np.deg2rad(config.max_angle_deg) * reach * angle_scale * rng.random()
    distance_m = config.max_translation_diameter * diameter_m * reach * distance_scale * rng.random()
    drawn = se3.perturb(T_cam_obj, float(angle_rad), float(distance_m), rng)
    return drawn if config.depth_stretch == 1 else se3.stretched_along_ray(T_cam_obj, drawn, config.depth_stretch)


class OnlinePairMaker:
    """Maker of batches of online pairs from stored scenes.

    Args:
        meshes: By object id, their origins at the pivots of hypotheses and updates.
        rasteriser: Rasteriser with these meshes; made in the process that uses it.
        patch_px: Side of the new patches.
        window: Crop window.
        fixed_sides_px: Side of each object's window in the full image, for windows of fixed side.
        contour_points: Contour points of each patch.
        hypothesis: Range of hypotheses; without `online` all are precomputed.
        augment_config: Image augmentation.
        symmetries: Symmetry transforms of each object, for `hypothesis.sample_symmetries`.
    """

    def __init__(
        self,
        *,
        meshes: Mapping[int, Mesh],
        rasteriser: Rasteriser,
        patch_px: int,
        window: WindowConfig,
        contour_points: int,
        hypothesis: HypothesisConfig,
        augment_config: AugmentConfig,
        fixed_sides_px: Mapping[int, float] | None = None,
        symmetries: Mapping[int, Float[np.ndarray, "s 4 4"]] | None = None,
    ) -> None:
        self._meshes = meshes
        self._rasteriser = rasteriser
        self._patch_px = patch_px
        self._window = window
        self._fixed_sides_px = dict(fixed_sides_px or {})
        self._contour_points = contour_points
        self._hypothesis = hypothesis
        self._augment = augment_config
        self._symmetries = dict(symmetries or {})

    def __call__(self, samples: Sequence[Mapping[str, Any]], rngs: Sequence[np.random.Generator]) -> PairArrays | None:
        """Pairs of these samples, each drawn with its own generator; None when no object is visible.

        Args:
            samples: Rows of a shard: scene_rgb, scene_mask, scene_contour_cam_m, T_cam_obj, K, window_px, obj_id and,
                where precomputed ones are used, T_cam_obj_hypothesis.
            rngs: As many.
        """
        drafts = [d for i, (s, rng) in enumerate(zip(samples, rngs, strict=True)) if (d := self._draft(i, s, rng))]
        if not drafts:
            return None
        K_crop = np.stack([d.K_crop for d in drafts])
        hypotheses = np.stack([d.T_cam_obj_hypothesis for d in drafts])
        obj_ids = np.array([int(d.sample["obj_id"]) for d in drafts])
        layers = self._rasteriser.render(obj_ids, K_crop, hypotheses, self._patch_px, self._patch_px)
        rgb, depth = layers.rgb, layers.depth_m
        assert rgb is not None
        masks = [contour.contour_mask(d > 0) for d in depth]
        visible = [i for i, mask in enumerate(masks) if mask.sum() >= MIN_CONTOUR_PX]
        if not visible:
            return None
        visible += [visible[i % len(visible)] for i in range(len(samples) - len(visible))]
        drafts = [drafts[i] for i in visible]
        scenes, bits = zip(*(self._scene(d, samples, rngs[d.index]) for d in drafts), strict=True)
        scene_bits = np.stack(bits)
        scene_rgb, hypothesis_rgb, render_colours = augmentation.colour(
            np.stack(scenes), rgb[visible], self._augment, rngs[drafts[0].index]
        )
        points = [
            contour.sample_contour(depth[i] > 0, depth[i], d.K_crop, self._contour_points, rngs[d.index])
            for i, d in zip(visible, drafts, strict=True)
        ]
        return PairArrays(
            scene_rgb=scene_rgb,
            hypothesis_rgb=hypothesis_rgb,
            T_cam_obj=np.stack([d.T_cam_obj for d in drafts]),
            T_cam_obj_hypothesis=hypotheses[visible],
            K_crop=K_crop[visible],
            scene_contour_m=np.stack([self._scene_points(d) for d in drafts]),
            hypothesis_contour_m=np.stack(points),
            scene_distance_px=np.stack([d.scene_distance_px for d in drafts]),
            hypothesis_distance_px=np.stack([contour.distance_transform_px(masks[i]) for i in visible]),
            hypothesis_depth_m=depth[visible],
            scene_bits=scene_bits,
            visible_iou=visible_mask_iou(depth[visible] > 0, scene_bits),
            render_colours=render_colours,
            obj_id=obj_ids[visible],
            kept=np.array([d.index for d in drafts]),
        )

    def _draft(self, index: int, sample: Mapping[str, Any], rng: np.random.Generator) -> _Draft | None:
        """Pose, window and scene labels of a pair; None when no window shows the scene's contour."""
        mesh = self._meshes[int(sample["obj_id"])]
        in_plane = self._hypothesis.online and self._hypothesis.in_plane
        rotation = optical_axis_rotation(rng.uniform(-np.pi, np.pi) if in_plane else 0.0)
        T_rotation = se3.make_T(rotation, np.zeros(3))
        T_gt = T_rotation @ sample["T_cam_obj"]
        x0, y0, side = (float(v) for v in sample["window_px"])
        stored, stored_px = Window(x0_px=x0, y0_px=y0, side_px=side), len(sample["scene_rgb"])
        fraction = self._hypothesis.precomputed_fraction
        precomputed = not self._hypothesis.online or (fraction > 0 and rng.random() < fraction)
        for attempt in range(ATTEMPTS):
            if self._hypothesis.online and not (precomputed and attempt == 0):
                around = self._equivalent(T_gt, int(sample["obj_id"]), rng)
                hypothesis = draw_hypothesis(around, mesh.diameter_m, self._hypothesis, rng, reach=0.5**attempt)
            else:
                hypothesis = T_rotation @ sample["T_cam_obj_hypothesis"]
            if mesh.center_cam_m(hypothesis)[2] < mesh.diameter_m:
                continue
            fixed_px = self._fixed_sides_px.get(int(sample["obj_id"]), stored.side_px)
            window = hypothesis_window(self._window, sample["K"], hypothesis, mesh, fixed_px)
            affine = crop_affine(stored, stored_px, sample["K"], rotation, window, self._patch_px)
            bits = warp(sample["scene_mask"], affine, self._patch_px, nearest=True)
            valid = warp(np.ones((stored_px, stored_px), np.uint8), affine, self._patch_px, nearest=True) > 0
            # Where the stored patch ends the silhouette is cut, which is not a contour: outside counts as object.
            outline = contour.contour_mask(((bits & BIT_OBJECT) > 0) | ~valid) & valid
            if outline.sum() >= MIN_CONTOUR_PX:
                return _Draft(
                    index=index,
                    sample=sample,
                    T_cam_obj=T_gt,
                    T_cam_obj_hypothesis=hypothesis,
                    K_crop=crop_K(sample["K"], window, self._patch_px),
                    rotation=rotation,
                    patch_from_stored=affine,
                    scene_distance_px=contour.distance_transform_px(outline),
                    scene_bits=bits,
                    valid=valid,
                )
        return None

    def _equivalent(
        self, T_gt: Float[np.ndarray, "4 4"], obj_id: int, rng: np.random.Generator
    ) -> Float[np.ndarray, "4 4"]:
        """A random symmetry-equivalent ground truth under `sample_symmetries`, else the ground truth itself."""
        transforms = self._symmetries.get(obj_id) if self._hypothesis.sample_symmetries else None
        return T_gt if transforms is None else np.asarray(T_gt @ transforms[rng.integers(len(transforms))])

    def _scene(
        self, draft: _Draft, samples: Sequence[Mapping[str, Any]], rng: np.random.Generator
    ) -> tuple[UInt8[np.ndarray, "p p 3"], UInt8[np.ndarray, "p p"]]:
        """Scene patch and its masks, with background and occluders replaced."""
        scene, bits = warp(draft.sample["scene_rgb"], draft.patch_from_stored, self._patch_px), draft.scene_bits
        exchange = rng.random() < self._augment.background
        if exchange or not draft.valid.all():
            other = samples[int(rng.integers(len(samples)))]
            foreground = (other["scene_mask"] & BIT_FOREGROUND) > 0
            behind = augmentation.background_patch(other["scene_rgb"], foreground, self._patch_px, rng)
            keep = draft.valid & ((bits & BIT_FOREGROUND) > 0) if exchange else draft.valid
            # The stored window's edge must not show: it is centred near the ground truth and would reveal it.
            scene = np.where(keep[..., None], scene, behind)
        if self._augment.occlusion and rng.random() < self._augment.occlusion:
            other = samples[int(rng.integers(len(samples)))]
            scene, bits = augmentation.occlude(
                scene, bits, other["scene_rgb"], other["scene_mask"], self._augment.min_visible_fraction, rng
            )
        return scene, bits

    def _scene_points(self, draft: _Draft) -> Float[np.ndarray, "n 3"]:
        points = draft.sample["scene_contour_cam_m"]
        chosen = (np.arange(self._contour_points) * len(points)) // self._contour_points
        return np.asarray(points[chosen] @ draft.rotation.T.astype(points.dtype))
