"""Layouts of whole camera images: several labelled objects that float or lie together, and cameras that look at them.

A layout is a training pair's scene with further objects put into it. Its frame is that of the camera that this scene
was drawn for, the reference camera; other cameras are poses in it.
"""

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import lru_cache

import numpy as np
from jaxtyping import Float
from posecore.camera import Camera
from posecore.mesh import Mesh
from posecore.se3 import inverse, make_T, random_direction, random_rotation, rotation_from_rotvec

from synthgen.config import LightConfig, SynthConfig
from synthgen.draw import scene_draw, tabletop
from synthgen.draw.random_streams import Subject, child_seed, stream
from synthgen.draw.scene_draw import SceneDraw
from synthgen.draw.target import Target
from synthgen.scene import Background, Environment, Light, Scene, SceneObject, Sensor, Vector

Array = np.ndarray

_TRIES = 40  # places tried for a further object before it is left out
_CEILING_HEIGHT = 2.0  # times the farthest lamp's distance
_CEILING_SIDE = 0.6  # of its height


@dataclass(frozen=True, kw_only=True, eq=False)
class Layout:
    """What the images of a scene share, in the reference camera's frame.

    Attributes:
        labelled: The objects with ground truth; their mesh keys are object ids. A camera looks at one of them.
        others: Table, distractors and shapes that float.
        T_ref_level: A frame whose z axis points up: that of the table where there is one.
        on_table: Whether there is a table.
        lights: Lamps.
        ambient_rgb: Even light.
        environment: Panorama, or none.
        background: What lies behind.
        sensor: Camera effects.
        render_seed: Seed of the renderer's noise.
    """

    labelled: tuple[SceneObject, ...]
    others: tuple[SceneObject, ...]
    T_ref_level: Float[Array, "4 4"]
    on_table: bool
    lights: tuple[Light, ...]
    ambient_rgb: Vector
    environment: Environment | None
    background: Background
    sensor: Sensor
    render_seed: int


@dataclass(frozen=True, kw_only=True, eq=False)
class View:
    """A layout as one image shows it.

    Attributes:
        layout: What there is.
        T_cam_ref: Pose of the layout's frame in the camera's.
        looks_at: Position in `layout.labelled` of the object that the image is about.
        background_shift_px: How far the background is moved right and down against its middle; none draws it for this
            image alone.
        background_reach_px: Largest such shift either way.
    """

    layout: Layout
    T_cam_ref: Float[Array, "4 4"]
    looks_at: int = 0
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
            lights=tuple(moved_light(light, T_cam_ref) for light in layout.lights),
            ambient_rgb=layout.ambient_rgb,
            environment=environment,
            background=layout.background,
            sensor=layout.sensor,
            samples=samples,
            render_seed=layout.render_seed,
        )


def moved_light(light: Light, T_cam_ref: Float[Array, "4 4"]) -> Light:
    """A lamp in another camera's frame."""
    position = T_cam_ref[:3, :3] @ np.array(light.position_cam_m) + T_cam_ref[:3, 3]
    return replace(light, position_cam_m=vector(position), direction_cam=turned(light.direction_cam, T_cam_ref))


def turned(direction: Vector, T_cam_ref: Float[Array, "4 4"]) -> Vector:
    """A direction in another camera's frame."""
    return vector(T_cam_ref[:3, :3] @ np.array(direction))


def vector(values: Float[Array, "3"]) -> Vector:
    """Three plain floats."""
    return (float(values[0]), float(values[1]), float(values[2]))


@dataclass(frozen=True, eq=False)
class Balls:
    """Bounding spheres of placed meshes: two that do not meet hold meshes that do not meet."""

    meshes: Mapping[int, Mesh]

    def of(self, placed: SceneObject) -> tuple[Float[Array, "3"], float]:
        """Centre, in the frame of the pose, and radius."""
        mesh, T = self.meshes[placed.mesh_key], placed.T_cam_obj
        return T[:3, :3] @ mesh.center_m + T[:3, 3], radius_m(mesh)

    def free(self, centre: Float[Array, "3"], radius: float, taken: Sequence[SceneObject]) -> bool:
        """Whether a sphere meets none of the placed ones."""
        return all(np.linalg.norm(centre - c) >= radius + r for c, r in map(self.of, taken))


