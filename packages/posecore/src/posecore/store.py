"""Where a dataset's files lie: a local folder, or any fsspec URL (s3://, gs://, memory://)."""

from pathlib import Path
from typing import Any, Protocol, runtime_checkable

from posecore.errors import ConfigError, StorageError
from posecore.files import storage_error, write_atomic


@runtime_checkable
class Store(Protocol):
    """A flat key-value view of a folder. `set` is atomic: a reader sees the old bytes or the new ones."""

    def get(self, key: str) -> bytes | None:
        """Bytes of a key, None when it is absent."""

    def set(self, key: str, data: bytes) -> None:
        """Write a key."""

    def list_names(self) -> list[str]:
        """Names at the top of the folder, sorted."""


class LocalStore:
    """A folder on a local or mounted disk."""

    def __init__(self, root: str | Path) -> None:
        self.root = Path(root)

    def get(self, key: str) -> bytes | None:
        """Bytes of a file, None when it is absent."""
        try:
            return (self.root / key).read_bytes()
        except (FileNotFoundError, NotADirectoryError, IsADirectoryError):
            return None
        except OSError as error:
            raise storage_error(self.root / key, error) from error

    def set(self, key: str, data: bytes) -> None:
        """Write a file under a temporary name, then rename it; what a killed writer left of it goes."""
        file = self.root / key
        write_atomic(file, data)
        for left in file.parent.glob(f".{file.name}.*.tmp"):
            left.unlink(missing_ok=True)

    def list_names(self) -> list[str]:
        """Names in the folder; what a killed writer left under a temporary name does not count."""
        if self.root.is_file():
            raise StorageError(f"{self.root}: is a file, expected a folder for the dataset; choose another path")
        return sorted(p.name for p in self.root.glob("*") if not p.name.endswith(".tmp"))


class FsspecStore:
    """Any filesystem that fsspec knows. Object stores write a whole object or none."""

    def __init__(self, url: str) -> None:
        import fsspec

        try:
            self._fs, self._root = fsspec.core.url_to_fs(url)
        except (ValueError, ImportError) as error:
            raise ConfigError(f"{url}: {str(error).splitlines()[0]}") from error
        self._url = url

    def get(self, key: str) -> bytes | None:
        """Bytes of an object, None when it is absent."""
        try:
            return bytes(self._fs.cat_file(f"{self._root}/{key}"))
        except FileNotFoundError:
            return None

    def set(self, key: str, data: bytes) -> None:
        """Write an object."""
        path = f"{self._root}/{key}"
        try:
            self._fs.makedirs(path.rsplit("/", 1)[0], exist_ok=True)
            self._fs.pipe_file(path, data)
        except OSError as error:
            raise storage_error(f"{self._url}/{key}", error, len(data)) from error

    def list_names(self) -> list[str]:
        """Names at the top of the URL."""
        try:
            entries: list[Any] = self._fs.ls(self._root, detail=False)
        except FileNotFoundError:
            return []
        return sorted(str(entry).rstrip("/").rsplit("/", 1)[-1] for entry in entries)


def open_store(url: str | Path) -> Store:
    """A store for a local path or an fsspec URL."""
    return FsspecStore(str(url)) if "://" in str(url) else LocalStore(url)
