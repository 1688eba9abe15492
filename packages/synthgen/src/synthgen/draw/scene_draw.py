"""Draws of scenes: pure functions of (configuration, seed, index, attempt)."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float
from posecore.camera import Camera
from posecore.se3 import inverse, make_T

from synthgen.config import SynthConfig
from synthgen.draw import appearance, occluders, tabletop
from synthgen.draw.poses import draw_level_rotation, draw_pose, pose_at_distance
from synthgen.draw.random_streams import Purpose, Subject, child_seed, stream
from synthgen.draw.target import TargetObject
from synthgen.inputs.assets import Assets
from synthgen.scene import Background, Environment, Light, Material, Scene, SceneObject, Sensor, Vector


@dataclass(frozen=True, kw_only=True, eq=False)
class SceneDraw:
    """A drawn scene, without the region of the image to render.

    Attributes:
        address: (purpose, scene, attempt) of the draw.
        target: The target object.
        T_cam_obj: True pose of the object.
        front: Occluders between the object and the camera.
        around: Table and props.
        material: Material of the object.
        lights: Lamps.
        ambient_rgb: Ambient light.
        environment: Panorama that lights the scene, or None.
        background: Background.
        sensor: Camera effects.
        render_seed: Seed of the renderer's noise.
    """

    address: tuple[Purpose, int, int]
    target: TargetObject
    T_cam_obj: Float[np.ndarray, "4 4"]
    front: tuple[SceneObject, ...]
    around: tuple[SceneObject, ...]
    material: Material
    lights: tuple[Light, ...]
    ambient_rgb: Vector
    environment: Environment | None
    background: Background
    sensor: Sensor
    render_seed: int

    @property
    def others(self) -> tuple[SceneObject, ...]:
        """All objects but the target."""
        return (*self.front, *self.around)

    def scene(self, camera: Camera, region_px: tuple[int, int, int, int], samples: int) -> Scene:
        """The scene to render in a region of the image."""
        target = SceneObject(mesh_key=self.target.obj_id, T_cam_obj=self.T_cam_obj, material=self.material)
        return Scene(
            camera=camera,
            region_px=region_px,
            objects=(target, *self.others),
            lights=self.lights,
            ambient_rgb=self.ambient_rgb,
            environment=self.environment,
            background=self.background,
            sensor=self.sensor,
            samples=samples,
            render_seed=self.render_seed,
        )


def draw_scene(
    config: SynthConfig,
    targets: Sequence[TargetObject],
    assets: Assets,
    purpose: Purpose,
    scene_index: int,
    attempt: int,
) -> SceneDraw:
    """Draw a scene. `attempt` starts at 0; a rejected scene is drawn again with the next attempt.

    The target does not depend on the attempt: an object whose scenes are often rejected is shown as often as others.
    """

    def rng(subject: Subject) -> np.random.Generator:
        return stream(config.seed, purpose, subject, scene_index, attempt)

    target = targets[target_index(config.seed, purpose, scene_index, len(targets))]
    is_tabletop = _is_tabletop(config, purpose, scene_index)
    T_cam_obj, T_cam_table, placement = _draw_poses(config, target, rng, is_tabletop)
    centre, diameter_m = target.mesh.center_cam_m(T_cam_obj), target.mesh.diameter_m
    front, around = occluders.draw_occluders(
        rng(Subject.OCCLUDERS), config.occluders, target.shapes, centre, diameter_m
    )
    if placement is not None:
        front = tuple(tabletop.raise_above_table(o, target.shapes[o.mesh_key], T_cam_table) for o in front)
        around = tabletop.surroundings(
            rng(Subject.TABLE),
            config.tabletop,
            placement,
            T_cam_table,
            target.shapes,
            target.stable_poses,
            target.tables,
            diameter_m,
            occluders.draw_occluder_material,
        )
    lights, ambient_rgb = appearance.draw_lights(rng(Subject.LIGHTS), config.lights, centre, diameter_m)
    background = appearance.draw_background(rng(Subject.BACKGROUND), config.background.photo_fraction, assets.photos)
    environment, is_visible = appearance.draw_environment(
        rng(Subject.ENVIRONMENT), config, assets.hdris, T_cam_table[:3, :3]
    )
    if environment is not None:
        lights, ambient_rgb = (), (0.0, 0.0, 0.0)
        background = Background(kind="environment", seed=background.seed) if is_visible else background
    return SceneDraw(
        address=(purpose, scene_index, attempt),
        target=target,
        T_cam_obj=T_cam_obj,
        front=front,
        around=around,
        material=appearance.draw_material(rng(Subject.MATERIAL), config.material, target),
        lights=lights,
        ambient_rgb=ambient_rgb,
        environment=environment,
        background=background,
        sensor=appearance.draw_sensor(rng(Subject.SENSOR), config.sensor),
        render_seed=child_seed(rng(Subject.RENDER)),
    )


def target_index(seed: int, purpose: Purpose, scene_index: int, count: int) -> int:
    """Index of a scene's target object among `count`.

    Every block of `count` scenes shows each target once, in random order, so that among the first n scenes the numbers
    of scenes of two targets differ by at most one.
    """
    block, position = divmod(scene_index, count)
    return int(stream(seed, purpose, Subject.TARGET, block).permutation(count)[position])


def _is_tabletop(config: SynthConfig, purpose: Purpose, scene_index: int) -> bool:
    """Whether a scene has a table; like the target this is the same in all attempts."""
    fraction = {"cutout": 0.0, "tabletop": 1.0, "mixed": config.scene.tabletop_fraction}[config.scene.kind]
    return bool(stream(config.seed, purpose, Subject.KIND, scene_index).random() < fraction)


def _draw_poses(
    config: SynthConfig, target: TargetObject, rng: Callable[[Subject], np.random.Generator], is_tabletop: bool
) -> tuple[Float[np.ndarray, "4 4"], Float[np.ndarray, "4 4"], tabletop.Placement | None]:
    """Poses of the object and of the table (of a level frame in a cutout scene), and the placement on the table."""
    pose_rng, camera = rng(Subject.POSE), config.camera.camera()
    R_cam_table = draw_level_rotation(rng(Subject.VIEW), config.tabletop.elevation_deg, config.view.roll_deg)
    if not is_tabletop:
        T_cam_obj = draw_pose(pose_rng, config.view, camera, target)
        level = T_cam_obj[:3, :3] if config.view.viewpoint == "upright" else R_cam_table
        return T_cam_obj, make_T(level, np.zeros(3)), None
    stable = target.stable_poses[target.obj_id]
    placement = tabletop.place_object(
        rng(Subject.PLACEMENT), config.tabletop, config.view, stable, target.mesh.diameter_m, target.tables
    )
    R = R_cam_table @ placement.T_table_obj[:3, :3]
    T_cam_obj = pose_at_distance(pose_rng, config.view, camera, target, R)
    return T_cam_obj, T_cam_obj @ inverse(placement.T_table_obj), placement


def adjust_visibility(draw: SceneDraw, config: SynthConfig, visible_of: Callable[[SceneDraw], float]) -> SceneDraw:
    """The scene with its occluders moved in front of the object until a drawn fraction of the object is visible.

    Args:
        draw: A scene.
        config: Configuration; without `occluders.visible_fraction` the scene stays as it is.
        visible_of: The object's visible fraction in a scene, from a low-resolution render.
    """
    if config.occluders.visible_fraction is None:
        return draw
    purpose, scene_index, attempt = draw.address
    shapes = draw.target.shapes
    tables = [o.T_cam_obj for o in draw.around if o.mesh_key in draw.target.tables]

    def lift(item: SceneObject) -> SceneObject:
        return tabletop.raise_above_table(item, shapes[item.mesh_key], tables[0]) if tables else item

    front = occluders.move_in_front(
        stream(config.seed, purpose, Subject.VISIBILITY, scene_index, attempt),
        config.occluders,
        shapes,
        draw.target.mesh.center_cam_m(draw.T_cam_obj),
        draw.target.mesh.diameter_m,
        draw.front,
        lambda front: visible_of(replace(draw, front=front)),
        lift,
    )
    return replace(draw, front=front)
