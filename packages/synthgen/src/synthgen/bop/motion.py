"""Tracking sequences: smooth motion of camera, objects, lamps and a shape that passes, as functions of time.

Everything that moves is a sum of sines in time: frame i is known without frame i - 1, nothing jumps, and speeds have
bounds that hold exactly. The camera is steered by where the first object is seen: its place in the image, its distance
and its orientation move within the configuration's ranges, so that it never leaves the image.
"""

import math
from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import lru_cache

import numpy as np
from jaxtyping import Float
from posecore.camera import Camera, project
from posecore.se3 import inverse, make_T, random_direction, random_rotation, rotation_from_rotvec

from synthgen.bop.layout import Balls, Layout, View, at_pixel, level_view, moved_light, radius_m
from synthgen.config import SynthConfig
from synthgen.draw import occluders
from synthgen.draw.random_streams import Purpose, Subject, child_seed, stream
from synthgen.draw.target import Target
from synthgen.scene import Light, SceneObject

Array = np.ndarray

_TERMS = 2
_FREE_SHARE = 0.45  # of the gap to its neighbour that a floating object may use up; the neighbour may do the same
_PASS_TRIES = 20
_PASS_CHECKS = 33  # moments of a pass at which it must touch nothing
_PASS_MARGIN = 1.3  # how much farther than out of the image a passing shape starts
_LIGHT_TURN_RAD = 0.5


@dataclass(frozen=True, eq=False)
class Wave:
    """A smooth function of time with values in [-amplitude, amplitude]."""

    amplitudes: Float[Array, " k"]
    rates_rad_s: Float[Array, " k"]
    phases_rad: Float[Array, " k"]

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
        shortest_period_s: No term swings faster.
    """
    fastest = min(2 * math.pi / shortest_period_s, max_speed / max(amplitude, 1e-12))
    return Wave(
        rng.dirichlet(np.ones(_TERMS)) * amplitude,
        rng.uniform(0.5, 1.0, _TERMS) * fastest,
        rng.uniform(0, 2 * math.pi, _TERMS),
    )


@dataclass(frozen=True, eq=False)
class Turn:
    """A smooth rotation; its angular speed is at most the length of its rotation vector's derivative."""

    rotvec_rad: tuple[Wave, Wave, Wave]

    def __call__(self, t_s: float) -> Float[Array, "3 3"]:
        """Rotation at a time."""
        return rotation_from_rotvec(np.array([wave(t_s) for wave in self.rotvec_rad]))


def draw_turn(rng: np.random.Generator, largest_rad: float, max_speed_rad_s: float, shortest_period_s: float) -> Turn:
    """Draw a rotation of at most an angle with at most an angular speed."""
    x, y, z = (
        draw_wave(rng, largest_rad / math.sqrt(3.0), max_speed_rad_s * share, shortest_period_s)
        for share in np.abs(random_direction(rng))
    )
    return Turn((x, y, z))


@dataclass(frozen=True, kw_only=True, eq=False)
class Drift:
    """A floating object's own motion about where the layout has it."""

    turn: Turn
    shift_m: tuple[Wave, Wave, Wave]


@dataclass(frozen=True, kw_only=True, eq=False)
class Passing:
    """A shape on its way across the view, between the camera and the first object.

    Attributes:
        shape: The shape; the rotation of its pose is the one in the reference frame.
        depth_share: Where it crosses, as a share of the way from the camera to the object.
        middle_s: When it is before the object.
        speed_m_s: How fast it goes.
        direction_cam: Where to in the camera's frame; over a table it goes level instead, to the right or left by the
            sign of the first number.
    """

    shape: SceneObject
    depth_share: float
    middle_s: float
    speed_m_s: float
    direction_cam: Float[Array, "3"]


