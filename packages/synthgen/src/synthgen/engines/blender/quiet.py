"""Capture of Blender's output, which is kept for error messages."""

import os
import sys
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from typing import IO

from posecore.errors import RenderError


@contextmanager
def blender_output_caught(what: str) -> Iterator[None]:
    """Capture the output of Blender's C++ code on stdout and stderr.

    Blender has no option for it, so the file descriptors are redirected to a temporary file within the block.

    Args:
        what: The action, for the message.

    Raises:
        RenderError: From a RuntimeError or OSError inside, in one line with Blender's last error message.
    """
    sys.stdout.flush()
    sys.stderr.flush()
    with tempfile.TemporaryFile() as caught:
        saved = os.dup(1), os.dup(2)
        os.dup2(caught.fileno(), 1)
        os.dup2(caught.fileno(), 2)
        failure: Exception | None = None
        try:
            yield
        except (RuntimeError, OSError) as error:
            failure = error
        finally:
            for number, old in zip((1, 2), saved, strict=True):
                os.dup2(old, number)
                os.close(old)
        if failure is not None:
            raise RenderError(f"{what}: {_one_line(str(failure), _tail(caught))}") from failure


def _tail(file: IO[bytes]) -> str:
    size = file.seek(0, os.SEEK_END)
    file.seek(max(0, size - 2000))
    return file.read().decode(errors="replace")


def _one_line(message: str, output: str) -> str:
    errors = [line.strip() for line in output.splitlines() if "error" in line.lower()]
    text = " ".join(message.split())
    return f"{text} (Blender: {errors[-1]})" if errors else text
