"""A whole file or a byte range of a tar file, read without unpacking."""

from dataclasses import dataclass
from pathlib import Path

from posecore.errors import DatasetError
from posecore.files import LARGEST_FILE_BYTES, open_regular


@dataclass(frozen=True, kw_only=True)
class StoredFile:
    """A file, or a byte range in it.

    Attributes:
        path: the file on disk.
        member: name inside the tar file, empty for a whole file.
        offset: first byte.
        size: number of bytes; None for up to the end.
    """

    path: Path
    member: str = ""
    offset: int = 0
    size: int | None = None

    def __str__(self) -> str:
        return f"{self.path}:{self.member}" if self.member else str(self.path)

    @property
    def suffix(self) -> str:
        """Extension with its dot, lower case."""
        return Path(self.member or self.path.name).suffix.lower()

    def read(self, limit: int | None = None) -> bytes:
        """All bytes, or the first `limit`.

        Raises:
            DatasetError: the file is missing, cannot be read or is shorter than it should be.
        """
        size = self.size if limit is None or (self.size is not None and self.size < limit) else limit
        try:
            with open_regular(self.path, LARGEST_FILE_BYTES if size is None else None) as stream:
                stream.seek(self.offset)
                data = stream.read() if size is None else stream.read(size)
        except (OSError, ValueError) as error:
            reason = getattr(error, "strerror", None) or str(error)
            raise DatasetError(f"{self}: cannot be read ({reason}); copy it again") from error
        if self.member and size is not None and len(data) < size:
            raise DatasetError(f"{self}: found {len(data)} of {size} bytes; the tar file is cut off, copy it again")
        return data


def stored(file: "Path | StoredFile") -> StoredFile:
    """A path as a stored file."""
    return file if isinstance(file, StoredFile) else StoredFile(path=file)
