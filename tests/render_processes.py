"""Commands that render in processes of their own, for tests."""

import sys

N = "46"


def render_command(mesh, out, settings, *extra):
    """Words of a `synthgen render` of N pairs."""
    return [
        *(sys.executable, "-m", "synthgen.cli", "render", "--object", str(mesh), "--out", str(out), "--quiet"),
        *("--n", N, *settings, *extra),
    ]
