"""The GL rasteriser: colour, camera z and instance of meshes at given poses, on EGL (a GPU, or software GL).

It draws the hypothesis at inference and in training, silhouettes for the metrics, and whole scenes as the `raster`
engine. Pixels are sampled at their centres (+0.5), without antialiasing, so mask and depth are exact labels.
`posecore.raster.reference` is the reference implementation that tests hold this against.
"""

import itertools
from collections.abc import Callable, Mapping, Sequence
from functools import wraps
from types import TracebackType
from typing import Any, Concatenate, Literal, ParamSpec, TypeVar

import moderngl
import numpy as np
from jaxtyping import Float, Int, UInt8

from posecore import se3
from posecore.errors import RenderError
from posecore.mesh import Mesh
from posecore.raster.clip import clip_from_cam
from posecore.raster.context import thread_device
from posecore.raster.scene import HEADLIGHT, MAX_LIGHTS, Instance, Layers, SceneLayers, Shading
from posecore.raster.selection import is_in_image, level_number
from posecore.raster.shaders import (
    DEPTH_FRAGMENT_SHADER,
    DEPTH_VERTEX_SHADER,
    FRAGMENT_SHADER,
    LABEL_FRAGMENT_SHADER,
    VERTEX_SHADER,
)

P, R = ParamSpec("P"), TypeVar("R")
Kind = Literal["all", "picture", "labels", "depth"]
"""Attachments of a framebuffer: colour with camera z and instance; colour with the instance as its alpha; camera z and
instance; camera z."""
_FORMATS: dict[Kind, tuple[tuple[int, str], ...]] = {
    "all": ((4, "f1"), (2, "f4")),
    "picture": ((4, "f1"),),
    "labels": ((2, "f4"),),
    "depth": ((1, "f4"),),
}
MAX_PICTURE_INSTANCES = 255
MAX_IMAGES = 64
"""Framebuffers of one image size."""
MAX_PIXELS = 2048 * 2048
"""Pixels in all framebuffers of one image size."""
MAX_SIZES = 8
"""Image sizes whose framebuffers are kept; the oldest goes."""


def _drawing(
    method: "Callable[Concatenate[Rasteriser, P], R]",
) -> "Callable[Concatenate[Rasteriser, P], R]":
    """A method that runs with the context current."""

    @wraps(method)
    def wrapped(self: "Rasteriser", *args: P.args, **settings: P.kwargs) -> R:
        with self._device.current():
            result: R = method(self, *args, **settings)
        return result

    return wrapped


