"""The objects of a dataset: its meshes, which lie beside the shards."""

import re
from pathlib import Path
from tempfile import TemporaryDirectory

from posecore.errors import MeshError, ShardError
from posecore.mesh import Mesh, load_mesh
from posecore.shard.reader import ShardReader


def load_meshes(reader: ShardReader) -> dict[int, Mesh]:
    """The meshes that the dataset carries in `models/`, by object id.

    Raises:
        ShardError: One is missing or broken.
    """
    meshes = {}
    with TemporaryDirectory() as folder:  # a dataset behind a URL has no paths to load from
        for obj_id, entry in sorted((int(key), entry) for key, entry in reader.card["objects"].items()):
            for key in filter(None, (entry.get("texture"), str(entry["path"]))):
                copy = Path(folder) / Path(key).name
                copy.write_bytes(reader.file(key))
            try:
                meshes[obj_id] = load_mesh(copy, units="mm")
            except MeshError as error:
                reason = re.sub(re.escape(str(copy)), "", str(error)).lstrip(": ")
                raise ShardError(f"{reader.url}/{entry['path']}: {reason}") from error
    return meshes
