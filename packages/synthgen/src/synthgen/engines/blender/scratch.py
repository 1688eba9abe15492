"""Temporary folders of renderers, and what killed processes left of them.

A folder is held with a lock that the kernel drops with its process, so a sweep removes exactly what nobody uses: a
process id in the name could belong to another container, or to a later process.
"""

import fcntl
import os
import shutil
import tempfile
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path

_PREFIX = "synthgen_"
_SHARED_MEMORY = Path("/dev/shm")


def root() -> Path:
    """Where the folders are: in memory if possible, since a write to a disk costs more than a render of few samples."""
    return _SHARED_MEMORY if _SHARED_MEMORY.is_dir() else Path(tempfile.gettempdir())


def make_folder() -> tuple[Path, Callable[[], None]]:
    """A new folder of this process, and what removes it."""
    unnamed = Path(tempfile.mkdtemp(dir=root(), prefix=".synthgen_"))
    held = os.open(unnamed, os.O_RDONLY)
    fcntl.flock(held, fcntl.LOCK_EX)
    folder = unnamed.with_name(_PREFIX + unnamed.name.removeprefix("." + _PREFIX))
    unnamed.rename(folder)  # only now may a sweep see it

    def remove() -> None:
        shutil.rmtree(folder, ignore_errors=True)
        os.close(held)

    return folder, remove


def sweep() -> list[Path]:
    """Remove the folders of processes that are gone.

    Returns:
        What was removed.
    """
    removed = []
    for folder in root().glob(_PREFIX + "*"):
        with suppress(OSError):  # another user's, or another sweep was faster
            held = os.open(folder, os.O_RDONLY | os.O_DIRECTORY)
            try:
                fcntl.flock(held, fcntl.LOCK_EX | fcntl.LOCK_NB)
                shutil.rmtree(folder, ignore_errors=True)
                removed.append(folder)
            finally:
                os.close(held)
    return removed
