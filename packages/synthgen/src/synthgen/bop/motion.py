"""Tracking sequences: smooth motion of camera, objects, lamps and passing occluders as functions of time.

Every motion is a sum of sines in time: frame i does not depend on frame i - 1, motions are continuous, and speeds have
exact bounds. The camera follows from the first object's image position, distance and orientation, which move within the
configuration's ranges, so that the object never leaves the image.
"""

import math
from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import lru_cache

import numpy as np
from jaxtyping import Float
from posecore.camera import Camera, project
from posecore.se3 import inverse, make_T, random_direction, random_rotation, rotation_from_rotvec

from synthgen.bop.layout import BoundingSpheres, CameraView, Layout, radius_m, transformed_light
from synthgen.config import SynthConfig
from synthgen.draw.occluders import draw_occluder_material
from synthgen.draw.poses import level_rotation, point_at_pixel
from synthgen.draw.random_streams import Purpose, Subject, child_seed, stream
from synthgen.draw.target import TargetObject
from synthgen.scene import Light, SceneObject

_TERMS = 2
_GAP_FRACTION = 0.45  # largest displacement of a floating object as a fraction of the gap to its neighbour
_OCCLUDER_TRIES = 20
_OCCLUDER_CHECKS = 33  # times within a pass at which the occluder must not touch anything
_OCCLUDER_MARGIN = 1.3  # length of an occluder's path relative to the width of the view
_LIGHT_ROTATION_RAD = 0.5


@dataclass(frozen=True, eq=False)
class Wave:
    """A smooth function of time with values in [-amplitude, amplitude]."""

    amplitudes: Float[np.ndarray, " k"]
    rates_rad_s: Float[np.ndarray, " k"]
    phases_rad: Float[np.ndarray, " k"]

    def __call__(self, t_s: float) -> float:
        """Value at a time."""
        return float(self.amplitudes @ np.sin(self.rates_rad_s * t_s + self.phases_rad))


def draw_wave(rng: np.random.Generator, amplitude: float, max_speed: float, shortest_period_s: float) -> Wave:
    """Draw a wave.

    Its derivative stays within `max_speed`, its second derivative within max_speed * 2 pi / shortest_period_s.

    Args:
        rng: Stream.
        amplitude: Largest value either way.
        max_speed: Largest derivative, per second.
        shortest_period_s: Shortest period of a term.
    """
    fastest = min(2 * math.pi / shortest_period_s, max_speed / max(amplitude, 1e-12))
    return Wave(
        rng.dirichlet(np.ones(_TERMS)) * amplitude,
        rng.uniform(0.5, 1.0, _TERMS) * fastest,
        rng.uniform(0, 2 * math.pi, _TERMS),
    )


@dataclass(frozen=True, eq=False)
class SmoothRotation:
    """A smooth rotation; its angular speed is at most the length of its rotation vector's derivative."""

    rotvec_rad: tuple[Wave, Wave, Wave]

    def __call__(self, t_s: float) -> Float[np.ndarray, "3 3"]:
        """Rotation at a time."""
        return rotation_from_rotvec(np.array([wave(t_s) for wave in self.rotvec_rad]))


def draw_rotation(
    rng: np.random.Generator, largest_rad: float, max_speed_rad_s: float, shortest_period_s: float
) -> SmoothRotation:
    """Draw a rotation with a maximum angle and a maximum angular speed."""
    x, y, z = (
        draw_wave(rng, largest_rad / math.sqrt(3.0), max_speed_rad_s * component, shortest_period_s)
        for component in np.abs(random_direction(rng))
    )
    return SmoothRotation((x, y, z))


@dataclass(frozen=True, kw_only=True, eq=False)
class ObjectMotion:
    """Motion of a floating object about its pose in the layout."""

    rotation: SmoothRotation
    shift_m: tuple[Wave, Wave, Wave]


@dataclass(frozen=True, kw_only=True, eq=False)
class PassingOccluder:
    """An occluder that crosses the view between the camera and the first object.

    Attributes:
        shape: The shape; its rotation is in the reference frame.
        depth_fraction: Depth of its path as a fraction of the distance from the camera to the object.
        middle_s: Time at which it is in front of the object.
        speed_m_s: Speed.
        direction_cam: Direction in the camera's frame; over a table the path is level instead, to the right or left by
            the sign of the first component.
    """

    shape: SceneObject
    depth_fraction: float
    middle_s: float
    speed_m_s: float
    direction_cam: Float[np.ndarray, "3"]


