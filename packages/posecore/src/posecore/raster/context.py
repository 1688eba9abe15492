"""One GL context per thread, on EGL, and the lock of who draws in it."""

import threading
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import moderngl

from posecore.errors import RenderError

_threads = threading.local()


class GlDevice:
    """A GL context, and the lock of who uses it: it is current in one thread, and only while it draws."""

    def __init__(self, context: Any) -> None:
        self.context = context
        self._lock = threading.RLock()

    @contextmanager
    def current(self) -> Iterator[None]:
        """Make it this thread's; Blender, in the same process, makes a context of its own the current one."""
        with self._lock, self.context:
            yield


def thread_device() -> GlDevice:
    """The GL context that rasterisers made in this thread share, made once and never released.

    Releasing one ends EGL for the whole process, and contexts made after that draw nothing, without an error.
    """
    if not hasattr(_threads, "device"):
        settings: dict[str, Any] = {"standalone": True, "backend": "egl", "require": 330}
        try:
            context: Any = moderngl.create_context(**settings)
        except Exception as error:  # moderngl raises bare exceptions from several layers
            reason = f"{type(error).__name__}: {str(error) or 'no reason given'}".splitlines()[0]
            raise RenderError(
                f"no EGL device for the rasteriser ({reason}); "
                "install a GPU driver with EGL, or Mesa's software renderer (Debian: libegl1 libgl1-mesa-dri)"
            ) from error
        context.gc_mode = "auto"
        context.enable(moderngl.DEPTH_TEST)
        context.front_face = "cw"  # image rows run downwards, which turns counter-clockwise faces around
        _threads.device = GlDevice(context)
    device: GlDevice = _threads.device
    return device
