"""Whole-file writes, hashes and the data files that ship with the project."""

import contextlib
import errno
import hashlib
import os
from pathlib import Path

from posecore.errors import ConfigError, StorageError


def write_atomic(path: str | Path, data: bytes) -> None:
    """Write a file so that a reader sees the old bytes or the new ones, never a part.

    Raises:
        StorageError: No rights, no space, or the folder is missing.
    """
    file = _target(path)
    temporary = file.with_name(f".{file.name}.{os.getpid()}.tmp")
    try:
        file.parent.mkdir(parents=True, exist_ok=True)
        with temporary.open("wb") as stream:
            stream.write(data)
            stream.flush()
            os.fsync(stream.fileno())
        os.replace(temporary, file)
    except OSError as error:
        with contextlib.suppress(OSError):
            temporary.unlink()
        raise storage_error(file, error, len(data)) from error


def require_writable(path: str | Path) -> None:
    """Refuse a file that cannot be written, before the work that would go into it; makes its folder.

    Raises:
        StorageError: No rights, no space, or no such folder can be.
    """
    file = _target(path)
    trial = file.with_name(f".{file.name}.{os.getpid()}.tmp")
    try:
        file.parent.mkdir(parents=True, exist_ok=True)
        trial.touch()
        trial.unlink()
    except OSError as error:
        raise storage_error(file, error) from error


def _target(path: str | Path) -> Path:
    """The file itself where a link stands for it: the link stays.

    Raises:
        StorageError: A device or a pipe, which writing in one go would replace by a file, a folder, or a name that
            cannot be.
    """
    file = Path(path)
    try:
        file = file.resolve() if file.is_symlink() else file
        is_folder, is_other = file.is_dir(), file.exists() and not file.is_file()
    except OSError as error:
        raise storage_error(path, error) from error
    except RuntimeError as error:  # Python 3.11 on links in a circle
        raise StorageError(f"{path}: a link that leads back to itself; choose another path") from error
    if is_folder:
        raise StorageError(f"{path}: a folder stands where a file is needed; choose another path")
    if is_other:
        raise StorageError(f"{path}: is a device or a pipe, expected a file or a free name; choose another path")
    return file


def storage_error(path: str | Path, error: OSError, size_bytes: int | None = None) -> StorageError:
    """Turn an OSError into one line with a remedy."""
    if error.errno == errno.ENOSPC:
        size = "" if size_bytes is None else f" of {size_bytes} bytes"
        return StorageError(f"{path}: the disk is full, this write{size} failed; free some space and start again")
    if error.errno in (errno.EACCES, errno.EPERM, errno.EROFS):
        return StorageError(f"{path}: no permission to write here; choose another folder or change its rights")
    if error.errno in (errno.ENOTDIR, errno.EEXIST):
        return StorageError(f"{path}: a file stands where a folder is needed; choose another path")
    if error.errno == errno.EISDIR:
        return StorageError(f"{path}: a folder stands where a file is needed; choose another path")
    return StorageError(f"{path}: {error.strerror or error}")


def sha256_bytes(data: bytes) -> str:
    """Hexadecimal SHA-256."""
    return hashlib.sha256(data).hexdigest()


def sha256_file(path: str | Path) -> str:
    """Hexadecimal SHA-256 of a file's bytes."""
    digest = hashlib.sha256()
    with Path(path).open("rb") as stream:
        while block := stream.read(1 << 20):
            digest.update(block)
    return digest.hexdigest()


def data_spec(name: str) -> Path:
    """Path of a file in `data_specs/`, as installed with posecore.

    Raises:
        ConfigError: There is no such file.
    """
    path = Path(__file__).parent / "data_specs" / name
    if not path.exists():
        names = sorted(p.stem for p in path.parent.glob("*")) if path.parent.is_dir() else []
        raise ConfigError(f"{path}: no such data specification; there are: {', '.join(names) or 'none'}")
    return path
