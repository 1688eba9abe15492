"""Lock on a dataset's folder against a second writer."""

import errno
import fcntl
import logging
import os
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from posecore.errors import StorageError
from posecore.files import storage_error

log = logging.getLogger(__name__)


@contextmanager
def held(url: str) -> Iterator[None]:
    """Hold the lock of a local folder, which is created if necessary.

    The lock is on the folder itself: it leaves no file, and the kernel releases it at the end of the process. Object
    stores and file systems without locks are not locked.

    Raises:
        StorageError: Another process holds the lock, or the folder cannot be created.
    """
    if "://" in url:
        yield
        return
    try:
        Path(url).mkdir(parents=True, exist_ok=True)
        descriptor = os.open(url, os.O_RDONLY | os.O_DIRECTORY)
    except OSError as error:
        raise storage_error(url, error) from error
    try:
        try:
            fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except OSError as error:
            if error.errno in (errno.EWOULDBLOCK, errno.EACCES):
                raise StorageError(
                    f"{url}: another synthgen is rendering into this folder; wait for it, stop it, or choose another "
                    "--out"
                ) from error
            log.warning("%s: cannot be locked (%s); make sure that only one render writes there", url, error.strerror)
        yield
    finally:
        os.close(descriptor)
