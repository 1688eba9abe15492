"""Shard files: one field's samples as Zarr's sharding codec lays them out, without Zarr's event loop.

The arrays' metadata name every codec, so `zarr.open_group` reads and writes the same files; tests hold the two against
each other. Here a shard is one call per chunk into numcodecs, which halves the time of a shard.

Inner codecs, by the name they have in the field table; CRC-32C closes each, so that every read is checked:

- `zstd`: level 1.
- `shuffle+zstd`: Blosc, bytes of a number sorted by significance, level 3.
- `delta+shuffle+zstd`: differences along a row before that.
- `planes+delta+zstd`: colour planes apart, differences along a row, level 1.
"""

import threading
from typing import Any

import cv2
import google_crc32c
import numpy as np
from numcodecs import blosc, zstd

MOST_CHUNK_SAMPLES = 8
"""Samples of a patch field that are compressed together: what reading one sample alone costs."""

_ABSENT = np.uint64(2**64 - 1)
_CRC_BYTES = 4
_ZSTD_LEVEL, _BLOSC_LEVEL = 1, 3
_ZSTD_MAGIC = b"\x28\xb5\x2f\xfd"
_BLOSC_SETTING = threading.Lock()


def chunk_samples(shape: tuple[str | int, ...], shard_size: int) -> int:
    """Samples in an inner chunk: a divisor of the shard's; fields without a patch are one chunk."""
    if "P" not in shape:
        return shard_size
    return max(n for n in range(1, min(MOST_CHUNK_SAMPLES, shard_size) + 1) if shard_size % n == 0)


def codecs(codec: str, dtype: str, ndim: int) -> list[dict[str, Any]]:
    """Inner codecs as Zarr v3 metadata.

    Args:
        codec: Name in the field table.
        dtype: On disk.
        ndim: Of the array, with the sample axis.
    """
    size = np.dtype(dtype).itemsize
    chain: list[dict[str, Any]] = []
    if "planes" in codec:
        chain.append({"name": "transpose", "configuration": {"order": [0, ndim - 1, *range(1, ndim - 1)]}})
    if "delta" in codec:
        stored = np.dtype(dtype).newbyteorder("<").str
        chain.append({"name": "numcodecs.delta", "configuration": {"dtype": stored, "astype": stored}})
    chain.append({"name": "bytes", **({"configuration": {"endian": "little"}} if size > 1 else {})})
    if "shuffle" in codec:
        blocks = {"typesize": size, "cname": "zstd", "clevel": _BLOSC_LEVEL, "shuffle": "shuffle", "blocksize": 0}
        chain.append({"name": "blosc", "configuration": blocks})
    else:
        chain.append({"name": "zstd", "configuration": {"level": _ZSTD_LEVEL, "checksum": False}})
    return [*chain, {"name": "crc32c"}]


