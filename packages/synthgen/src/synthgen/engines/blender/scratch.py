"""Temporary folders of renderers, and removal of those that killed processes leave.

A lock on each folder, which the kernel releases with its process, marks the used ones: a process id in the name could
belong to another container, or to a later process.
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
    """Parent of the folders, in memory if possible: a write to disk costs more than a render with few samples."""
    return _SHARED_MEMORY if _SHARED_MEMORY.is_dir() else Path(tempfile.gettempdir())


def make_folder() -> tuple[Path, Callable[[], None]]:
    """A new folder of this process, and the function that removes it."""
    unnamed = Path(tempfile.mkdtemp(dir=root(), prefix=".synthgen_"))
    descriptor = os.open(unnamed, os.O_RDONLY)
    fcntl.flock(descriptor, fcntl.LOCK_EX)
    folder = unnamed.with_name(_PREFIX + unnamed.name.removeprefix("." + _PREFIX))
    unnamed.rename(folder)  # from now on a sweep may find it

    def remove() -> None:
        shutil.rmtree(folder, ignore_errors=True)
        os.close(descriptor)

    return folder, remove


def sweep() -> list[Path]:
    """Remove the folders of ended processes.

    Returns:
        The removed folders.
    """
    removed = []
    for folder in root().glob(_PREFIX + "*"):
        with suppress(OSError):  # another user's, or another sweep was faster
            descriptor = os.open(folder, os.O_RDONLY | os.O_DIRECTORY)
            try:
                fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
                shutil.rmtree(folder, ignore_errors=True)
                removed.append(folder)
            finally:
                os.close(descriptor)
    return removed
