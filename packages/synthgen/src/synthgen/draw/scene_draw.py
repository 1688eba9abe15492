"""Draws of scenes and hypotheses: pure functions of (configuration, seed, index, attempt)."""

import colorsys
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
from jaxtyping import Float
from posecore.camera import Camera
from posecore.mesh import Mesh
from posecore.se3 import inverse, make_T, random_direction, random_rotation, rotation_from_rotvec
from posecore.window import silhouette_box

from synthgen.config import LightConfig, MaterialConfig, PerturbationConfig, SensorConfig, SynthConfig, ViewConfig
from synthgen.draw import occluders, tabletop
from synthgen.draw.random_streams import Purpose, Subject, child_seed, stream
from synthgen.draw.target import Target
from synthgen.inputs.assets import Assets
from synthgen.scene import Background, Environment, Light, Material, Pattern, Scene, SceneObject, Sensor, Vector

Array = np.ndarray


@dataclass(frozen=True, kw_only=True, eq=False)
class SceneDraw:
    """Everything about a scene but the part of the image to render.

    Attributes:
        address: (purpose, scene, attempt) that it was drawn at.
        target: The object.
        T_cam_obj: Its true pose.
        front: Shapes that float between it and the camera.
        around: Table and props.
        material: Its surface.
        lights: Lamps.
        ambient_rgb: Even light.
        environment: Panorama that lights the scene, or none.
        background: What lies behind.
        sensor: Camera effects.
        render_seed: Seed of the renderer's noise.
    """

    address: tuple[Purpose, int, int]
    target: Target
    T_cam_obj: Float[Array, "4 4"]
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
        """Everything beside the target."""
        return (*self.front, *self.around)

    def scene(self, camera: Camera, region_px: tuple[int, int, int, int], samples: int) -> Scene:
        """The scene to render for a part of the image."""
        truth = SceneObject(mesh_key=self.target.obj_id, T_cam_obj=self.T_cam_obj, material=self.material)
        return Scene(
            camera=camera,
            region_px=region_px,
            objects=(truth, *self.others),
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
    targets: Sequence[Target],
    assets: Assets,
    purpose: Purpose,
    scene_index: int,
    attempt: int,
) -> SceneDraw:
    """Draw a scene. `attempt` 0 is the first; a rejected scene is drawn again with the next.

    The target does not depend on the attempt: objects that are often rejected are shown as often as the others.
    """

    def rng(subject: Subject) -> np.random.Generator:
        return stream(config.seed, purpose, subject, scene_index, attempt)

    target = targets[target_of(config.seed, purpose, scene_index, len(targets))]
    is_tabletop = _is_tabletop(config, purpose, scene_index)
    T_cam_obj, T_cam_table, setting = _placed(config, target, rng, is_tabletop)
    centre, diameter_m = _centre(target, T_cam_obj), target.mesh.diameter_m
    front, around = occluders.place(rng(Subject.OCCLUDERS), config.occluders, target.shapes, centre, diameter_m)
    if setting is not None:
        front = tuple(tabletop.lifted(o, target.shapes[o.mesh_key], T_cam_table) for o in front)
        around = tabletop.surroundings(
            rng(Subject.TABLE),
            config.tabletop,
            setting,
            T_cam_table,
            target.shapes,
            target.rests,
            target.tables,
            diameter_m,
            occluders.look,
        )
    lights, ambient_rgb = draw_lights(rng(Subject.LIGHTS), config.lights, centre, diameter_m)
    background = draw_background(rng(Subject.BACKGROUND), config.background.photo_fraction, assets.photos)
    environment, seen = draw_environment(rng(Subject.ENVIRONMENT), config, assets.hdris, T_cam_table[:3, :3])
    if environment is not None:
        lights, ambient_rgb = (), (0.0, 0.0, 0.0)
        background = Background(kind="environment", seed=background.seed) if seen else background
    return SceneDraw(
        address=(purpose, scene_index, attempt),
        target=target,
        T_cam_obj=T_cam_obj,
        front=front,
        around=around,
        material=draw_material(rng(Subject.MATERIAL), config.material, target),
        lights=lights,
        ambient_rgb=ambient_rgb,
        environment=environment,
        background=background,
        sensor=draw_sensor(rng(Subject.SENSOR), config.sensor),
        render_seed=child_seed(rng(Subject.RENDER)),
    )


def target_of(seed: int, purpose: Purpose, scene_index: int, count: int) -> int:
    """Which of `count` targets a scene shows.

    Every block of `count` scenes shows each target once, in an order of its own, so that over any number of scenes from
    the first on two targets' numbers of scenes differ by one at most.
    """
    block, place = divmod(scene_index, count)
    return int(stream(seed, purpose, Subject.TARGET, block).permutation(count)[place])


