"""What is checked of an object before its poses are refined: is it the trained one, in the trained unit."""

from posecore.errors import CheckpointError
from posecore.mesh import Mesh, mesh_digest

from refinenet.models.checkpoint import Checkpoint

DIAMETER_TOLERANCE = 0.02
MEMBER_SIZES = (0.8, 1.25)
"""Smallest and largest member of a category, as shares of the smallest and largest trained one's diameter."""


def require_trained(loaded: Checkpoint, obj_id: int, mesh: Mesh, *, allow_other_mesh: bool = False) -> None:
    """Refuse a mesh that the checkpoint was not trained with; for a category, one of another size than its members.

    First the size, as the same file may be read in another unit; then the hash decides, that of the file, or
    `mesh_digest`. A checkpoint that has no `mesh_digest` cannot tell a mesh
    that was written anew from another one of its size; such a mesh passes.

    Raises:
        CheckpointError: The object is not in the training data, has another size, or is another mesh.
    """
    objects = loaded.provenance.objects
    if loaded.provenance.config.category:
        _require_member(loaded, obj_id, mesh)
        return
    if str(obj_id) not in objects:
        known = ", ".join(sorted(objects, key=int))
        raise CheckpointError(
            f"{loaded.path}: object {obj_id} was not in its training data (objects {known}); "
            "choose another checkpoint, or name the objects to refine with --object"
        )
    trained = objects[str(obj_id)]
    trained_m = float(trained["diameter_m"])
    ratio = mesh.diameter_m / trained_m
    if abs(ratio - 1) > DIAMETER_TOLERANCE:
        unit = next((word for factor, word in _UNITS.items() if abs(ratio / factor - 1) < DIAMETER_TOLERANCE), None)
        why = f"it was read in {unit} too large a unit" if ratio > 1 and unit else "another object, or another unit"
        why = f"it was read in {unit} too small a unit" if ratio < 1 and unit else why
        raise CheckpointError(
            f"{loaded.path}: object {obj_id} had a diameter of {1e3 * trained_m:.1f} mm in training, this one has "
            f"{1e3 * mesh.diameter_m:.6g} mm: {why}"
        )
    if mesh.sha256 and mesh.sha256 == trained.get("sha256"):
        return
    if "mesh_digest" in trained and mesh_digest(mesh) != trained["mesh_digest"] and not allow_other_mesh:
        raise CheckpointError(
            f"{loaded.path}: object {obj_id} is another mesh than in training ({mesh.path or 'this one'} has digest "
            f"{mesh_digest(mesh)[:12]}, {trained.get('name', 'the trained one')} had {trained['mesh_digest'][:12]}); "
            "give the mesh it was trained with, or pass --allow-other-mesh"
        )


def _require_member(loaded: Checkpoint, obj_id: int, mesh: Mesh) -> None:
    diameters_m = [float(card["diameter_m"]) for card in loaded.provenance.objects.values()]
    least_m, most_m = MEMBER_SIZES[0] * min(diameters_m), MEMBER_SIZES[1] * max(diameters_m)
    if not least_m <= mesh.diameter_m <= most_m:
        raise CheckpointError(
            f"{loaded.path}: object {obj_id} has a diameter of {1e3 * mesh.diameter_m:.6g} mm, expected "
            f"{1e3 * least_m:.1f} to {1e3 * most_m:.1f} mm, as the members of the category that it was trained on: "
            "no member, or read in another unit"
        )


_UNITS = {1e3: "a thousand times", 1e-3: "a thousand times", 10.0: "ten times", 0.1: "ten times"}
