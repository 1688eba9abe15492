"""Packages of another commit of this repository, to measure them in turn with those of this checkout."""

import os
import subprocess
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

Environment = dict[str, str]

ROOT = Path(__file__).resolve().parent.parent
PACKAGES = ("posecore", "synthgen", "refinenet", "evalkit")


@contextmanager
def packages_of(commit: str | None) -> Iterator[Environment | None]:
    """Environment in which Python imports the four packages of a commit; of this checkout, inherited, for None."""
    if commit is None:
        yield None
        return
    with tempfile.TemporaryDirectory() as folder:
        git = ["git", "-C", str(ROOT), "worktree"]
        subprocess.run([*git, "add", "--detach", folder, commit], check=True, capture_output=True)
        try:
            sources = os.pathsep.join(f"{folder}/packages/{name}/src" for name in PACKAGES)
            yield {**os.environ, "PYTHONPATH": sources}
        finally:
            subprocess.run([*git, "remove", "--force", folder], check=True)