def _is_tabletop(config: SynthConfig, purpose: Purpose, scene_index: int) -> bool:
    """Whether a scene has a table; like its target it keeps that over all attempts."""
    share = {"cutout": 0.0, "tabletop": 1.0, "mixed": config.scene.tabletop_fraction}[config.scene.kind]
    return bool(stream(config.seed, purpose, Subject.KIND, scene_index).random() < share)


def _placed(
    config: SynthConfig, target: Target, rng: Callable[[Subject], np.random.Generator], is_tabletop: bool
) -> tuple[Float[Array, "4 4"], Float[Array, "4 4"], tabletop.Setting | None]:
    """The object's pose, that of the table or of a level frame in its place, and the setting on the table if any."""
    pose_rng, camera = rng(Subject.POSE), config.camera.camera()
    R_cam_table = _level(rng(Subject.VIEW), config.tabletop.elevation_deg, config.view.roll_deg)
    if not is_tabletop:
        T_cam_obj = draw_pose(pose_rng, config.view, camera, target)
        level = T_cam_obj[:3, :3] if config.view.viewpoint == "upright" else R_cam_table
        return T_cam_obj, make_T(level, np.zeros(3)), None
    rest = target.rests[target.obj_id]
    setting = tabletop.set_object(
        rng(Subject.SETTING), config.tabletop, config.view, rest, target.mesh.diameter_m, target.tables
    )
    R = R_cam_table @ setting.T_table_obj[:3, :3]
    T_cam_obj = _at_distance(pose_rng, config.view, camera, target, R)
    return T_cam_obj, T_cam_obj @ inverse(setting.T_table_obj), setting


def slide_in(draw: SceneDraw, config: SynthConfig, visible_of: Callable[[SceneDraw], float]) -> SceneDraw:
    """The scene with its shapes in front slid in until the wanted share of the object is visible.

    Args:
        draw: A scene.
        config: Recipe; without `occluders.visible_fraction` the scene stays as it is.
        visible_of: The object's visible share in a scene, as a small render sees it.
    """
    if config.occluders.visible_fraction is None:
        return draw
    purpose, scene_index, attempt = draw.address
    shapes = draw.target.shapes
    tables = [o.T_cam_obj for o in draw.around if o.mesh_key in draw.target.tables]

    def lift(thing: SceneObject) -> SceneObject:
        return tabletop.lifted(thing, shapes[thing.mesh_key], tables[0]) if tables else thing

    front = occluders.slide_in(
        stream(config.seed, purpose, Subject.VISIBILITY, scene_index, attempt),
        config.occluders,
        shapes,
        _centre(draw.target, draw.T_cam_obj),
        draw.target.mesh.diameter_m,
        draw.front,
        lambda things: visible_of(replace(draw, front=things)),
        lift,
    )
    return replace(draw, front=front)


def _centre(target: Target, T_cam_obj: Float[Array, "4 4"]) -> Float[Array, "3"]:
    return np.asarray(T_cam_obj[:3, :3] @ target.mesh.center_m + T_cam_obj[:3, 3])


def draw_pose(rng: np.random.Generator, view: ViewConfig, camera: Camera, target: Target) -> Float[Array, "4 4"]:
    """Draw a true pose: rotation by `view.viewpoint`, distance uniform, box centre around the image's middle."""
    R = random_rotation(rng) if view.viewpoint == "so3" else _level(rng, view.elevation_deg, view.roll_deg)
    return _at_distance(rng, view, camera, target, R)


def _at_distance(
    rng: np.random.Generator, view: ViewConfig, camera: Camera, target: Target, R: Float[Array, "3 3"]
) -> Float[Array, "4 4"]:
    z = rng.uniform(*target.distance_m)
    half = np.array([camera.width_px, camera.height_px]) / 2
    uv = half * (1.0 + view.position_jitter * rng.uniform(-1.0, 1.0, 2))
    focal, principal = camera.K[[0, 1], [0, 1]], camera.K[:2, 2]
    centre = np.append((uv - principal) / focal * z, z)
    return make_T(R, centre - R @ target.mesh.center_m)


