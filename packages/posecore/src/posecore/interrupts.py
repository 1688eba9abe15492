"""Ctrl-C where a process starts others."""

import signal
import threading
from collections.abc import Iterator
from contextlib import contextmanager


@contextmanager
def interrupts_ignored() -> Iterator[None]:
    """Start processes that ignore ctrl-C: a terminal sends it to all, and only the driver may stop the run.

    A process inherits what its parent ignores. A signal mask would not do: multiprocessing clears it.
    """
    if threading.current_thread() is not threading.main_thread():  # only the main thread may set signal handlers
        yield
        return
    before = signal.signal(signal.SIGINT, signal.SIG_IGN)
    try:
        yield
    finally:
        signal.signal(signal.SIGINT, before)
