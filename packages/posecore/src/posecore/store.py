"""Storage of a dataset: a local folder, or any fsspec URL (s3://, gs://, memory://)."""

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any, Protocol, runtime_checkable

from posecore.errors import ConfigError, StorageError
from posecore.files import read_regular, storage_error, write_atomic


@runtime_checkable
class Store(Protocol):
    """A flat key-value view of a folder. `set` is atomic: a reader sees the old bytes or the new ones."""

    def get(self, key: str) -> bytes | None:
        """Bytes of a key, None when it is absent."""

    def set(self, key: str, data: bytes) -> None:
        """Write a key."""

    def list_names(self) -> list[str]:
        """Names at the top of the folder, sorted."""

    def sizes(self, folder: str) -> dict[str, int]:
        """Bytes of every file below a folder, by key; empty when there is none."""


class LocalStore:
    """A folder on a local or mounted disk."""

    def __init__(self, root: str | Path) -> None:
        self.root = Path(root)

    def get(self, key: str) -> bytes | None:
        """Bytes of a file, None when it is absent."""
        try:
            return read_regular(self.root / key)
        except (FileNotFoundError, NotADirectoryError, IsADirectoryError):
            return None
        except OSError as error:
            raise storage_error(self.root / key, error) from error

    def set(self, key: str, data: bytes) -> None:
        """Write a file under a temporary name, then rename it; remains of a killed writer are deleted."""
        file = self.root / key
        write_atomic(file, data)
        for left in file.parent.glob(f".{file.name}.*.tmp"):
            left.unlink(missing_ok=True)

    def list_names(self) -> list[str]:
        """Names in the folder without the temporary files of killed writers."""
        if self.root.is_file():
            raise StorageError(f"{self.root}: is a file, expected a folder for the dataset; choose another path")
        return sorted(p.name for p in self.root.glob("*") if not p.name.endswith(".tmp"))

    def sizes(self, folder: str) -> dict[str, int]:
        """Bytes of every file below a folder, by key."""
        files = (p for p in (self.root / folder).rglob("*") if p.is_file())
        return {p.relative_to(self.root).as_posix(): p.stat().st_size for p in files}


class FsspecStore:
    """Any filesystem of fsspec. Object stores write a whole object or none."""

    def __init__(self, url: str) -> None:
        import fsspec

        try:
            self._fs, self._root = fsspec.core.url_to_fs(url)
        except (ValueError, ImportError) as error:
            raise ConfigError(f"{url}: {str(error).splitlines()[0]}{_install_hint(url)}") from error
        self._url = url

    def get(self, key: str) -> bytes | None:
        """Bytes of an object, None when it is absent."""
        with self._errors(key):
            try:
                return bytes(self._fs.cat_file(f"{self._root}/{key}"))
            except FileNotFoundError as error:
                if _is_bucket_missing(error):
                    raise
        return None

    def set(self, key: str, data: bytes) -> None:
        """Write an object."""
        path = f"{self._root}/{key}"
        with self._errors(key, len(data)):
            try:
                self._fs.pipe_file(path, data)
            except FileNotFoundError as error:  # a filesystem with real folders
                if _is_bucket_missing(error):  # making folders would make the bucket
                    raise
                self._fs.makedirs(path.rsplit("/", 1)[0], exist_ok=True)
                self._fs.pipe_file(path, data)

    def list_names(self) -> list[str]:
        """Names at the top of the URL."""
        with self._errors():
            self._fs.invalidate_cache()
            try:
                entries: list[Any] = self._fs.ls(self._root, detail=False)
            except FileNotFoundError as error:
                if _is_bucket_missing(error):
                    raise
                return []
        return sorted(str(entry).rstrip("/").rsplit("/", 1)[-1] for entry in entries)

    def sizes(self, folder: str) -> dict[str, int]:
        """Bytes of every object below a folder, by key."""
        with self._errors(folder):
            self._fs.invalidate_cache()
            entries: dict[str, Any] = self._fs.find(f"{self._root}/{folder}", detail=True)
        start = len(str(self._root).strip("/")) + 1
        return {path.strip("/")[start:]: int(entry["size"]) for path, entry in entries.items()}

    @contextmanager
    def _errors(self, key: str = "", size_bytes: int | None = None) -> Iterator[None]:
        """Turn any exception of a backend (few raise OSError only) into one line with a remedy."""
        where = f"{self._url}/{key}" if key else self._url
        try:
            yield
        except Exception as error:
            name, text = type(error).__name__, (str(error).splitlines() or [""])[0]
            if "Credential" in name:
                advice = (
                    "no credentials found; set AWS_ACCESS_KEY_ID and AWS_SECRET_ACCESS_KEY or AWS_PROFILE"
                    if self._url.startswith("s3")
                    else f"no credentials found ({text}); log in to this store"
                )
            elif isinstance(error, FileNotFoundError) and _is_bucket_missing(error):
                advice = "the bucket does not exist; create it"
            elif isinstance(error, PermissionError):
                advice = f"access denied ({text}); use credentials that may read and write there"
            elif "Connect" in name or "Timeout" in name or isinstance(error, ConnectionError | TimeoutError):
                advice = f"cannot reach the store ({text}); check the network and, for S3 elsewhere, AWS_ENDPOINT_URL"
            elif isinstance(error, OSError) and error.errno is not None:
                raise storage_error(where, error, size_bytes) from error
            else:
                advice = f"the store answered {name}: {text}"
            raise StorageError(f"{where}: {advice}, or choose another place") from error


def _is_bucket_missing(error: Exception) -> bool:
    """Whether the bucket itself is missing; the filesystems have no error of its own for that."""
    return "bucket does not exist" in str(error).lower()


def _install_hint(url: str) -> str:
    return "; pip install 'posecore[s3]'" if url.startswith("s3") else ""


def open_store(url: str | Path) -> Store:
    """A store for a local path or an fsspec URL."""
    return FsspecStore(str(url)) if "://" in str(url) else LocalStore(url)