def _level(
    rng: np.random.Generator, elevation_deg: tuple[float, float], roll_deg: tuple[float, float]
) -> Float[Array, "3 3"]:
    """Rotation from a frame whose z axis points up to a camera around it; elevations uniform on the sphere's zone."""
    low, high = np.sin(np.deg2rad(elevation_deg))
    elevation, azimuth = math.asin(rng.uniform(low, high)), rng.uniform(0, 2 * math.pi)
    roll = math.radians(rng.uniform(*roll_deg))
    right = np.array([-math.sin(azimuth), math.cos(azimuth), 0.0])
    forward = -np.array(
        [math.cos(elevation) * math.cos(azimuth), math.cos(elevation) * math.sin(azimuth), math.sin(elevation)]
    )
    level = np.stack([right, np.cross(forward, right), forward])
    return np.asarray(rotation_from_rotvec(np.array([0.0, 0.0, roll])) @ level)


def draw_hypothesis(
    rng: np.random.Generator, config: PerturbationConfig, T_cam_obj: Float[Array, "4 4"], mesh: Mesh
) -> Float[Array, "4 4"]:
    """Perturb a true pose: turn it about the object's box centre and move it.

    The box centre and not the origin is the pivot, because meshes whose origin lies far off their surface would swing
    out of the window. For a mesh centred on its origin the two are the same.
    """
    ease = config.easy_scale if rng.random() < config.easy_fraction else 1.0
    angle = math.radians(config.max_angle_deg) * ease * rng.uniform()
    length_m = config.max_translation_diameter * mesh.diameter_m * ease * rng.uniform()
    dR = rotation_from_rotvec(random_direction(rng) * angle)
    R, t = T_cam_obj[:3, :3], T_cam_obj[:3, 3]
    centre = R @ mesh.center_m + t
    moved = centre + random_direction(rng) * length_m
    return make_T(dR @ R, moved - dR @ R @ mesh.center_m)


def draw_lights(
    rng: np.random.Generator, config: LightConfig, centre_cam_m: Float[Array, "3"], diameter_m: float
) -> tuple[tuple[Light, ...], Vector]:
    """Draw lamps around the object, mostly on the camera's side, and the even light.

    A white matt surface that faced all lamps at once would show the drawn brightness: irradiance E makes a white
    surface's radiance E / pi, and strengths follow from the lamp's distance d as E d^2 4 pi (point) or E d^2 pi (area
    lamp, on its axis).
    """
    brightness = math.exp(rng.uniform(*np.log(config.brightness)))
    count = int(rng.integers(config.count[0], config.count[1] + 1))
    share = rng.uniform(*config.ambient_fraction) if count else 1.0
    ambient = _tinted(rng, config.colour / 2) * brightness * share
    weights = rng.dirichlet(np.ones(count)) if count else np.zeros(0)
    lights = []
    for weight in weights:
        direction = random_direction(rng)
        while direction[2] > 0.3:  # from behind it would only draw rims
            direction = random_direction(rng)
        distance_m = rng.uniform(*config.distance_diameter) * diameter_m
        size = math.exp(rng.uniform(*np.log(config.size)))
        irradiance = math.pi * brightness * (1 - share) * float(weight)
        kinds: tuple[Literal["point", "area", "sun"], ...] = ("point", "area", "sun")
        kind = kinds[int(rng.integers(3))]
        factor = {"point": 4 * math.pi * distance_m**2, "area": math.pi * distance_m**2, "sun": 1.0}[kind]
        lights.append(
            Light(
                kind=kind,
                position_cam_m=_vector(centre_cam_m + direction * distance_m),
                direction_cam=_vector(direction),
                rgb=_vector(_tinted(rng, config.colour)),
                strength=irradiance * factor,
                size_m=min(size, 1.0) if kind == "sun" else size * distance_m,
            )
        )
    return tuple(lights), _vector(ambient)


def draw_material(rng: np.random.Generator, config: MaterialConfig, target: Target) -> Material:
    """Draw how the object's surface departs from its own colours, or replaces them."""
    material = Material(
        hue_shift=float(rng.uniform(-config.hue_shift, config.hue_shift)),
        saturation=float(rng.uniform(*config.saturation)),
        value=float(rng.uniform(*config.value)),
        roughness=float(rng.uniform(*config.roughness)),
        metallic=float(rng.uniform(*config.metallic)),
        specular=float(rng.uniform(*config.specular)),
    )
    kind = rng.random()
    if kind < config.textureless_fraction:
        mean = _vector(target.mean_rgb)
        hue, saturation, value = colorsys.rgb_to_hsv(*mean)
        changed = ((hue + material.hue_shift) % 1.0, saturation * material.saturation, value * material.value)
        base = colorsys.hsv_to_rgb(changed[0], min(changed[1], 1.0), min(changed[2], 1.0))
    elif kind < config.textureless_fraction + config.random_colour_fraction:
        base = _any_colour(rng)
    else:
        return material
    is_patterned = kind >= config.textureless_fraction and rng.random() < 0.5
    pattern = _pattern(rng, target.mesh.diameter_m) if is_patterned else None
    return replace(material, base_rgb=base, pattern=pattern, hue_shift=0.0, saturation=1.0, value=1.0)


