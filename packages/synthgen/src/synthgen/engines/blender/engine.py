"""The Blender engine: plain scenes in, layers out."""

import weakref
from collections.abc import Mapping

import numpy as np
from jaxtyping import Float
from posecore.camera import Camera
from posecore.errors import ConfigError, RenderError
from posecore.mesh import Mesh

try:
    import bpy
except ImportError as error:
    raise RenderError(
        f"Blender's module bpy cannot be imported ({error}); install bpy 4.5 (Python 3.11) and the system libraries "
        "it names, or use the engine raster"
    ) from error

from synthgen.engine import RenderedScene
from synthgen.engines.blender import scratch
from synthgen.engines.blender.camera import (
    SENSOR_WIDTH_MM,
    USUAL_CLIP_M,
    Region,
    clip_range_m,
    lens_for,
    occupied_region,
)
from synthgen.engines.blender.exr import read_channels
from synthgen.engines.blender.lights import Lamps, World
from synthgen.engines.blender.materials import INDEX_AOV
from synthgen.engines.blender.objects import Props
from synthgen.engines.blender.quiet import blender_output_caught
from synthgen.engines.blender.settings import ENGINE_IDS, set_common, set_cycles, set_eevee
from synthgen.image.hdri import with_lamps, with_suns
from synthgen.names import Device
from synthgen.scene import Scene

Channels = dict[str, Float[np.ndarray, "h w"]]

INDEX_CHANNELS = {"cycles": "IndexOB.X", "eevee": f"{INDEX_AOV}.X"}


class BlenderEngine:
    """Renders scenes in one persistent Blender scene whose datablocks are reused.

    Depth and index are sampled once, at the pixels' centres: by Cycles with the first of its samples, by EEVEE in a
    render of their own, since its samples all count for every layer. Near and far plane are around the scene's objects
    (`camera.clip_range_m`). Several engines may live in one process; a process that has one must not fork.

    Args:
        name: 'cycles' or 'eevee'.
        threads: Threads to render with, 0 for all cores. The result is the same for any number.
        device: Device of Cycles; 'auto' takes the first available one of OptiX, CUDA and the CPU.

    Raises:
        ConfigError: Another name.
        RenderError: No such device.
    """

    def __init__(self, name: str, *, threads: int = 0, device: Device = "cpu") -> None:
        if name not in ENGINE_IDS:
            raise ConfigError(f"engine: got {name!r}, expected one of {', '.join(ENGINE_IDS)}")
        self.name = name
        self._scene = bpy.data.scenes.new(f"synthgen_{name}")
        set_common(self._scene, engine=name, threads=threads)
        if name == "cycles":
            set_cycles(self._scene, device=device)
        else:
            set_eevee(self._scene)
        self._camera = bpy.data.objects.new("camera", bpy.data.cameras.new("camera"))
        self._camera.data.sensor_fit = "HORIZONTAL"
        self._camera.data.sensor_width = SENSOR_WIDTH_MM
        self._scene.collection.objects.link(self._camera)
        self._scene.camera = self._camera
        self._props = Props(self._scene.collection)
        self._lamps = Lamps(self._scene.collection)
        self._world = World(self._scene)
        # In memory: a write to a disk costs more than a render of few samples.
        folder, remove_folder = scratch.make_folder()
        self._remove_folder = weakref.finalize(self, remove_folder)
        self._file = folder / "layers.exr"
        self._scene.render.filepath = str(self._file)

    def load(self, meshes: Mapping[int, Mesh]) -> None:
        """Load meshes under their keys; a mesh with a loaded key replaces the earlier mesh.

        Raises:
            MeshError: A mesh has no faces, or its faces do not fit its vertices.
        """
        self._props.load(meshes)

    def render(self, scene: Scene) -> RenderedScene:
        """Render `scene.region_px`.

        Raises:
            RenderError: A mesh key is not loaded, or Blender failed.
        """
        # EEVEE's light from a world casts no shadow.
        scene = with_suns(scene) if self.name == "cycles" else with_lamps(scene)
        self._props.set(scene.objects)
        self._lamps.set(scene.lights)
        self._world.set(scene.ambient_rgb, scene.environment)
        corners_cam_m = self._props.corners(scene.objects)
        clip_m = clip_range_m(corners_cam_m, USUAL_CLIP_M if self.name == "cycles" else None)
        occupied = occupied_region(scene.camera, scene.region_px, corners_cam_m, clip_m[0])
        layers = _empty(scene.region_px)
        if occupied is None:
            return layers
        self._point_camera(scene.camera, occupied)
        self._camera.data.clip_start, self._camera.data.clip_end = clip_m
        if self.name == "cycles":
            self._scene.cycles.samples = scene.samples
            self._scene.cycles.seed = scene.render_seed
            colour = labels = self._render()
        else:
            self._scene.eevee.taa_render_samples = 1
            colour = labels = self._render()
            if scene.samples > 1:
                self._scene.eevee.taa_render_samples = scene.samples
                colour = self._render()
        number = labels[INDEX_CHANNELS[self.name]]
        _paste(layers, colour, labels["Depth.Z"], number, scene.region_px, occupied)
        return layers

    def close(self) -> None:
        """Remove the scene and everything made for it from Blender. Closing twice does nothing."""
        if not self._remove_folder.alive:
            return
        self._remove_folder()
        self._props.remove()
        self._lamps.remove()
        self._world.remove()
        bpy.data.cameras.remove(self._camera.data)
        bpy.data.scenes.remove(self._scene)

    def _point_camera(self, camera: Camera, region_px: Region) -> None:
        lens = lens_for(camera, region_px)
        render, settings = self._scene.render, self._camera.data
        render.resolution_x, render.resolution_y = lens.width_px, lens.height_px
        render.pixel_aspect_x, render.pixel_aspect_y = lens.pixel_aspect_x, lens.pixel_aspect_y
        settings.lens, settings.shift_x, settings.shift_y = lens.lens_mm, lens.shift_x, lens.shift_y

    def _render(self) -> Channels:
        # Without the old file, a render that writes nothing cannot return the layers of the previous one.
        self._file.unlink(missing_ok=True)
        with blender_output_caught(f"{self.name}: Blender failed to render"):
            bpy.ops.render.render(scene=self._scene.name, write_still=True)
        return read_channels(self._file)


