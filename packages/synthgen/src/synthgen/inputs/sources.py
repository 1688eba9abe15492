"""What a command line names, found and loaded: objects, photographs, panoramas, occluders, symmetries."""

import logging
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

from posecore.bop import ModelInfo
from posecore.bop.jsonfile import read_json
from posecore.bop.models_info import load_model_info
from posecore.errors import ConfigError, MeshError, TextureError
from posecore.mesh import Mesh, Units, load_mesh

from synthgen.draw.target import object_ids
from synthgen.image.background import list_photos
from synthgen.image.hdri import list_hdris
from synthgen.inputs.assets import Assets
from synthgen.pairs.data_card import load_symmetries

log = logging.getLogger(__name__)

MESH_SUFFIXES = (".ply", ".obj", ".gltf", ".glb", ".stl", ".off")
MODELS_INFO = "models_info.json"


@dataclass(frozen=True, kw_only=True)
class Sources:
    """Files and folders as they were given.

    Attributes:
        objects: Meshes, folders of meshes (subfolders included), or BOP `models/` folders.
        units: Unit of the meshes' coordinates; those of a BOP folder are in mm whatever this says.
        backgrounds: Folder of photographs.
        hdris: Folder of panoramas.
        occluders: Folder of meshes, or one mesh.
        models_info: BOP file to take symmetries from; without it those in or beside `objects`.
        allow_missing_textures: Whether a mesh whose texture is missing has its plain colours instead.
        skip_bad_objects: Whether an object that cannot be loaded is left out.
    """

    objects: tuple[Path, ...]
    units: Units = "mm"
    backgrounds: Path | None = None
    hdris: Path | None = None
    occluders: Path | None = None
    models_info: Path | None = None
    allow_missing_textures: bool = False
    skip_bad_objects: bool = False

    def meshes(self) -> dict[int, Mesh]:
        """The objects by id; see `target.object_ids`. An object that is left out leaves the others' ids as they are.

        Raises:
            MeshError: One cannot be loaded, or none of them.
            ConfigError: A folder holds no mesh, or two files have one id.
        """
        files = [found for given in self.objects for found in find_meshes(given, self.units, "--object")]
        loaded, bad = {}, []
        for obj_id, (path, units) in zip(object_ids([str(path) for path, _ in files]), files, strict=True):
            try:
                loaded[obj_id] = self._load(path, units)
            except MeshError as error:
                if not self.skip_bad_objects:
                    hint = "; repair it or leave it out with --skip-bad-objects" if len(files) > 1 else ""
                    raise MeshError(f"{error}{hint}") from error
                log.warning("object %d is left out: %s", obj_id, error)
                bad.append(str(error))
        if not loaded:
            raise MeshError(f"--object: none of {len(files)} meshes can be loaded; the first: {bad[0]}")
        return loaded

    def assets(self) -> Assets:
        """Photographs, panoramas and occluder meshes, every one looked at.

        Raises:
            ConfigError: A folder is missing, empty, or holds a file that does not decode.
            MeshError: An occluder cannot be loaded.
        """
        occluders = find_meshes(self.occluders, self.units, "--occluders") if self.occluders is not None else []
        return Assets(
            photos=list_photos(self.backgrounds.resolve()) if self.backgrounds is not None else (),
            hdris=list_hdris(self.hdris.resolve()) if self.hdris is not None else (),
            occluders=tuple(self._load(path, units) for path, units in occluders),
        )

    def _load(self, path: Path, units: Units) -> Mesh:
        try:
            return load_mesh(path, units=units, allow_missing_textures=self.allow_missing_textures)
        except TextureError as error:
            raise MeshError(f"{error}, or add --allow-missing-textures for plain colours") from error

    def infos(self, meshes: Mapping[int, Mesh]) -> dict[int, ModelInfo]:
        """Symmetries of the objects.

        Raises:
            DatasetError: The file is missing or broken, or knows none of the objects.
        """
        if self.models_info is not None:
            return load_symmetries(str(self.models_info), meshes)
        known: dict[int, ModelInfo] = {}
        for given in self.objects:
            inside = {i: m for i, m in meshes.items() if given in (Path(m.path), Path(m.path).parent)}
            if given.is_dir() and inside and (given / MODELS_INFO).is_file():
                known |= load_symmetries(str(given / MODELS_INFO), inside)
            elif not given.is_dir():
                known |= {i: info for i in inside if (info := info_beside(given)) is not None}
        return known


def info_beside(mesh_file: Path) -> ModelInfo | None:
    """What the `models_info.json` beside a mesh says of it, by its name, or by the number in a BOP name.

    Raises:
        DatasetError: It is broken.
    """
    file = mesh_file.with_name(MODELS_INFO)
    if not file.is_file():
        return None
    numbered = re.fullmatch(r"obj_(\d+)", mesh_file.stem)
    names = (mesh_file.stem, str(int(numbered[1])) if numbered else "")
    listed = read_json(file)
    return next((load_model_info(listed[name], f"{file}, object {name}") for name in names if name in listed), None)


def find_meshes(given: Path, units: Units, option: str) -> Sequence[tuple[Path, Units]]:
    """Mesh files that a path stands for, sorted by name, with their units.

    A folder with `models_info.json` and obj_XXXXXX.ply files is a BOP models folder: those files, in mm. Any other
    folder stands for all meshes in it and below; a `models_info.json` in it has their names as keys.

    Args:
        given: File or folder.
        units: Of meshes outside BOP folders.
        option: Named in messages.

    Raises:
        ConfigError: A folder without meshes, or with the numbers of BOP objects and without their files.
    """
    if not given.is_dir():
        return [(given, units)]
    if (given / MODELS_INFO).is_file():
        models = [p for p in sorted(given.glob("*.ply")) if re.fullmatch(r"obj_\d+", p.stem)]
        if models:
            return [(path, "mm") for path in models]
        if any(key.isdigit() for key in read_json(given / MODELS_INFO)):
            raise ConfigError(
                f"{option} {given}: {MODELS_INFO} has object numbers and there is no obj_XXXXXX.ply; name the meshes "
                "like that, or let its keys be their names"
            )
    found = sorted(p for p in given.rglob("*") if p.suffix.lower() in MESH_SUFFIXES)
    if not found:
        raise ConfigError(f"{option} {given}: no mesh in this folder, expected {', '.join(MESH_SUFFIXES)} files")
    return [(path, units) for path in found]