def _any_colour(rng: np.random.Generator) -> Vector:
    return colorsys.hsv_to_rgb(rng.random(), rng.uniform(0.0, 1.0), rng.uniform(0.1, 1.0))


def _pattern(rng: np.random.Generator, diameter_m: float) -> Pattern:
    """Bands of another colour, 2 to 15 over the diameter, straight or bent."""
    wave = random_direction(rng) * 2 * math.pi * math.exp(rng.uniform(math.log(2), math.log(15))) / diameter_m
    warp = random_direction(rng) * 2 * math.pi * rng.uniform(1.0, 6.0) / diameter_m
    bend = float(rng.uniform(0.0, 6.0)) if rng.random() < 0.7 else 0.0
    return Pattern(
        accent_rgb=_any_colour(rng),
        wave=_vector(wave),
        warp=_vector(warp),
        bend=bend,
        sharpness=float(math.exp(rng.uniform(0.0, math.log(20.0)))),
    )


def draw_environment(
    rng: np.random.Generator, config: SynthConfig, hdris: Sequence[str], R_cam_level: Float[Array, "3 3"]
) -> tuple[Environment | None, bool]:
    """Draw which panorama lights a scene, if any, and whether it is seen behind.

    Args:
        rng: Stream.
        config: Recipe.
        hdris: Panoramas.
        R_cam_level: Rotation from a frame whose z axis points up; the panorama stands upright in it.
    """
    if not hdris or rng.random() >= config.lights.hdri_fraction:
        return None, False
    path = hdris[int(rng.integers(len(hdris)))]
    turn = rotation_from_rotvec(np.array([0.0, 0.0, rng.uniform(0, 2 * math.pi)]))
    strength = math.exp(rng.uniform(*np.log(config.lights.brightness)))
    seen = bool(rng.random() < config.background.hdri_fraction)
    return Environment(path=path, R_cam_env=R_cam_level @ turn, strength=strength), seen


def draw_background(rng: np.random.Generator, photo_fraction: float, photos: Sequence[str]) -> Background:
    """Draw which background; a photograph only where some are given."""
    seed, is_photo = child_seed(rng), rng.random() < photo_fraction
    if photos and is_photo:
        return Background(kind="photo", seed=seed, path=photos[int(rng.integers(len(photos)))])
    return Background(kind="procedural", seed=seed)


def draw_sensor(rng: np.random.Generator, config: SensorConfig) -> Sensor:
    """Draw camera effects."""
    return Sensor(
        exposure_ev=float(rng.uniform(*config.exposure_ev)),
        white_balance=_vector(np.exp(rng.normal(0.0, config.white_balance, 3))),
        noise_sigma=float(rng.uniform(*config.noise_sigma)),
        blur_sigma_px=float(rng.uniform(*config.blur_sigma_px)),
        motion_px=float(rng.uniform(*config.motion_px)) if rng.random() < config.motion_fraction else 0.0,
        motion_angle_rad=float(rng.uniform(0, math.pi)),
        jpeg_quality=int(rng.integers(config.jpeg_quality[0], config.jpeg_quality[1] + 1))
        if rng.random() < config.jpeg_fraction
        else None,
        seed=child_seed(rng),
    )


def share_inside(box_px: Float[Array, "4"], camera: Camera) -> float:
    """Share of a silhouette's box (x0, y0, x1, y1) that lies inside the image; 0 for an infinite box."""
    x0, y0, x1, y1 = box_px
    if not np.isfinite(box_px).all():
        return 0.0
    w = max(0.0, min(x1, camera.width_px) - max(x0, 0.0))
    h = max(0.0, min(y1, camera.height_px) - max(y0, 0.0))
    return float(w * h / max((x1 - x0) * (y1 - y0), 1e-12))


def target_box(target: Target, camera: Camera, T_cam_obj: Float[Array, "4 4"]) -> Float[Array, "4"]:
    """Box (x0, y0, x1, y1) of the target's silhouette in full-image pixels."""
    return silhouette_box(target.hull_m, camera.K, T_cam_obj)


def _tinted(rng: np.random.Generator, strength: float) -> Float[Array, "3"]:
    """A light colour between white and, at strength 1, any colour; its brightest channel is 1."""
    colour = 1.0 - strength * rng.random(3)
    return np.asarray(colour / colour.max())


def _vector(values: Float[Array, "3"]) -> Vector:
    return (float(values[0]), float(values[1]), float(values[2]))