@lru_cache(maxsize=4096)
def radius_m(mesh: Mesh) -> float:
    """Radius of the sphere about the box centre that holds a mesh; asked for often, so kept by the mesh's identity."""
    return float(np.linalg.norm(mesh.vertices_m - mesh.center_m, axis=1).max())


def draw_layout(
    config: SynthConfig,
    targets: Sequence[Target],
    base: SceneDraw,
    *,
    together: bool,
) -> Layout:
    """Put further labelled objects into a scene.

    An object that finds no free place after many tries is left out. Floating objects keep apart by their bounding
    spheres, those on a table by the circles around them as seen from above.

    Args:
        config: Recipe.
        targets: Objects to choose from.
        base: The scene, with its own object; that one is the first of the layout.
        together: Whether floating objects gather around the first, as they must to be seen by several cameras, or are
            spread over the image at any distance. On a table they always gather.
    """
    purpose, index, attempt = base.address
    rng = stream(config.seed, purpose, Subject.COMPANIONS, index, attempt)
    first = SceneObject(mesh_key=base.target.obj_id, T_cam_obj=base.T_cam_obj, material=base.material)
    table = next((o for o in base.around if o.mesh_key in base.target.tables), None)
    companions = _companions(rng, config, targets, base.target)
    placed: list[SceneObject] = [first]
    for target in companions:
        T = (
            _floating(rng, config, target, _balls(base, targets), placed, base.others, together)
            if table is None
            else _beside(rng, config, target, base, table, placed, targets)
        )
        material = scene_draw.draw_material(rng, config.material, target)
        if T is not None:
            placed.append(SceneObject(mesh_key=target.obj_id, T_cam_obj=T, material=material))
    T_ref_level = table.T_cam_obj if table is not None else _level_of(config, base)
    lights, ambient_rgb = base.lights, base.ambient_rgb
    if config.frames.lights == "ceiling" and base.environment is None:
        centre = Balls({base.target.obj_id: base.target.mesh}).of(first)[0]
        lights, ambient_rgb = ceiling_lights(rng, config.lights, T_ref_level, centre, base.target.mesh.diameter_m)
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
    rng: np.random.Generator, config: SynthConfig, targets: Mapping[int, Target], layout: Layout
) -> tuple[int, Float[Array, "4 4"]]:
    """Draw a camera that looks at one of a layout's objects from its range of distances.

    Over a table, and for upright views, elevations are uniform on the sphere's zone and the image is level but for the
    roll; else every rotation is as likely.

    Returns:
        Position in `layout.labelled` of what it looks at, and T_cam_ref.
    """
    number = int(rng.integers(len(layout.labelled)))
    seen = layout.labelled[number]
    target, camera = targets[seen.mesh_key], config.camera.camera()
    if layout.on_table or config.view.viewpoint == "upright":
        zone = config.tabletop.elevation_deg if layout.on_table else config.view.elevation_deg
        low, high = np.sin(np.deg2rad(zone))
        R_cam_level = level_view(
            math.asin(rng.uniform(low, high)),
            rng.uniform(0, 2 * math.pi),
            math.radians(rng.uniform(*config.view.roll_deg)),
        )
        R = R_cam_level @ layout.T_ref_level[:3, :3].T
    else:
        R = random_rotation(rng)
    place = rng.uniform(-1.0, 1.0, 2) * config.view.position_jitter
    z_m = rng.uniform(*target.distance_m)
    centre = Balls({seen.mesh_key: target.mesh}).of(seen)[0]
    return number, make_T(R, at_pixel(camera, place, z_m) - R @ centre)


def level_view(elevation_rad: float, azimuth_rad: float, roll_rad: float) -> Float[Array, "3 3"]:
    """Rotation from a frame whose z axis points up to a camera above it that looks at its origin.

    Args:
        elevation_rad: Of the camera above the xy plane.
        azimuth_rad: Of the camera, from x towards y.
        roll_rad: Turn of the camera about its axis; at 0 up is up in the image.
    """
    sin_a, cos_a = math.sin(azimuth_rad), math.cos(azimuth_rad)
    sin_e, cos_e = math.sin(elevation_rad), math.cos(elevation_rad)
    right = np.array([-sin_a, cos_a, 0.0])
    forward = -np.array([cos_e * cos_a, cos_e * sin_a, sin_e])
    level = np.stack([right, np.cross(forward, right), forward])
    return np.asarray(rotation_from_rotvec(np.array([0.0, 0.0, roll_rad])) @ level)


