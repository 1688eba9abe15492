"""Draws of poses: true poses by viewpoint and distance, hypotheses around them, and their boxes in the image."""

import math

import numpy as np
from jaxtyping import Float
from posecore.camera import Camera
from posecore.mesh import Mesh
from posecore.se3 import make_T, random_direction, random_rotation, rotation_from_rotvec
from posecore.window import silhouette_box

from synthgen.config import PerturbationConfig, ViewConfig
from synthgen.draw.target import TargetObject


def draw_pose(
    rng: np.random.Generator, view: ViewConfig, camera: Camera, target: TargetObject
) -> Float[np.ndarray, "4 4"]:
    """Draw a true pose: rotation by `view.viewpoint`, distance uniform, box centre around the image's middle."""
    if view.viewpoint == "so3":
        R = random_rotation(rng)
    else:
        R = draw_level_rotation(rng, view.elevation_deg, view.roll_deg)
    return pose_at_distance(rng, view, camera, target, R)


def pose_at_distance(
    rng: np.random.Generator, view: ViewConfig, camera: Camera, target: TargetObject, R: Float[np.ndarray, "3 3"]
) -> Float[np.ndarray, "4 4"]:
    """Draw the distance and the image position of a true pose with the given rotation."""
    z_m = rng.uniform(*target.distance_m)
    centre = point_at_pixel(camera, view.position_jitter * rng.uniform(-1.0, 1.0, 2), z_m)
    return make_T(R, centre - R @ target.mesh.center_m)


def draw_level_rotation(
    rng: np.random.Generator, elevation_deg: tuple[float, float], roll_deg: tuple[float, float]
) -> Float[np.ndarray, "3 3"]:
    """Draw a `level_rotation`: elevation uniform on the sphere's zone, azimuth and roll uniform."""
    low, high = np.sin(np.deg2rad(elevation_deg))
    elevation, azimuth = math.asin(rng.uniform(low, high)), rng.uniform(0, 2 * math.pi)
    return level_rotation(elevation, azimuth, math.radians(rng.uniform(*roll_deg)))


def level_rotation(elevation_rad: float, azimuth_rad: float, roll_rad: float) -> Float[np.ndarray, "3 3"]:
    """Rotation to a camera whose optical axis points at the origin of a frame with z up.

    Args:
        elevation_rad: Elevation of the camera above the xy plane.
        azimuth_rad: Azimuth of the camera, from x towards y.
        roll_rad: Rotation of the camera about its axis; at 0 the frame's z is up in the image.
    """
    sin_a, cos_a = math.sin(azimuth_rad), math.cos(azimuth_rad)
    sin_e, cos_e = math.sin(elevation_rad), math.cos(elevation_rad)
    right = np.array([-sin_a, cos_a, 0.0])
    forward = -np.array([cos_e * cos_a, cos_e * sin_a, sin_e])
    level = np.stack([right, np.cross(forward, right), forward])
    return np.asarray(rotation_from_rotvec(np.array([0.0, 0.0, roll_rad])) @ level)


def point_at_pixel(camera: Camera, position: Float[np.ndarray, "2"], z_m: float) -> Float[np.ndarray, "3"]:
    """Point in the camera frame at a depth and an image position, from -1 to 1 across the image."""
    uv = np.array([camera.width_px, camera.height_px]) / 2 * (1.0 + position)
    focal, principal = camera.K[[0, 1], [0, 1]], camera.K[:2, 2]
    return np.append((uv - principal) / focal * z_m, z_m)


def draw_hypothesis(
    rng: np.random.Generator, config: PerturbationConfig, T_cam_obj: Float[np.ndarray, "4 4"], mesh: Mesh
) -> Float[np.ndarray, "4 4"]:
    """Perturb a true pose: rotate it about the object's centre and translate it."""
    ease = config.easy_scale if rng.random() < config.easy_fraction else 1.0
    angle = math.radians(config.max_angle_deg) * ease * rng.uniform()
    length_m = config.max_translation_diameter * mesh.diameter_m * ease * rng.uniform()
    dR = rotation_from_rotvec(random_direction(rng) * angle)
    centre = mesh.center_cam_m(T_cam_obj) + random_direction(rng) * length_m
    R = dR @ T_cam_obj[:3, :3]
    return make_T(R, centre - R @ mesh.center_m)


def target_box(target: TargetObject, camera: Camera, T_cam_obj: Float[np.ndarray, "4 4"]) -> Float[np.ndarray, "4"]:
    """Box (x0, y0, x1, y1) of the target object's silhouette in full-image pixels."""
    return silhouette_box(target.hull_m, camera.K, T_cam_obj)


def fraction_inside(box_px: Float[np.ndarray, "4"], camera: Camera) -> float:
    """Fraction of a silhouette's box (x0, y0, x1, y1) inside the image; 0 for an infinite box."""
    x0, y0, x1, y1 = box_px
    if not np.isfinite(box_px).all():
        return 0.0
    w = max(0.0, min(x1, camera.width_px) - max(x0, 0.0))
    h = max(0.0, min(y1, camera.height_px) - max(y0, 0.0))
    return float(w * h / max((x1 - x0) * (y1 - y0), 1e-12))
