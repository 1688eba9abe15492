"""Files named on the command line, loaded: meshes, symmetries, photographs, panoramas, occluders."""

import logging
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path

from posecore.bop import ModelInfo
from posecore.bop.jsonfile import id_of, read_json
from posecore.bop.models_info import load_model_info
from posecore.errors import ConfigError, DatasetError, MeshError, TextureError
from posecore.mesh import Mesh, Units, load_mesh
from posecore.mesh_files import METRE_SUFFIXES, SUFFIXES

from synthgen.image.background import list_photos
from synthgen.image.hdri import list_hdris
from synthgen.inputs.assets import Assets

log = logging.getLogger(__name__)

MODELS_INFO = "models_info.json"
LARGEST_OBJECT_ID = 2**31 - 1
"""Of the shards' field `obj_id`."""
MOST_DIAMETER_LINES = 30


def _nothing(file: Path) -> None:
    """The default of `Sources.on_load`, which processes can be sent."""


@dataclass(frozen=True, kw_only=True)
class Sources:
    """Paths of a dataset's inputs.

    Attributes:
        objects: Meshes, folders of meshes (subfolders included), or BOP `models/` folders.
        units: Unit of the meshes' coordinates; meshes of a BOP folder are always in mm, glTF is always in m.
        backgrounds: Folder of photographs.
        hdris: Folder of panoramas.
        occluders: Folder of meshes, or one mesh.
        models_info: BOP file with symmetries; None reads the files in or beside `objects`.
        allow_missing_textures: Whether a mesh whose texture is missing gets its plain colours.
        skip_bad_objects: Whether objects that cannot be loaded are left out.
        on_load: Called with each mesh file before it is read.
    """

    objects: tuple[Path, ...]
    units: Units = "mm"
    backgrounds: Path | None = None
    hdris: Path | None = None
    occluders: Path | None = None
    models_info: Path | None = None
    allow_missing_textures: bool = False
    skip_bad_objects: bool = False
    on_load: Callable[[Path], None] = field(default=_nothing, repr=False, compare=False)
    _loaded: dict[Path, Mesh] = field(default_factory=dict, init=False, repr=False, compare=False)

    def meshes(self) -> dict[int, Mesh]:
        """Objects by id; see `object_ids`. A skipped object does not change the ids of the others.

        Raises:
            MeshError: An object cannot be loaded, or all are skipped.
            ConfigError: A folder holds no mesh, or two files have one id.
        """
        files = [mesh_file for path in self.objects for mesh_file in find_meshes(path, self.units, "--object")]
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

    def diameter_lines(self, meshes: Mapping[int, Mesh]) -> list[str]:
        """A line with the diameter for each object, or a single line for many: a wrong unit is seen at once."""
        if len(meshes) > MOST_DIAMETER_LINES:
            sizes = sorted(mesh.diameter_m for mesh in meshes.values())
            return [f"{len(meshes)} objects: diameters {1e3 * sizes[0]:.1f} to {1e3 * sizes[-1]:.1f} mm"]
        unit_of = {
            str(file): "BOP models are in mm"
            if path.is_dir() and (path / MODELS_INFO).is_file()
            else "glTF is in metres"
            if file.suffix.lower() in METRE_SUFFIXES
            else f"--units {units}"
            for path in self.objects
            for file, units in find_meshes(path, self.units, "--object")
        }
        return [
            f"{diameter_text(Path(mesh.path).name, mesh.diameter_m)} ({unit_of[mesh.path]})" for mesh in meshes.values()
        ]

    def assets(self) -> Assets:
        """Photographs, panoramas and occluder meshes, each decoded once.

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
        """The mesh of a file; the same object for a target and an occluder."""
        try:
            if path not in self._loaded:
                self.on_load(path)
                self._loaded[path] = load_mesh(path, units=units, allow_missing_textures=self.allow_missing_textures)
            return self._loaded[path]
        except TextureError as error:
            raise MeshError(f"{error}, or add --allow-missing-textures for plain colours") from error

    def infos(self, meshes: Mapping[int, Mesh]) -> dict[int, ModelInfo]:
        """Symmetries of the objects by id.

        Raises:
            DatasetError: A models_info file is missing or broken, or lists none of the objects.
        """
        if self.models_info is not None:
            return load_symmetries(self.models_info, meshes)
        infos: dict[int, ModelInfo] = {}
        for path in self.objects:
            inside = {i: m for i, m in meshes.items() if path in (Path(m.path), Path(m.path).parent)}
            if path.is_dir() and inside and (path / MODELS_INFO).is_file():
                infos |= load_symmetries(path / MODELS_INFO, inside)
            elif not path.is_dir():
                infos |= {i: info for i in inside if (info := info_beside(path)) is not None}
        return infos


def diameter_text(name: str, diameter_m: float) -> str:
    """An object's file name with its diameter."""
    return f"{name}: diameter {1e3 * diameter_m:.1f} mm"


