"""Lamps and the world around, even or a panorama, pooled and updated in place."""

import bpy
import numpy as np
from jaxtyping import Float
from mathutils import Matrix

from synthgen.engines.blender.camera import blender_from_opencv
from synthgen.image import hdri
from synthgen.scene import Environment, Light

PANORAMAS = 8  # worlds kept at a time; one is 8 MB
_BLENDER_KIND = {"point": "POINT", "area": "AREA", "sun": "SUN"}


class Lamps:
    """Slot i holds the scene's light i, whatever its kind.

    Slots keep their order, so that Cycles meets the lights in the scene's order and not in the order of the history:
    its random choice of a light, and with it the noise, depends on that.
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
    """What surrounds the scene: one colour, or a panorama beside it. It lights and is not seen: the film is clear."""

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
        """The panorama of a file; the one unused for longest makes room for a new one."""
        panorama = self._panoramas.pop(path, None) or _Panorama(path)
        self._panoramas[path] = panorama
        if len(self._panoramas) > PANORAMAS:
            self._panoramas.pop(next(iter(self._panoramas))).remove()
        return panorama


class _Panorama:
    """A world lit by one panorama: its image, seen through a turn, times its strength, plus an even colour.

    The bright places are lamps (`hdri.with_suns`). Sampling the panorama by importance is the obvious way, but Cycles
    takes the sampling method of the first world that it renders for all later ones, so a picture would depend on
    what was rendered before it, and it builds its map again at every turn.
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
        direction, self._turn = tree.nodes.new("ShaderNodeTexCoord"), tree.nodes.new("ShaderNodeMapping")
        tree.links.new(direction.outputs["Generated"], self._turn.inputs["Vector"])
        texture = tree.nodes.new("ShaderNodeTexEnvironment")
        texture.image = self.image
        tree.links.new(self._turn.outputs["Vector"], texture.inputs["Vector"])
        self._scale = tree.nodes.new("ShaderNodeVectorMath")
        self._scale.operation = "MULTIPLY_ADD"
        tree.links.new(texture.outputs["Color"], self._scale.inputs[0])
        tree.links.new(self._scale.outputs["Vector"], tree.nodes["Background"].inputs["Color"])

    def set(self, rgb: tuple[float, float, float], environment: Environment) -> None:
        """Set turn, strength and even light."""
        R_env_world = environment.R_cam_env.T @ blender_from_opencv(np.eye(4))[:3, :3]
        self._turn.inputs["Rotation"].default_value = Matrix(R_env_world.tolist()).to_euler("XYZ")
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
    """Return the lamp's pose in the OpenCV camera frame: its own z axis points back along the light it sends.

    A Blender lamp shines along its -z, so z is the direction from the scene towards the lamp. The turn about z is
    free, and fixed by the axis that z is least aligned with.
    """
    z = np.array(light.direction_cam) / np.linalg.norm(light.direction_cam)
    x = np.cross(np.eye(3)[np.argmin(np.abs(z))], z)
    x /= np.linalg.norm(x)
    T = np.eye(4)
    T[:3, :3] = np.stack([x, np.cross(z, x), z], axis=1)
    T[:3, 3] = light.position_cam_m
    return T
