"""Layouts of whole camera images: several labelled objects, floating or on a table, and the cameras that view them.

A layout is a training pair's scene with further objects. Its frame is that of the scene's camera, the reference camera;
other cameras are poses in this frame.
"""

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import lru_cache

import numpy as np
from jaxtyping import Float
from posecore.camera import Camera
from posecore.mesh import Mesh
from posecore.se3 import inverse, make_T, random_direction, random_rotation

from synthgen.config import SynthConfig
from synthgen.draw import appearance, tabletop
from synthgen.draw.appearance import as_vector
from synthgen.draw.poses import draw_pose, level_rotation, point_at_pixel
from synthgen.draw.random_streams import Subject, child_seed, stream
from synthgen.draw.scene_draw import SceneDraw
from synthgen.draw.target import TargetObject
from synthgen.scene import Background, Environment, Light, Scene, SceneObject, Sensor, Vector

_TRIES = 40  # positions tried for a further object before it is left out


@dataclass(frozen=True, kw_only=True, eq=False)
class Layout:
    """Objects and light common to the images of a scene, in the reference camera's frame.

    Attributes:
        labelled: Objects with ground truth; their mesh keys are object ids.
        others: Table, distractors and floating shapes.
        T_ref_level: A frame with z up: that of the table, if there is a table.
        on_table: Whether there is a table.
        lights: Lamps.
        ambient_rgb: Ambient light.
        environment: Panorama, or None.
        background: Background.
        sensor: Camera effects.
        render_seed: Seed of the renderer's noise.
    """

    labelled: tuple[SceneObject, ...]
    others: tuple[SceneObject, ...]
    T_ref_level: Float[np.ndarray, "4 4"]
    on_table: bool
    lights: tuple[Light, ...]
    ambient_rgb: Vector
    environment: Environment | None
    background: Background
    sensor: Sensor
    render_seed: int


@dataclass(frozen=True, kw_only=True, eq=False)
class CameraView:
    """A layout in the view of an image's camera.

    Attributes:
        layout: Objects and light.
        T_cam_ref: Pose of the layout's frame in the camera's.
        target_index: Position in `layout.labelled` of the object that the camera is aimed at.
        background_shift_px: Shift of the background right and down from its middle; None for a background of this image
            only.
        background_reach_px: Largest shift either way.
    """

    layout: Layout
    T_cam_ref: Float[np.ndarray, "4 4"]
    target_index: int = 0
    background_shift_px: tuple[float, float] | None = None
    background_reach_px: tuple[int, int] = (0, 0)

    def scene(self, camera: Camera, samples: int) -> Scene:
        """The whole image; the labelled objects come first."""
        layout, T_cam_ref = self.layout, self.T_cam_ref
        placed = [replace(o, T_cam_obj=T_cam_ref @ o.T_cam_obj) for o in (*layout.labelled, *layout.others)]
        environment = layout.environment
        if environment is not None:
            environment = replace(environment, R_cam_env=T_cam_ref[:3, :3] @ environment.R_cam_env)
        return Scene(
            camera=camera,
            region_px=(0, 0, camera.width_px, camera.height_px),
            objects=tuple(placed),
            lights=tuple(transformed_light(light, T_cam_ref) for light in layout.lights),
            ambient_rgb=layout.ambient_rgb,
            environment=environment,
            background=layout.background,
            sensor=layout.sensor,
            samples=samples,
            render_seed=layout.render_seed,
        )


def transformed_light(light: Light, T_cam_ref: Float[np.ndarray, "4 4"]) -> Light:
    """A lamp transformed to another camera's frame."""
    position = T_cam_ref[:3, :3] @ np.array(light.position_cam_m) + T_cam_ref[:3, 3]
    return replace(
        light, position_cam_m=as_vector(position), direction_cam=transformed_direction(light.direction_cam, T_cam_ref)
    )


def transformed_direction(direction: Vector, T_cam_ref: Float[np.ndarray, "4 4"]) -> Vector:
    """A direction transformed to another camera's frame."""
    return as_vector(T_cam_ref[:3, :3] @ np.array(direction))


@dataclass(frozen=True, eq=False)
class BoundingSpheres:
    """Bounding spheres of placed meshes; meshes with disjoint spheres do not intersect."""

    meshes: Mapping[int, Mesh]

    def sphere(self, placed: SceneObject) -> tuple[Float[np.ndarray, "3"], float]:
        """Centre, in the frame of the pose, and radius."""
        mesh, T = self.meshes[placed.mesh_key], placed.T_cam_obj
        return mesh.center_cam_m(T), radius_m(mesh)

    def is_free(self, centre: Float[np.ndarray, "3"], radius: float, placed: Sequence[SceneObject]) -> bool:
        """Whether a sphere is disjoint from those of all placed objects."""
        return all(np.linalg.norm(centre - c) >= radius + r for c, r in map(self.sphere, placed))


