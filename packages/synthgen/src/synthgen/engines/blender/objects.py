"""Meshes, loaded once, and pools of objects that show them."""

from collections.abc import Mapping
from itertools import product

import bpy
import numpy as np
from jaxtyping import Float
from mathutils import Matrix
from posecore import se3
from posecore.errors import RenderError
from posecore.mesh import Mesh

from synthgen.engines.blender.camera import blender_from_opencv
from synthgen.engines.blender.materials import make_surface, set_material
from synthgen.engines.blender.meshes import check_mesh, make_mesh, make_texture
from synthgen.engines.blender.visibility import show
from synthgen.scene import SceneObject, with_origins_at

# Cycles bakes the pose of an object whose mesh has no other user into the vertices, and then has to build the BVH again
# at every move. With two users from the start a pose is only a matrix.
FEWEST_PER_MESH = 2
# Position of unused objects, behind the camera. A hidden object is still in the BVH: one that stayed where it was last
# shown, or at the origin, which is the camera, would be visited by every ray (measured: 1.6 times the render).
PARKED = Matrix.Translation((0.0, 0.0, 1e4))


class Props:
    """For each mesh a pool of objects that show it; unused ones stay in the scene, hidden from every ray."""

    def __init__(self, collection: bpy.types.Collection) -> None:
        self._collection = collection
        self._centers_m: dict[int, Float[np.ndarray, "3"]] = {}
        self._meshes: dict[int, bpy.types.Mesh] = {}
        self._pools: dict[int, list[bpy.types.Object]] = {}
        self._boxes: dict[int, Float[np.ndarray, "8 3"]] = {}

    def load(self, meshes: Mapping[int, Mesh]) -> None:
        """Make the meshes' datablocks; those of a loaded key are replaced and removed.

        Their origins are the meshes' centres: Blender's float32 has no digits to spare for an origin metres off, and
        patterns are about the origin.
        """
        for key, loaded in meshes.items():
            check_mesh(loaded)
            self._centers_m[key] = loaded.center_m
            mesh = loaded.with_origin_at(loaded.center_m)
            block = make_mesh(key, mesh)
            surface = make_surface(f"surface_{key}", make_texture(key, mesh), has_colours=mesh.vertex_rgb is not None)
            block.materials.append(surface)
            old = self._meshes.get(key)
            self._meshes[key] = block
            self._boxes[key] = np.array(
                list(product(*zip(mesh.vertices_m.min(axis=0), mesh.vertices_m.max(axis=0), strict=True)))
            )
            if old is None:
                self._pools[key] = [self._make_object(key) for _ in range(FEWEST_PER_MESH)]
            else:
                old.user_remap(block)  # removing a mesh that is in use would take its objects along
                _remove_mesh(old)

    def set(self, objects: tuple[SceneObject, ...]) -> None:
        """Show exactly these objects; object i gets the pass index i + 1.

        Raises:
            RenderError: A mesh key was never loaded.
        """
        used = dict.fromkeys(self._pools, 0)
        for number, item in enumerate(with_origins_at(objects, self._centers_m)):
            if item.mesh_key not in used:
                loaded = ", ".join(map(str, used)) or "none"
                raise RenderError(f"object {number}: mesh key {item.mesh_key} is not loaded (loaded: {loaded})")
            pool = self._pools[item.mesh_key]
            if used[item.mesh_key] == len(pool):
                pool.append(self._make_object(item.mesh_key))
            thing = pool[used[item.mesh_key]]
            used[item.mesh_key] += 1
            thing.pass_index = number + 1
            thing.matrix_basis = Matrix(blender_from_opencv(item.T_cam_obj).tolist())
            set_material(thing, item.material)
            show(thing, shown=True)
        for key, pool in self._pools.items():
            for thing in pool[used[key] :]:
                park(thing)

    def corners(self, objects: tuple[SceneObject, ...]) -> Float[np.ndarray, "n 8 3"]:
        """Return the corners of the objects' bounding boxes in the camera frame, metres."""
        centred = with_origins_at(objects, self._centers_m)
        return np.stack([se3.apply(item.T_cam_obj, self._boxes[item.mesh_key]) for item in centred])

    def remove(self) -> None:
        """Remove every datablock of the pool from Blender."""
        bpy.data.batch_remove([thing for pool in self._pools.values() for thing in pool])
        for block in self._meshes.values():
            _remove_mesh(block)
        self._pools, self._meshes, self._boxes = {}, {}, {}
        self._centers_m = {}

    def _make_object(self, key: int) -> bpy.types.Object:
        thing = bpy.data.objects.new(f"object_{key}", self._meshes[key])
        self._collection.objects.link(thing)
        park(thing)
        return thing


def park(thing: bpy.types.Object) -> None:
    """Hide an object and keep it out of every ray's way."""
    if thing.visible_camera:
        show(thing, shown=False)
        thing.matrix_basis = PARKED


def _remove_mesh(block: bpy.types.Mesh) -> None:
    """Remove a mesh with its material and texture, which nothing else uses."""
    surface = block.materials[0]
    images = [node.image for node in surface.node_tree.nodes if node.type == "TEX_IMAGE"]
    bpy.data.batch_remove([block, surface, *images])