def pack(stored: np.ndarray, codec: str, shard_size: int, chunk: int) -> bytes:
    """A shard file.

    Args:
        stored: Samples of the shard in front, at most `shard_size`; what is missing is filled up with zeros.
        codec: Name in the field table.
        shard_size: Samples in a full shard.
        chunk: Samples in an inner chunk.
    """
    index = np.full((shard_size // chunk, 2), _ABSENT, "<u8")
    parts: list[bytes] = []
    position = 0
    for number in range(-(-len(stored) // chunk)):
        part = stored[number * chunk : (number + 1) * chunk]
        if len(part) < chunk:
            part = np.concatenate([part, np.zeros((chunk - len(part), *part.shape[1:]), part.dtype)])
        data = _with_crc(_compress(part, codec))
        index[number] = position, len(data)
        position += len(data)
        parts.append(data)
    return b"".join([*parts, _with_crc(index.tobytes())])


def unpack(
    data: bytes, codec: str, dtype: str, chunk_shape: tuple[int, ...], shard_size: int, first: int
) -> np.ndarray:
    """One inner chunk of a shard file.

    Args:
        data: The file.
        codec: Name in the field table.
        dtype: On disk.
        chunk_shape: With the samples of a chunk in front.
        shard_size: Samples in a full shard.
        first: First sample of the chunk.

    Raises:
        ValueError: A checksum differs, or the file is not one.
    """
    n_chunks = shard_size // chunk_shape[0]
    index_bytes = _checked(memoryview(data)[-(16 * n_chunks + _CRC_BYTES) :])
    if len(index_bytes) != 16 * n_chunks:
        raise ValueError("too short for its index")
    position, size = np.frombuffer(index_bytes, "<u8").reshape(n_chunks, 2)[first // chunk_shape[0]]
    if position == _ABSENT:
        return np.zeros(chunk_shape, dtype)
    part = _checked(memoryview(data)[int(position) : int(position) + int(size)])
    return _decompress(part, codec, np.dtype(dtype).newbyteorder("<"), chunk_shape)


def _compress(values: np.ndarray, codec: str) -> bytes:
    values = np.ascontiguousarray(values, values.dtype.newbyteorder("<"))
    if "planes" in codec:
        values = np.stack([np.stack(cv2.split(image)) for image in values])
    if "delta" in codec:
        flat = values.reshape(-1)
        values = np.empty_like(flat)
        values[0] = flat[0]
        np.subtract(flat[1:], flat[:-1], out=values[1:])
    if "shuffle" not in codec:
        return bytes(zstd.compress(values.reshape(-1).view(np.uint8), _ZSTD_LEVEL))
    with _BLOSC_SETTING:  # threads would order a chunk's blocks by who is done first
        threads, blosc.use_threads = blosc.use_threads, False
        try:
            return bytes(blosc.compress(values.reshape(-1), b"zstd", _BLOSC_LEVEL, blosc.SHUFFLE))
        finally:
            blosc.use_threads = threads


def _decompress(data: memoryview, codec: str, dtype: np.dtype, shape: tuple[int, ...]) -> np.ndarray:
    flat = np.empty(int(np.prod(shape)), dtype)
    size = (_blosc_size if "shuffle" in codec else _zstd_size)(data)
    if size != flat.nbytes:  # a shorter chunk would leave the rest of `flat` as it was in memory
        raise ValueError(f"a chunk holds {size} bytes, expected {flat.nbytes}")
    (blosc if "shuffle" in codec else zstd).decompress(data, flat.view(np.uint8))
    if "delta" in codec:
        flat = np.cumsum(flat, dtype=dtype)
    if "planes" not in codec:
        return flat.reshape(shape)
    images = np.empty(shape, dtype)
    for image, planes in zip(images, flat.reshape(shape[0], shape[-1], *shape[1:-1]), strict=True):
        cv2.merge(list(planes), dst=image)
    return images


def _blosc_size(data: memoryview) -> int:
    """Bytes of a chunk when decompressed, from Blosc's header."""
    return int.from_bytes(data[4:8], "little")


def _zstd_size(data: memoryview) -> int | None:
    """Bytes of a chunk when decompressed, from zstd's frame header (RFC 8878, 3.1.1.1); None where it has none."""
    if len(data) < 5 or bytes(data[:4]) != _ZSTD_MAGIC:
        raise ValueError("not zstd")
    descriptor = data[4]
    is_single_segment = bool(descriptor & 0x20)
    start = 5 + (not is_single_segment) + (0, 1, 2, 4)[descriptor & 3]
    length = (int(is_single_segment), 2, 4, 8)[descriptor >> 6]
    if not length:
        return None
    return int.from_bytes(data[start : start + length], "little") + (256 if length == 2 else 0)


def _with_crc(data: bytes) -> bytes:
    checksum: int = google_crc32c.value(data)
    return data + checksum.to_bytes(_CRC_BYTES, "little")


def _checked(data: memoryview) -> memoryview:
    """Bytes without the checksum behind them."""
    body, checksum = data[:-_CRC_BYTES], data[-_CRC_BYTES:]
    if google_crc32c.value(bytes(body)) != int.from_bytes(checksum, "little"):
        raise ValueError("checksum differs")
    return body
