"""Cleanup of Python's search path after Blender."""

import sys
from pathlib import Path


def forget_blenders_paths() -> None:
    """Remove Blender's scripts from the search path that a spawned process inherits from its parent.

    Blender puts its scripts on the path, with a module bpy that only works within Blender; the process would import
    that module.
    """
    sys.path[:] = [entry for entry in sys.path if not (Path(entry) / "bpy_types.py").is_file()]
