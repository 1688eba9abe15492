"""Loops that numpy has no words for, compiled."""

from collections.abc import Callable
from typing import Any

import numba


def compiled(loop: Callable[..., Any]) -> Callable[..., Any]:
    """A function compiled at its first call and kept on disk beside its file, or where NUMBA_CACHE_DIR says.

    Where no folder can be written to, each process compiles anew.
    """
    settings: dict[str, Any] = {"error_model": "numpy", "nogil": True}
    try:
        function = numba.njit(loop, cache=True, **settings)
    except RuntimeError:
        function = numba.njit(loop, **settings)
    return function  # type: ignore[no-any-return]
