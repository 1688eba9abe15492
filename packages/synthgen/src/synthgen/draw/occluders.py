"""Shapes in front of, beside and behind the object: primitives, or the user's meshes."""

import colorsys
import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace

import numpy as np
import trimesh
from jaxtyping import Float
from posecore.mesh import Mesh
from posecore.se3 import make_T, random_rotation

from synthgen.config import OccluderConfig
from synthgen.draw.random_streams import Purpose, Subject, stream
from synthgen.scene import Material, SceneObject

_SHARP_EDGE_RAD = 0.6  # dihedral angle from which an edge is shaded flat
_MAX_DISTANCE_FRACTION = 0.6  # a larger shape does not fit between camera and object
_EXTRA_FRONT = 4  # maximum number of shapes added to reach a visible fraction
_BISECTIONS = 6
_TOLERANCE = 0.02  # of the visible fraction


def scaled_meshes(
    config: OccluderConfig, seed: int, obj_id: int, diameter_m: float, meshes: Sequence[Mesh]
) -> list[Mesh]:
    """Occluder meshes scaled to `config.size_diameter` times the object's diameter, each once, centred."""
    rng = stream(seed, Purpose.PAIRS, Subject.LIBRARY, obj_id)
    indices = sorted(rng.permutation(len(meshes))[: config.library].tolist())
    shapes = []
    for i in indices:
        size_m = diameter_m * rng.uniform(*config.size_diameter)
        shapes.append(meshes[i].scaled(size_m / meshes[i].diameter_m))
    return shapes


def primitive_shapes(config: OccluderConfig, seed: int, obj_id: int, diameter_m: float) -> list[Mesh]:
    """Primitives of a dataset for an object of this size: boxes, cylinders, spheres, cones, tori, capsules.

    Every shape has different colours; the sizes are `config.size_diameter` times the object's diameter.
    """
    shapes = []
    for i in range(config.library):
        rng = stream(seed, Purpose.PAIRS, Subject.LIBRARY, obj_id, i)
        size_m = diameter_m * rng.uniform(*config.size_diameter)
        shapes.append(_shape(rng, i, size_m))
    return shapes


def draw_occluders(
    rng: np.random.Generator,
    config: OccluderConfig,
    shapes: Mapping[int, Mesh],
    centre_cam_m: Float[np.ndarray, "3"],
    diameter_m: float,
) -> tuple[tuple[SceneObject, ...], tuple[SceneObject, ...]]:
    """Draw shapes in front of and around an object whose box centre is at `centre_cam_m`.

    Occluders in front reach over the object's edge; a render decides whether the object is too occluded (see
    `pair_maker.PairMaker`). Props around it keep clear of its bounding sphere. A shape that does not fit between camera
    and object is not used.

    Returns:
        Occluders in front, and props around.
    """
    keys = [k for k in sorted(shapes) if shapes[k].diameter_m <= _MAX_DISTANCE_FRACTION * centre_cam_m[2]]
    front, props = [], []
    for _ in range(rng.integers(config.front[0], config.front[1] + 1) if keys else 0):
        key = keys[int(rng.integers(len(keys)))]
        front.append(_object(rng, shapes, key, _in_front(rng, centre_cam_m, diameter_m, shapes[key].diameter_m)))
    for _ in range(rng.integers(config.props[0], config.props[1] + 1) if keys else 0):
        key = keys[int(rng.integers(len(keys)))]
        props.append(_object(rng, shapes, key, _around(rng, centre_cam_m, diameter_m, shapes[key].diameter_m)))
    return tuple(front), tuple(props)


def move_in_front(
    rng: np.random.Generator,
    config: OccluderConfig,
    shapes: Mapping[int, Mesh],
    centre_cam_m: Float[np.ndarray, "3"],
    diameter_m: float,
    front: Sequence[SceneObject],
    visible_of: Callable[[tuple[SceneObject, ...]], float],
    lift: Callable[[SceneObject], SceneObject],
) -> tuple[SceneObject, ...]:
    """Move occluders in front of an object until its visible fraction is the one drawn from `config.visible_fraction`.

    One occluder after another moves in from outside towards a position over the object. The first one that hides too
    much is stopped on its path, by bisection. Where all occluders together hide too little, up to four are added.

    Args:
        rng: Stream of the visible fraction, the positions and the added shapes.
        config: `visible_fraction` must be set.
        shapes: Occluder meshes by key.
        centre_cam_m: The object's box centre.
        diameter_m: The object's diameter.
        front: Occluders in front, from `draw_occluders`.
        visible_of: Visible fraction of the object behind these occluders, from a low-resolution render.
        lift: Moves an occluder out of the table.

    Returns:
        Occluders in front; those that do not reach the object are left out.
    """
    assert config.visible_fraction is not None
    goal = rng.uniform(*config.visible_fraction)
    waiting = list(front)
    keys = [k for k in sorted(shapes) if shapes[k].diameter_m <= _MAX_DISTANCE_FRACTION * centre_cam_m[2]]
    placed: tuple[SceneObject, ...] = ()
    if config.front[1] == 0 or not keys or visible_of(placed) <= goal + _TOLERANCE:
        return placed
    for _ in range(len(waiting) + _EXTRA_FRONT):
        if waiting:
            item = waiting.pop(0)
        else:
            key = keys[int(rng.integers(len(keys)))]
            item = _object(rng, shapes, key, _in_front(rng, centre_cam_m, diameter_m, shapes[key].diameter_m))
        path = _path(rng, item, shapes[item.mesh_key], centre_cam_m, diameter_m, lift)
        inside = (*placed, path(1.0))
        visible = visible_of(inside)
        if visible > goal + _TOLERANCE:
            placed = inside
            continue
        if visible >= goal - _TOLERANCE:
            return inside
        low, high = 0.0, 1.0  # hides too little, hides too much
        for _ in range(_BISECTIONS):
            middle = (low + high) / 2
            visible = visible_of((*placed, path(middle)))
            if abs(visible - goal) <= _TOLERANCE:
                low = middle
                break
            low, high = (middle, high) if visible > goal else (low, middle)
        return (*placed, path(low))
    return placed