class Rasteriser:
    """Draws meshes at poses; a context manager. One per process; any thread may use it, one at a time.

    Args:
        meshes: Meshes by object id; uploaded at their first use.

    Raises:
        RenderError: No EGL device (neither a GPU nor Mesa's software renderer).
    """

    def __init__(self, meshes: Mapping[int, Mesh]) -> None:
        self._meshes = dict(meshes)
        self._device = thread_device()
        self._context = self._device.context
        with self._device.current():
            self._program: Any = self._context.program(vertex_shader=VERTEX_SHADER, fragment_shader=FRAGMENT_SHADER)
            self._label_program: Any = self._context.program(
                vertex_shader=DEPTH_VERTEX_SHADER, fragment_shader=LABEL_FRAGMENT_SHADER
            )
            self._depth_program: Any = self._context.program(
                vertex_shader=DEPTH_VERTEX_SHADER, fragment_shader=DEPTH_FRAGMENT_SHADER
            )
            self._blank = self._context.texture((1, 1), 3, b"\xff\xff\xff")
        self._arrays: dict[int, dict[int, dict[Kind, Any]]] = {}
        self._textures: dict[int, moderngl.Texture] = {}
        self._targets: dict[tuple[tuple[int, int], Kind], list[moderngl.Framebuffer]] = {}

    def __enter__(self) -> "Rasteriser":
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    @property
    def device(self) -> str:
        """The GL renderer's own name."""
        with self._device.current():
            return str(self._context.info["GL_RENDERER"])

    @property
    def is_software(self) -> bool:
        """Whether the processor draws, not a GPU."""
        return any(name in self.device.lower() for name in ("llvmpipe", "softpipe", "swrast"))

    @_drawing
    def add(self, obj_id: int, mesh: Mesh) -> None:
        """Add a mesh, or replace the one of this id."""
        self._release(obj_id)
        self._meshes[obj_id] = mesh

    @_drawing
    def close(self) -> None:
        """Free everything; nothing can be drawn after that."""
        for held in (self._program, self._label_program, self._depth_program, self._blank):
            held.release()
        for obj_id in list(self._arrays):
            self._release(obj_id)
        for target in itertools.chain.from_iterable(self._targets.values()):
            self._free(target)
        self._targets.clear()

    @_drawing
    def render(
        self,
        obj_id: int | Int[np.ndarray, " b"],
        K: Float[np.ndarray, "*k 3 3"],
        T_cam_obj: Float[np.ndarray, "b 4 4"],
        width_px: int,
        height_px: int,
        *,
        rgb: bool = True,
        shading: Shading = HEADLIGHT,
    ) -> Layers:
        """Draw a batch of poses, each in an image of its own.

        Args:
            obj_id: Which mesh, one for all or one per pose.
            K: One camera matrix for all, or one per pose (as crops have).
            T_cam_obj: Poses, metres.
            width_px: Width of each image.
            height_px: Height of each image.
            rgb: Whether colours are read back.
            shading: Lights.
        """
        n = len(T_cam_obj)
        K = np.broadcast_to(np.asarray(K, np.float64), (n, 3, 3))
        obj_ids = np.broadcast_to(obj_id, n)
        colours = np.empty((n, height_px, width_px, 3), np.uint8) if rgb else None
        depth = np.empty((n, height_px, width_px), np.float32)
        if rgb:
            self._set_shading(shading)
        size = (width_px, height_px)
        kind: Kind = "all" if rgb else "depth"
        for start in range(0, n, _images_at_once(size)):
            targets = []
            for i in range(start, min(start + _images_at_once(size), n)):
                targets.append(self._begin(size, kind, i - start))
                instance = Instance(obj_id=int(obj_ids[i]), T_cam_obj=T_cam_obj[i])
                self._draw(instance, 0, K[i], size, self._depth_range_m([instance]), kind)
            for i, target in enumerate(targets, start):  # all are drawn before the first is read
                depth[i] = self._read_floats(target, size, *((1, 2) if rgb else (0, 1)))[..., 0]
                if colours is not None:
                    colours[i] = self._read_rgb(target, size)
        return Layers(rgb=colours, depth_m=depth)

    @_drawing
    def render_scene(
        self,
        instances: Sequence[Instance],
        K: Float[np.ndarray, "3 3"],
        width_px: int,
        height_px: int,
        *,
        rgb: bool = True,
        shading: Shading = HEADLIGHT,
    ) -> SceneLayers:
        """Draw several objects into one image."""
        size = (width_px, height_px)
        target = self._draw_scene(instances, K, size, "all" if rgb else "labels", shading)
        colours, layer = (
            self._read_rgb(target, size).copy() if rgb else None,
            self._read_floats(target, size, int(rgb), 2),
        )
        return SceneLayers(rgb=colours, depth_m=layer[..., 0].copy(), instance=layer[..., 1].astype(np.int16) - 1)

    @_drawing
    def render_picture(
        self,
        instances: Sequence[Instance],
        K: Float[np.ndarray, "3 3"],
        width_px: int,
        height_px: int,
        *,
        shading: Shading = HEADLIGHT,
        samples: int = 1,
    ) -> tuple[UInt8[np.ndarray, "h w 3"], Int[np.ndarray, "h w"]]:
        """Colours and instances of `render_scene`, without depths, of which a large picture has many bytes.

        Args:
            instances: Objects.
            K: Camera matrix.
            width_px: Width.
            height_px: Height.
            shading: Lights.
            samples: Pixels along a side that are averaged to one afterwards; levels of detail are chosen for that one.

        Raises:
            RenderError: More than 255 instances.
        """
        if len(instances) > MAX_PICTURE_INSTANCES:
            raise RenderError(f"a picture of {len(instances)} objects, expected at most {MAX_PICTURE_INSTANCES}")
        size = (width_px, height_px)
        target = self._draw_scene(instances, K, size, "picture", shading, samples)
        data = target.read(viewport=(0, 0, *size), components=4, attachment=0, alignment=1)
        layers = np.frombuffer(data, np.uint8).reshape(height_px, width_px, 4)
        return np.ascontiguousarray(layers[..., :3]), layers[..., 3].astype(np.int16) - 1

    def _draw_scene(
        self,
        instances: Sequence[Instance],
        K: Float[np.ndarray, "3 3"],
        size: tuple[int, int],
        kind: Kind,
        shading: Shading,
        samples: int = 1,
    ) -> moderngl.Framebuffer:
        self._set_shading(shading)
        target = self._begin(size, kind)
        depth_range_m = self._depth_range_m(instances)  # one for all that share a buffer
        for index, instance in enumerate(instances):
            self._draw(instance, index + 1, np.asarray(K, np.float64), size, depth_range_m, kind, samples)
        return target

    def _set_shading(self, shading: Shading) -> None:
        program, lights = self._program, shading.lights
        program["ambient"].value, program["diffuse"].value = shading.ambient, shading.diffuse
        program["n_lights"].value = len(lights)
        padding = [(0.0, 0.0, 1.0)] * (MAX_LIGHTS - len(lights))
        program["light_direction"].value = [light.direction_cam for light in lights] + padding
        program["light_rgb"].value = [light.rgb for light in lights] + padding

    def _begin(self, size: tuple[int, int], kind: Kind, index: int = 0) -> moderngl.Framebuffer:
        """A cleared framebuffer, the one that is drawn to from now on.

        Each image of a batch has a framebuffer of its own. In a shared one the viewport's offset would move the last
        bits of every interpolated value, so that a pose's render would depend on its index in the batch.
        """
        if (size, kind) not in self._targets and len(self._targets) >= MAX_SIZES:
            for target in self._targets.pop(next(iter(self._targets))):
                self._free(target)
        targets = self._targets.setdefault((size, kind), [])
        if index == len(targets):
            attachments = [self._context.texture(size, n, dtype=dtype) for n, dtype in _FORMATS[kind]]
            targets.append(self._context.framebuffer(attachments, self._context.depth_texture(size)))
        targets[index].use()
        targets[index].clear(0.0, 0.0, 0.0, 0.0)
        return targets[index]

    def _draw(
        self,
        instance: Instance,
        label: int,
        K: Float[np.ndarray, "3 3"],
        size: tuple[int, int],
        depth_range_m: tuple[float, float],
        kind: Kind,
        samples: int = 1,
    ) -> None:
        mesh = self._mesh(instance.obj_id)
        T = np.asarray(instance.T_cam_obj, np.float64)
        center_z_m, near_m = self._center_z_m(instance), depth_range_m[0]
        if center_z_m + mesh.diameter_m <= near_m or not is_in_image(mesh, K, T, *size):
            return
        level = level_number(mesh, np.diag([1 / samples, 1 / samples, 1.0]) @ K, T)
        arrays = self._array(instance.obj_id, mesh, level)
        # Half of a closed surface's faces are never seen; when the near plane opens it, its inside is.
        is_closed = mesh.levels[level - 1].is_closed if level else mesh.is_closed
        if is_closed and center_z_m - mesh.diameter_m > near_m:
            self._context.enable(moderngl.CULL_FACE)
        else:
            self._context.disable(moderngl.CULL_FACE)
        array = arrays[kind]
        program = array.program
        program["clip_from_cam"].write(clip_from_cam(K, *size, *depth_range_m).T.astype("f4").tobytes())
        program["cam_from_obj"].write(se3.with_origin_at(T, mesh.center_m).T.astype("f4").tobytes())
        if kind != "depth":
            program["instance"].value = float(label)
        if kind in ("all", "picture"):
            program["tint"].value = instance.tint
            texture = self._textures.get(instance.obj_id)
            program["textured"].value = texture is not None
            program["coloured"].value = mesh.vertex_rgb is not None
            (texture or self._blank).use(0)
        array.render(moderngl.TRIANGLES)

    def _read_rgb(self, target: moderngl.Framebuffer, size: tuple[int, int]) -> UInt8[np.ndarray, "h w 3"]:
        width, height = size
        data = target.read(viewport=(0, 0, width, height), components=3, attachment=0, alignment=1)
        return np.frombuffer(data, np.uint8).reshape(height, width, 3)

    def _read_floats(
        self, target: moderngl.Framebuffer, size: tuple[int, int], attachment: int, components: int
    ) -> Float[np.ndarray, "h w c"]:
        width, height = size
        viewport = (0, 0, width, height)
        data = target.read(viewport=viewport, components=components, attachment=attachment, dtype="f4", alignment=1)
        return np.frombuffer(data, np.float32).reshape(height, width, components)

    def _center_z_m(self, instance: Instance) -> float:
        """Camera z of the mesh's centre. No vertex is a diameter from it."""
        T = instance.T_cam_obj
        return float(T[2, :3] @ self._mesh(instance.obj_id).center_m + T[2, 3])

    def _depth_range_m(self, instances: Sequence[Instance]) -> tuple[float, float]:
        """Near and far plane: around all instances, no nearer than a twentieth of the depth of the nearest centre.

        A 24-bit depth buffer keeps the order of surfaces that are `z^2 (far - near) / (near far 2^24)` apart: 1.2e-7
        diameters for one object, 1.2e-6 z for one that is 20 times as far as the nearest. Coordinates are float32: 6e-8
        z.
        """
        depths = [(self._center_z_m(instance), self._mesh(instance.obj_id).diameter_m) for instance in instances]
        farthest_m = 1.01 * max((z_m + diameter_m for z_m, diameter_m in depths), default=1.0)
        in_front = [(z_m, diameter_m) for z_m, diameter_m in depths if z_m > 0]
        if not in_front:
            return 1e-3, max(1.0, farthest_m)  # a large object still reaches to the front
        nearest_m = 0.99 * min(z_m - diameter_m for z_m, diameter_m in in_front)
        return max(nearest_m, 0.05 * min(z_m for z_m, _ in in_front)), farthest_m

    def _mesh(self, obj_id: int) -> Mesh:
        if obj_id not in self._meshes:
            raise RenderError(f"object {obj_id} has no mesh here; there are meshes for {sorted(self._meshes)}")
        return self._meshes[obj_id]

    def _array(self, obj_id: int, mesh: Mesh, number: int) -> dict[Kind, Any]:
        """A level of the mesh as the programs take it, its origin at the centre: with colours, or positions alone."""
        arrays = self._arrays.setdefault(obj_id, {})
        if number in arrays:
            return arrays[number]
        drawn = mesh.level(number)
        textured = drawn.uv is not None and drawn.texture_rgb is not None
        uv = np.zeros((len(drawn.vertices_m), 2)) if drawn.uv is None else drawn.uv
        colours = drawn.colours if drawn.vertex_rgb is None else drawn.vertex_rgb  # a factor where there is a texture
        # About the centre: float32 has no digits to spare for an origin that lies metres off.
        about_center_m = drawn.vertices_m - mesh.center_m
        vertices = np.hstack([about_center_m, drawn.normals, colours / 255.0, uv]).astype("f4")
        layout = (self._context.buffer(vertices.tobytes()), "3f 3f 3f 2f", "position", "normal", "colour", "uv")
        positions = (self._context.buffer(np.ascontiguousarray(vertices[:, :3]).tobytes()), "3f", "position")
        index = self._context.buffer(drawn.faces.astype("i4").tobytes())
        coloured = self._context.vertex_array(self._program, [layout], index)
        arrays[number] = {
            "all": coloured,
            "picture": coloured,
            "labels": self._context.vertex_array(self._label_program, [positions], index),
            "depth": self._context.vertex_array(self._depth_program, [positions], index),
        }
        if textured:
            assert drawn.texture_rgb is not None
            height, width = drawn.texture_rgb.shape[:2]
            flipped = np.ascontiguousarray(drawn.texture_rgb[::-1])  # GL's first row is the bottom one
            texture = self._context.texture((width, height), 3, flipped.tobytes(), alignment=1)
            texture.build_mipmaps(max_level=1000 if drawn.mip_levels is None else drawn.mip_levels)  # GL's default
            texture.filter = (moderngl.LINEAR_MIPMAP_LINEAR, moderngl.LINEAR)
            self._textures[obj_id] = texture
        return arrays[number]

    def _release(self, obj_id: int) -> None:
        texture = self._textures.pop(obj_id, None)
        arrays = {array for level in self._arrays.pop(obj_id, {}).values() for array in level.values()}
        for held in (*arrays, *([] if texture is None else [texture])):
            held.release()

    def _free(self, target: moderngl.Framebuffer) -> None:
        for attachment in (*target.color_attachments, target.depth_attachment):
            if attachment is not None:
                attachment.release()
        target.release()


def _images_at_once(size: tuple[int, int]) -> int:
    """Images of one size that have a framebuffer at the same time."""
    return max(1, min(MAX_IMAGES, MAX_PIXELS // (size[0] * size[1])))
