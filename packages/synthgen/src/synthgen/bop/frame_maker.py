"""Rendered frames with exact ground truth: scene, layers, and masks of the objects."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from functools import lru_cache
from typing import Literal

import cv2
import numpy as np
from jaxtyping import Bool, Float, UInt8
from posecore.bop import GroundTruth
from posecore.camera import Camera, crop_K
from posecore.errors import ConfigError
from posecore.mesh import Mesh
from posecore.raster import Instance, Rasteriser
from posecore.window import Window, centred, silhouette_box

from synthgen.bop.layout import BoundingSpheres, CameraView, Layout, clearance_m, draw_camera, draw_layout, frame_sensor
from synthgen.bop.motion import Motion
from synthgen.config import SynthConfig
from synthgen.draw import scene_draw
from synthgen.draw.poses import fraction_inside, target_box
from synthgen.draw.random_streams import Purpose, Subject, child_seed, stream
from synthgen.draw.target import TargetObject
from synthgen.engine import RenderedScene
from synthgen.engines.make import make_engine
from synthgen.image import background, sensor
from synthgen.inputs.assets import Assets
from synthgen.scene import Background, Scene, SceneObject

Split = Literal["test", "val", "train_pbr"]

MAX_ATTEMPTS = 100
_PURPOSES = {"test": Purpose.FRAMES, "val": Purpose.VALIDATION_FRAMES, "train_pbr": Purpose.TRAINING_FRAMES}
_SEQUENCE_PURPOSES = {
    "test": Purpose.SEQUENCES,
    "val": Purpose.VALIDATION_SEQUENCES,
    "train_pbr": Purpose.TRAINING_SEQUENCES,
}
_VISIBILITY_PX = 64  # side of the low-resolution render that measures the visible fraction
_CLEARANCE = 0.3  # smallest distance of other objects from the camera, in units of the target's smallest distance
_CHECKED_FRAMES = 9  # frames of a sequence at which the object's visibility is tested
_MIN_VISIBLE_FRAMES = 0.7  # fraction of these frames at which the object must be visible enough


@dataclass(frozen=True, kw_only=True)
class FramePlan:
    """Images of a dataset.

    Attributes:
        split: BOP split; no two splits share a scene.
        frames: Number of images, in total or per sequence.
        frames_per_scene: Number of images of a layout, which is then a BOP scene (0, 1, ...). None: every image has its
            own layout, and all are in BOP scene 1.
        sequences: Number of sequences, which are the BOP scenes 1, 2, ...; None for single images.
    """

    split: Split = "test"
    frames: int
    frames_per_scene: int | None = None
    sequences: int | None = None

    def __post_init__(self) -> None:
        if self.frames < 1:
            raise ConfigError(f"--frames {self.frames}: expected at least 1 frame")
        if self.sequences is not None and self.frames_per_scene is not None:
            raise ConfigError("--frames-per-scene: a sequence is one scene; leave the option out with --sequence")
        for name, value in (("frames-per-scene", self.frames_per_scene), ("sequences", self.sequences)):
            if value is not None and value < 1:
                raise ConfigError(f"--{name} {value}: expected at least 1")

    def scenes(self) -> Iterator[tuple[int, int]]:
        """BOP scene ids with their numbers of images."""
        if self.sequences is not None:
            yield from ((1 + i, self.frames) for i in range(self.sequences))
        elif self.frames_per_scene is None:
            yield 1, self.frames
        else:
            k = self.frames_per_scene
            yield from ((i, min(k, self.frames - i * k)) for i in range(-(-self.frames // k)))

    @property
    def shares_layout(self) -> bool:
        """Whether the images of a BOP scene have the same layout, and so a common world frame."""
        return self.sequences is not None or self.frames_per_scene is not None


@dataclass(frozen=True, kw_only=True, eq=False)
class RenderedFrame:
    """A rendered image with its ground truth.

    Attributes:
        rgb: Camera image.
        depth_m: Camera z at the pixels' centres, 0 for the background.
        gts: The labelled objects.
        masks: Amodal silhouette of each object, on a canvas of three images' width and height with the image in its
            middle (bop_toolkit's canvas).
        masks_visib: Visible silhouette of each object in the image.
        mask_origin_px: Column and row of the image's corner in `masks`.
        T_cam_world: The layout's frame in the camera's.
    """

    rgb: UInt8[np.ndarray, "h w 3"]
    depth_m: Float[np.ndarray, "h w"]
    gts: list[GroundTruth]
    masks: list[Bool[np.ndarray, "h3 w3"]]
    masks_visib: list[Bool[np.ndarray, "h w"]]
    mask_origin_px: tuple[int, int]
    T_cam_world: Float[np.ndarray, "4 4"]


class FrameMaker:
    """Makes frames. One per process, because it holds the renderers.

    Args:
        config: Configuration.
        targets: Target objects.
        assets: Photographs, panoramas, occluder meshes.
        plan: Images of the dataset.
        threads: Threads of a Blender engine, 0 for all cores; results do not depend on it.

    Raises:
        RenderError: A renderer cannot start here.
    """

    def __init__(
        self, config: SynthConfig, targets: Sequence[TargetObject], assets: Assets, plan: FramePlan, *, threads: int = 0
    ) -> None:
        self.config, self.targets, self.assets, self.plan = config, tuple(targets), assets, plan
        self.camera: Camera = config.camera.camera()
        self._by_id = {t.obj_id: t for t in targets}
        meshes: dict[int, Mesh] = {}
        for target in targets:
            meshes |= {target.obj_id: target.mesh, **target.shapes, **target.tables}
        self._spheres = BoundingSpheres(meshes)
        self._engine = make_engine(config.engine, threads=threads, device=config.device)
        self._engine.load(meshes)
        self._rasteriser = Rasteriser(meshes)
        self._lengths = dict(plan.scenes())
        self._motion = lru_cache(maxsize=2)(self._accepted_motion)
        self._layout = lru_cache(maxsize=2)(self._shared_layout)

    def close(self) -> None:
        """Free the renderers."""
        self._engine.close()
        self._rasteriser.close()

    def frame(self, scene_id: int, im_id: int) -> RenderedFrame:
        """Draw and render one image of the plan.

        Raises:
            ConfigError: No acceptable scene exists with this configuration.
        """
        view = self.view(scene_id, im_id)
        scene = view.scene(self.camera, self.config.samples)
        rendered = self._engine.render(scene)
        margin = (self.camera.width_px, self.camera.height_px)
        labelled = scene.objects[: len(view.layout.labelled)]
        masks = [self._silhouette(placed) for placed in labelled]
        inside = [mask[margin[1] : 2 * margin[1], margin[0] : 2 * margin[0]] for mask in masks]
        return RenderedFrame(
            rgb=_compose(rendered, scene, view),
            depth_m=rendered.depth_m,
            gts=[GroundTruth(obj_id=o.mesh_key, T_cam_obj=o.T_cam_obj) for o in labelled],
            masks=masks,
            # Blender's index layer may differ from the rasteriser's silhouette by single pixels: visible within amodal
            masks_visib=[(rendered.index == i) & mask for i, mask in enumerate(inside)],
            mask_origin_px=margin,
            T_cam_world=view.T_cam_ref,
        )

    def view(self, scene_id: int, im_id: int) -> CameraView:
        """The camera view of an image of the plan.

        Raises:
            ConfigError: No acceptable scene exists with this configuration.
        """
        if self.plan.sequences is not None:
            return self._motion(scene_id).view(im_id)
        if self.plan.frames_per_scene is not None:
            return self._view_of_layout(scene_id, im_id)
        return self._single_view(im_id)

    def _single_view(self, index: int) -> CameraView:
        """A view of a training pair's scene with further objects."""
        purpose = _PURPOSES[self.plan.split]
        for attempt in range(MAX_ATTEMPTS):
            base = scene_draw.draw_scene(self.config, self.targets, self.assets, purpose, index, attempt)
            base = scene_draw.adjust_visibility(base, self.config, self._visible_fraction)
            view = CameraView(layout=draw_layout(self.config, self.targets, base, together=False), T_cam_ref=np.eye(4))
            if self._is_good(view):
                return view
        raise self._no_view(f"image {index}")

    def _shared_layout(self, scene_id: int) -> Layout:
        purpose = _PURPOSES[self.plan.split]
        base = scene_draw.draw_scene(self.config, self.targets, self.assets, purpose, scene_id, 0)
        return draw_layout(self.config, self.targets, base, together=True)

    def _view_of_layout(self, scene_id: int, im_id: int) -> CameraView:
        layout, purpose = self._layout(scene_id), _PURPOSES[self.plan.split]
        for attempt in range(MAX_ATTEMPTS):
            rng = stream(self.config.seed, purpose, Subject.CAMERA, scene_id, im_id, attempt)
            number, T_cam_ref = draw_camera(rng, self.config, self._by_id, layout)
            style, render_seed = frame_sensor(rng, self.config)
            behind = layout.background
            if behind.kind != "environment":  # a panorama is common to all cameras, other backgrounds are not
                behind = replace(behind, seed=child_seed(rng))
            varied = replace(layout, sensor=style, render_seed=render_seed, background=behind)
            view = CameraView(layout=varied, T_cam_ref=T_cam_ref, target_index=number)
            if self._is_clear(view) and self._is_good(view):
                return view
        raise self._no_view(f"scene {scene_id}, image {im_id}")

    def _accepted_motion(self, scene_id: int) -> Motion:
        purpose = _SEQUENCE_PURPOSES[self.plan.split]
        last = self._lengths[scene_id] - 1
        checked = sorted({round(last * i / (_CHECKED_FRAMES - 1)) for i in range(_CHECKED_FRAMES)})
        step = max(1, round(self.config.sequence.fps / 10))
        for attempt in range(MAX_ATTEMPTS):
            base = scene_draw.draw_scene(self.config, self.targets, self.assets, purpose, scene_id, attempt)
            # the drawn occluders suit one camera only; a passing occluder replaces them
            layout = draw_layout(self.config, self.targets, replace(base, front=()), together=True)
            motion = Motion(self.config, self._by_id, layout, base.address)
            if not all(self._is_clear(motion.view(i)) for i in (*range(0, last, step), last)):
                continue
            if sum(self._is_good(motion.view(i)) for i in checked) >= _MIN_VISIBLE_FRAMES * len(checked):
                return motion
        raise self._no_view(f"sequence {scene_id}")

    def _is_clear(self, view: CameraView) -> bool:
        """Whether no object but a table is near the camera."""
        layout = view.layout
        target = self._by_id[layout.labelled[view.target_index].mesh_key]
        objects = [o for o in (*layout.labelled, *layout.others) if o.mesh_key not in self._tables]
        return clearance_m(self._spheres, objects, view.T_cam_ref) >= _CLEARANCE * target.distance_m[0]

    @property
    def _tables(self) -> set[int]:
        return {key for target in self.targets for key in target.tables}

    def _is_good(self, view: CameraView) -> bool:
        """Whether the target object is large, inside the image and visible enough."""
        placed = [
            replace(o, T_cam_obj=view.T_cam_ref @ o.T_cam_obj) for o in (*view.layout.labelled, *view.layout.others)
        ]
        first = placed.pop(view.target_index)
        target = self._by_id[first.mesh_key]
        box = target_box(target, self.camera, first.T_cam_obj)
        inside = fraction_inside(box, self.camera)
        if inside < self.config.view.min_inside:
            return False
        area_px, visible = self._area_and_visibility(first, placed)
        # in patch pixels, as for training pairs
        area_px *= (self.config.patch_px / target.window_side_px) ** 2
        return area_px >= self.config.window.min_area_px and visible * inside >= self.config.occluders.min_visible

    def _visible_fraction(self, draw: scene_draw.SceneDraw) -> float:
        first = SceneObject(mesh_key=draw.target.obj_id, T_cam_obj=draw.T_cam_obj)
        return self._area_and_visibility(first, draw.others)[1]

    def _area_and_visibility(self, first: SceneObject, others: Sequence[SceneObject]) -> tuple[float, float]:
        """An object's area in image pixels and its visible fraction, from a low-resolution render."""
        x0, y0, x1, y1 = target_box(self._by_id[first.mesh_key], self.camera, first.T_cam_obj)
        window = centred((x0 + x1) / 2, (y0 + y1) / 2, max(x1 - x0, y1 - y0))
        K = crop_K(self.camera.K, window, _VISIBILITY_PX)
        instances = [Instance(obj_id=o.mesh_key, T_cam_obj=o.T_cam_obj) for o in (first, *others)]
        alone = self._rasteriser.render_scene(instances[:1], K, _VISIBILITY_PX, _VISIBILITY_PX, rgb=False).instance == 0
        visible = self._rasteriser.render_scene(instances, K, _VISIBILITY_PX, _VISIBILITY_PX, rgb=False).instance == 0
        area_px = float(alone.sum()) * (window.side_px / _VISIBILITY_PX) ** 2
        return area_px, float(visible.sum() / max(alone.sum(), 1))

    def _silhouette(self, placed: SceneObject) -> Bool[np.ndarray, "h3 w3"]:
        """Amodal silhouette on a canvas of three images' width and height; only the object's box is rendered."""
        width, height = self.camera.width_px, self.camera.height_px
        canvas = np.zeros((3 * height, 3 * width), bool)
        box = silhouette_box(self._by_id[placed.mesh_key].hull_m, self.camera.K, placed.T_cam_obj)
        low, high = np.array([-width, -height]), np.array([2 * width, 2 * height])
        if np.isfinite(box).all():
            low = np.maximum(low, np.floor(box[:2]).astype(int) - 1)
            high = np.minimum(high, np.ceil(box[2:]).astype(int) + 1)
        if (low >= high).any():
            return canvas
        x0, y0 = int(low[0]), int(low[1])
        columns, rows = int(high[0]) - x0, int(high[1]) - y0
        K = crop_K(self.camera.K, Window(x0_px=float(x0), y0_px=float(y0), side_px=1.0), 1)
        mask = self._rasteriser.render(placed.mesh_key, K, placed.T_cam_obj[None], columns, rows, rgb=False).mask[0]
        canvas[height + y0 : height + y0 + rows, width + x0 : width + x0 + columns] = mask
        return canvas

    def _no_view(self, where: str) -> ConfigError:
        return ConfigError(
            f"{where}: {MAX_ATTEMPTS} consecutive draws were rejected: the target object is hidden, too small or "
            "outside the image, or another object is too near to the camera; lower frames.objects, occluders.front, "
            "occluders.min_visible, view.position_jitter or window.min_area_px, or raise distance.min"
        )


def _compose(rendered: RenderedScene, scene: Scene, view: CameraView) -> UInt8[np.ndarray, "h w 3"]:
    """Composite the render over the background in linear light, and apply the sensor effects."""
    height, width = rendered.alpha.shape
    if view.background_shift_px is None or scene.background.kind == "environment":
        behind = background.render_background(scene, width, height)
    else:
        behind = _shifted_background(view, width, height)
    alpha = rendered.alpha[..., None]
    linear = rendered.rgb_linear * alpha + sensor.linear_from_display(behind) * (1 - alpha)
    return sensor.expose(linear, scene.sensor)


def _shifted_background(view: CameraView, width: int, height: int) -> UInt8[np.ndarray, "h w 3"]:
    """Part of a background larger than the image, at a subpixel shift."""
    assert view.background_shift_px is not None
    reach_x, reach_y = view.background_reach_px
    whole = _canvas(view.layout.background, width + 2 * reach_x, height + 2 * reach_y)
    dx, dy = view.background_shift_px
    source = np.array([[1.0, 0.0, reach_x - dx], [0.0, 1.0, reach_y - dy]])
    flags = cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP
    return np.asarray(cv2.warpAffine(whole, source, (width, height), flags=flags, borderMode=cv2.BORDER_REPLICATE))


@lru_cache(maxsize=2)
def _canvas(behind: Background, width: int, height: int) -> UInt8[np.ndarray, "h w 3"]:
    """Background canvas of a sequence, of which every image shows a part."""
    return background.draw(behind, width, height)