def _path(
    rng: np.random.Generator,
    item: SceneObject,
    shape: Mesh,
    centre_cam_m: Float[np.ndarray, "3"],
    diameter_m: float,
    lift: Callable[[SceneObject], SceneObject],
) -> Callable[[float], SceneObject]:
    """Path of an occluder at constant depth, from a position where it hides nothing (0) to one over the object (1)."""
    centre = shape.center_cam_m(item.T_cam_obj)
    scale = centre[2] / centre_cam_m[2]
    angle = rng.uniform(0, 2 * math.pi)
    over = centre_cam_m * scale + _sideways(rng) * rng.uniform(0.0, 0.35) * diameter_m * scale
    out = centre_cam_m * scale + np.array([math.cos(angle), math.sin(angle), 0.0]) * 0.75 * (
        diameter_m * scale + shape.diameter_m
    )

    def occluder_at(fraction: float) -> SceneObject:
        T = item.T_cam_obj.copy()
        T[:3, 3] += out + (over - out) * fraction - centre
        return lift(replace(item, T_cam_obj=T))

    return occluder_at


def _in_front(
    rng: np.random.Generator, centre_cam_m: Float[np.ndarray, "3"], diameter_m: float, size_m: float
) -> Float[np.ndarray, "3"]:
    z = centre_cam_m[2]
    gap = (diameter_m + size_m) / 2
    front = max(z - gap - rng.uniform(0.0, 0.3) * z, size_m, 0.3 * z)
    scale = front / z
    reach = rng.uniform(0.35, 1.1) * (diameter_m / 2 * scale + size_m / 2)
    return np.asarray(centre_cam_m * scale + _sideways(rng) * reach)


def _around(
    rng: np.random.Generator, centre_cam_m: Float[np.ndarray, "3"], diameter_m: float, size_m: float
) -> Float[np.ndarray, "3"]:
    gap = (diameter_m + size_m) / 2
    if rng.random() < 0.5:  # behind
        depth, reach = gap + rng.uniform(0.0, 2.0) * diameter_m, rng.uniform(0.0, 1.5) * gap
    else:  # beside
        depth, reach = rng.uniform(-0.5, 1.0) * diameter_m, rng.uniform(1.0, 2.2) * gap
    return np.asarray(centre_cam_m + _sideways(rng) * reach + np.array([0.0, 0.0, depth]))


def _sideways(rng: np.random.Generator) -> Float[np.ndarray, "3"]:
    angle = rng.uniform(0, 2 * np.pi)
    return np.array([np.cos(angle), np.sin(angle), 0.0])


def _object(
    rng: np.random.Generator, shapes: Mapping[int, Mesh], key: int, position_cam_m: Float[np.ndarray, "3"]
) -> SceneObject:
    R = random_rotation(rng)
    t = position_cam_m - R @ shapes[key].center_m
    return SceneObject(mesh_key=key, T_cam_obj=make_T(R, t), material=draw_occluder_material(rng))


def draw_occluder_material(rng: np.random.Generator) -> Material:
    """Material of an occluder: the mesh's colours rotated in hue, or one colour all over."""
    keeps_colours = rng.random() < 0.4
    base = None if keeps_colours else colorsys.hsv_to_rgb(rng.random(), rng.uniform(0.0, 1.0), rng.uniform(0.05, 1.0))
    return Material(
        base_rgb=base,
        hue_shift=float(rng.uniform(-0.5, 0.5)) if keeps_colours else 0.0,
        roughness=float(rng.uniform(0.1, 1.0)),
        metallic=float(rng.random() < 0.15),
        specular=float(rng.uniform(0.1, 0.9)),
    )


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


def _colours(rng: np.random.Generator, vertices: Float[np.ndarray, "v 3"]) -> np.ndarray:
    """Two or three colours in bands across the shape; edges are as sharp as the vertices are dense."""
    palette = rng.integers(0, 256, (int(rng.integers(2, 4)), 3))
    axis = rng.normal(size=3)
    t = vertices @ (axis / np.linalg.norm(axis))
    t = (t - t.min()) / max(float(np.ptp(t)), 1e-12) * rng.uniform(1.0, 4.0)
    return palette[np.floor(t).astype(int) % len(palette)].astype(np.uint8)
