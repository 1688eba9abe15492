"""Meshes and scenes that the Blender tests share."""

from typing import Any

import numpy as np
from posecore import se3
from posecore.camera import Camera, intrinsics
from posecore.mesh import Mesh
from synthgen.scene import Light, Material, Scene, SceneObject

MATT = Material(roughness=1.0, specular=0.0)
# fx differs from fy, and the principal point is off the image's centre.
SKEWED = Camera(K=intrinsics(420.0, 510.0, 81.3, 37.8), width_px=160, height_px=120)


def box(x_m: float, y_m: float, z_m: float) -> Mesh:
    """A grey box around the origin, with flat faces that face outwards."""
    corners = np.array([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)]) * np.array([x_m, y_m, z_m]) / 2
    quads = [(0, 1, 3, 2), (4, 6, 7, 5), (0, 4, 5, 1), (2, 3, 7, 6), (0, 2, 6, 4), (1, 5, 7, 3)]
    faces = np.array([(q[0], q[i], q[i + 1]) for q in quads for i in (1, 2)])
    vertices = corners[faces].reshape(-1, 3)
    normals = np.cross(vertices[1::3] - vertices[::3], vertices[2::3] - vertices[::3])
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    return Mesh(
        vertices_m=vertices,
        faces=np.arange(len(vertices), dtype=np.int32).reshape(-1, 3),
        normals=np.repeat(normals, 3, axis=0).astype(np.float32),
        vertex_rgb=np.full((len(vertices), 3), 128, np.uint8),
    )


def quad(vertex_rgb: np.ndarray | None = None, texture_rgb: np.ndarray | None = None) -> Mesh:
    """A square of side 0.2 m that faces the camera: vertices top left, top right, bottom right, bottom left."""
    vertices = np.array([[-0.1, -0.1, 0.0], [0.1, -0.1, 0.0], [0.1, 0.1, 0.0], [-0.1, 0.1, 0.0]])
    return Mesh(
        vertices_m=vertices,
        faces=np.array([[0, 2, 1], [0, 3, 2]], np.int32),
        normals=np.tile(np.float32([0, 0, -1]), (4, 1)),
        vertex_rgb=vertex_rgb,
        uv=None if texture_rgb is None else np.float32([[0, 1], [1, 1], [1, 0], [0, 0]]),
        texture_rgb=texture_rgb,
    )


def at(x_m: float, y_m: float, z_m: float, rotvec: tuple[float, float, float] = (0.0, 0.0, 0.0)) -> np.ndarray:
    """A pose from a position and a rotation vector."""
    return se3.make_T(se3.rotation_from_rotvec(np.array(rotvec)), np.array([x_m, y_m, z_m]))


def scene_of(*objects: SceneObject, **changes: Any) -> Scene:
    """A scene of a 64 px square camera, lit by a white sky alone, unless said otherwise."""
    fields: dict[str, Any] = {
        "camera": Camera(K=intrinsics(128.0, 128.0, 32.0, 32.0), width_px=64, height_px=64),
        "region_px": (0, 0, 64, 64),
        "objects": objects,
        "ambient_rgb": (1.0, 1.0, 1.0),
        "samples": 8,
    }
    return Scene(**{**fields, **changes})


def box_and_plate(size_m: float, diameters: float) -> tuple[dict[int, Mesh], Scene, tuple[float, float]]:
    """A box, and a thousandth of its size before it a plate a third as wide, a number of diameters away.

    Returns:
        The meshes, the scene (the box is object 0), and the camera z of the faces that box and plate turn to the
        camera.
    """
    meshes = {1: box(0.6 * size_m, 0.5 * size_m, 0.4 * size_m), 2: box(0.2 * size_m, 0.2 * size_m, 0.02 * size_m)}
    z_m = diameters * meshes[1].diameter_m
    box_z_m = z_m - 0.2 * size_m
    plate_z_m = box_z_m - 1e-3 * size_m - 0.02 * size_m
    scene = scene_of(
        SceneObject(mesh_key=1, T_cam_obj=at(0, 0, z_m)),
        SceneObject(mesh_key=2, T_cam_obj=at(0, 0, plate_z_m + 0.01 * size_m)),
        camera=Camera(K=intrinsics(40 * diameters, 40 * diameters, 32.0, 32.0), width_px=64, height_px=64),
        samples=1,
    )
    return meshes, scene, (box_z_m, plate_z_m)


def busy_scene(seed: int, keys: tuple[int, ...], **changes: Any) -> Scene:
    """Objects, poses, materials and lights drawn from a seed."""
    rng = np.random.default_rng(seed)
    objects = tuple(
        SceneObject(
            mesh_key=key,
            T_cam_obj=se3.make_T(
                se3.random_rotation(rng), np.array([*rng.uniform(-0.06, 0.06, 2), rng.uniform(0.4, 0.8)])
            ),
            material=Material(base_rgb=tuple(rng.uniform(0, 1, 3)) if rng.random() < 0.5 else None, hue_shift=0.1),
        )
        for key in keys
    )
    lights = (
        Light(kind="area", position_cam_m=(0.5, -0.5, 0.0), direction_cam=(0.5, -0.5, -0.6), strength=8.0, size_m=0.3),
        Light(kind="point", position_cam_m=(-0.4, 0.1, 0.1), strength=3.0, rgb=(1.0, 0.8, 0.6)),
        Light(kind="sun", direction_cam=(0.0, -1.0, -1.0), strength=1.0, size_m=0.02),
    )[: int(rng.integers(4))]
    return scene_of(*objects, **{"lights": lights, "render_seed": seed, **changes})
