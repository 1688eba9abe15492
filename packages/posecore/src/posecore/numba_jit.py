"""`numba.njit` with an on-disk cache, or without where nothing can be written."""

from collections.abc import Callable
from typing import Any

import numba


def compiled(loop: Callable[..., Any]) -> Callable[..., Any]:
    """A function compiled at its first call, cached on disk beside its file or in NUMBA_CACHE_DIR.

    Where no folder can be written to, each process compiles anew.
    """
    settings: dict[str, Any] = {"error_model": "numpy", "nogil": True}
    try:
        function = numba.njit(loop, cache=True, **settings)
    except RuntimeError:
        function = numba.njit(loop, **settings)
    return function  # type: ignore[no-any-return]
