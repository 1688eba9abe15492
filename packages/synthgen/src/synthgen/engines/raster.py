"""The `raster` engine: scenes drawn by posecore's rasteriser, for drafts, tests and machines without Blender."""

import math
from collections.abc import Mapping
from dataclasses import replace

import cv2
import numpy as np
from jaxtyping import Float, Int, UInt8
from posecore.camera import back_project, crop_K
from posecore.errors import RenderError
from posecore.mesh import Mesh
from posecore.raster import (
    MAX_LIGHTS,
    MAX_PICTURE_INSTANCES,
    DirectionalLight,
    Instance,
    Rasteriser,
    Shading,
)
from posecore.se3 import apply, inverse
from posecore.window import Window

from synthgen.engine import RenderedScene
from synthgen.image import pattern
from synthgen.image.hdri import with_lamps
from synthgen.image.sensor import linear_from_display
from synthgen.scene import Light, Material, Scene, Vector, with_origins_at

_SUPERSAMPLING = 2
_WHITE_KEY = -1_000_000_000  # key of a mesh's white copy, drawn where a material replaces its colours


class RasterEngine:
    """Engine over `posecore.raster`: no shadows, no reflections, lamps as if at infinity."""

    name = "raster"

    def __init__(self) -> None:
        self._centers_m: dict[int, Float[np.ndarray, "3"]] = {}
        self._rasteriser: Rasteriser | None = None

    def load(self, meshes: Mapping[int, Mesh]) -> None:
        """Load meshes under their keys; patterns and light are about their centres."""
        if self._rasteriser is None:
            self._rasteriser = Rasteriser({})
        for key, mesh in meshes.items():
            self._centers_m[key] = mesh.center_m
            centred = mesh.with_origin_at(mesh.center_m)
            self._rasteriser.add(key, centred)
            self._rasteriser.add(_WHITE_KEY + key, centred.recoloured((255, 255, 255)))

    def render(self, scene: Scene) -> RenderedScene:
        """Render `scene.region_px`: colour with 2 x 2 samples per pixel, depth and index at the pixel centres."""
        if self._rasteriser is None:
            raise RenderError("the raster engine has no meshes; call load first")
        scene = replace(scene, objects=with_origins_at(scene.objects, self._centers_m))
        x0, y0, width, height = scene.region_px
        instances = [
            Instance(
                obj_id=o.mesh_key if o.material.base_rgb is None else _WHITE_KEY + o.mesh_key,
                T_cam_obj=o.T_cam_obj,
                tint=(o.material.base_rgb if o.material.pattern is None else None) or (1.0, 1.0, 1.0),
            )
            for o in scene.objects
        ]
        scene = with_lamps(scene)
        K = crop_K(scene.camera.K, Window(x0_px=x0, y0_px=y0, side_px=1.0), 1)
        fine_K = np.diag([_SUPERSAMPLING, _SUPERSAMPLING, 1.0]) @ K
        size = (width * _SUPERSAMPLING, height * _SUPERSAMPLING)
        shading = _shading(scene)
        depth_m = None
        if any(o.material.pattern for o in scene.objects) or len(instances) > MAX_PICTURE_INSTANCES:
            layers = self._rasteriser.render_scene(instances, fine_K, *size, shading=shading)
            rgb, index, depth_m = layers.rgb, layers.instance, layers.depth_m
        else:  # only a pattern depends on the depth of each sample
            rgb, index = self._rasteriser.render_picture(
                instances, fine_K, *size, shading=shading, samples=_SUPERSAMPLING
            )
        assert rgb is not None
        _recolour(rgb, index, depth_m, scene, fine_K)
        exact = self._rasteriser.render_scene(instances, K, width, height, rgb=False)
        rgb_linear, alpha = _resolve(linear_from_display(rgb), index >= 0)
        return RenderedScene(
            rgb_linear=rgb_linear, alpha=alpha, depth_m=exact.depth_m, index=exact.instance.astype(np.int16)
        )

    def close(self) -> None:
        """Release GPU memory."""
        if self._rasteriser is not None:
            self._rasteriser.close()
            self._rasteriser = None


