"""Primitive shapes that stand in front of, beside and behind the object."""

import colorsys
from collections.abc import Mapping

import numpy as np
import trimesh
from jaxtyping import Float
from posecore.mesh import Mesh
from posecore.se3 import make_T, random_rotation

from synthgen.config import OccluderConfig
from synthgen.scene import Material, SceneObject
from synthgen.streams import Purpose, Subject, stream

Array = np.ndarray

_SHARP_EDGE_RAD = 0.6  # faces that meet at more than this are shaded flat


def library(config: OccluderConfig, seed: int, obj_id: int, diameter_m: float) -> list[Mesh]:
    """The shapes of a dataset for an object of this size: boxes, cylinders, spheres, cones, tori, capsules.

    Every shape has colours of its own; the sizes are `config.size_diameter` times the object's diameter.
    """
    shapes = []
    for i in range(config.library):
        rng = stream(seed, Purpose.PAIRS, Subject.LIBRARY, obj_id, i)
        size_m = diameter_m * rng.uniform(*config.size_diameter)
        shapes.append(_shape(rng, i, size_m))
    return shapes


def place(
    rng: np.random.Generator,
    config: OccluderConfig,
    shapes: Mapping[int, Mesh],
    centre_cam_m: Float[Array, "3"],
    diameter_m: float,
) -> tuple[SceneObject, ...]:
    """Place shapes around an object whose box centre is at `centre_cam_m`.

    Those in front reach over the object's edge more or less; whether too much of it is hidden only a render can tell
    (see `pair.PairMaker`). Those around it keep clear of its bounding sphere.
    """
    keys = sorted(shapes)
    placed = []
    for _ in range(rng.integers(config.front[0], config.front[1] + 1)):
        key = keys[int(rng.integers(len(keys)))]
        placed.append(_object(rng, shapes, key, _in_front(rng, centre_cam_m, diameter_m, shapes[key].diameter_m)))
    for _ in range(rng.integers(config.props[0], config.props[1] + 1)):
        key = keys[int(rng.integers(len(keys)))]
        placed.append(_object(rng, shapes, key, _around(rng, centre_cam_m, diameter_m, shapes[key].diameter_m)))
    return tuple(placed)


def _in_front(
    rng: np.random.Generator, centre_cam_m: Float[Array, "3"], diameter_m: float, size_m: float
) -> Float[Array, "3"]:
    z = centre_cam_m[2]
    gap = (diameter_m + size_m) / 2
    front = max(z - gap - rng.uniform(0.0, 0.3) * z, size_m, 0.3 * z)
    scale = front / z
    reach = rng.uniform(0.35, 1.1) * (diameter_m / 2 * scale + size_m / 2)
    return np.asarray(centre_cam_m * scale + _sideways(rng) * reach)


def _around(
    rng: np.random.Generator, centre_cam_m: Float[Array, "3"], diameter_m: float, size_m: float
) -> Float[Array, "3"]:
    gap = (diameter_m + size_m) / 2
    if rng.random() < 0.5:  # behind
        depth, reach = gap + rng.uniform(0.0, 2.0) * diameter_m, rng.uniform(0.0, 1.5) * gap
    else:  # beside
        depth, reach = rng.uniform(-0.5, 1.0) * diameter_m, rng.uniform(1.0, 2.2) * gap
    return np.asarray(centre_cam_m + _sideways(rng) * reach + np.array([0.0, 0.0, depth]))


def _sideways(rng: np.random.Generator) -> Float[Array, "3"]:
    angle = rng.uniform(0, 2 * np.pi)
    return np.array([np.cos(angle), np.sin(angle), 0.0])


def _object(
    rng: np.random.Generator, shapes: Mapping[int, Mesh], key: int, position_cam_m: Float[Array, "3"]
) -> SceneObject:
    R = random_rotation(rng)
    own_colours = rng.random() < 0.4
    base = None if own_colours else colorsys.hsv_to_rgb(rng.random(), rng.uniform(0.0, 1.0), rng.uniform(0.05, 1.0))
    material = Material(
        base_rgb=base,
        hue_shift=float(rng.uniform(-0.5, 0.5)) if own_colours else 0.0,
        roughness=float(rng.uniform(0.1, 1.0)),
        metallic=float(rng.random() < 0.15),
        specular=float(rng.uniform(0.1, 0.9)),
    )
    t = position_cam_m - R @ shapes[key].center_m
    return SceneObject(mesh_key=key, T_cam_obj=make_T(R, t), material=material)


def _shape(rng: np.random.Generator, index: int, size_m: float) -> Mesh:
    kind = index % 6
    if kind == 0:
        solid = trimesh.creation.box(extents=rng.uniform(0.2, 1.0, 3))
    elif kind == 1:
        solid = trimesh.creation.cylinder(radius=rng.uniform(0.1, 0.6), height=1.0, sections=32)
    elif kind == 2:
        solid = trimesh.creation.icosphere(subdivisions=3)
        solid.apply_scale(rng.uniform(0.4, 1.0, 3))
    elif kind == 3:
        solid = trimesh.creation.cone(radius=rng.uniform(0.2, 0.6), height=1.0, sections=32)
    elif kind == 4:
        solid = trimesh.creation.torus(major_radius=1.0, minor_radius=rng.uniform(0.15, 0.45))
    else:
        solid = trimesh.creation.capsule(height=rng.uniform(0.5, 2.0), radius=0.5, count=[24, 24])
    solid = trimesh.graph.smooth_shade(solid, angle=_SHARP_EDGE_RAD)
    vertices = np.asarray(solid.vertices, np.float64)
    vertices -= (vertices.min(axis=0) + vertices.max(axis=0)) / 2
    mesh = Mesh(
        vertices_m=vertices,
        faces=np.asarray(solid.faces, np.int32),
        normals=np.asarray(solid.vertex_normals, np.float32),
    )
    return Mesh(
        vertices_m=vertices * (size_m / mesh.diameter_m),
        faces=mesh.faces,
        normals=mesh.normals,
        vertex_rgb=_colours(rng, vertices),
        path=f"occluder {index}",
    )


def _colours(rng: np.random.Generator, vertices: Float[Array, "v 3"]) -> Array:
    """Two or three colours by bands across the shape: soft where vertices are few, sharp where they are many."""
    palette = rng.integers(0, 256, (int(rng.integers(2, 4)), 3))
    axis = rng.normal(size=3)
    t = vertices @ (axis / np.linalg.norm(axis))
    t = (t - t.min()) / max(float(np.ptp(t)), 1e-12) * rng.uniform(1.0, 4.0)
    return palette[np.floor(t).astype(int) % len(palette)].astype(np.uint8)
