"""The objects of a dataset: its meshes and symmetries, which lie beside the shards."""

import re
from pathlib import Path
from tempfile import TemporaryDirectory

from posecore.errors import MeshError, ShardError
from posecore.mesh import Mesh, load_mesh
from posecore.shard.reader import ShardReader

MODELS_INFO = "models/models_info.json"
_TEXTURE = re.compile(rb"^comment TextureFile (.*?)\r?$", re.MULTILINE)


def model_keys(reader: ShardReader) -> list[str]:
    """Keys of the objects' files, all in `models/`."""
    reader.require("objects")
    entries = reader.card["objects"].values()
    return [*(entry[part] for entry in entries for part in ("path", "texture") if entry.get(part)), MODELS_INFO]


def load_meshes(reader: ShardReader) -> dict[int, Mesh]:
    """The meshes that the dataset carries in `models/`, by object id.

    Raises:
        ShardError: One is missing or broken, or names a texture that is not the dataset's.
    """
    reader.require("objects")
    meshes = {}
    with TemporaryDirectory() as folder:  # a dataset behind a URL has no paths to load from
        for obj_id, entry in sorted((int(key), entry) for key, entry in reader.card["objects"].items()):
            texture, path = entry.get("texture"), str(entry["path"])
            for key in filter(None, (texture, path)):
                copy = Path(folder) / Path(key).name
                copy.write_bytes(reader.file(key))
            for name in _TEXTURE.findall(copy.read_bytes().partition(b"end_header")[0]):
                if texture is None or name.strip() != Path(texture).name.encode():
                    raise ShardError(
                        f"{reader.url}/{path}: names the texture {name.decode('utf-8', 'replace').strip()!r}, expected "
                        f"the data card's {texture}; render the dataset again"
                    )
            try:
                meshes[obj_id] = load_mesh(copy, units="mm")
            except MeshError as error:
                reason = re.sub(re.escape(str(copy)), "", str(error)).lstrip(": ")
                raise ShardError(f"{reader.url}/{path}: {reason}") from error
    return meshes
