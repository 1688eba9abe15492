"""Target objects of a dataset: mesh, hull, distance range, window, occluders and tables."""

from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path

import numpy as np
from jaxtyping import Float
from posecore.mesh import Mesh
from posecore.window import fixed_side_px
from scipy.spatial import ConvexHull, QhullError

from synthgen.config import SynthConfig
from synthgen.draw import occluders, tabletop
from synthgen.draw.resting_pose import StablePosesByKey
from synthgen.inputs.assets import Assets

# Mesh keys below this are object ids, from here on keys of library shapes.
LIBRARY_KEY = 1_000_000
# Occluder meshes of unscaled size are common to all objects: their keys are below this, those of tables far below.
OCCLUDER_KEY = -1000
_CUTOUT_REACH_DIAMETER = 4.0  # largest distance of props behind the object in a cutout scene


@dataclass(frozen=True, kw_only=True, eq=False)
class TargetObject:
    """One target object of a dataset.

    Attributes:
        obj_id: BOP object id.
        name: Name of the mesh file.
        mesh: The object.
        hull_m: (h, 3) vertices of the convex hull: their projections have the same box as the silhouette.
        distance_m: Nearest and farthest camera z of the box centre.
        window_side_px: Side of the fixed window in full-image pixels.
        shapes: Occluder meshes by mesh key.
        tables: Table meshes by mesh key; empty where no scene has a table.
        reach_m: Largest extent of a scene behind the object's centre.
    """

    obj_id: int
    name: str
    mesh: Mesh
    hull_m: Float[np.ndarray, "h 3"]
    distance_m: tuple[float, float]
    window_side_px: float
    shapes: Mapping[int, Mesh]
    tables: Mapping[int, Mesh]
    reach_m: float

    @cached_property
    def stable_poses(self) -> StablePosesByKey:
        """Stable poses of the object and its occluder shapes by mesh key."""
        return StablePosesByKey({self.obj_id: self.mesh, **self.shapes})

    @cached_property
    def mean_rgb(self) -> Float[np.ndarray, "3"]:
        """Mean display colour of the surface, in [0, 1], faces weighted by their area."""
        corners = self.mesh.vertices_m[self.mesh.faces]
        area = np.linalg.norm(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1)
        colours = self.mesh.colours[self.mesh.faces].mean(axis=1) / 255.0
        return np.asarray((colours * area[:, None]).sum(axis=0) / max(float(area.sum()), 1e-12))


def make_targets(meshes: Mapping[int, Mesh], config: SynthConfig, assets: Assets | None = None) -> list[TargetObject]:
    """Target objects, sorted by id; with `window.shared` all have the largest window.

    Raises:
        ConfigError: The distance range does not suit an object's size.
    """
    targets = [make_target(obj_id, mesh, config, assets) for obj_id, mesh in sorted(meshes.items())]
    if config.window.shared:
        side_px = max(t.window_side_px for t in targets)
        targets = [replace(t, window_side_px=side_px) for t in targets]
    return targets


def make_target(obj_id: int, mesh: Mesh, config: SynthConfig, assets: Assets | None = None) -> TargetObject:
    """A target object with its hull, distances, window, occluder shapes and tables.

    Raises:
        ConfigError: The distance range does not suit the object's size.
    """
    distance_m = config.distance.range_m(mesh.diameter_m)
    hull_m = hull(mesh)
    camera = config.camera.camera()
    centred = hull_m - mesh.center_m
    side_px = fixed_side_px(centred, camera.K, distance_m[0], config.window.padding)
    assets = assets or Assets()
    shapes = _shapes(obj_id, mesh, config, assets)
    tables: dict[int, Mesh] = {}
    reach_m = max(_CUTOUT_REACH_DIAMETER * mesh.diameter_m, 2.5 * mesh.diameter_m + _largest_m(shapes))
    if config.scene.kind != "cutout":
        tables = tabletop.tables(config.tabletop, config.seed, mesh.diameter_m, assets.photos)
        reach_m = max(reach_m, tabletop.reach_diameter(config.tabletop) * mesh.diameter_m)
    return TargetObject(
        obj_id=obj_id,
        name=Path(mesh.path).name,
        mesh=mesh,
        hull_m=hull_m,
        distance_m=distance_m,
        window_side_px=side_px,
        shapes=shapes,
        tables=tables,
        reach_m=reach_m,
    )


def hull(mesh: Mesh) -> Float[np.ndarray, "h 3"]:
    """Vertices of the convex hull; all vertices of a flat object, whose hull has no volume."""
    try:
        return np.asarray(mesh.vertices_m[ConvexHull(mesh.vertices_m - mesh.center_m).vertices])
    except QhullError:
        return mesh.vertices_m


def _shapes(obj_id: int, mesh: Mesh, config: SynthConfig, assets: Assets) -> dict[int, Mesh]:
    if assets.occluders and config.occluders.scale == "own":
        return {OCCLUDER_KEY - i: shape for i, shape in enumerate(assets.occluders[: config.occluders.library])}
    settings = (config.occluders, config.seed, obj_id, mesh.diameter_m)
    if assets.occluders:
        shapes = occluders.scaled_meshes(*settings, assets.occluders)
    else:
        shapes = occluders.primitive_shapes(*settings)
    first_key = LIBRARY_KEY + obj_id * config.occluders.library
    return {first_key + i: shape for i, shape in enumerate(shapes)}


def _largest_m(shapes: Mapping[int, Mesh]) -> float:
    return max((shape.diameter_m for shape in shapes.values()), default=0.0)
