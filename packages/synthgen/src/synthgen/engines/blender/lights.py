"""Lamps and the world, uniform or a panorama, pooled and updated in place."""

import bpy
import numpy as np
from jaxtyping import Float
from mathutils import Matrix

from synthgen.engines.blender.camera import blender_from_opencv
from synthgen.image import hdri
from synthgen.scene import Environment, Light

PANORAMAS = 8  # cached worlds of 8 MB each
_BLENDER_KIND = {"point": "POINT", "area": "AREA", "sun": "SUN"}


class Lamps:
    """Slot i holds the scene's light i, whatever its kind.

    Slots keep their order, so that Cycles has the lights in the scene's order and not in that of earlier scenes: its
    random choice of lights, and so the noise, depends on the order.
    """

    def __init__(self, collection: bpy.types.Collection) -> None:
        self._collection = collection
        self._slots: list[bpy.types.Object] = []
        self._blocks: dict[tuple[int, str], bpy.types.Light] = {}

    def set(self, lights: tuple[Light, ...]) -> None:
        """Show exactly these lights."""
        for slot, light in enumerate(lights):
            block = self._block(slot, light.kind)
            if slot == len(self._slots):
                lamp = bpy.data.objects.new(f"light_{slot}", block)
                self._collection.objects.link(lamp)
                self._slots.append(lamp)
            lamp = self._slots[slot]
            if lamp.data != block:
                lamp.data = block
            lamp.matrix_basis = Matrix(blender_from_opencv(_lamp_pose(light)).tolist())
            _show(lamp, shown=True)
            _set_block(block, light)
        for lamp in self._slots[len(lights) :]:
            _show(lamp, shown=False)

    def remove(self) -> None:
        """Remove every lamp from Blender."""
        bpy.data.batch_remove([*self._slots, *self._blocks.values()])
        self._slots, self._blocks = [], {}

    def _block(self, slot: int, kind: str) -> bpy.types.Light:
        key = (slot, kind)
        if key not in self._blocks:
            self._blocks[key] = bpy.data.lights.new(f"{kind}_{slot}", _BLENDER_KIND[kind])
        return self._blocks[key]


class World:
    """Environment of the scene: a uniform colour, or a panorama plus a colour. It is a light source but invisible."""

    def __init__(self, scene: bpy.types.Scene) -> None:
        self._scene = scene
        self._panoramas: dict[str, _Panorama] = {}
        self._even = self._make_even()

    def set(self, rgb: tuple[float, float, float], environment: Environment | None) -> None:
        """Set the linear radiance of the even light, and the panorama."""
        if environment is None:
            world = self._even
            colour = world.node_tree.nodes["Background"].inputs["Color"]
            value = np.array([*rgb, 1.0], np.float32)
            if not np.array_equal(np.array(colour.default_value, np.float32), value):  # a write compiles the world
                colour.default_value = value
        else:
            panorama = self._panorama(environment.path)
            panorama.set(rgb, environment)
            world = panorama.world
        if self._scene.world != world:
            self._scene.world = world

    def remove(self) -> None:
        """Remove every world from Blender."""
        for panorama in self._panoramas.values():
            panorama.remove()
        self._panoramas = {}
        bpy.data.worlds.remove(self._even)

    def _make_even(self) -> bpy.types.World:
        world = bpy.data.worlds.new("ambient")
        world.use_nodes = True
        # The colour is the same everywhere, so there is nothing to sample by importance: paths that miss find it.
        world.cycles.sampling_method = "NONE"
        return world

    def _panorama(self, path: str) -> "_Panorama":
        """Panorama of a file; a new one replaces the least recently used."""
        panorama = self._panoramas.pop(path, None) or _Panorama(path)
        self._panoramas[path] = panorama
        if len(self._panoramas) > PANORAMAS:
            self._panoramas.pop(next(iter(self._panoramas))).remove()
        return panorama


class _Panorama:
    """World of a panorama: its rotated image times its strength, plus a uniform colour.

    The bright spots are lamps (`hdri.with_suns`). Importance sampling of the panorama would be obvious, but Cycles
    applies the sampling method of the first rendered world to all later ones, so that a picture would depend on
    earlier renders, and it rebuilds its map at every rotation.
    """

    def __init__(self, path: str) -> None:
        light = hdri.split_light(path).residual
        height, width = light.shape[:2]
        self.image = bpy.data.images.new("panorama", width, height, alpha=False, float_buffer=True)
        self.image.colorspace_settings.name = "Linear Rec.709"
        rgba = np.ones((height, width, 4), np.float32)
        rgba[..., :3] = light[::-1]
        self.image.pixels.foreach_set(rgba.ravel())
        self.image.pack()
        self.world = bpy.data.worlds.new("panorama")
        self.world.use_nodes = True
        self.world.cycles.sampling_method = "NONE"
        tree = self.world.node_tree
        direction, self._rotation = tree.nodes.new("ShaderNodeTexCoord"), tree.nodes.new("ShaderNodeMapping")
        tree.links.new(direction.outputs["Generated"], self._rotation.inputs["Vector"])
        texture = tree.nodes.new("ShaderNodeTexEnvironment")
        texture.image = self.image
        tree.links.new(self._rotation.outputs["Vector"], texture.inputs["Vector"])
        self._scale = tree.nodes.new("ShaderNodeVectorMath")
        self._scale.operation = "MULTIPLY_ADD"
        tree.links.new(texture.outputs["Color"], self._scale.inputs[0])
        tree.links.new(self._scale.outputs["Vector"], tree.nodes["Background"].inputs["Color"])

    def set(self, rgb: tuple[float, float, float], environment: Environment) -> None:
        """Set rotation, strength and uniform light."""
        R_env_world = environment.R_cam_env.T @ blender_from_opencv(np.eye(4))[:3, :3]
        self._rotation.inputs["Rotation"].default_value = Matrix(R_env_world.tolist()).to_euler("XYZ")
        self._scale.inputs[1].default_value = (environment.strength,) * 3
        self._scale.inputs[2].default_value = rgb

    def remove(self) -> None:
        """Remove world and image from Blender."""
        bpy.data.worlds.remove(self.world)
        bpy.data.images.remove(self.image)


def _show(lamp: bpy.types.Object, *, shown: bool) -> None:
    if lamp.hide_render == shown:  # a write alone makes Blender build its dependency graph again
        lamp.hide_render = not shown


def _set_block(block: bpy.types.Light, light: Light) -> None:
    block.color = light.rgb
    block.energy = light.strength
    if light.kind == "point":
        block.shadow_soft_size = light.size_m / 2
    elif light.kind == "area":
        block.shape, block.size = "SQUARE", light.size_m
    else:
        block.angle = light.size_m


def _lamp_pose(light: Light) -> Float[np.ndarray, "4 4"]:
    """Return the lamp's pose in the OpenCV camera frame: its z axis is opposite to its light.

    A Blender lamp shines along its -z, so z is the direction from the scene towards the lamp. The rotation about z
    is free, and fixed by the axis that z is least aligned with.
    """
    z = np.array(light.direction_cam) / np.linalg.norm(light.direction_cam)
    x = np.cross(np.eye(3)[np.argmin(np.abs(z))], z)
    x /= np.linalg.norm(x)
    T = np.eye(4)
    T[:3, :3] = np.stack([x, np.cross(z, x), z], axis=1)
    T[:3, 3] = light.position_cam_m
    return T
