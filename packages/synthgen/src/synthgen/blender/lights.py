"""Lamps and the ambient world, pooled and updated in place."""

import bpy
import numpy as np
from jaxtyping import Float
from mathutils import Matrix

from synthgen.blender.camera import blender_from_opencv
from synthgen.scene import Light

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


class Ambient:
    """A world of one colour: light from everywhere, never seen behind the film's alpha."""

    def __init__(self, scene: bpy.types.Scene) -> None:
        world = bpy.data.worlds.new("ambient")
        world.use_nodes = True
        # The colour is the same everywhere, so there is nothing to sample by importance: paths that miss find it.
        world.cycles.sampling_method = "NONE"
        self._colour = world.node_tree.nodes["Background"].inputs["Color"]
        scene.world = world

    def set(self, rgb: tuple[float, float, float]) -> None:
        """Set the linear radiance."""
        value = np.array([*rgb, 1.0], np.float32)
        if not np.array_equal(np.array(self._colour.default_value, np.float32), value):  # a write compiles the world
            self._colour.default_value = value


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