class Motion:
    """The motion of a sequence: a pure function of (configuration, layout, address).

    Args:
        config: Configuration.
        targets: Target objects by id.
        layout: Objects and light at rest; the first object is the one to track.
        address: (purpose, sequence, attempt) of the random streams.
    """

    def __init__(
        self,
        config: SynthConfig,
        targets: Mapping[int, TargetObject],
        layout: Layout,
        address: tuple[Purpose, int, int],
    ) -> None:
        self.config, self.layout, self.address = config, layout, address
        self.camera: Camera = config.camera.camera()
        self._first = targets[layout.labelled[0].mesh_key]
        self._targets = targets
        meshes = {i: t.mesh for i, t in targets.items()}
        self._spheres = BoundingSpheres({**meshes, **self._first.shapes, **self._first.tables})
        self._centre_m = self._spheres.sphere(layout.labelled[0])[0]
        rng = self._stream(Subject.MOTION)
        settings = config.sequence
        speed_rad_s = math.radians(settings.max_angular_speed_deg_s) * (1.0 if layout.on_table else 0.5)
        self._draw_position(rng)
        self._draw_direction(rng, speed_rad_s)
        self._object_motions: tuple[ObjectMotion, ...] = ()
        if not layout.on_table:
            self._object_motions = tuple(self._draw_object_motion(rng, i, speed_rad_s) for i in self._numbers)
        self._light_rotation = draw_rotation(rng, _LIGHT_ROTATION_RAD, math.radians(20.0), settings.min_period_s)
        variation = settings.light_variation
        self._light_waves = tuple(draw_wave(rng, variation, variation, settings.min_period_s) for _ in layout.lights)
        self._shutter = rng.uniform(*settings.shutter)
        self._occluder = lru_cache(maxsize=4)(self._draw_occluder)

    @property
    def _numbers(self) -> range:
        return range(len(self.layout.labelled))

    def view(self, frame: int) -> CameraView:
        """The camera's view of a frame."""
        t_s = frame / self.config.sequence.fps
        T_cam_ref = self.T_cam_ref(t_s)
        occluder = self._occluder_at(t_s)
        blur_px, blur_angle_rad = self._blur(t_s)
        layout = replace(
            self.layout,
            labelled=self.labelled(t_s),
            others=self.layout.others if occluder is None else (*self.layout.others, occluder),
            lights=self._lights(t_s),
            sensor=replace(
                self.layout.sensor,
                motion_px=blur_px,
                motion_angle_rad=blur_angle_rad,
                seed=child_seed(self._stream(Subject.SENSOR, frame)),
            ),
            render_seed=child_seed(self._stream(Subject.RENDER, frame)),
        )
        half = np.array([self.camera.width_px, self.camera.height_px]) / 2
        shift, reach = self._position(t_s) * half, self._jitter * half
        return CameraView(
            layout=layout,
            T_cam_ref=T_cam_ref,
            target_index=0,
            background_shift_px=(float(shift[0]), float(shift[1])),
            background_reach_px=(math.ceil(reach[0]) + 1, math.ceil(reach[1]) + 1),
        )

    def T_cam_ref(self, t_s: float) -> Float[np.ndarray, "4 4"]:
        """Pose of the reference frame in the moving camera's frame."""
        z_m = self._nearest_m + (self._farthest_m - self._nearest_m) * (1 + self._waves[2](t_s)) / 2
        R = self._R_cam_ref(t_s)
        return make_T(R, point_at_pixel(self.camera, self._position(t_s), z_m) - R @ self._centre_m)

    def labelled(self, t_s: float) -> tuple[SceneObject, ...]:
        """The labelled objects in the reference frame."""
        if not self._object_motions:
            return self.layout.labelled
        objects = []
        for placed, motion in zip(self.layout.labelled, self._object_motions, strict=True):
            centre, T = self._spheres.sphere(placed)[0], placed.T_cam_obj
            R = motion.rotation(t_s) @ T[:3, :3]
            shift = np.array([wave(t_s) for wave in motion.shift_m])
            mesh = self._targets[placed.mesh_key].mesh
            objects.append(replace(placed, T_cam_obj=make_T(R, centre + shift - R @ mesh.center_m)))
        return tuple(objects)

    def _stream(self, subject: Subject, *address: int) -> np.random.Generator:
        purpose, index, attempt = self.address
        return stream(self.config.seed, purpose, subject, index, attempt, *address)

    def _draw_position(self, rng: np.random.Generator) -> None:
        """Waves, of amplitude 1, of the first object's horizontal and vertical image position and of its distance."""
        camera, settings = self.camera, self.config.sequence
        self._nearest_m, self._farthest_m = self._first.distance_m
        half, focal = np.array([camera.width_px, camera.height_px]) / 2, camera.K[[0, 1], [0, 1]]
        # keeps its bounding sphere inside the image at the smallest distance, if it fits
        radius_px = focal * radius_m(self._first.mesh) / (self._nearest_m - radius_m(self._first.mesh))
        self._jitter = np.clip(1.0 - radius_px / half, 0.0, self.config.view.position_jitter)
        corner = point_at_pixel(camera, self._jitter, 1.0), point_at_pixel(camera, -self._jitter, 1.0)
        amplitudes_m = np.append(
            self._jitter * half / focal * self._farthest_m,
            (self._farthest_m - self._nearest_m) / 2 * np.linalg.norm(np.maximum(*np.abs(corner))),
        )
        speed_m_s = settings.max_speed_diameter_s * self._first.mesh.diameter_m * rng.dirichlet(np.ones(3))
        self._waves = [
            draw_wave(rng, 1.0, speed / max(amplitude, 1e-12), settings.min_period_s)
            for speed, amplitude in zip(speed_m_s, amplitudes_m, strict=True)
        ]

    def _position(self, t_s: float) -> Float[np.ndarray, "2"]:
        return self._jitter * np.array([self._waves[0](t_s), self._waves[1](t_s)])

    def _draw_direction(self, rng: np.random.Generator, max_speed_rad_s: float) -> None:
        """Viewing direction: elevation, azimuth and roll over a table and for upright views, else any rotation."""
        config, period_s = self.config, self.config.sequence.min_period_s
        self._is_level = self.layout.on_table or config.view.viewpoint == "upright"
        if not self._is_level:
            self._R_initial = random_rotation(rng)
            self._rotation = draw_rotation(rng, math.pi, max_speed_rad_s, period_s)
            return
        zone = np.deg2rad(config.tabletop.elevation_deg if self.layout.on_table else config.view.elevation_deg)
        ranges = (zone, np.array([0.0, 2 * math.pi]), np.deg2rad(config.view.roll_deg))
        speeds = max_speed_rad_s * rng.dirichlet(np.ones(3))
        self._middles = [float(r.mean()) for r in ranges]
        self._angles = [
            draw_wave(rng, float(np.ptp(r)) / 2, speed, period_s) for r, speed in zip(ranges, speeds, strict=True)
        ]

    def _R_cam_ref(self, t_s: float) -> Float[np.ndarray, "3 3"]:
        if not self._is_level:
            return self._rotation(t_s) @ self._R_initial
        elevation, azimuth, roll = (
            middle + wave(t_s) for middle, wave in zip(self._middles, self._angles, strict=True)
        )
        return level_rotation(elevation, azimuth, roll) @ self.layout.T_ref_level[:3, :3].T

    def _draw_object_motion(self, rng: np.random.Generator, number: int, max_speed_rad_s: float) -> ObjectMotion:
        layout, settings = self.layout, self.config.sequence
        centre, radius = self._spheres.sphere(layout.labelled[number])
        others = [o for i, o in enumerate((*layout.labelled, *layout.others)) if i != number]
        gaps_m = (float(np.linalg.norm(centre - c)) - radius - r for c, r in map(self._spheres.sphere, others))
        gap_m = min(gaps_m, default=0.0)
        room_m = _GAP_FRACTION * max(gap_m, 0.0) / math.sqrt(3.0) if number else 0.0  # the camera follows the first
        speed_m_s = settings.max_speed_diameter_s * self._first.mesh.diameter_m / 3
        x, y, z = (draw_wave(rng, room_m, speed_m_s, settings.min_period_s) for _ in range(3))
        rotation = draw_rotation(rng, math.pi, max_speed_rad_s, settings.min_period_s)
        return ObjectMotion(rotation=rotation, shift_m=(x, y, z))

    def _lights(self, t_s: float) -> tuple[Light, ...]:
        T = make_T(self._light_rotation(t_s), np.zeros(3))
        T[:3, 3] = self._centre_m - T[:3, :3] @ self._centre_m
        return tuple(
            replace(transformed_light(light, T), strength=light.strength * (1 + wave(t_s)))
            for light, wave in zip(self.layout.lights, self._light_waves, strict=True)
        )

    def _blur(self, t_s: float) -> tuple[float, float]:
        """Length and direction of the motion blur: the first object's image motion while the shutter is open."""
        open_s = self._shutter / self.config.sequence.fps
        uv = []
        for moment in (t_s - open_s / 2, t_s + open_s / 2):
            T = self.T_cam_ref(moment)
            uv.append(project(self.camera.K, (T[:3, :3] @ self._centre_m + T[:3, 3])[None])[0])
        dx, dy = uv[1] - uv[0]
        return float(math.hypot(dx, dy)), math.atan2(dy, dx)

    def _occluder_at(self, t_s: float) -> SceneObject | None:
        period_s = self.config.sequence.occluder_period_s
        occluder = self._occluder(int(t_s // period_s)) if period_s else None
        return None if occluder is None else self._placed_occluder(occluder, t_s)

    def _placed_occluder(self, occluder: PassingOccluder, t_s: float) -> SceneObject:
        T_cam_ref = self.T_cam_ref(t_s)
        R = T_cam_ref[:3, :3]
        direction = occluder.direction_cam
        if self.layout.on_table:  # a level path keeps the height over the table
            up = R @ self.layout.T_ref_level[:3, 2]
            level = np.array([1.0, 0.0, 0.0]) - up * up[0]
            direction = level / max(float(np.linalg.norm(level)), 1e-12) * math.copysign(1.0, direction[0])
        centre_cam = occluder.depth_fraction * (R @ self._centre_m + T_cam_ref[:3, 3])
        centre_cam = centre_cam + direction * occluder.speed_m_s * (t_s - occluder.middle_s)
        centre_ref = R.T @ (centre_cam - T_cam_ref[:3, 3])
        R_ref = occluder.shape.T_cam_obj[:3, :3]
        mesh = self._first.shapes[occluder.shape.mesh_key]
        return replace(occluder.shape, T_cam_obj=make_T(R_ref, centre_ref - R_ref @ mesh.center_m))

    def _draw_occluder(self, number: int) -> PassingOccluder | None:
        """The occluder of a period; None where every try touches something."""
        period_s, rng = self.config.sequence.occluder_period_s, self._stream(Subject.OCCLUDERS, number)
        shapes = self._first.shapes
        keys = sorted(shapes)
        middle_s = (number + rng.uniform(0.4, 0.6)) * period_s
        for _ in range(_OCCLUDER_TRIES if keys else 0):
            key, depth, angle = keys[int(rng.integers(len(keys)))], rng.uniform(0.2, 0.7), rng.uniform(0, 2 * math.pi)
            R = random_rotation(rng)
            # outside the image at both ends of the period, also with the object at the opposite edge
            K, size = self.camera.K, np.array([self.camera.width_px, self.camera.height_px])
            across_m = float(np.linalg.norm(size / K[[0, 1], [0, 1]])) * self._farthest_m * depth
            shape = SceneObject(mesh_key=key, T_cam_obj=make_T(R, np.zeros(3)), material=draw_occluder_material(rng))
            occluder = PassingOccluder(
                shape=shape,
                depth_fraction=depth,
                middle_s=middle_s,
                speed_m_s=_OCCLUDER_MARGIN * (across_m + radius_m(shapes[key])) / (0.4 * period_s),
                direction_cam=np.array([math.cos(angle), math.sin(angle), 0.0]),
            )
            moments = np.linspace(number * period_s, (number + 1) * period_s, _OCCLUDER_CHECKS)
            if all(self._is_clear(occluder, float(t_s)) for t_s in moments):
                return occluder
        return None

    def _is_clear(self, occluder: PassingOccluder, t_s: float) -> bool:
        placed = self._placed_occluder(occluder, t_s)
        centre, radius = self._spheres.sphere(placed)
        T_cam_ref = self.T_cam_ref(t_s)
        if float(np.linalg.norm(centre - inverse(T_cam_ref)[:3, 3])) < 1.5 * radius:
            return False
        others = [o for o in (*self.labelled(t_s), *self.layout.others) if o.mesh_key not in self._first.tables]
        if not self._spheres.is_free(centre, radius, others):
            return False
        if not self.layout.on_table:
            return True
        T = inverse(self.layout.T_ref_level)
        return float((T[:3, :3] @ centre + T[:3, 3])[2]) > radius
