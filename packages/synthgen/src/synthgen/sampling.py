"""Draws of scenes and hypotheses: pure functions of (configuration, seed, index, attempt)."""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np
from jaxtyping import Float
from posecore.camera import Camera
from posecore.se3 import make_T, random_direction, random_rotation, rotation_from_rotvec
from posecore.window import silhouette_box

from synthgen import occluders
from synthgen.config import LightConfig, MaterialConfig, PerturbationConfig, SensorConfig, SynthConfig, ViewConfig
from synthgen.scene import Background, Light, Material, Scene, SceneObject, Sensor, Vector
from synthgen.streams import Purpose, Subject, child_seed, stream
from synthgen.target import Target

Array = np.ndarray


@dataclass(frozen=True, kw_only=True, eq=False)
class SceneDraw:
    """Everything about a scene but the part of the image to render.

    Attributes:
        target: The object.
        T_cam_obj: Its true pose.
        others: Occluders and props.
        material: Its surface.
        lights: Lamps.
        ambient_rgb: Even light.
        background: What lies behind.
        sensor: Camera effects.
        render_seed: Seed of the renderer's noise.
    """

    target: Target
    T_cam_obj: Float[Array, "4 4"]
    others: tuple[SceneObject, ...]
    material: Material
    lights: tuple[Light, ...]
    ambient_rgb: Vector
    background: Background
    sensor: Sensor
    render_seed: int

    def scene(self, camera: Camera, region_px: tuple[int, int, int, int], samples: int) -> Scene:
        """The scene to render for a part of the image."""
        truth = SceneObject(mesh_key=self.target.obj_id, T_cam_obj=self.T_cam_obj, material=self.material)
        return Scene(
            camera=camera,
            region_px=region_px,
            objects=(truth, *self.others),
            lights=self.lights,
            ambient_rgb=self.ambient_rgb,
            background=self.background,
            sensor=self.sensor,
            samples=samples,
            render_seed=self.render_seed,
        )


def draw_scene(
    config: SynthConfig,
    targets: Sequence[Target],
    photos: Sequence[str],
    purpose: Purpose,
    scene_index: int,
    attempt: int,
) -> SceneDraw:
    """Draw a scene. `attempt` 0 is the first; a rejected scene is drawn again with the next."""

    def rng(subject: Subject) -> np.random.Generator:
        return stream(config.seed, purpose, subject, scene_index, attempt)

    pose_rng = rng(Subject.POSE)
    target = targets[int(pose_rng.integers(len(targets)))]
    T_cam_obj = draw_pose(pose_rng, config.view, config.camera.camera(), target)
    centre = T_cam_obj[:3, :3] @ target.mesh.center_m + T_cam_obj[:3, 3]
    diameter_m = target.mesh.diameter_m
    lights, ambient_rgb = draw_lights(rng(Subject.LIGHTS), config.lights, centre, diameter_m)
    return SceneDraw(
        target=target,
        T_cam_obj=T_cam_obj,
        others=occluders.place(rng(Subject.OCCLUDERS), config.occluders, target.shapes, centre, diameter_m),
        material=draw_material(rng(Subject.MATERIAL), config.material),
        lights=lights,
        ambient_rgb=ambient_rgb,
        background=draw_background(rng(Subject.BACKGROUND), config.background.photo_share, photos),
        sensor=draw_sensor(rng(Subject.SENSOR), config.sensor),
        render_seed=child_seed(rng(Subject.RENDER)),
    )


def draw_pose(rng: np.random.Generator, view: ViewConfig, camera: Camera, target: Target) -> Float[Array, "4 4"]:
    """Draw a true pose: rotation by `view.viewpoint`, distance uniform, box centre around the image's middle."""
    R = random_rotation(rng) if view.viewpoint == "so3" else _upright(rng, view)
    z = rng.uniform(*target.distance_m)
    half = np.array([camera.width_px, camera.height_px]) / 2
    uv = half * (1.0 + view.position_jitter * rng.uniform(-1.0, 1.0, 2))
    focal, principal = camera.K[[0, 1], [0, 1]], camera.K[:2, 2]
    centre = np.append((uv - principal) / focal * z, z)
    return make_T(R, centre - R @ target.mesh.center_m)


def _upright(rng: np.random.Generator, view: ViewConfig) -> Float[Array, "3 3"]:
    """Rotation of a camera around an object whose z axis points up; elevations uniform on the sphere's zone."""
    low, high = np.sin(np.deg2rad(view.elevation_deg))
    elevation, azimuth = math.asin(rng.uniform(low, high)), rng.uniform(0, 2 * math.pi)
    roll = math.radians(rng.uniform(*view.roll_deg))
    right = np.array([-math.sin(azimuth), math.cos(azimuth), 0.0])
    forward = -np.array(
        [math.cos(elevation) * math.cos(azimuth), math.cos(elevation) * math.sin(azimuth), math.sin(elevation)]
    )
    level = np.stack([right, np.cross(forward, right), forward])
    return np.asarray(rotation_from_rotvec(np.array([0.0, 0.0, roll])) @ level)


def draw_hypothesis(
    rng: np.random.Generator, config: PerturbationConfig, T_cam_obj: Float[Array, "4 4"], target: Target
) -> Float[Array, "4 4"]:
    """Perturb a true pose: turn it about the object's box centre and move it.

    The box centre and not the origin is the pivot, because meshes whose origin lies far off their surface would swing
    out of the window. For a mesh centred on its origin the two are the same.
    """
    ease = config.easy_scale if rng.random() < config.easy_share else 1.0
    angle = math.radians(config.max_angle_deg) * ease * rng.uniform()
    length_m = config.max_translation_diameter * target.mesh.diameter_m * ease * rng.uniform()
    dR = rotation_from_rotvec(random_direction(rng) * angle)
    R, t = T_cam_obj[:3, :3], T_cam_obj[:3, 3]
    centre = R @ target.mesh.center_m + t
    moved = centre + random_direction(rng) * length_m
    return make_T(dR @ R, moved - dR @ R @ target.mesh.center_m)


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
    share = rng.uniform(*config.ambient_share) if count else 1.0
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


def draw_material(rng: np.random.Generator, config: MaterialConfig) -> Material:
    """Draw how the object's surface departs from its own colours."""
    return Material(
        hue_shift=float(rng.uniform(-config.hue_shift, config.hue_shift)),
        saturation=float(rng.uniform(*config.saturation)),
        value=float(rng.uniform(*config.value)),
        roughness=float(rng.uniform(*config.roughness)),
        metallic=float(rng.uniform(*config.metallic)),
        specular=float(rng.uniform(*config.specular)),
    )


def draw_background(rng: np.random.Generator, photo_share: float, photos: Sequence[str]) -> Background:
    """Draw which background; a photograph only where some are given."""
    seed, is_photo = child_seed(rng), rng.random() < photo_share
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
        motion_px=float(rng.uniform(*config.motion_px)) if rng.random() < config.motion_share else 0.0,
        motion_angle_rad=float(rng.uniform(0, math.pi)),
        jpeg_quality=int(rng.integers(config.jpeg_quality[0], config.jpeg_quality[1] + 1))
        if rng.random() < config.jpeg_share
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