def object_ids(paths: Sequence[str]) -> list[int]:
    """Object ids by file: the number of a BOP name (obj_000005.ply is 5), else 1, 2, ... in the order of the files.

    Raises:
        ConfigError: Two files would get one id, or an id does not fit 32 bits.
    """
    numbers = [_bop_number(Path(path)) for path in paths]
    ids = [number for number in numbers if number is not None]
    if not paths or len(ids) < len(paths):
        ids = list(range(1, len(paths) + 1))
    if max(ids, default=0) > LARGEST_OBJECT_ID:
        raise ConfigError(f"--object: a file has the object id {max(ids)}, expected at most {LARGEST_OBJECT_ID}")
    if len(set(ids)) < len(ids):
        raise ConfigError(f"--object: two files have the object id {max(ids, key=ids.count)}; rename one file")
    return ids


def load_symmetries(file: Path, meshes: Mapping[int, Mesh]) -> dict[int, ModelInfo]:
    """Symmetries of the objects from a `models_info.json` whose keys are object ids or the meshes' file names.

    A key that is both, such as 2 for `2.ply` as the first object, is a file name.

    Raises:
        DatasetError: The file is missing or broken, or lists none of the objects.
    """
    ids = {str(obj_id): obj_id for obj_id in meshes} | {Path(mesh.path).stem: i for i, mesh in meshes.items()}
    content = read_json(file)
    infos = {ids[key]: load_model_info(content[key], f"{file}, object {key}") for key in content if key in ids}
    if not infos:
        raise DatasetError(f"{file}: no entry for {', '.join(sorted(ids))}; its keys are {', '.join(content)}")
    return infos


def info_beside(mesh_file: Path) -> ModelInfo | None:
    """Entry of a mesh in the `models_info.json` beside it, by file name or BOP number; None without an entry.

    Raises:
        DatasetError: The file is broken.
    """
    file, number = mesh_file.with_name(MODELS_INFO), _bop_number(mesh_file)
    if not file.is_file():
        return None
    names = (mesh_file.stem, *(() if number is None else (str(number),)))
    content = read_json(file)
    return next((load_model_info(content[name], f"{file}, object {name}") for name in names if name in content), None)


def _bop_number(path: Path) -> int | None:
    return id_of(path.stem.removeprefix("obj_")) if path.stem.startswith("obj_") else None


def find_meshes(path: Path, units: Units, option: str) -> Sequence[tuple[Path, Units]]:
    """Mesh files of a path, sorted by name, with their units.

    A folder with `models_info.json` and obj_XXXXXX.ply files is a BOP models folder: those files, in mm. Any other
    folder stands for all meshes in it and below; a `models_info.json` in it has their names as keys.

    Args:
        path: File or folder.
        units: Unit of meshes outside BOP folders.
        option: Command-line option, for messages.

    Raises:
        ConfigError: A folder without meshes, or with the numbers of BOP objects and without their files.
    """
    if not path.is_dir():
        return [(path, units)]
    if (path / MODELS_INFO).is_file():
        models = [file for file in sorted(path.glob("*.ply")) if _bop_number(file) is not None]
        if models:
            return [(file, "mm") for file in models]
        if any(key.isdigit() for key in read_json(path / MODELS_INFO)):
            raise ConfigError(
                f"{option} {path}: {MODELS_INFO} has object numbers and there is no obj_XXXXXX.ply; name the meshes "
                "like that, or let its keys be their names"
            )
    files = sorted(file for file in path.rglob("*") if file.suffix.lower() in SUFFIXES)
    if not files:
        raise ConfigError(f"{option} {path}: no mesh in this folder, expected {', '.join(SUFFIXES)} files")
    return [(file, units) for file in files]
