"""Objects of a dataset: meshes for the rasteriser, points and symmetries for the point loss and the metrics."""

import tempfile
from collections.abc import Mapping
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float
from posecore.bop.models_info import ModelInfo, load_models_info, symmetry_transforms
from posecore.detail import with_levels
from posecore.errors import DatasetError
from posecore.mesh import Mesh
from posecore.shard import ShardReader
from posecore.symmetry import ball_center_m, is_ball

from refinenet.config import Pivot
from refinenet.geometry.pivots import PivotFrames
from refinenet.geometry.symmetry import ObjectPoints


def object_ids(reader: ShardReader) -> list[int]:
    """Objects of the data card, sorted.

    Raises:
        ShardError: The card has none.
    """
    reader.require("objects")
    return sorted(int(key) for key in reader.card["objects"])


def pivot_frames(meshes: Mapping[int, Mesh], pivot: Pivot) -> PivotFrames:
    """Frames that poses are trained in: their origins are the configured pivots."""
    if pivot == "center":
        return PivotFrames.at_centers(meshes)
    return PivotFrames.at(meshes, {obj_id: np.zeros(3) for obj_id in meshes})


def for_patches(meshes: Mapping[int, Mesh]) -> dict[int, Mesh]:
    """Meshes for rendering hypotheses in training, with levels of detail: a patch shows few of many faces."""
    return {obj_id: with_levels(mesh) for obj_id, mesh in meshes.items()}


def load_models(reader: ShardReader) -> dict[int, ModelInfo]:
    """Diameters and symmetries that the dataset carries in `models/models_info.json`.

    Raises:
        ShardError: The file is missing.
        DatasetError: It is not valid.
    """
    with tempfile.TemporaryDirectory() as folder:
        copy = Path(folder) / "models_info.json"
        copy.write_bytes(reader.file("models/models_info.json"))
        try:
            return load_models_info(copy)
        except DatasetError as error:
            raise DatasetError(str(error).replace(folder, f"{reader.url}/models")) from error


def symmetries_of(
    meshes: Mapping[int, Mesh], models: Mapping[int, ModelInfo], step_deg: float
) -> dict[int, np.ndarray]:
    """(s, 4, 4) symmetry transforms of each object, the identity first, by object id, in the frames of `models`.

    Args:
        meshes: By object id.
        models: Symmetries by object id; an object without an entry has none.
        step_deg: Step at which continuous symmetries are sampled.
    """
    transforms = {}
    for obj_id in meshes:
        model, identity = models.get(obj_id), np.eye(4)[None]
        transforms[obj_id] = (
            identity if model is None else symmetry_transforms(model, max_step_rad=np.deg2rad(step_deg))
        )
    return transforms


def object_points(
    meshes: Mapping[int, Mesh], models: Mapping[int, ModelInfo], n_points: int, step_deg: float
) -> ObjectPoints:
    """Vertices spread over each object by farthest-point sampling, and its symmetries, padded to one shape.

    Args:
        meshes: By object id; rows follow the sorted ids.
        models: Symmetries by object id, in the meshes' frames; an object without an entry has none.
        n_points: Points of each object.
        step_deg: Step at which continuous symmetries are sampled.
    """
    points = [farthest_points(mesh.vertices_m, n_points) for _, mesh in sorted(meshes.items())]
    transforms = [S for _, S in sorted(symmetries_of(meshes, models, step_deg).items())]
    width = max(len(S) for S in transforms)
    padded = [np.concatenate([S, np.tile(np.eye(4), (width - len(S), 1, 1))]) for S in transforms]
    valid = np.stack([np.arange(width) < len(S) for S in transforms])
    continuous = [axes_of(models.get(obj_id)) for obj_id in sorted(meshes)]
    most = max(len(axes) for axes, _ in continuous)
    axes = np.stack([np.concatenate([axes, np.zeros((most - len(axes), 3))]) for axes, _ in continuous])
    return ObjectPoints(
        torch.from_numpy(np.stack(points).astype(np.float32)),
        torch.from_numpy(np.stack(padded).astype(np.float32)),
        torch.from_numpy(valid),
        torch.from_numpy(axes.astype(np.float32)),
        torch.from_numpy(np.stack([point for _, point in continuous]).astype(np.float32)),
    )


def axes_of(model: ModelInfo | None) -> tuple[Float[np.ndarray, "a 3"], Float[np.ndarray, "3"]]:
    """Unit axes of an object's continuous symmetries, and a point (metres) on all axes; object frame.

    No axis, one axis, or the three axes of a ball.
    """
    if model is None or not model.symmetries_continuous:
        return np.zeros((0, 3)), np.zeros(3)
    continuous = model.symmetries_continuous
    if is_ball(continuous):
        return np.eye(3), ball_center_m(continuous)
    axis = np.array(continuous[0].axis)
    return axis[None] / np.linalg.norm(axis), np.array(continuous[0].offset_m)


def farthest_points(vertices_m: np.ndarray, n: int) -> np.ndarray:
    """(n, 3) vertices by farthest-point sampling; repeated where the mesh has fewer."""
    chosen = [int(np.argmax(np.linalg.norm(vertices_m - vertices_m.mean(axis=0), axis=1)))]
    distance = np.full(len(vertices_m), np.inf)
    for _ in range(n - 1):
        distance = np.minimum(distance, np.linalg.norm(vertices_m - vertices_m[chosen[-1]], axis=1))
        chosen.append(int(distance.argmax()))
    return np.asarray(vertices_m[chosen])
