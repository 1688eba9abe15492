"""Rendered frames with exact ground truth: which scene an image shows, its layers, and the masks of its objects."""

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

from synthgen.bop.layout import Balls, Layout, View, clearance_m, draw_camera, draw_layout, frame_sensor
from synthgen.bop.motion import Motion
from synthgen.config import SynthConfig
from synthgen.draw import scene_draw
from synthgen.draw.random_streams import Purpose, Subject, child_seed, stream
from synthgen.draw.target import Target
from synthgen.engine import RenderedScene
from synthgen.engines.make import make_engine
from synthgen.image import background, sensor
from synthgen.inputs.assets import Assets
from synthgen.scene import Background, Scene, SceneObject

Array = np.ndarray
Split = Literal["test", "val", "train_pbr"]

MAX_ATTEMPTS = 100
_PURPOSES = {"test": Purpose.FRAMES, "val": Purpose.VALIDATION_FRAMES, "train_pbr": Purpose.TRAINING_FRAMES}
_SEQUENCE_PURPOSES = {
    "test": Purpose.SEQUENCES,
    "val": Purpose.VALIDATION_SEQUENCES,
    "train_pbr": Purpose.TRAINING_SEQUENCES,
}
_GLANCE_PX = 64  # side of the small render that tells how much of an object is seen
_NEAREST = 0.3  # of the smallest distance of what a camera looks at: no other thing may be nearer to it
_KEY_MOMENTS = 9  # of a sequence at which its object is looked at
_SEEN_AT = 0.7  # share of them at which enough of it must be visible