def _shading(scene: Scene) -> Shading:
    """Lamps as directional lights. The shader multiplies display values, so linear factors are converted to them."""
    target = scene.objects[0].T_cam_obj[:3, 3]
    lamps = sorted(((_irradiance(light, target), light) for light in scene.lights), key=lambda pair: -pair[0])
    lights = tuple(
        DirectionalLight(direction_cam=_direction(light, target), rgb=_display_factor(light.rgb, irradiance / math.pi))
        for irradiance, light in lamps[:MAX_LIGHTS]
    )
    ambient = _display_factor(scene.ambient_rgb, 1.0)
    if not lights:  # the shader takes an empty list for a headlight
        return Shading(ambient=sum(ambient) / 3, diffuse=0.0)
    return Shading(ambient=sum(ambient) / 3, diffuse=1.0, lights=lights)


def _irradiance(light: Light, at_cam_m: Float[np.ndarray, "3"]) -> float:
    """Irradiance of a surface that faces the lamp, W/m^2."""
    if light.kind == "sun":
        return light.strength
    d2 = float(np.sum((np.array(light.position_cam_m) - at_cam_m) ** 2))
    return light.strength / (d2 * math.pi * (4.0 if light.kind == "point" else 1.0))


def _direction(light: Light, at_cam_m: Float[np.ndarray, "3"]) -> Vector:
    d = np.array(light.direction_cam) if light.kind == "sun" else np.array(light.position_cam_m) - at_cam_m
    x, y, z = d / max(float(np.linalg.norm(d)), 1e-12)
    return (float(x), float(y), float(z))


def _display_factor(rgb: Vector, scale: float) -> Vector:
    r, g, b = (max(c * scale, 0.0) ** (1 / 2.2) for c in rgb)
    return (r, g, b)


def _recolour(
    rgb: UInt8[np.ndarray, "h w 3"],
    index: Int[np.ndarray, "h w"],
    depth_m: Float[np.ndarray, "h w"] | None,
    scene: Scene,
    K: Float[np.ndarray, "3 3"],
) -> None:
    """Apply each material's pattern, or its hue, saturation and value, to the pixels of its object, in place."""
    for i, placed in enumerate(scene.objects):
        material = placed.material
        inside = index == i
        if not inside.any():  # hidden by others, or out of sight
            continue
        if material.base_rgb is None and _changes_colour(material):
            rgb[inside] = _shift(rgb[inside], material)
        elif material.pattern is not None:
            assert depth_m is not None
            v, u = np.nonzero(inside)
            p_cam = back_project(K, np.stack([u, v], -1) + 0.5, depth_m[v, u])
            rgb[v, u] = pattern.paint(rgb[v, u], material, apply(inverse(placed.T_cam_obj), p_cam))


def _changes_colour(material: Material) -> bool:
    return (material.hue_shift, material.saturation, material.value) != (0.0, 1.0, 1.0)


def _shift(rgb: UInt8[np.ndarray, "n 3"], material: Material) -> UInt8[np.ndarray, "n 3"]:
    hsv = cv2.cvtColor(rgb[None].astype(np.float32) / np.float32(255.0), cv2.COLOR_RGB2HSV)
    hsv[..., 0] = (hsv[..., 0] + np.float32(360.0 * material.hue_shift)) % np.float32(360.0)
    hsv[..., 1] = np.clip(hsv[..., 1] * np.float32(material.saturation), 0.0, 1.0)
    hsv[..., 2] = np.clip(hsv[..., 2] * np.float32(material.value), 0.0, 1.0)
    return np.asarray((cv2.cvtColor(hsv, cv2.COLOR_HSV2RGB)[0] * 255.0 + 0.5).astype(np.uint8))


def _resolve(
    rgb: Float[np.ndarray, "h2 w2 3"], hit: np.ndarray
) -> tuple[Float[np.ndarray, "h w 3"], Float[np.ndarray, "h w"]]:
    """Average the fine samples of a pixel: straight colour and coverage. Samples that hit nothing are black."""
    size = (hit.shape[1] // _SUPERSAMPLING, hit.shape[0] // _SUPERSAMPLING)
    alpha = cv2.resize(hit.astype(np.float32), size, interpolation=cv2.INTER_AREA)
    premultiplied = cv2.resize(rgb, size, interpolation=cv2.INTER_AREA)
    return premultiplied / np.maximum(alpha, np.float32(0.25))[..., None], alpha
