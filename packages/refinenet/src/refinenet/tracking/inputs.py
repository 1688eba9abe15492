"""Inputs of tracking: initial poses, meshes and symmetries."""

from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np
from jaxtyping import Float
from posecore.bop import Estimate, ModelInfo
from posecore.bop.annotations import ground_truth
from posecore.bop.jsonfile import id_of, read_json
from posecore.bop.models_info import load_model_info
from posecore.bop.result_table import parse_results
from posecore.bop.results import (
    Extent,
    estimate_table,
    estimates_of,
    in_metres,
    metres_fault,
    read_result_bytes,
)
from posecore.errors import ConfigError, ResultFileError
from posecore.mesh import Mesh, Units, load_mesh

from refinenet.models.checkpoint import Checkpoint
from refinenet.tracking.frame_sources import BopScene, FrameSequence

Pose = Float[np.ndarray, "4 4"]


class InitialPoses:
    """Initial poses of a sequence: those of a result file at their images, those of a pose file at any image.

    Args:
        sequence: Frames.
        init: BOP result file; None with `pose`.
        pose: List of `scene_gt.json`; None with `init`.
        objects: Objects to track; all when empty.

    Attributes:
        obj_ids: Objects with an initial pose.

    Raises:
        ConfigError: There is no pose of a requested object, or none at all.
    """

    def __init__(
        self, sequence: FrameSequence, init: Path | None, pose: Path | None, objects: Sequence[int] = ()
    ) -> None:
        self._always: dict[int, list[Pose]] = {}
        self._at: dict[int, dict[int, list[Pose]]] = {}
        self._file, self._estimates = init or pose, list[Estimate]()
        if init is not None:
            for initial in estimates_of(parse_results(read_result_bytes(init), str(init))):
                if initial.scene_id == sequence.scene_id and (not objects or initial.obj_id in objects):
                    self._estimates.append(initial)
                    self._at.setdefault(initial.im_id, {}).setdefault(initial.obj_id, []).append(initial.T_cam_obj)
        elif pose is not None:
            for obj_id, T in read_poses(pose):
                if not objects or obj_id in objects:
                    self._always.setdefault(obj_id, []).append(T)
        self.obj_ids = sorted({i for poses in (self._always, *self._at.values()) for i in poses})
        missing = sorted(set(objects) - set(self.obj_ids))
        if missing or not self.obj_ids:
            which = f" of object {', '.join(map(str, missing))}" if missing else ""
            where, change = (f" for scene {sequence.scene_id}", "--scene or --object") if init else ("", "--object")
            todo = f"change {change}" if objects or init else "list the initial poses of the objects"
            raise ConfigError(f"{init or pose}: no pose{which}{where}; {todo}")

    def at(self, number: int) -> Mapping[int, list[Pose]]:
        """Initial poses for a frame, by object id."""
        return self._at.get(number, {}) if self._at else self._always

    def require_millimetres(self, meshes: Mapping[int, Mesh]) -> None:
        """Refuse poses whose file is probably in metres, see `posecore.bop.results.in_metres`.

        Args:
            meshes: By object id, of all objects.

        Raises:
            ResultFileError: The result file is.
            ConfigError: A pose of the pose file is.
        """
        extents = {obj_id: Extent(mesh.center_m, mesh.diameter_m) for obj_id, mesh in meshes.items()}
        metres = metres_fault(estimate_table(self._estimates), extents)
        if metres is not None:
            raise ResultFileError(f"{self._file}:{metres.line}: {metres.message}")
        for obj_id, T in ((obj_id, T) for obj_id, poses in self._always.items() for T in poses):
            if in_metres(T[None], [extents[obj_id]]):
                raise ConfigError(
                    f"{self._file}: a t of length {1e3 * np.linalg.norm(T[:3, 3]):.4g} is probably in metres; "
                    "cam_t_m2c is in millimetres, multiply it by 1000"
                )


def read_poses(file: Path) -> list[tuple[int, Pose]]:
    """Object ids and poses (metres) of a list of `scene_gt.json`, which is in millimetres."""
    poses = [ground_truth(entry, i, None, f"{file}, entry {i}") for i, entry in enumerate(read_json(file, list))]
    return [(pose.obj_id, pose.T_cam_obj) for pose in poses]


def load_models(
    sequence: FrameSequence, files: Sequence[Path], units: Units, loaded: Checkpoint | None, obj_ids: Sequence[int]
) -> tuple[dict[int, Mesh], dict[int, ModelInfo]]:
    """Meshes and symmetries of objects: those of the BOP dataset, or files with a models_info.json beside them.

    Args:
        sequence: Frames.
        files: Mesh files; `obj_000005.ply` is object 5, any other name the only object.
        units: Unit of the files.
        loaded: Checkpoint, whose objects may be tracked; None without a network.
        obj_ids: Objects to track.

    Raises:
        ConfigError: Files for a BOP dataset, a file without an object number, or an object without a mesh.
    """
    if isinstance(sequence, BopScene):
        if files or units != "mm":
            raise ConfigError(
                "--mesh and --units are for images and videos; a BOP dataset brings its own models, in mm"
            )
        infos = sequence.dataset.models_info
        return {i: sequence.dataset.mesh(i) for i in obj_ids}, {i: infos[i] for i in obj_ids if i in infos}
    possible = list(obj_ids) if loaded is None else sorted(map(int, loaded.provenance.objects))
    meshes: dict[int, Mesh] = {}
    symmetric: dict[int, ModelInfo] = {}
    for file in files:
        number = id_of(file.stem.removeprefix("obj_")) if file.stem.startswith("obj_") else None
        if number is None and len(possible) > 1:
            ids = ", ".join(map(str, possible))
            owner = "initial poses are of" if loaded is None else "the checkpoint has"
            raise ConfigError(f"{file}: {owner} objects {ids}; name the file obj_000001.ply to give its object")
        obj_id = possible[0] if number is None else number
        meshes[obj_id] = load_mesh(file, units=units)
        info_file = file.with_name("models_info.json")
        listed = read_json(info_file) if info_file.is_file() else {}
        entry = listed.get(str(obj_id)) or listed.get(file.stem)  # by number as in BOP, or by the mesh's name
        if entry is not None:
            symmetric[obj_id] = load_model_info(entry, f"{info_file}, object {obj_id}")
    missing = [i for i in obj_ids if i not in meshes]
    if missing:
        raise ConfigError(f"object {missing[0]} has an initial pose and no mesh; give its file with --mesh")
    return {i: meshes[i] for i in obj_ids}, symmetric
