"""Export of a dataset to an HDF5 file or a folder of WebDataset tars, streamed shard by shard."""

import errno
import io
import json
import os
import re
import shutil
import tarfile
import zipfile
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any, Literal

import cv2
import h5py
import numpy as np
from posecore.errors import ConfigError, ShardError, StorageError
from posecore.files import storage_error
from posecore.shard import Field, ShardReader, field_table, model_keys, n_shards

from synthgen.machine import free_bytes

OnShard = Callable[[int], None]
Layout = Literal["hdf5", "webdataset"]

ALIASES = {"colors": "scene_rgb", "depth": "scene_depth_m"}
"""BlenderProc's keys in an HDF5 file, and the fields that they alias."""

PNG_FIELDS = ("scene_rgb", "hypothesis_rgb", "scene_mask", "scene_depth_m", "hypothesis_depth_m")
"""Fields stored as PNG in a tar; depth in 16 bits, in steps of `depth_step_m`."""

NPZ_FIELDS = ("scene_contour_cam_m", "hypothesis_contour_cam_m", "scene_distance_px", "hypothesis_distance_px")
"""Fields in a tar's `.npz`; all others are in its `.json`."""

SUFFIXES = (".h5", ".hdf5")
_ROWS_PER_CHUNK = 1024  # of fields other than patches
_SPARE_BYTES = 16 * 2**20  # for HDF5's internal tables
_PNG = [cv2.IMWRITE_PNG_COMPRESSION, 1]


def export_dataset(
    url: str,
    out: Path,
    layout: Layout,
    *,
    overwrite: bool = False,
    on_start: OnShard = lambda n: None,
    on_shard: OnShard = lambda n: None,
) -> int:
    """Write a complete dataset in another container; see `to_hdf5` and `to_webdataset`.

    Args:
        url: Dataset.
        out: File or folder.
        layout: Container.
        overwrite: Replace an existing `out`.
        on_start: Called with the number of samples of the dataset.
        on_shard: Called with the number of samples of each written shard.

    Returns:
        The number of samples.

    Raises:
        ShardError, ConfigError, StorageError: See `to_hdf5`.
    """
    refuse_existing(out, overwrite)
    n = ShardReader(url).n
    on_start(n)
    write = to_hdf5 if layout == "hdf5" else to_webdataset
    write(url, out, overwrite=overwrite, on_shard=on_shard)
    return n


def to_hdf5(url: str, out: Path, *, overwrite: bool = False, on_shard: OnShard = lambda n: None) -> None:
    """Write a complete dataset as an HDF5 file: a dataset per field, sample axis first, in the field's unit.

    `colors` and `depth` alias the scene patch and its depth, as in BlenderProc's files. Every patch is a chunk,
    compressed with gzip, which any HDF5 library reads. The root's attribute `data_card` is the data card as JSON; the
    objects are in `models/` as bytes.

    Args:
        url: Dataset.
        out: File; it appears when it is complete.
        overwrite: Replace an existing `out`.
        on_shard: Called with the number of samples of each written shard.

    Raises:
        ShardError: The dataset is incomplete or damaged.
        ConfigError: The name does not end in .h5 or .hdf5.
        StorageError: `out` exists or cannot be written.
    """
    if out.suffix.lower() not in SUFFIXES:
        raise ConfigError(f"{out}: expected a name that ends in .h5 or .hdf5; for tars add --format webdataset")
    reader = complete_dataset(url)
    with _whole(out, overwrite) as temporary, h5py.File(temporary, "w") as file:
        file.attrs["schema"], file.attrs["schema_version"] = reader.card["schema"], reader.card["schema_version"]
        file.attrs["data_card"] = json.dumps(reader.card)
        for key, data in _models(reader).items():
            file[key] = np.frombuffer(data, np.uint8)
        for field in field_table():
            _hdf5_dataset(file, field, reader.card)
        for alias, name in ALIASES.items():
            file[alias] = file[name]
        for shard_id, values in _shards(reader):
            _require_room(out, sum(rows.nbytes for rows in values.values()))
            first = shard_id * reader.shard_size
            for name, rows in values.items():
                file[name][first : first + len(rows)] = rows
            file.flush()
            on_shard(reader.n_samples(shard_id))


def to_webdataset(url: str, out: Path, *, overwrite: bool = False, on_shard: OnShard = lambda n: None) -> None:
    """Write a complete dataset as a folder of tars, one a shard, in WebDataset's convention.

    The files of sample 7 are adjacent members `00000007.*`: `PNG_FIELDS` as lossless pictures, `NPZ_FIELDS` in
    `labels.npz`, all others in `json`, in the field's unit except for depth. `card.json` and `models/` are beside the
    tars.

    Args:
        url: Dataset.
        out: Folder; it appears when it is complete.
        overwrite: Replace an existing `out`.
        on_shard: Called with the number of samples of each written shard.

    Raises:
        ShardError: The dataset is incomplete or damaged.
        ConfigError: The name ends in .h5 or .hdf5.
        StorageError: `out` exists or cannot be written.
    """
    if out.suffix.lower() in SUFFIXES:
        raise ConfigError(f"{out}: WebDataset is a folder of tars; expected a folder's name, or --format hdf5")
    reader = complete_dataset(url)
    with _whole(out, overwrite) as temporary:
        temporary.mkdir(parents=True)
        (temporary / "card.json").write_text(json.dumps(reader.card, indent=1), encoding="utf-8")
        for key, data in _models(reader).items():
            (temporary / key).parent.mkdir(parents=True, exist_ok=True)
            (temporary / key).write_bytes(data)
        for shard_id, values in _shards(reader):
            with tarfile.open(temporary / f"shards-{shard_id:06d}.tar", "w") as tar:
                for row in range(reader.n_samples(shard_id)):
                    sample = {name: rows[row] for name, rows in values.items()}
                    for name, data in webdataset_files(sample, reader.card).items():
                        info = tarfile.TarInfo(f"{shard_id * reader.shard_size + row:08d}.{name}")
                        info.size = len(data)
                        tar.addfile(info, io.BytesIO(data))
            on_shard(reader.n_samples(shard_id))