def at_pixel(camera: Camera, place: Float[Array, "2"], z_m: float) -> Float[Array, "3"]:
    """The point at a depth that is seen at a place in the image, from -1 to 1 across it."""
    uv = np.array([camera.width_px, camera.height_px]) / 2 * (1.0 + place)
    focal, principal = camera.K[[0, 1], [0, 1]], camera.K[:2, 2]
    return np.append((uv - principal) / focal * z_m, z_m)


def clearance_m(balls: Balls, placed: Sequence[SceneObject], T_cam_ref: Float[Array, "4 4"]) -> float:
    """Distance from a camera to the nearest bounding sphere; negative inside one, infinite without any."""
    eye = inverse(T_cam_ref)[:3, 3]
    return min((float(np.linalg.norm(c - eye)) - r for c, r in map(balls.of, placed)), default=math.inf)


def ceiling_lights(
    rng: np.random.Generator,
    config: LightConfig,
    T_ref_level: Float[Array, "4 4"],
    centre_m: Float[Array, "3"],
    diameter_m: float,
) -> tuple[tuple[Light, ...], Vector]:
    """Light as in a room: a large lamp overhead, a small one somewhere on a shell around, and what walls send back.

    Brightness, ambient share, colour, size and the shell's radii are those of `config`; of what the lamps send, the one
    overhead has between half and nine tenths. See `sampling.draw_lights` for the units.
    """
    brightness = math.exp(rng.uniform(*np.log(config.brightness)))
    share, overhead = rng.uniform(*config.ambient_fraction), rng.uniform(0.5, 0.9)
    R = T_ref_level[:3, :3]
    elevation, azimuth = math.asin(rng.uniform(*np.sin(np.deg2rad([5.0, 89.0])))), rng.uniform(0, 2 * math.pi)
    side = np.array([math.cos(elevation) * math.cos(azimuth), math.cos(elevation) * math.sin(azimuth)])
    near = R @ np.append(side, math.sin(elevation))
    height_m = _CEILING_HEIGHT * config.distance_diameter[1] * diameter_m
    distance_m = rng.uniform(*config.distance_diameter) * diameter_m
    size_m = math.exp(rng.uniform(*np.log(config.size))) * distance_m
    irradiance = math.pi * brightness * (1 - share)
    colours = [1.0 - config.colour * rng.random(3) for _ in range(2)]
    lights = (
        Light(
            kind="area",
            position_cam_m=vector(centre_m + R[:, 2] * height_m),
            direction_cam=vector(R[:, 2]),
            rgb=vector(colours[0] / colours[0].max()),
            strength=irradiance * overhead * math.pi * height_m**2,
            size_m=_CEILING_SIDE * height_m,
        ),
        Light(
            kind="point",
            position_cam_m=vector(centre_m + near * distance_m),
            direction_cam=vector(near),
            rgb=vector(colours[1] / colours[1].max()),
            strength=irradiance * (1 - overhead) * 4 * math.pi * distance_m**2,
            size_m=size_m,
        ),
    )
    return lights, vector(np.full(3, brightness * share))


def frame_sensor(rng: np.random.Generator, config: SynthConfig) -> tuple[Sensor, int]:
    """Camera effects and the renderer's seed of one image among several of a layout."""
    return scene_draw.draw_sensor(rng, config.sensor), child_seed(rng)


def _companions(
    rng: np.random.Generator, config: SynthConfig, targets: Sequence[Target], first: Target
) -> list[Target]:
    """Further objects, none more often than the configuration allows."""
    count = int(rng.integers(config.frames.objects[0], config.frames.objects[1] + 1)) - 1
    pool = [t for t in targets for _ in range(config.frames.instances - (t is first))]
    return [pool[i] for i in rng.permutation(len(pool))[:count]]


