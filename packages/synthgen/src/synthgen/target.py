"""Objects that a dataset is about, with what follows from their size."""

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Float
from posecore.errors import ConfigError
from posecore.mesh import Mesh
from posecore.window import fixed_side_px
from scipy.spatial import ConvexHull, QhullError

from synthgen import occluders
from synthgen.config import SynthConfig

Array = np.ndarray

# A mesh key is an object id below this and a library shape from here on.
LIBRARY_KEY = 1_000_000


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
    """

    obj_id: int
    name: str
    mesh: Mesh
    hull_m: Float[Array, "h 3"]
    distance_m: tuple[float, float]
    window_side_px: float
    shapes: Mapping[int, Mesh]


def object_ids(paths: Sequence[str]) -> list[int]:
    """Object ids by file: the number of a BOP name (obj_000005.ply is 5), else 1, 2, ... in the order given.

    Raises:
        ConfigError: Two files would get one id.
    """
    numbers = [re.fullmatch(r"obj_(\d+)", Path(p).stem) for p in paths]
    if all(numbers) and paths:
        ids = [int(m.group(1)) for m in numbers if m]
    else:
        ids = list(range(1, len(paths) + 1))
    if len(set(ids)) < len(ids):
        raise ConfigError(f"--object: two files have the object id {max(ids, key=ids.count)}; rename one of them")
    return ids


def make_target(obj_id: int, mesh: Mesh, config: SynthConfig) -> Target:
    """Prepare an object: its hull, distances, window and occluder shapes.

    Raises:
        ConfigError: The distance range does not suit the object's size.
    """
    distance_m = config.distance.range_m(mesh.diameter_m)
    try:
        hull_m = mesh.vertices_m[ConvexHull(mesh.vertices_m).vertices]
    except QhullError:  # a flat object has no hull with volume
        hull_m = mesh.vertices_m
    camera = config.camera.camera()
    centred = hull_m - mesh.center_m
    side_px = fixed_side_px(centred, camera.K, distance_m[0], config.window.padding)
    first_key = LIBRARY_KEY + obj_id * config.occluders.library
    shapes = occluders.library(config.occluders, config.seed, obj_id, mesh.diameter_m)
    return Target(
        obj_id=obj_id,
        name=Path(mesh.path).name,
        mesh=mesh,
        hull_m=hull_m,
        distance_m=distance_m,
        window_side_px=side_px,
        shapes={first_key + i: shape for i, shape in enumerate(shapes)},
    )
