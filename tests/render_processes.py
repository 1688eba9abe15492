"""Commands that render in processes of their own, for tests."""

import subprocess
import sys
from contextlib import suppress

import psutil

N = "46"


def render_command(mesh, out, settings, *extra):
    """Words of a `synthgen render` of N pairs."""
    return [
        *(sys.executable, "-m", "synthgen.cli", "render", "--object", str(mesh), "--out", str(out), "--quiet"),
        *("--n", N, *settings, *extra),
    ]


def kill(process: subprocess.Popen) -> None:
    """End a process and its children."""
    try:
        family = [*psutil.Process(process.pid).children(recursive=True), psutil.Process(process.pid)]
    except psutil.NoSuchProcess:  # it has ended, and was waited for
        return
    for member in family:
        with suppress(psutil.NoSuchProcess):
            member.kill()
    process.wait()
