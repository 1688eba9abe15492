"""Memory of the arrays that a reader gives: filled again once nobody holds them.

A shard at 224 px is 70 MB of arrays. Asking the system for fresh pages for each shard costs as much time as decoding
it, or several times that where many shards are held at once (`benchmarks/shard_codecs.py`).
"""

import sys
from collections.abc import Sequence
from threading import Lock
from typing import Any

import numpy as np

Array = np.ndarray

_MOST_BYTES = 2**30
_LEAST_BYTES = 2**20  # of an array that is worth it


def _references(objects: Sequence[Any]) -> list[int]:
    return [sys.getrefcount(item) for item in objects]


_UNHELD = _references([object()])[0]  # what an object in a list counts when nothing else refers to it


class Recycler:
    """Makes empty arrays, out of its own former ones where nothing refers to them any more.

    A view, a torch tensor on an array's memory or a memoryview refers to it, so what anybody can still see is never
    touched. At most 1 GiB is kept for later.
    """

    def __init__(self) -> None:
        self._kept: dict[tuple[Any, ...], list[Array]] = {}
        self._bytes = 0
        self._lock = Lock()

    def __reduce__(self) -> tuple[type["Recycler"], tuple[()]]:
        return (Recycler, ())  # another process starts with nothing

    def empty(self, shape: tuple[int, ...], dtype: np.dtype) -> Array:
        """An array with arbitrary content."""
        with self._lock:
            kept = self._kept.setdefault((shape, dtype.str), [])
            for i, count in enumerate(_references(kept)):
                if count == _UNHELD:
                    return kept[i]
            made = np.empty(shape, dtype)
            if made.nbytes >= _LEAST_BYTES and self._bytes + made.nbytes <= _MOST_BYTES:
                kept.append(made)
                self._bytes += made.nbytes
            return made
