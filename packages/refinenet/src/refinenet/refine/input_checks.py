"""Checks of a mesh before refinement: the trained object, in the trained unit."""

from collections.abc import Mapping
from typing import Any

import numpy as np
from jaxtyping import Float
from posecore.errors import CheckpointError
from posecore.mesh import Mesh, mesh_digest

from refinenet.models.checkpoint import Checkpoint

DIAMETER_TOLERANCE = 0.02
"""Largest relative difference between the diameters of a mesh and of the trained one."""
MEMBER_SIZES = (0.8, 1.25)
"""Smallest and largest member of a category, as fractions of the smallest and largest trained diameter."""
UNIT_FACTORS = {1e3: "a thousand times", 1e-3: "a thousand times", 10.0: "ten times", 0.1: "ten times"}
"""Ratios of diameters that a mesh in another unit has."""


def require_trained(loaded: Checkpoint, obj_id: int, mesh: Mesh, *, allow_other_mesh: bool = False) -> None:
    """Refuse a mesh that is not the trained one; for a category, a mesh outside the range of its members' sizes.

    The diameter is compared first, as the same file may be read in another unit. Then the hash of the file or
    `mesh_digest` decides. A checkpoint without `mesh_digest` accepts any mesh of the trained diameter.

    Raises:
        CheckpointError: The object is not in the training data, has another size, or is another mesh.
    """
    objects = loaded.provenance.objects
    if loaded.provenance.config.category:
        _require_member(loaded, obj_id, mesh)
        return
    if str(obj_id) not in objects:
        trained_ids = ", ".join(sorted(objects, key=int))
        raise CheckpointError(
            f"{loaded.path}: object {obj_id} was not in its training data (objects {trained_ids}); "
            "choose another checkpoint, or name the objects to refine with --object"
        )
    trained = objects[str(obj_id)]
    trained_m = float(trained["diameter_m"])
    ratio = mesh.diameter_m / trained_m
    if abs(ratio - 1) > DIAMETER_TOLERANCE:
        unit = next(
            (word for factor, word in UNIT_FACTORS.items() if abs(ratio / factor - 1) < DIAMETER_TOLERANCE), None
        )
        size = "large" if ratio > 1 else "small"
        reason = f"it was read in {unit} too {size} a unit" if unit else "another object, or another unit"
        raise CheckpointError(
            f"{loaded.path}: object {obj_id} had a diameter of {1e3 * trained_m:.1f} mm in training, this one has "
            f"{1e3 * mesh.diameter_m:.6g} mm: {reason}"
        )
    if not allow_other_mesh and not _is_trained_mesh(trained, mesh):
        raise CheckpointError(
            f"{loaded.path}: object {obj_id} is another mesh than in training ({mesh.path or 'this one'} has digest "
            f"{mesh_digest(mesh)[:12]}, {trained.get('name', 'the trained one')} had {trained['mesh_digest'][:12]}); "
            "give the mesh it was trained with, or pass --allow-other-mesh"
        )


def pivots_m(loaded: Checkpoint, meshes: Mapping[int, Mesh]) -> dict[int, Float[np.ndarray, "3"]]:
    """Point of each object, in its own frame, that a checkpoint's updates are about: the centre, metres.

    A checkpoint of an earlier version learned updates about the origin of the mesh that it was trained on, and has it
    there. Another mesh's origin, accepted with --allow-other-mesh, may lie anywhere: it has its centre. Where an update
    is small, both give the same pose. The members of a category share their frame, and have their origin.
    """
    config, objects = loaded.provenance.config, loaded.provenance.objects
    return {
        obj_id: np.zeros(3)
        if config.pivot == "origin" and (config.category or _is_trained_mesh(objects[str(obj_id)], mesh))
        else mesh.center_m
        for obj_id, mesh in meshes.items()
    }


def _is_trained_mesh(trained: Mapping[str, Any], mesh: Mesh) -> bool:
    """Whether the hash of the file or `mesh_digest` is that of training; without `mesh_digest` any mesh is."""
    if mesh.sha256 and mesh.sha256 == trained.get("sha256"):
        return True
    return "mesh_digest" not in trained or mesh_digest(mesh) == trained["mesh_digest"]


def _require_member(loaded: Checkpoint, obj_id: int, mesh: Mesh) -> None:
    diameters_m = [float(card["diameter_m"]) for card in loaded.provenance.objects.values()]
    least_m, most_m = MEMBER_SIZES[0] * min(diameters_m), MEMBER_SIZES[1] * max(diameters_m)
    if not least_m <= mesh.diameter_m <= most_m:
        raise CheckpointError(
            f"{loaded.path}: object {obj_id} has a diameter of {1e3 * mesh.diameter_m:.6g} mm, expected "
            f"{1e3 * least_m:.1f} to {1e3 * most_m:.1f} mm, as the members of the category that it was trained on: "
            "no member, or read in another unit"
        )