def webdataset_files(sample: Mapping[str, np.ndarray], card: Mapping[str, Any]) -> dict[str, bytes]:
    """Files of a sample by the suffix after its key."""
    table = {field.name: field for field in field_table()}
    files = {f"{name}.png": _png(table[name], sample[name], card) for name in PNG_FIELDS}
    files["labels.npz"] = _npz({name: sample[name] for name in NPZ_FIELDS})
    rest = {name: np.asarray(sample[name]).tolist() for name in table if name not in PNG_FIELDS + NPZ_FIELDS}
    files["json"] = json.dumps({**rest, "depth_step_m": card["depth_step_m"]}).encode()
    return files


def _hdf5_dataset(file: h5py.File, field: Field, card: Mapping[str, Any]) -> None:
    n, size = int(card["n"]), field.size(card["patch_px"], card["contour_points"])
    rows = 1 if "P" in field.shape else min(n, _ROWS_PER_CHUNK)
    made = file.create_dataset(
        field.name,
        shape=(n, *size),
        dtype=field.decoded_dtype,
        chunks=(rows, *size),
        compression="gzip",
        compression_opts=1,
        shuffle=True,
    )
    made.attrs["unit"], made.attrs["text"] = field.unit, field.text


def _png(field: Field, values: np.ndarray, card: Mapping[str, Any]) -> bytes:
    stored = field.encode(values, card)
    ok, data = cv2.imencode(".png", stored[..., ::-1] if stored.ndim == 3 else stored, _PNG)
    assert ok
    return data.tobytes()


def _npz(arrays: Mapping[str, np.ndarray]) -> bytes:
    """Bytes as of np.savez_compressed, but faster and without timestamps."""
    buffer = io.BytesIO()
    with zipfile.ZipFile(buffer, "w") as archive:
        for name, values in arrays.items():
            content = io.BytesIO()
            np.lib.format.write_array(content, np.asanyarray(values), allow_pickle=False)
            entry = zipfile.ZipInfo(f"{name}.npy")
            archive.writestr(entry, content.getvalue(), zipfile.ZIP_DEFLATED, compresslevel=1)
    return buffer.getvalue()


def complete_dataset(url: str) -> ShardReader:
    """Open a dataset, and raise a ShardError unless every shard is committed."""
    reader = ShardReader(url)
    if not reader.complete:
        raise ShardError(
            f"{url}: {len(reader.committed)} of {n_shards(reader.card)} shards are committed; complete it first "
            "with the `synthgen render` that began it"
        )
    return reader


def _require_room(out: Path, size_bytes: int) -> None:
    """Stop before the disk is full: HDF5 would crash the process when it closes the file."""
    if free_bytes(out) < size_bytes + _SPARE_BYTES:
        raise storage_error(out, OSError(errno.ENOSPC, os.strerror(errno.ENOSPC)), size_bytes)


def _models(reader: ShardReader) -> dict[str, bytes]:
    """The objects' files by key."""
    return {key: reader.file(key) for key in model_keys(reader)}


def _shards(reader: ShardReader) -> Iterator[tuple[int, dict[str, np.ndarray]]]:
    for shard_id in reader.committed:
        yield shard_id, reader.read_checked(shard_id)


def refuse_existing(out: Path, overwrite: bool) -> None:
    """Raise a StorageError for an existing `out` that may not be replaced."""
    if out.exists() and not overwrite:
        raise StorageError(f"{out}: exists; choose another name, or add --overwrite to replace it")


@contextmanager
def _whole(out: Path, overwrite: bool) -> Iterator[Path]:
    """A temporary path beside `out`: renamed to `out` on success, removed otherwise."""
    refuse_existing(out, overwrite)
    if out.is_dir() and not (out / "card.json").is_file() and any(out.iterdir()):
        raise StorageError(f"{out}: is not an exported folder, so it is not replaced; choose another name")
    temporary = out.with_name(f".{out.name}.{os.getpid()}.tmp")
    try:
        try:
            out.parent.mkdir(parents=True, exist_ok=True)
            for leftover in out.parent.glob(f".{out.name}.*.tmp"):  # of a killed export
                _remove(leftover)
            yield temporary
            if out.is_dir() or temporary.is_dir():
                _remove(out)
            os.replace(temporary, out)
        except StorageError:
            raise
        except OSError as error:
            raise _as_storage_error(out, error) from error
    finally:
        with suppress(OSError):
            _remove(temporary)


def _remove(path: Path) -> None:
    if path.is_dir():
        shutil.rmtree(path)
    else:
        path.unlink(missing_ok=True)


def _as_storage_error(out: Path, error: OSError) -> StorageError:
    """The StorageError of an OSError, whose number HDF5 has only in its message."""
    hidden = re.search(r"errno = (\d+)", str(error))
    return storage_error(out, OSError(int(hidden[1]), os.strerror(int(hidden[1]))) if hidden else error)
