"""Pairs of scene and hypothesis patches with their labels, all samples of a scene at once."""

import math
import os
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial

import cv2
import numpy as np
from jaxtyping import Bool, Float, UInt8
from posecore.camera import Camera, crop_K
from posecore.contour import contour_mask, distance_transform_px, sample_contour
from posecore.mesh import Mesh
from posecore.raster import Instance, Rasteriser
from posecore.shard import BIT_FOREGROUND, BIT_OBJECT, BIT_VISIBLE
from posecore.window import Window, centred, cut, fixed_window

from synthgen.config import SynthConfig
from synthgen.draw import scene_draw
from synthgen.draw.poses import draw_hypothesis, fraction_inside, target_box
from synthgen.draw.random_streams import Purpose, Subject, stream
from synthgen.draw.rejection import Tally, nothing_accepted
from synthgen.draw.scene_draw import SceneDraw
from synthgen.draw.target import TargetObject
from synthgen.engine import Engine, RenderedScene
from synthgen.engines.make import make_engine
from synthgen.image.compose import compose, on_black
from synthgen.image.region import (
    contains,
    inside_image,
    pixel_bounds,
    render_region,
    scaled_camera,
    scaled_window,
    window_in_region,
)
from synthgen.inputs.assets import Assets
from synthgen.scene import Light, Scene, SceneObject

MAX_ATTEMPTS = 100
MAX_HYPOTHESIS_ATTEMPTS = 50
_VISIBILITY_PX = 64  # side of the low-resolution render that measures the visible fraction


@dataclass(frozen=True, kw_only=True, eq=False)
class Hypothesis:
    """One accepted hypothesis with the exact geometry of both silhouettes in its window.

    Attributes:
        T_cam_obj: Perturbed pose.
        window: Crop window of both patches.
        K_crop: Camera matrix of the patch.
        gt_depth_m: Camera z of the object alone at its true pose.
        depth_m: Camera z of the object at the hypothesis.
        rgb: Rasterised hypothesis on black.
        rejected: Number of rejected draws before this one.
    """

    T_cam_obj: Float[np.ndarray, "4 4"]
    window: Window
    K_crop: Float[np.ndarray, "3 3"]
    gt_depth_m: Float[np.ndarray, "p p"]
    depth_m: Float[np.ndarray, "p p"]
    rgb: UInt8[np.ndarray, "p p 3"]
    rejected: int


@dataclass(frozen=True, kw_only=True, eq=False)
class RenderedImage:
    """A rendered region of a scene's image.

    Attributes:
        rendered: The engine's layers.
        image: Camera image: the render over the background, exposed.
        region_px: (x0, y0, width, height) in the scaled image.
        scale: Pixels of the render per pixel of the camera.
    """

    rendered: RenderedScene
    image: UInt8[np.ndarray, "h w 3"]
    region_px: tuple[int, int, int, int]
    scale: float


