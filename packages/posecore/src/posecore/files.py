"""Opening of regular files, whole-file writes, hashes and the data files that ship with the project."""

import contextlib
import errno
import hashlib
import os
import stat
from pathlib import Path
from typing import BinaryIO

from posecore.errors import ConfigError, StorageError

LARGEST_FILE_BYTES = 1 << 31
"""Default limit of a file that is read whole: 2 GiB."""
_KINDS = (
    (stat.S_ISDIR, "is a folder"),
    (stat.S_ISFIFO, "is a pipe"),
    (stat.S_ISSOCK, "is a socket"),
    (stat.S_ISCHR, "is a device"),
    (stat.S_ISBLK, "is a device"),
)


def open_regular(path: str | Path, limit_bytes: int | None = LARGEST_FILE_BYTES) -> BinaryIO:
    """Open a user's file for reading. A pipe would block for ever, and a device may have no end.

    Args:
        path: The file, or a link to it.
        limit_bytes: Largest file that is opened; None for files of which only parts are read.

    Raises:
        OSError: Missing, no rights, not a regular file, larger than the limit, or a name that no file can have. Its
            `strerror` is the reason in words, for the caller's message.
    """
    try:
        descriptor = os.open(path, os.O_RDONLY | getattr(os, "O_NONBLOCK", 0) | getattr(os, "O_BINARY", 0))
    except ValueError as error:  # a zero byte, or characters that no encoding of a name has
        raise OSError(errno.EINVAL, "is a name that no file can have", str(path)) from error
    try:
        _require_regular(os.fstat(descriptor), path, limit_bytes)
    except OSError:
        os.close(descriptor)
        raise
    return os.fdopen(descriptor, "rb")


def read_regular(path: str | Path, limit_bytes: int = LARGEST_FILE_BYTES) -> bytes:
    """The bytes of a user's file.

    Raises:
        OSError: As `open_regular`.
    """
    with open_regular(path, limit_bytes) as stream:
        return stream.read()


def require_regular(path: str | Path, limit_bytes: int | None = LARGEST_FILE_BYTES) -> None:
    """Refuse a user's file, as `open_regular` does, before a library opens it by its name.

    Raises:
        OSError: As `open_regular`.
    """
    open_regular(path, limit_bytes).close()


def _require_regular(status: os.stat_result, path: str | Path, limit_bytes: int | None) -> None:
    if not stat.S_ISREG(status.st_mode):
        kind = next((text for is_kind, text in _KINDS if is_kind(status.st_mode)), "is of another kind")
        code = errno.EISDIR if stat.S_ISDIR(status.st_mode) else errno.EINVAL
        raise OSError(code, f"{kind}, expected a regular file", str(path))
    if limit_bytes is not None and status.st_size > limit_bytes:
        raise OSError(errno.EFBIG, f"has {status.st_size} bytes, expected at most {limit_bytes}", str(path))


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
    with open_regular(path, None) as stream:
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
