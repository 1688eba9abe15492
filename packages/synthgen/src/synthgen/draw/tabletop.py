"""Tabletop scenes: the object on or near a textured plane, among other things that lie there.

The table's frame has its origin in the middle of the top, x and y along the sides, z up.
"""

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import lru_cache

import numpy as np
from jaxtyping import Float, UInt8
from posecore.mesh import Mesh
from posecore.se3 import apply, make_T, random_rotation, rotation_from_rotvec

from synthgen.config import TabletopConfig, ViewConfig
from synthgen.draw.random_streams import Purpose, Subject, child_seed, stream
from synthgen.draw.resting_pose import Rest
from synthgen.image import background
from synthgen.scene import Background, Material, SceneObject

Array = np.ndarray
MaterialOf = Callable[[np.random.Generator], Material]

TABLE_KEY = -1_000_000  # mesh keys of tables lie below this
_PER_SIZE = 1000
_UNIT_M = 0.1
_TEXTURE_PX = 768
_SPREAD = 0.6  # share of the table's half sides that objects stand within
_TRIES = 12  # places tried for a distractor before it is left out


@dataclass(frozen=True, kw_only=True, eq=False)
class Setting:
    """An object on its table.

    Attributes:
        T_table_obj: Pose of the object in the table's frame.
        table_key: Mesh key of the table.
        footprint_m: (x, y, radius) of the circle around the object, seen from above.
    """

    T_table_obj: Float[Array, "4 4"]
    table_key: int
    footprint_m: tuple[float, float, float]


def tables(config: TabletopConfig, seed: int, diameter_m: float, photos: Sequence[str] = ()) -> dict[int, Mesh]:
    """The tables for an object of this size, by mesh key; objects of about one size get the same ones.

    Half of the textures are cut from photographs where there are some; the rest is drawn: wood, noise, patterns.
    """
    size = size_class(diameter_m)
    first = TABLE_KEY - (size + 64) * _PER_SIZE
    return {first - i: table for i, table in enumerate(_tables_of_size(config, seed, size, tuple(photos)))}


def size_class(diameter_m: float) -> int:
    """The power of two of 0.1 m that comes nearest to a diameter."""
    return round(math.log2(diameter_m / _UNIT_M))


def reach_diameter(config: TabletopConfig) -> float:
    """How far from the object's centre a table's corner can be, in object diameters."""
    # half a side and how far off the middle the object stands, over the diagonal, and what the size class may be off
    return (0.5 + 0.5 * _SPREAD) * math.sqrt(2.0) * math.sqrt(2.0) * config.size_diameter[1]


def set_object(
    rng: np.random.Generator,
    config: TabletopConfig,
    view: ViewConfig,
    rest: Rest,
    diameter_m: float,
    tables: Mapping[int, Mesh],
) -> Setting:
    """Choose a table and put an object on it, at rest, or in any orientation near it."""
    keys = sorted(tables, reverse=True)
    key = keys[int(rng.integers(len(keys)))]
    is_near, hover = rng.random() < config.near_fraction, rng.uniform(*config.hover_diameter) * diameter_m
    if is_near:
        R = random_rotation(rng)
    elif view.viewpoint == "upright":
        R = np.eye(3)
    else:
        R = _facing_down(rest.down[int(rng.choice(len(rest.down), p=rest.weights))])
    R = rotation_from_rotvec(np.array([0.0, 0.0, rng.uniform(0, 2 * math.pi)])) @ R
    T, radius_m = _standing(R, rest, hover if is_near else 0.0)
    half = np.abs(tables[key].vertices_m).max(axis=0)[:2]
    room = np.maximum(half - 1.5 * radius_m, 0.0) * _SPREAD
    T[:2, 3] += rng.uniform(-room, room)
    x, y = _middle(T, rest)
    return Setting(T_table_obj=T, table_key=key, footprint_m=(x, y, radius_m))