class PairMaker:
    """Makes samples. One per process, because it holds the renderers.

    Args:
        config: Configuration.
        targets: Target objects.
        assets: Photographs, panoramas and occluder meshes; none by default.
        threads: Threads of a Blender engine, 0 for all cores; results do not depend on it.

    Raises:
        RenderError: A renderer cannot start here.
    """

    def __init__(
        self, config: SynthConfig, targets: Sequence[TargetObject], assets: Assets | None = None, *, threads: int = 0
    ) -> None:
        self.config = config
        self.targets = tuple(targets)
        self.assets = assets or Assets()
        self.camera: Camera = config.camera.camera()
        meshes: dict[int, Mesh] = {}
        for target in targets:
            meshes |= {target.obj_id: target.mesh, **target.shapes, **target.tables}
        self._engines: dict[str, Engine] = {}
        for name in dict.fromkeys((config.engine, config.hypothesis_engine)):
            # hypotheses by the rasteriser need no engine
            if name != "raster" or name == config.engine:
                self._engines[name] = make_engine(name, threads=threads, device=config.device)
                self._engines[name].load(meshes)
        self._rasteriser = Rasteriser(meshes)

    def close(self) -> None:
        """Free the renderers."""
        for engine in self._engines.values():
            engine.close()
        self._rasteriser.close()

    def samples(self, scene_index: int, keep: int | None = None, first_attempt: int = 0) -> dict[str, np.ndarray]:
        """All samples of a scene: every field of the shard table, hypotheses on the first axis.

        Args:
            scene_index: Index of the scene.
            keep: Number of hypotheses to keep; it changes neither the scene nor the kept hypotheses.
            first_attempt: First draw of the scene to try, e.g. because an earlier one crashes the renderer.

        Raises:
            ConfigError: No acceptable scene or hypothesis exists with this configuration.
        """
        tally = Tally()
        draw, rejected_scenes = self.accepted_scene(scene_index, first_attempt, tally)
        while (hypotheses := self._hypotheses(draw, scene_index, tally)) is None:
            tally["no hypothesis"] += 1
            draw, rejected_scenes = self.accepted_scene(scene_index, rejected_scenes + 1, tally)
        image = self._render(draw, [h.window for h in hypotheses])
        rows = [
            self._sample(draw, scene_index, number, hypothesis, rejected_scenes, image)
            for number, hypothesis in enumerate(hypotheses[:keep])
        ]
        return {name: np.stack([row[name] for row in rows]) for name in rows[0]}

    def accepted_scene(
        self, scene_index: int, first_attempt: int = 0, tally: Tally | None = None
    ) -> tuple[SceneDraw, int]:
        """Draw scenes until the object is inside the image, large and visible enough.

        Args:
            scene_index: Index of the scene.
            first_attempt: First draw to try.
            tally: Rejections by reason; those of this call are added.

        Returns:
            The scene and the number of draws rejected before it.

        Raises:
            ConfigError: No draw is acceptable.
        """
        tally = Tally() if tally is None else tally
        for attempt in range(first_attempt, MAX_ATTEMPTS):
            draw = scene_draw.draw_scene(self.config, self.targets, self.assets, Purpose.PAIRS, scene_index, attempt)
            box = target_box(draw.target, self.camera, draw.T_cam_obj)
            inside = fraction_inside(box, self.camera)
            if inside < self.config.view.min_inside:
                tally["outside"] += 1
                continue
            draw = scene_draw.adjust_visibility(draw, self.config, partial(self._visible_fraction, box))
            area_px, visible = self._area_and_visibility(draw, box)
            if area_px < self.config.window.min_area_px:
                tally["small"] += 1
            elif visible * inside < self.config.occluders.min_visible:
                tally["hidden"] += 1
            else:
                return draw, attempt
        target = self.targets[scene_draw.target_index(self.config.seed, Purpose.PAIRS, scene_index, len(self.targets))]
        raise nothing_accepted(scene_index, target.name, tally, self.config)

    def _render(self, draw: SceneDraw, windows: Sequence[Window]) -> RenderedImage:
        """Render the region of the image that the windows need, at most at the patches' resolution."""
        scale = min(1.0, self.config.patch_px / draw.target.window_side_px)
        camera = scaled_camera(self.camera, scale)
        region = render_region([scaled_window(w, scale) for w in windows], camera)
        scene = draw.scene(camera, region, self.config.samples)
        rendered = self._engines[self.config.engine].render(scene)
        return RenderedImage(rendered=rendered, image=compose(rendered, scene), region_px=region, scale=scale)

    def _visible_fraction(self, box: Float[np.ndarray, "4"], draw: SceneDraw) -> float:
        return self._area_and_visibility(draw, box)[1]

    def _area_and_visibility(self, draw: SceneDraw, box: Float[np.ndarray, "4"]) -> tuple[float, float]:
        """The silhouette's area in patch pixels and its visible fraction, from a low-resolution render."""
        x0, y0, x1, y1 = box
        window = centred((x0 + x1) / 2, (y0 + y1) / 2, max(x1 - x0, y1 - y0))
        K = crop_K(self.camera.K, window, _VISIBILITY_PX)
        alone = self._rasteriser.render(
            draw.target.obj_id, K, draw.T_cam_obj[None], _VISIBILITY_PX, _VISIBILITY_PX, rgb=False
        ).mask.sum()
        area_px = (
            float(alone) * (window.side_px / _VISIBILITY_PX * self.config.patch_px / draw.target.window_side_px) ** 2
        )
        if not draw.others or not alone:
            return area_px, 1.0
        instances = [Instance(obj_id=draw.target.obj_id, T_cam_obj=draw.T_cam_obj)]
        instances += [Instance(obj_id=o.mesh_key, T_cam_obj=o.T_cam_obj) for o in draw.others]
        scene = self._rasteriser.render_scene(instances, K, _VISIBILITY_PX, _VISIBILITY_PX, rgb=False)
        visible = (scene.instance == 0).sum()
        return area_px, float(visible / alone)

    def _hypotheses(self, draw: SceneDraw, scene_index: int, tally: Tally) -> list[Hypothesis] | None:
        """Draw each hypothesis until both silhouettes are inside the window and large enough.

        None if the scene does not allow it; another scene is then drawn.
        """
        accepted: dict[int, Hypothesis] = {}
        attempts = dict.fromkeys(range(self.config.hypotheses_per_scene), 0)
        while len(accepted) < len(attempts):
            candidates: dict[int, tuple[Float[np.ndarray, "4 4"], Window]] = {}
            for number in attempts:
                if number not in accepted:
                    candidate = self._next_candidate(draw, scene_index, number, attempts, tally)
                    if candidate is None:
                        return None
                    candidates[number] = candidate
            for number, hypothesis in self._rasterise(draw, candidates, attempts).items():
                area_px = min((hypothesis.gt_depth_m > 0).sum(), (hypothesis.depth_m > 0).sum())
                if area_px >= self.config.window.min_area_px:
                    accepted[number] = hypothesis
                else:
                    tally["too small"] += 1
                    attempts[number] += 1
        return [accepted[number] for number in sorted(accepted)]

    def _next_candidate(
        self, draw: SceneDraw, scene_index: int, number: int, attempts: dict[int, int], tally: Tally
    ) -> tuple[Float[np.ndarray, "4 4"], Window] | None:
        """The next draw of a hypothesis whose window contains both silhouettes' boxes, None after too many draws."""
        gt_box = target_box(draw.target, self.camera, draw.T_cam_obj)
        while attempts[number] < MAX_HYPOTHESIS_ATTEMPTS:
            rng = stream(self.config.seed, Purpose.PAIRS, Subject.HYPOTHESIS, scene_index, number, attempts[number])
            T = draw_hypothesis(rng, self.config.perturbation, draw.T_cam_obj, draw.target.mesh)
            box = target_box(draw.target, self.camera, T)
            if np.isfinite(box).all():
                window = fixed_window(draw.target.hull_m, self.camera.K, T, draw.target.window_side_px)
                if contains(window, gt_box) and contains(window, box):
                    return T, window
            tally["left window"] += 1
            attempts[number] += 1
        return None

    def _rasterise(
        self,
        draw: SceneDraw,
        candidates: Mapping[int, tuple[Float[np.ndarray, "4 4"], Window]],
        attempts: Mapping[int, int],
    ) -> dict[int, Hypothesis]:
        """Rasterise ground truth and hypotheses in their windows, at the patch's resolution."""
        p, obj_id = self.config.patch_px, draw.target.obj_id
        K_crop = np.stack([crop_K(self.camera.K, window, p) for _, window in candidates.values()])
        T_gt = np.repeat(draw.T_cam_obj[None], len(candidates), axis=0)
        T_hypothesis = np.stack([T for T, _ in candidates.values()])
        gt = self._rasteriser.render(obj_id, K_crop, T_gt, p, p, rgb=False)
        perturbed = self._rasteriser.render(obj_id, K_crop, T_hypothesis, p, p)
        assert perturbed.rgb is not None
        return {
            number: Hypothesis(
                T_cam_obj=T,
                window=window,
                K_crop=K_crop[i],
                gt_depth_m=gt.depth_m[i],
                depth_m=perturbed.depth_m[i],
                rgb=perturbed.rgb[i],
                rejected=attempts[number],
            )
            for i, (number, (T, window)) in enumerate(candidates.items())
        }

    def _sample(
        self,
        draw: SceneDraw,
        scene_index: int,
        number: int,
        hypothesis: Hypothesis,
        rejected_scenes: int,
        image: RenderedImage,
    ) -> dict[str, np.ndarray]:
        config, window, p = self.config, hypothesis.window, self.config.patch_px
        local = window_in_region(scaled_window(window, image.scale), image.region_px)
        scene_depth_m, scene_mask = _scene_labels(
            hypothesis.gt_depth_m,
            cut(image.rendered.depth_m, local, p, interpolation="nearest"),
            cut(image.rendered.index, local, p, interpolation="nearest", fill=-1),
            inside_image(window, p, self.camera),
            reach_px=math.ceil(max(1.0, p / window.side_px)) + 1,
        )
        amodal = hypothesis.gt_depth_m > 0
        shape = hypothesis.depth_m > 0
        rng = stream(config.seed, Purpose.PAIRS, Subject.CONTOUR, scene_index, number)
        n = config.contour_points
        values = {
            "scene_rgb": cut(image.image, local, p, interpolation="area"),
            "hypothesis_rgb": self._hypothesis_rgb(draw, hypothesis),
            "scene_depth_m": scene_depth_m,
            "hypothesis_depth_m": hypothesis.depth_m,
            "scene_mask": scene_mask,
            "scene_contour_cam_m": sample_contour(amodal, hypothesis.gt_depth_m, hypothesis.K_crop, n, rng),
            "hypothesis_contour_cam_m": sample_contour(shape, hypothesis.depth_m, hypothesis.K_crop, n, rng),
            "scene_distance_px": distance_transform_px(contour_mask(amodal)),
            "hypothesis_distance_px": distance_transform_px(contour_mask(shape)),
            "T_cam_obj": draw.T_cam_obj,
            "T_cam_obj_hypothesis": hypothesis.T_cam_obj,
            "K": self.camera.K,
            "K_crop": hypothesis.K_crop,
            "window_px": window.as_array(),
            "visible_fraction": np.float32(((scene_mask & BIT_VISIBLE) > 0).sum() / amodal.sum()),
            "obj_id": np.int32(draw.target.obj_id),
            "scene_index": np.int64(scene_index),
            "rejected": np.int32(rejected_scenes + hypothesis.rejected),
        }
        return {name: np.asarray(value) for name, value in values.items()}

    def _hypothesis_rgb(self, draw: SceneDraw, hypothesis: Hypothesis) -> UInt8[np.ndarray, "p p 3"]:
        engine = self._engines.get(self.config.hypothesis_engine)
        if self.config.hypothesis_engine == "raster" or engine is None:
            return hypothesis.rgb
        region = pixel_bounds([hypothesis.window])
        scene = Scene(
            camera=self.camera,
            region_px=region,
            objects=(SceneObject(mesh_key=draw.target.obj_id, T_cam_obj=hypothesis.T_cam_obj),),
            lights=(Light(kind="sun", direction_cam=(0.0, 0.0, -1.0), strength=float(np.pi) / 2),),
            ambient_rgb=(0.5, 0.5, 0.5),
            samples=self.config.samples,
            render_seed=draw.render_seed,
        )
        image = on_black(engine.render(scene))
        return cut(image, window_in_region(hypothesis.window, region), self.config.patch_px, interpolation="area")


