"""What Blender does to Python's search path."""

import sys
from pathlib import Path


def forget_blenders_paths() -> None:
    """Undo what a parent that has Blender loaded does to the search path of the processes that it spawns.

    Blender puts its scripts on the path, where a module bpy lies that only works within Blender; a process that
    inherits the path would import that one.
    """
    sys.path[:] = [entry for entry in sys.path if not (Path(entry) / "bpy_types.py").is_file()]