@lru_cache(maxsize=4096)
def radius_m(mesh: Mesh) -> float:
    """Radius of the smallest sphere about the box centre that contains a mesh, cached by the mesh's identity."""
    return float(np.linalg.norm(mesh.vertices_m - mesh.center_m, axis=1).max())


def draw_layout(
    config: SynthConfig,
    targets: Sequence[TargetObject],
    base: SceneDraw,
    *,
    together: bool,
) -> Layout:
    """Add further labelled objects to a scene.

    Floating objects have disjoint bounding spheres, objects on a table disjoint footprint circles. An object without a
    free position after many tries is left out.

    Args:
        config: Configuration.
        targets: Objects to choose from.
        base: The scene; its object is the first of the layout.
        together: Whether floating objects are grouped around the first, as several cameras require, or spread over the
            image at any distance. On a table they are always grouped.
    """
    purpose, index, attempt = base.address
    rng = stream(config.seed, purpose, Subject.COMPANIONS, index, attempt)
    first = SceneObject(mesh_key=base.target.obj_id, T_cam_obj=base.T_cam_obj, material=base.material)
    table = next((o for o in base.around if o.mesh_key in base.target.tables), None)
    companions = _companions(rng, config, targets, base.target)
    placed: list[SceneObject] = [first]
    for target in companions:
        T = (
            _floating(rng, config, target, _spheres(base, targets), placed, base.others, together)
            if table is None
            else _beside(rng, config, target, base, table, placed, targets)
        )
        material = appearance.draw_material(rng, config.material, target)
        if T is not None:
            placed.append(SceneObject(mesh_key=target.obj_id, T_cam_obj=T, material=material))
    T_ref_level = table.T_cam_obj if table is not None else _level_of(config, base)
    lights, ambient_rgb = base.lights, base.ambient_rgb
    if config.frames.lights == "ceiling" and base.environment is None:
        centre = BoundingSpheres({base.target.obj_id: base.target.mesh}).sphere(first)[0]
        lights, ambient_rgb = appearance.draw_ceiling_lights(
            rng, config.lights, T_ref_level, centre, base.target.mesh.diameter_m
        )
    return Layout(
        labelled=tuple(placed),
        others=base.others,
        T_ref_level=T_ref_level,
        on_table=table is not None,
        lights=lights,
        ambient_rgb=ambient_rgb,
        environment=base.environment,
        background=base.background,
        sensor=base.sensor,
        render_seed=base.render_seed,
    )


def draw_camera(
    rng: np.random.Generator, config: SynthConfig, targets: Mapping[int, TargetObject], layout: Layout
) -> tuple[int, Float[np.ndarray, "4 4"]]:
    """Draw a camera that is aimed at one of a layout's objects, within the object's range of distances.

    Over a table, and for upright views, elevations are uniform on the sphere's zone and the image is level but for the
    roll; else rotations are uniform.

    Returns:
        Position in `layout.labelled` of that object, and T_cam_ref.
    """
    number = int(rng.integers(len(layout.labelled)))
    aim = layout.labelled[number]
    target, camera = targets[aim.mesh_key], config.camera.camera()
    if layout.on_table or config.view.viewpoint == "upright":
        zone = config.tabletop.elevation_deg if layout.on_table else config.view.elevation_deg
        low, high = np.sin(np.deg2rad(zone))
        R_cam_level = level_rotation(
            math.asin(rng.uniform(low, high)),
            rng.uniform(0, 2 * math.pi),
            math.radians(rng.uniform(*config.view.roll_deg)),
        )
        R = R_cam_level @ layout.T_ref_level[:3, :3].T
    else:
        R = random_rotation(rng)
    position = rng.uniform(-1.0, 1.0, 2) * config.view.position_jitter
    z_m = rng.uniform(*target.distance_m)
    centre = BoundingSpheres({aim.mesh_key: target.mesh}).sphere(aim)[0]
    return number, make_T(R, point_at_pixel(camera, position, z_m) - R @ centre)


def clearance_m(spheres: BoundingSpheres, placed: Sequence[SceneObject], T_cam_ref: Float[np.ndarray, "4 4"]) -> float:
    """Distance from a camera to the nearest bounding sphere; negative inside a sphere, infinite without objects."""
    eye = inverse(T_cam_ref)[:3, 3]
    return min((float(np.linalg.norm(c - eye)) - r for c, r in map(spheres.sphere, placed)), default=math.inf)


def frame_sensor(rng: np.random.Generator, config: SynthConfig) -> tuple[Sensor, int]:
    """Camera effects and renderer's seed of a single image of a layout."""
    return appearance.draw_sensor(rng, config.sensor), child_seed(rng)