def _empty(region_px: Region) -> RenderedScene:
    _, _, width, height = region_px
    return RenderedScene(
        rgb_linear=np.zeros((height, width, 3), np.float32),
        alpha=np.zeros((height, width), np.float32),
        depth_m=np.zeros((height, width), np.float32),
        index=np.full((height, width), -1, np.int16),
    )


def _paste(
    layers: RenderedScene,
    colour: Channels,
    depth: Float[np.ndarray, "h w"],
    number: Float[np.ndarray, "h w"],
    region_px: Region,
    occupied_px: Region,
) -> None:
    """Write Blender's channels into the layers, in the contract's units.

    Args:
        layers: Layers of the whole region, empty.
        colour: The Combined pass: premultiplied by alpha.
        depth: Camera z; anything where nothing was hit.
        number: Object index + 1; 0 where nothing was hit.
        region_px: Region of the layers.
        occupied_px: Region of the channels, inside `region_px`; Blender's smallest picture may be larger.
    """
    x0, y0, width, height = occupied_px
    left, top = x0 - region_px[0], y0 - region_px[1]
    source, target = np.s_[:height, :width], np.s_[top : top + height, left : left + width]
    index = np.rint(number[source]).astype(np.int16) - np.int16(1)
    alpha = np.clip(colour["Combined.A"][source], 0.0, 1.0)
    rgb = np.stack([colour[f"Combined.{channel}"][source] for channel in "RGB"], axis=-1)
    np.divide(rgb, alpha[..., None], out=layers.rgb_linear[target], where=alpha[..., None] > 0.0)
    layers.alpha[target], layers.index[target] = alpha, index
    layers.depth_m[target] = np.where(index >= 0, depth[source], np.float32(0.0))
