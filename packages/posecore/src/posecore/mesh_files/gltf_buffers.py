"""Binary data of a glTF file: buffers, and the arrays that accessors describe in them."""

import base64
import binascii
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any
from urllib.parse import unquote, unquote_to_bytes

import numpy as np
from jaxtyping import Float, Int

from posecore.errors import MeshError
from posecore.mesh_files.images import beside, linked_bytes, missing

_TYPES = {5120: "<i1", 5121: "<u1", 5122: "<i2", 5123: "<u2", 5125: "<u4", 5126: "<f4"}
_WIDTHS = {"SCALAR": 1, "VEC2": 2, "VEC3": 3, "VEC4": 4}
_MOST_ZEROS = 1 << 24
"""Values of an accessor that has no data of its own."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Buffers:
    """Buffers of a file, read when they are first needed.

    Attributes:
        file: The file, for messages and for what lies beside it.
        tree: Its JSON.
        blob: A GLB's binary chunk.
    """

    file: Path
    tree: Mapping[str, Any]
    blob: bytes | None
    _loaded: dict[int, bytes] = field(default_factory=dict)

    def is_stored(self, accessor: int) -> bool:
        """Whether an accessor has data of its own, and not zeros that an extension would replace."""
        entry = self.tree["accessors"][accessor]
        return "bufferView" in entry or "sparse" in entry

    def values(self, accessor: int) -> Float[np.ndarray, "n d"]:
        """An accessor's numbers; normalised integers in [0, 1] or [-1, 1]."""
        entry = self.tree["accessors"][accessor]
        stored = self._array(accessor)
        if entry.get("normalized") and stored.dtype.kind in "iu":
            return np.maximum(stored.astype(np.float64) / np.iinfo(stored.dtype).max, -1.0)
        return stored.astype(np.float64)

    def indices(self, accessor: int) -> Int[np.ndarray, " n"]:
        """An accessor's whole numbers."""
        return self._array(accessor).reshape(-1).astype(np.int64)

    def view(self, number: int) -> bytes:
        """Bytes of a buffer view.

        Raises:
            MeshError: The buffer is too short.
        """
        entry = self.tree["bufferViews"][number]
        data = self._buffer(entry["buffer"])
        start, length = entry.get("byteOffset", 0), entry["byteLength"]
        if start + length > len(data):
            raise MeshError(
                f"{self.file}: its buffer {entry['buffer']} is cut off, it has {len(data)} bytes, expected at least "
                f"{start + length}; copy it again"
            )
        return data[start : start + length]

    def linked(self, uri: str, what: str) -> tuple[bytes, str]:
        """Bytes and a name of what a URI stands for: data in the URI itself, or a file beside the mesh.

        Raises:
            MeshError: The URI cannot be read.
            TextureError: There is no such file.
        """
        if uri.startswith("data:"):
            head, _, body = uri.partition(",")
            try:
                return (base64.b64decode(body) if head.endswith(";base64") else unquote_to_bytes(body)), f"{what} in it"
            except (binascii.Error, ValueError) as error:
                raise MeshError(f"{self.file}: its {what} is broken base64 data ({error}); export it again") from error
        path = beside(unquote(uri), [self.file.parent])
        if path is None:
            raise missing(self.file, what, self.file.parent, unquote(uri))
        return linked_bytes(self.file, path), str(path)

    def _buffer(self, number: int) -> bytes:
        if number not in self._loaded:
            uri = self.tree["buffers"][number].get("uri")
            if uri is None and (self.blob is None or number > 0):
                raise MeshError(f"{self.file}: its buffer {number} has no data; export it again")
            self._loaded[number] = self.blob or b"" if uri is None else self.linked(uri, "buffer")[0]
        return self._loaded[number]

    def _array(self, accessor: int) -> np.ndarray:
        entry = self.tree["accessors"][accessor]
        count, width = entry["count"], _WIDTHS[entry["type"]]
        dtype = np.dtype(_TYPES[entry["componentType"]])
        if "bufferView" in entry:
            stride = self.tree["bufferViews"][entry["bufferView"]].get("byteStride")
            array = self._strided(
                accessor, entry["bufferView"], entry.get("byteOffset", 0), (count, width), dtype, stride
            )
        elif 0 <= count * width <= _MOST_ZEROS:
            array = np.zeros((count, width), dtype)
        else:
            raise MeshError(f"{self.file}: accessor {accessor} has {count} elements and no data; export it again")
        if "sparse" in entry:
            sparse = entry["sparse"]
            positions, changed = sparse["indices"], sparse["values"]
            index_type = np.dtype(_TYPES[positions["componentType"]])
            where = self._strided(
                accessor,
                positions["bufferView"],
                positions.get("byteOffset", 0),
                (sparse["count"], 1),
                index_type,
                None,
            )
            array = array.copy()
            array[where[:, 0].astype(np.int64)] = self._strided(
                accessor, changed["bufferView"], changed.get("byteOffset", 0), (sparse["count"], width), dtype, None
            )
        return array

    def _strided(
        self, accessor: int, view: int, offset: int, shape: tuple[int, int], dtype: np.dtype[Any], stride: int | None
    ) -> np.ndarray:
        data = self.view(view)
        row = shape[1] * dtype.itemsize
        step = stride or row
        if shape[0] < 0 or step < row or offset < 0 or (shape[0] and offset + (shape[0] - 1) * step + row > len(data)):
            raise MeshError(f"{self.file}: accessor {accessor} reaches beyond its buffer view; export it again")
        if not shape[0]:
            return np.zeros(shape, dtype)
        return np.ndarray(shape, dtype, data, offset, (step, dtype.itemsize))