@dataclass(frozen=True, kw_only=True)
class FramePlan:
    """Which images a dataset has.

    Attributes:
        split: BOP split; each has scenes of its own.
        frames: Images in all; of each sequence where there are sequences.
        frames_per_scene: Images that share a layout, which is then a BOP scene (0, 1, ...). Nothing: each image has its
            own layout, and all are in BOP scene 1.
        sequences: Number of sequences, which are the BOP scenes 1, 2, ...; nothing for single images.
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
        """BOP scene ids and how many images each has."""
        if self.sequences is not None:
            yield from ((1 + i, self.frames) for i in range(self.sequences))
        elif self.frames_per_scene is None:
            yield 1, self.frames
        else:
            k = self.frames_per_scene
            yield from ((i, min(k, self.frames - i * k)) for i in range(-(-self.frames // k)))

    @property
    def shares_layout(self) -> bool:
        """Whether the images of a BOP scene show the same things, so that they have a world in common."""
        return self.sequences is not None or self.frames_per_scene is not None


@dataclass(frozen=True, kw_only=True, eq=False)
class Frame:
    """A rendered image with its ground truth.

    Attributes:
        rgb: What the camera saw.
        depth_m: Camera z at the pixels' centres, 0 where nothing was hit.
        truths: The labelled objects.
        masks: Silhouette of each as if nothing stood before it, on a canvas of three images' width and height with
            the image in its middle (bop_toolkit's canvas).
        masks_visib: Visible part of each in the image.
        mask_origin_px: Column and row of the image's corner in `masks`.
        T_cam_world: The layout's frame in the camera's.
    """

    rgb: UInt8[Array, "h w 3"]
    depth_m: Float[Array, "h w"]
    truths: list[GroundTruth]
    masks: list[Bool[Array, "h3 w3"]]
    masks_visib: list[Bool[Array, "h w"]]
    mask_origin_px: tuple[int, int]
    T_cam_world: Float[Array, "4 4"]


class FrameMaker:
    """Makes frames. One per process: it holds the renderers.

    Args:
        config: Recipe.
        targets: Objects.
        assets: Photographs, panoramas, occluder meshes.
        plan: Which images.
        threads: Threads of a Blender engine, 0 for all cores; results do not depend on it.

    Raises:
        RenderError: A renderer cannot start here.
    """

    def __init__(
        self, config: SynthConfig, targets: Sequence[Target], assets: Assets, plan: FramePlan, *, threads: int = 0
    ) -> None:
        self.config, self.targets, self.assets, self.plan = config, tuple(targets), assets, plan
        self.camera: Camera = config.camera.camera()
        self._by_id = {t.obj_id: t for t in targets}
        meshes: dict[int, Mesh] = {}
        for target in targets:
            meshes |= {target.obj_id: target.mesh, **target.shapes, **target.tables}
        self._balls = Balls(meshes)
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

    def frame(self, scene_id: int, im_id: int) -> Frame:
        """Draw and render one image of the plan.

        Raises:
            ConfigError: No acceptable scene is found with this configuration.
        """
        view = self.view(scene_id, im_id)
        scene = view.scene(self.camera, self.config.samples)
        rendered = self._engine.render(scene)
        margin = (self.camera.width_px, self.camera.height_px)
        labelled = scene.objects[: len(view.layout.labelled)]
        masks = [self._silhouette(placed) for placed in labelled]
        inside = [mask[margin[1] : 2 * margin[1], margin[0] : 2 * margin[0]] for mask in masks]
        return Frame(
            rgb=_compose(rendered, scene, view),
            depth_m=rendered.depth_m,
            truths=[GroundTruth(obj_id=o.mesh_key, T_cam_obj=o.T_cam_obj) for o in labelled],
            masks=masks,
            # Blender's index layer and the rasteriser's silhouette differ by single pixels: a part stays in its whole
            masks_visib=[(rendered.index == i) & mask for i, mask in enumerate(inside)],
            mask_origin_px=margin,
            T_cam_world=view.T_cam_ref,
        )

    def view(self, scene_id: int, im_id: int) -> View:
        """What an image of the plan shows.

        Raises:
            ConfigError: No acceptable scene is found with this configuration.
        """
        if self.plan.sequences is not None:
            return self._motion(scene_id).view(im_id)
        if self.plan.frames_per_scene is not None:
            return self._view_of_shared(scene_id, im_id)
        return self._single(im_id)

    def _single(self, index: int) -> View:
        """A training pair's scene of its own, with further objects in it."""
        purpose = _PURPOSES[self.plan.split]
        for attempt in range(MAX_ATTEMPTS):
            base = scene_draw.draw_scene(self.config, self.targets, self.assets, purpose, index, attempt)
            base = scene_draw.slide_in(base, self.config, self._share_visible)
            view = View(layout=draw_layout(self.config, self.targets, base, together=False), T_cam_ref=np.eye(4))
            if self._is_good(view):
                return view
        raise self._nothing(f"image {index}")

    def _shared_layout(self, scene_id: int) -> Layout:
        purpose = _PURPOSES[self.plan.split]
        base = scene_draw.draw_scene(self.config, self.targets, self.assets, purpose, scene_id, 0)
        return draw_layout(self.config, self.targets, base, together=True)

    def _view_of_shared(self, scene_id: int, im_id: int) -> View:
        layout, purpose = self._layout(scene_id), _PURPOSES[self.plan.split]
        for attempt in range(MAX_ATTEMPTS):
            rng = stream(self.config.seed, purpose, Subject.CAMERA, scene_id, im_id, attempt)
            number, T_cam_ref = draw_camera(rng, self.config, self._by_id, layout)
            style, render_seed = frame_sensor(rng, self.config)
            behind = layout.background
            if behind.kind != "environment":  # each camera has its own; a panorama is the same place for all
                behind = replace(behind, seed=child_seed(rng))
            own = replace(layout, sensor=style, render_seed=render_seed, background=behind)
            view = View(layout=own, T_cam_ref=T_cam_ref, looks_at=number)
            if self._is_clear(view) and self._is_good(view):
                return view
        raise self._nothing(f"scene {scene_id}, image {im_id}")

    def _accepted_motion(self, scene_id: int) -> Motion:
        purpose = _SEQUENCE_PURPOSES[self.plan.split]
        last = self._lengths[scene_id] - 1
        moments = sorted({round(last * i / (_KEY_MOMENTS - 1)) for i in range(_KEY_MOMENTS)})
        step = max(1, round(self.config.sequence.fps / 10))
        for attempt in range(MAX_ATTEMPTS):
            base = scene_draw.draw_scene(self.config, self.targets, self.assets, purpose, scene_id, attempt)
            # shapes stand between the object and one camera only: here one passes instead
            layout = draw_layout(self.config, self.targets, replace(base, front=()), together=True)
            motion = Motion(self.config, self._by_id, layout, base.address)
            if not all(self._is_clear(motion.view(i)) for i in (*range(0, last, step), last)):
                continue
            if sum(self._is_good(motion.view(i)) for i in moments) >= _SEEN_AT * len(moments):
                return motion
        raise self._nothing(f"sequence {scene_id}")

    def _is_clear(self, view: View) -> bool:
        """Whether nothing but a table is near the camera."""
        layout = view.layout
        target = self._by_id[layout.labelled[view.looks_at].mesh_key]
        things = [o for o in (*layout.labelled, *layout.others) if o.mesh_key not in self._tables]
        return clearance_m(self._balls, things, view.T_cam_ref) >= _NEAREST * target.distance_m[0]

    @property
    def _tables(self) -> set[int]:
        return {key for target in self.targets for key in target.tables}

    def _is_good(self, view: View) -> bool:
        """Whether what the image is about is large, inside and visible enough."""
        placed = [
            replace(o, T_cam_obj=view.T_cam_ref @ o.T_cam_obj) for o in (*view.layout.labelled, *view.layout.others)
        ]
        first = placed.pop(view.looks_at)
        target = self._by_id[first.mesh_key]
        box = scene_draw.target_box(target, self.camera, first.T_cam_obj)
        inside = scene_draw.share_inside(box, self.camera)
        if inside < self.config.view.min_inside:
            return False
        area_px, visible = self._glance(first, placed)
        # the same measure as for training pairs, whose patches show the object smaller
        area_px *= (self.config.patch_px / target.window_side_px) ** 2
        return area_px >= self.config.window.min_area_px and visible * inside >= self.config.occluders.min_visible

    def _share_visible(self, draw: scene_draw.SceneDraw) -> float:
        first = SceneObject(mesh_key=draw.target.obj_id, T_cam_obj=draw.T_cam_obj)
        return self._glance(first, draw.others)[1]

    def _glance(self, first: SceneObject, others: Sequence[SceneObject]) -> tuple[float, float]:
        """An object's area in image pixels and its visible share, from a small render."""
        x0, y0, x1, y1 = scene_draw.target_box(self._by_id[first.mesh_key], self.camera, first.T_cam_obj)
        window = centred((x0 + x1) / 2, (y0 + y1) / 2, max(x1 - x0, y1 - y0))
        K = crop_K(self.camera.K, window, _GLANCE_PX)
        instances = [Instance(obj_id=o.mesh_key, T_cam_obj=o.T_cam_obj) for o in (first, *others)]
        alone = self._rasteriser.render_scene(instances[:1], K, _GLANCE_PX, _GLANCE_PX, rgb=False).instance == 0
        seen = self._rasteriser.render_scene(instances, K, _GLANCE_PX, _GLANCE_PX, rgb=False).instance == 0
        area_px = float(alone.sum()) * (window.side_px / _GLANCE_PX) ** 2
        return area_px, float(seen.sum() / max(alone.sum(), 1))

    def _silhouette(self, placed: SceneObject) -> Bool[Array, "h3 w3"]:
        """An object alone on a canvas of three images' width and height; only the part it may cover is drawn."""
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

    def _nothing(self, where: str) -> ConfigError:
        return ConfigError(
            f"{where}: {MAX_ATTEMPTS} draws in a row are unusable: the object that the camera looks at is hidden, too "
            "small or out of the image, or something is too near to the camera; lower frames.objects, occluders.front, "
            "occluders.min_visible, view.position_jitter or window.min_area_px, or raise distance.min"
        )


def _compose(rendered: RenderedScene, scene: Scene, view: View) -> UInt8[Array, "h w 3"]:
    """Lay the render over the background in linear light and expose it."""
    height, width = rendered.alpha.shape
    if view.background_shift_px is None or scene.background.kind == "environment":
        behind = background.behind(scene, width, height)
    else:
        behind = _shifted(view, width, height)
    alpha = rendered.alpha[..., None]
    linear = rendered.rgb_linear * alpha + sensor.linear_from_display(behind) * (1 - alpha)
    return sensor.expose(linear, scene.sensor)


def _shifted(view: View, width: int, height: int) -> UInt8[Array, "h w 3"]:
    """A part of a background that is larger than the image, moved by fractions of a pixel."""
    assert view.background_shift_px is not None
    reach_x, reach_y = view.background_reach_px
    whole = _canvas(view.layout.background, width + 2 * reach_x, height + 2 * reach_y)
    dx, dy = view.background_shift_px
    source = np.array([[1.0, 0.0, reach_x - dx], [0.0, 1.0, reach_y - dy]])
    flags = cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP
    return np.asarray(cv2.warpAffine(whole, source, (width, height), flags=flags, borderMode=cv2.BORDER_REPLICATE))


@lru_cache(maxsize=2)
def _canvas(behind: Background, width: int, height: int) -> UInt8[Array, "h w 3"]:
    """All images of a sequence are parts of one canvas."""
    return background.draw(behind, width, height)