def _balls(base: SceneDraw, targets: Sequence[Target]) -> Balls:
    return Balls({**{t.obj_id: t.mesh for t in targets}, **base.target.shapes, **base.target.tables})


def _floating(
    rng: np.random.Generator,
    config: SynthConfig,
    target: Target,
    balls: Balls,
    placed: Sequence[SceneObject],
    others: Sequence[SceneObject],
    together: bool,
) -> Float[Array, "4 4"] | None:
    radius, camera = radius_m(target.mesh), config.camera.camera()
    for _ in range(_TRIES):
        T = scene_draw.draw_pose(rng, config.view, camera, target)
        if together:
            beside, r = balls.of(placed[int(rng.integers(len(placed)))])
            gap = rng.uniform(*config.frames.gap_diameter) * target.mesh.diameter_m
            T[:3, 3] += (
                beside + random_direction(rng) * (r + radius + gap) - (T[:3, :3] @ target.mesh.center_m + T[:3, 3])
            )
        if balls.free(T[:3, :3] @ target.mesh.center_m + T[:3, 3], radius, (*placed, *others)):
            return T
    return None


def _beside(
    rng: np.random.Generator,
    config: SynthConfig,
    target: Target,
    base: SceneDraw,
    table: SceneObject,
    placed: Sequence[SceneObject],
    targets: Sequence[Target],
) -> Float[Array, "4 4"] | None:
    """At rest on the scene's table, next to one of the labelled objects."""
    T_table_ref = inverse(table.T_cam_obj)
    circle = _circles(base, targets, T_table_ref)
    neighbours = [circle(o) for o in placed]
    taken = neighbours + [circle(o) for o in base.others if o is not table]
    half = np.abs(base.target.tables[table.mesh_key].vertices_m).max(axis=0)[:2]
    only_this = {table.mesh_key: base.target.tables[table.mesh_key]}
    setting = tabletop.set_object(
        rng,
        replace(config.tabletop, near_fraction=0.0),
        config.view,
        target.rests[target.obj_id],
        target.mesh.diameter_m,
        only_this,
    )
    x0, y0, radius = setting.footprint_m
    for _ in range(_TRIES):
        x1, y1, r = neighbours[int(rng.integers(len(neighbours)))]
        angle = rng.uniform(0, 2 * math.pi)
        reach = r + radius + rng.uniform(*config.frames.gap_diameter) * target.mesh.diameter_m
        x, y = x1 + reach * math.cos(angle), y1 + reach * math.sin(angle)
        stands = abs(x) + radius <= half[0] and abs(y) + radius <= half[1]
        if stands and all(math.hypot(x - other[0], y - other[1]) >= other[2] + radius for other in taken):
            T = setting.T_table_obj.copy()
            T[:2, 3] += x - x0, y - y0
            return np.asarray(table.T_cam_obj @ T)
    return None


def _circles(
    base: SceneDraw, targets: Sequence[Target], T_table_ref: Float[Array, "4 4"]
) -> Callable[[SceneObject], tuple[float, float, float]]:
    """The circle around a placed thing, seen from above."""
    hulls = {t.obj_id: t.hull_m for t in targets}

    def circle(placed: SceneObject) -> tuple[float, float, float]:
        hull = hulls.get(placed.mesh_key)
        if hull is None:
            hull = base.target.rests[placed.mesh_key].hull_m
        T = T_table_ref @ placed.T_cam_obj
        points = (hull @ T[:3, :3].T + T[:3, 3])[:, :2]
        centre = (points.min(axis=0) + points.max(axis=0)) / 2
        return float(centre[0]), float(centre[1]), float(np.linalg.norm(points - centre, axis=1).max())

    return circle


def _level_of(config: SynthConfig, base: SceneDraw) -> Float[Array, "4 4"]:
    """A level frame without a table: the object's own where it stands upright, else the camera's, y being down."""
    if config.view.viewpoint == "upright":
        return base.T_cam_obj
    return make_T(np.array([[1.0, 0.0, 0.0], [0.0, 0.0, -1.0], [0.0, 1.0, 0.0]]), np.zeros(3))
