"""Objects that a dataset is about, with what follows from their size."""

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
from synthgen.draw.resting_pose import Rests
from synthgen.inputs.assets import Assets

Array = np.ndarray

# A mesh key is an object id below this and a library shape from here on.
LIBRARY_KEY = 1_000_000
# Occluder meshes in their own size are the same for all objects: their keys lie below this, and tables' far below.
OCCLUDER_KEY = -1000
_CUTOUT_REACH_DIAMETER = 4.0  # how far behind the object its props reach in a cutout scene


@dataclass(frozen=True, kw_only=True, eq=False)
class Target:
    """One object of a dataset.

    Attributes:
        obj_id: BOP object id.
        name: File name it came from.
        mesh: The object.
        hull_m: (h, 3) vertices of its convex hull: their projections have the same box as the silhouette.
        distance_m: Nearest and farthest camera z of the box centre.
        window_side_px: Side of its fixed window in full-image pixels.
        shapes: Occluder meshes by mesh key.
        tables: Table meshes by mesh key; none where no scene has a table.
        reach_m: How far behind the object's centre a scene may reach.
    """

    obj_id: int
    name: str
    mesh: Mesh
    hull_m: Float[Array, "h 3"]
    distance_m: tuple[float, float]
    window_side_px: float
    shapes: Mapping[int, Mesh]
    tables: Mapping[int, Mesh]
    reach_m: float

    @cached_property
    def rests(self) -> Rests:
        """Stable poses of the object and its occluder shapes by mesh key."""
        return Rests({self.obj_id: self.mesh, **self.shapes})

    @cached_property
    def mean_rgb(self) -> Float[Array, "3"]:
        """Mean display colour of the surface, in [0, 1], faces weighted by their area."""
        corners = self.mesh.vertices_m[self.mesh.faces]
        area = np.linalg.norm(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1)
        colours = self.mesh.colours[self.mesh.faces].mean(axis=1) / 255.0
        return np.asarray((colours * area[:, None]).sum(axis=0) / max(float(area.sum()), 1e-12))


def make_targets(meshes: Mapping[int, Mesh], config: SynthConfig, assets: Assets | None = None) -> list[Target]:
    """Prepare objects, sorted by id; `window.shared` gives all of them the largest one's window.

    Raises:
        ConfigError: The distance range does not suit an object's size.
    """
    targets = [make_target(obj_id, mesh, config, assets) for obj_id, mesh in sorted(meshes.items())]
    if config.window.shared:
        side_px = max(t.window_side_px for t in targets)
        targets = [replace(t, window_side_px=side_px) for t in targets]
    return targets


def make_target(obj_id: int, mesh: Mesh, config: SynthConfig, assets: Assets | None = None) -> Target:
    """Prepare one object: its hull, distances, window, occluder shapes and tables.

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
    return Target(
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


def hull(mesh: Mesh) -> Float[Array, "h 3"]:
    """Vertices of the convex hull; all of them of a flat object, which has no hull with volume."""
    try:
        return np.asarray(mesh.vertices_m[ConvexHull(mesh.vertices_m).vertices])
    except QhullError:
        return mesh.vertices_m


def _shapes(obj_id: int, mesh: Mesh, config: SynthConfig, assets: Assets) -> dict[int, Mesh]:
    if assets.occluders and config.occluders.scale == "own":
        return {OCCLUDER_KEY - i: shape for i, shape in enumerate(assets.occluders[: config.occluders.library])}
    recipe = (config.occluders, config.seed, obj_id, mesh.diameter_m)
    shapes = occluders.fitted(*recipe, assets.occluders) if assets.occluders else occluders.library(*recipe)
    first_key = LIBRARY_KEY + obj_id * config.occluders.library
    return {first_key + i: shape for i, shape in enumerate(shapes)}


def _largest_m(shapes: Mapping[int, Mesh]) -> float:
    return max((shape.diameter_m for shape in shapes.values()), default=0.0)