def surroundings(
    rng: np.random.Generator,
    config: TabletopConfig,
    setting: Setting,
    T_cam_table: Float[Array, "4 4"],
    shapes: Mapping[int, Mesh],
    rests: Mapping[int, Rest],
    tables: Mapping[int, Mesh],
    diameter_m: float,
    materials: MaterialOf,
) -> tuple[SceneObject, ...]:
    """The table and the things that lie on it, none inside another.

    Two things keep apart when the circles around them, seen from above, do. One that finds no free place is left out.
    """
    table = SceneObject(mesh_key=setting.table_key, T_cam_obj=T_cam_table, material=_table_look(rng))
    half = np.abs(tables[setting.table_key].vertices_m).max(axis=0)[:2]
    taken = [setting.footprint_m]
    placed = [table]
    keys = [k for k in sorted(shapes) if shapes[k].diameter_m < half.min()]
    for _ in range(int(rng.integers(config.distractors[0], config.distractors[1] + 1)) if keys else 0):
        key = keys[int(rng.integers(len(keys)))]
        rest = rests[key]
        R = _facing_down(rest.down[int(rng.choice(len(rest.down), p=rest.weights))])
        R = rotation_from_rotvec(np.array([0.0, 0.0, rng.uniform(0, 2 * math.pi)])) @ R
        T, radius_m = _standing(R, rest, 0.0)
        look = materials(rng)
        for _ in range(_TRIES):
            beside = taken[int(rng.integers(len(taken)))]
            angle = rng.uniform(0, 2 * math.pi)
            distance_m = beside[2] + radius_m + rng.uniform(*config.gap_diameter) * diameter_m
            x, y = beside[0] + distance_m * math.cos(angle), beside[1] + distance_m * math.sin(angle)
            free = all(math.hypot(x - other[0], y - other[1]) >= other[2] + radius_m for other in taken)
            if free and abs(x) < half[0] and abs(y) < half[1]:
                T[:2, 3] += np.array([x, y]) - _middle(T, rest)
                taken.append((x, y, radius_m))
                placed.append(SceneObject(mesh_key=key, T_cam_obj=T_cam_table @ T, material=look))
                break
    return tuple(placed)


def lifted(thing: SceneObject, mesh: Mesh, T_cam_table: Float[Array, "4 4"]) -> SceneObject:
    """A floating thing, moved towards the camera until it is wholly above the table's plane; it hides what it hid.

    One that finds no room between camera and plane stays where it is.
    """
    up, origin = T_cam_table[:3, 2], T_cam_table[:3, 3]
    T = thing.T_cam_obj
    centre = T[:3, :3] @ mesh.center_m + T[:3, 3]
    below_m = float(-((mesh.vertices_m - mesh.center_m) @ (T[:3, :3].T @ up)).min())  # how far it reaches down
    height_m, camera_height_m = float((centre - origin) @ up), float(-origin @ up)
    if height_m > below_m or camera_height_m <= below_m:
        return thing
    share = (camera_height_m - below_m) / (camera_height_m - height_m)
    moved = T.copy()
    moved[:3, 3] += (share - 1.0) * centre
    return replace(thing, T_cam_obj=moved)


def _standing(R_table_obj: Float[Array, "3 3"], rest: Rest, height_m: float) -> tuple[Float[Array, "4 4"], float]:
    """Pose over the table's middle with the lowest point at a height, and the radius of the circle around it."""
    turned = rest.hull_m @ R_table_obj.T
    centre = (turned.min(axis=0) + turned.max(axis=0)) / 2
    T = make_T(R_table_obj, np.array([-centre[0], -centre[1], height_m - turned[:, 2].min()]))
    return T, float(np.linalg.norm(turned[:, :2] - centre[:2], axis=1).max())


def _middle(T_table_obj: Float[Array, "4 4"], rest: Rest) -> Float[Array, "2"]:
    points = apply(T_table_obj, rest.hull_m)[:, :2]
    return np.asarray((points.min(axis=0) + points.max(axis=0)) / 2)


def _facing_down(direction: Float[Array, "3"]) -> Float[Array, "3 3"]:
    """A rotation that turns a direction of the object straight down."""
    x = np.cross(np.eye(3)[np.argmin(np.abs(direction))], direction)
    x /= np.linalg.norm(x)
    return np.stack([x, np.cross(-direction, x), -direction])