def _companions(
    rng: np.random.Generator, config: SynthConfig, targets: Sequence[TargetObject], first: TargetObject
) -> list[TargetObject]:
    """Further objects, each at most `frames.instances` times in the image."""
    count = int(rng.integers(config.frames.objects[0], config.frames.objects[1] + 1)) - 1
    pool = [t for t in targets for _ in range(config.frames.instances - (t is first))]
    return [pool[i] for i in rng.permutation(len(pool))[:count]]


def _spheres(base: SceneDraw, targets: Sequence[TargetObject]) -> BoundingSpheres:
    return BoundingSpheres({**{t.obj_id: t.mesh for t in targets}, **base.target.shapes, **base.target.tables})


def _floating(
    rng: np.random.Generator,
    config: SynthConfig,
    target: TargetObject,
    spheres: BoundingSpheres,
    placed: Sequence[SceneObject],
    others: Sequence[SceneObject],
    together: bool,
) -> Float[np.ndarray, "4 4"] | None:
    radius, camera = radius_m(target.mesh), config.camera.camera()
    for _ in range(_TRIES):
        T = draw_pose(rng, config.view, camera, target)
        if together:
            neighbour, r = spheres.sphere(placed[int(rng.integers(len(placed)))])
            gap = rng.uniform(*config.frames.gap_diameter) * target.mesh.diameter_m
            T[:3, 3] += neighbour + random_direction(rng) * (r + radius + gap) - target.mesh.center_cam_m(T)
        if spheres.is_free(target.mesh.center_cam_m(T), radius, (*placed, *others)):
            return T
    return None


def _beside(
    rng: np.random.Generator,
    config: SynthConfig,
    target: TargetObject,
    base: SceneDraw,
    table: SceneObject,
    placed: Sequence[SceneObject],
    targets: Sequence[TargetObject],
) -> Float[np.ndarray, "4 4"] | None:
    """Pose at rest on the scene's table, next to a labelled object; None without a free position."""
    T_table_ref = inverse(table.T_cam_obj)
    circle = _circles(base, targets, T_table_ref)
    neighbours = [circle(o) for o in placed]
    footprints = neighbours + [circle(o) for o in base.others if o is not table]
    half = np.abs(base.target.tables[table.mesh_key].vertices_m).max(axis=0)[:2]
    only_this = {table.mesh_key: base.target.tables[table.mesh_key]}
    placement = tabletop.place_object(
        rng,
        replace(config.tabletop, near_fraction=0.0),
        config.view,
        target.stable_poses[target.obj_id],
        target.mesh.diameter_m,
        only_this,
    )
    x0, y0, radius = placement.footprint_m
    for _ in range(_TRIES):
        x1, y1, r = neighbours[int(rng.integers(len(neighbours)))]
        angle = rng.uniform(0, 2 * math.pi)
        reach = r + radius + rng.uniform(*config.frames.gap_diameter) * target.mesh.diameter_m
        x, y = x1 + reach * math.cos(angle), y1 + reach * math.sin(angle)
        is_on_table = abs(x) + radius <= half[0] and abs(y) + radius <= half[1]
        if is_on_table and all(math.hypot(x - other[0], y - other[1]) >= other[2] + radius for other in footprints):
            T = placement.T_table_obj.copy()
            T[:2, 3] += x - x0, y - y0
            return np.asarray(table.T_cam_obj @ T)
    return None


def _circles(
    base: SceneDraw, targets: Sequence[TargetObject], T_table_ref: Float[np.ndarray, "4 4"]
) -> Callable[[SceneObject], tuple[float, float, float]]:
    """A function that computes the footprint circle of a placed object as seen from above."""
    hulls = {t.obj_id: t.hull_m for t in targets}

    def circle(placed: SceneObject) -> tuple[float, float, float]:
        hull = hulls.get(placed.mesh_key)
        if hull is None:
            hull = base.target.stable_poses[placed.mesh_key].hull_m
        T = T_table_ref @ placed.T_cam_obj
        points = (hull @ T[:3, :3].T + T[:3, 3])[:, :2]
        centre = (points.min(axis=0) + points.max(axis=0)) / 2
        return float(centre[0]), float(centre[1]), float(np.linalg.norm(points - centre, axis=1).max())

    return circle


def _level_of(config: SynthConfig, base: SceneDraw) -> Float[np.ndarray, "4 4"]:
    """A frame with z up, without a table: the object's where it stands upright, else the camera's (y down)."""
    if config.view.viewpoint == "upright":
        return base.T_cam_obj
    return make_T(np.array([[1.0, 0.0, 0.0], [0.0, 0.0, -1.0], [0.0, 1.0, 0.0]]), np.zeros(3))