def concatenate(scenes: Iterable[Mapping[str, np.ndarray]]) -> dict[str, np.ndarray]:
    """Join the samples of several scenes."""
    parts = list(scenes)
    return {name: np.concatenate([part[name] for part in parts]) for name in parts[0]}


def _scene_labels(
    gt_depth_m: Float[np.ndarray, "p p"],
    engine_depth_m: Float[np.ndarray, "p p"],
    engine_index: np.ndarray,
    inside: Bool[np.ndarray, "p p"],
    reach_px: int,
) -> tuple[Float[np.ndarray, "p p"], UInt8[np.ndarray, "p p"]]:
    """Depth and mask bits of the scene patch.

    The object's silhouette and depth are exact at the patch's resolution; occlusion comes from the engine's layers,
    resampled to nearest. A silhouette pixel is hidden where the engine rendered another object nearer to the camera.
    The test for index 0 instead would lose a fringe of up to a camera pixel all around the object.

    Args:
        gt_depth_m: Depth of the object alone.
        engine_depth_m: Depth of the scene.
        engine_index: Object index of the scene.
        inside: Patch pixels inside the camera's image.
        reach_px: Radius in patch pixels, larger than an engine's pixel.
    """
    amodal = gt_depth_m > 0
    other = engine_index > 0
    visible = amodal & inside & ~(other & (engine_depth_m < gt_depth_m))
    other_depth_m = np.where(other & inside, engine_depth_m, np.float32(0.0))
    # In the fringe outside the exact silhouette, where the engine's coarser pixels still show the object, the depth is
    # that of the neighbourhood: another object (the table), or background.
    fringe = (engine_index == 0) & ~amodal & inside
    neighbourhood = np.ones((2 * reach_px + 1, 2 * reach_px + 1), np.uint8)
    other_depth_m = np.where(fringe, cv2.dilate(other_depth_m, neighbourhood), other_depth_m)
    depth = np.where(visible, gt_depth_m, other_depth_m)
    foreground = visible | (other_depth_m > 0)
    mask = amodal * BIT_OBJECT + visible * BIT_VISIBLE + foreground * BIT_FOREGROUND
    return depth.astype(np.float32), mask.astype(np.uint8)


def limit_threads(threads: int) -> None:
    """Limit the threads of OpenCV and Mesa's software GL, by default one per core. Call before any render.

    Args:
        threads: Threads for the software GL, 0 for its default.
    """
    cv2.setNumThreads(1)
    if threads:
        os.environ.setdefault("LP_NUM_THREADS", str(threads))