@lru_cache(maxsize=16)
def _tables_of_size(config: TabletopConfig, seed: int, size: int, photos: tuple[str, ...]) -> tuple[Mesh, ...]:
    return tuple(_table(config, seed, size, i, photos) for i in range(config.tables))


def _table(config: TabletopConfig, seed: int, size: int, index: int, photos: Sequence[str]) -> Mesh:
    """A rectangle with a texture; its sides are in proportion to the picture's, so that nothing is stretched."""
    rng = stream(seed, Purpose.PAIRS, Subject.TABLETOPS, size + 64, index)
    side_m = _UNIT_M * 2.0**size * math.exp(rng.uniform(*np.log(config.size_diameter)))
    aspect = rng.uniform(0.6, 1.0)
    width_px, height_px = _TEXTURE_PX, max(1, round(_TEXTURE_PX * aspect))
    x, y = side_m / 2, side_m / 2 * aspect
    return Mesh(
        vertices_m=np.array([[-x, -y, 0.0], [x, -y, 0.0], [x, y, 0.0], [-x, y, 0.0]]),
        faces=np.array([[0, 1, 2], [0, 2, 3]], np.int32),
        normals=np.tile(np.array([0.0, 0.0, 1.0], np.float32), (4, 1)),
        uv=np.array([[0, 0], [1, 0], [1, 1], [0, 1]], np.float32),
        texture_rgb=_texture(rng, width_px, height_px, photos),
        path=f"table {index}",
    )


def _texture(rng: np.random.Generator, width_px: int, height_px: int, photos: Sequence[str]) -> UInt8[Array, "h w 3"]:
    from_photo, kind, child = rng.random() < 0.5, rng.random(), child_seed(rng)
    if photos and from_photo:
        chosen = photos[int(rng.integers(len(photos)))]
        return background.draw(Background(kind="photo", seed=child, path=chosen), width_px, height_px)
    if kind < 0.4:
        return _wood(np.random.default_rng(child), width_px, height_px)
    return background.draw(Background(seed=child), width_px, height_px)


def _wood(rng: np.random.Generator, width_px: int, height_px: int) -> UInt8[Array, "h w 3"]:
    """Boards with grain: noise stretched along them, between two browns."""
    boards = int(rng.integers(1, 7))
    hue, light, dark = rng.uniform(0.0, 0.25), rng.uniform(0.4, 0.9), rng.uniform(0.1, 0.4)
    pale = light * np.array([1.0, 0.82 - 0.3 * hue, 0.62 - hue])
    deep = dark * np.array([1.0, 0.75, 0.5])
    y, x = np.mgrid[0:height_px, 0:width_px] / width_px
    board = np.minimum((y * width_px / height_px * boards).astype(int), boards - 1)
    offset, bend = rng.uniform(0, 10, boards)[board], rng.uniform(0.02, 0.12)
    rings = rng.uniform(8, 30) * (y + bend * np.sin(2.5 * x + offset) + 0.3 * bend * np.sin(9.0 * x + 3 * offset))
    grain = rng.random((height_px, 12)).repeat(-(-width_px // 12), axis=1)[:, :width_px]
    share = 0.5 + 0.35 * np.sin(2 * np.pi * rings + offset) * np.sin(3.0 * y + offset) + 0.25 * (grain - 0.5)
    share = np.clip(share + 0.3 * (rng.random(boards)[board] - 0.5), 0.0, 1.0)[..., None]
    image = pale * (1 - share) + deep * share
    seam = np.abs(y * width_px / height_px * boards - np.rint(y * width_px / height_px * boards)) < 0.012
    image = np.where(seam[..., None] & (boards > 1), image * 0.4, image)
    return np.asarray((np.clip(image, 0.0, 1.0) * 255.0 + 0.5).astype(np.uint8))


def _table_look(rng: np.random.Generator) -> Material:
    """How a table departs from its texture; mostly matt."""
    return Material(
        hue_shift=float(rng.uniform(-0.5, 0.5)) if rng.random() < 0.4 else 0.0,
        saturation=float(rng.uniform(0.3, 1.2)),
        value=float(rng.uniform(0.6, 1.3)),
        roughness=float(rng.uniform(0.4, 1.0)),
        specular=float(rng.uniform(0.0, 0.5)),
    )