class Motion:
    """The motion of one sequence: a pure function of (configuration, layout, address).

    Args:
        config: Recipe.
        targets: Objects by id.
        layout: What moves, and where it starts from; its first object is the one to be tracked.
        address: (purpose, sequence, attempt) of its streams.
    """

    def __init__(
        self,
        config: SynthConfig,
        targets: Mapping[int, Target],
        layout: Layout,
        address: tuple[Purpose, int, int],
    ) -> None:
        self.config, self.layout, self.address = config, layout, address
        self.camera: Camera = config.camera.camera()
        self._first = targets[layout.labelled[0].mesh_key]
        self._targets = targets
        self._balls = Balls({**{i: t.mesh for i, t in targets.items()}, **self._first.shapes, **self._first.tables})
        self._centre_m = self._balls.of(layout.labelled[0])[0]
        rng = self._stream(Subject.MOTION)
        settings = config.sequence
        turn = math.radians(settings.max_angular_speed_deg_s) * (1.0 if layout.on_table else 0.5)
        self._draw_place(rng)
        self._draw_direction(rng, turn)
        self._drifts = () if layout.on_table else tuple(self._draw_drift(rng, i, turn) for i in self._numbers)
        self._light_turn = draw_turn(rng, _LIGHT_TURN_RAD, math.radians(20.0), settings.min_period_s)
        self._light_swing = tuple(
            draw_wave(rng, settings.light_variation, settings.light_variation, settings.min_period_s)
            for _ in layout.lights
        )
        self._shutter = rng.uniform(*settings.shutter)
        self._passing = lru_cache(maxsize=4)(self._draw_passing)

    @property
    def _numbers(self) -> range:
        return range(len(self.layout.labelled))

    def view(self, frame: int) -> View:
        """What the camera sees in a frame."""
        t_s = frame / self.config.sequence.fps
        T_cam_ref = self.T_cam_ref(t_s)
        passing = self._passing_at(t_s)
        blur_px, blur_angle_rad = self._blur(t_s)
        layout = replace(
            self.layout,
            labelled=self.labelled(t_s),
            others=self.layout.others if passing is None else (*self.layout.others, passing),
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
        shift, reach = self._place(t_s) * half, self._jitter * half
        return View(
            layout=layout,
            T_cam_ref=T_cam_ref,
            looks_at=0,
            background_shift_px=(float(shift[0]), float(shift[1])),
            background_reach_px=(math.ceil(reach[0]) + 1, math.ceil(reach[1]) + 1),
        )

    def T_cam_ref(self, t_s: float) -> Float[Array, "4 4"]:
        """Pose of the reference frame in the moving camera's."""
        z_m = self._nearest_m + (self._farthest_m - self._nearest_m) * (1 + self._waves[2](t_s)) / 2
        R = self._R_cam_ref(t_s)
        return make_T(R, at_pixel(self.camera, self._place(t_s), z_m) - R @ self._centre_m)

    def labelled(self, t_s: float) -> tuple[SceneObject, ...]:
        """The labelled objects in the reference frame."""
        if not self._drifts:
            return self.layout.labelled
        moved = []
        for placed, drift in zip(self.layout.labelled, self._drifts, strict=True):
            centre, T = self._balls.of(placed)[0], placed.T_cam_obj
            R = drift.turn(t_s) @ T[:3, :3]
            shift = np.array([wave(t_s) for wave in drift.shift_m])
            mesh = self._targets[placed.mesh_key].mesh
            moved.append(replace(placed, T_cam_obj=make_T(R, centre + shift - R @ mesh.center_m)))
        return tuple(moved)

    def _stream(self, subject: Subject, *address: int) -> np.random.Generator:
        purpose, index, attempt = self.address
        return stream(self.config.seed, purpose, subject, index, attempt, *address)

    def _draw_place(self, rng: np.random.Generator) -> None:
        """Waves, of amplitude 1, of the first object's place in the image, across and down, and of its distance."""
        camera, settings = self.camera, self.config.sequence
        self._nearest_m, self._farthest_m = self._first.distance_m
        half, focal = np.array([camera.width_px, camera.height_px]) / 2, camera.K[[0, 1], [0, 1]]
        # so that its bounding sphere stays inside also at the smallest distance, as far as it fits at all
        ball_px = focal * radius_m(self._first.mesh) / (self._nearest_m - radius_m(self._first.mesh))
        self._jitter = np.clip(1.0 - ball_px / half, 0.0, self.config.view.position_jitter)
        corner = at_pixel(camera, self._jitter, 1.0), at_pixel(camera, -self._jitter, 1.0)
        ways_m = np.append(
            self._jitter * half / focal * self._farthest_m,
            (self._farthest_m - self._nearest_m) / 2 * np.linalg.norm(np.maximum(*np.abs(corner))),
        )
        speed_m_s = settings.max_speed_diameter_s * self._first.mesh.diameter_m * rng.dirichlet(np.ones(3))
        self._waves = [
            draw_wave(rng, 1.0, speed / max(way, 1e-12), settings.min_period_s)
            for speed, way in zip(speed_m_s, ways_m, strict=True)
        ]

    def _place(self, t_s: float) -> Float[Array, "2"]:
        return self._jitter * np.array([self._waves[0](t_s), self._waves[1](t_s)])

    def _draw_direction(self, rng: np.random.Generator, max_turn_rad_s: float) -> None:
        """Where the camera looks from: over a table and upright by elevation, azimuth and roll, else any rotation."""
        config, smooth = self.config, self.config.sequence.min_period_s
        self._is_level = self.layout.on_table or config.view.viewpoint == "upright"
        if not self._is_level:
            self._R_start = random_rotation(rng)
            self._turn = draw_turn(rng, math.pi, max_turn_rad_s, smooth)
            return
        zone = np.deg2rad(config.tabletop.elevation_deg if self.layout.on_table else config.view.elevation_deg)
        ranges = (zone, np.array([0.0, 2 * math.pi]), np.deg2rad(config.view.roll_deg))
        speeds = max_turn_rad_s * rng.dirichlet(np.ones(3))
        self._middles = [float(r.mean()) for r in ranges]
        self._angles = [
            draw_wave(rng, float(np.ptp(r)) / 2, speed, smooth) for r, speed in zip(ranges, speeds, strict=True)
        ]

    def _R_cam_ref(self, t_s: float) -> Float[Array, "3 3"]:
        if not self._is_level:
            return self._turn(t_s) @ self._R_start
        elevation, azimuth, roll = (
            middle + wave(t_s) for middle, wave in zip(self._middles, self._angles, strict=True)
        )
        return level_view(elevation, azimuth, roll) @ self.layout.T_ref_level[:3, :3].T

    def _draw_drift(self, rng: np.random.Generator, number: int, max_turn_rad_s: float) -> Drift:
        layout, settings = self.layout, self.config.sequence
        own = self._balls.of(layout.labelled[number])
        rest = [o for i, o in enumerate((*layout.labelled, *layout.others)) if i != number]
        gap_m = min((float(np.linalg.norm(own[0] - c)) - own[1] - r for c, r in map(self._balls.of, rest)), default=0.0)
        room_m = _FREE_SHARE * max(gap_m, 0.0) / math.sqrt(3.0) if number else 0.0  # the first one steers the camera
        speed_m_s = settings.max_speed_diameter_s * self._first.mesh.diameter_m / 3
        x, y, z = (draw_wave(rng, room_m, speed_m_s, settings.min_period_s) for _ in range(3))
        return Drift(turn=draw_turn(rng, math.pi, max_turn_rad_s, settings.min_period_s), shift_m=(x, y, z))

    def _lights(self, t_s: float) -> tuple[Light, ...]:
        T = make_T(self._light_turn(t_s), np.zeros(3))
        T[:3, 3] = self._centre_m - T[:3, :3] @ self._centre_m
        return tuple(
            replace(moved_light(light, T), strength=light.strength * (1 + wave(t_s)))
            for light, wave in zip(self.layout.lights, self._light_waves, strict=True)
        )

    def _blur(self, t_s: float) -> tuple[float, float]:
        """Length and direction of the motion blur: the first object's way in the image while the shutter is open."""
        open_s = self._shutter / self.config.sequence.fps
        seen = []
        for moment in (t_s - open_s / 2, t_s + open_s / 2):
            T = self.T_cam_ref(moment)
            seen.append(project(self.camera.K, (T[:3, :3] @ self._centre_m + T[:3, 3])[None])[0])
        dx, dy = seen[1] - seen[0]
        return float(math.hypot(dx, dy)), math.atan2(dy, dx)

    def _passing_at(self, t_s: float) -> SceneObject | None:
        span_s = self.config.sequence.occluder_period_s
        passing = self._passing(int(t_s // span_s)) if span_s else None
        return None if passing is None else self._passing_shape(passing, t_s)

    def _passing_shape(self, passing: Passing, t_s: float) -> SceneObject:
        T_cam_ref = self.T_cam_ref(t_s)
        R = T_cam_ref[:3, :3]
        direction = passing.direction_cam
        if self.layout.on_table:  # level, so that it keeps its height over the table
            up = R @ self.layout.T_ref_level[:3, 2]
            level = np.array([1.0, 0.0, 0.0]) - up * up[0]
            direction = level / max(float(np.linalg.norm(level)), 1e-12) * math.copysign(1.0, direction[0])
        at_cam = passing.depth_share * (R @ self._centre_m + T_cam_ref[:3, 3])
        at_cam = at_cam + direction * passing.speed_m_s * (t_s - passing.middle_s)
        at_ref = R.T @ (at_cam - T_cam_ref[:3, 3])
        R_ref = passing.shape.T_cam_obj[:3, :3]
        mesh = self._first.shapes[passing.shape.mesh_key]
        return replace(passing.shape, T_cam_obj=make_T(R_ref, at_ref - R_ref @ mesh.center_m))

    def _draw_passing(self, number: int) -> Passing | None:
        """The shape that passes in the given span of time; none where every try touches something."""
        span_s, rng = self.config.sequence.occluder_period_s, self._stream(Subject.OCCLUDERS, number)
        shapes = self._first.shapes
        keys = sorted(shapes)
        middle_s = (number + rng.uniform(0.4, 0.6)) * span_s
        for _ in range(_PASS_TRIES if keys else 0):
            key, share, angle = keys[int(rng.integers(len(keys)))], rng.uniform(0.2, 0.7), rng.uniform(0, 2 * math.pi)
            R = random_rotation(rng)
            # out of the image at both ends of the span, also when the object is seen at the other side
            K, size = self.camera.K, np.array([self.camera.width_px, self.camera.height_px])
            across_m = float(np.linalg.norm(size / K[[0, 1], [0, 1]])) * self._farthest_m * share
            shape = SceneObject(mesh_key=key, T_cam_obj=make_T(R, np.zeros(3)), material=occluders.look(rng))
            passing = Passing(
                shape=shape,
                depth_share=share,
                middle_s=middle_s,
                speed_m_s=_PASS_MARGIN * (across_m + radius_m(shapes[key])) / (0.4 * span_s),
                direction_cam=np.array([math.cos(angle), math.sin(angle), 0.0]),
            )
            moments = np.linspace(number * span_s, (number + 1) * span_s, _PASS_CHECKS)
            if all(self._is_clear(passing, float(t_s)) for t_s in moments):
                return passing
        return None

    def _is_clear(self, passing: Passing, t_s: float) -> bool:
        placed = self._passing_shape(passing, t_s)
        centre, radius = self._balls.of(placed)
        T_cam_ref = self.T_cam_ref(t_s)
        if float(np.linalg.norm(centre - inverse(T_cam_ref)[:3, 3])) < 1.5 * radius:
            return False
        things = [o for o in (*self.labelled(t_s), *self.layout.others) if o.mesh_key not in self._first.tables]
        if not self._balls.free(centre, radius, things):
            return False
        if not self.layout.on_table:
            return True
        T = inverse(self.layout.T_ref_level)
        return float((T[:3, :3] @ centre + T[:3, 3])[2]) > radius
