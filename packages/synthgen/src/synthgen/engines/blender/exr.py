"""Reading of Blender's multilayer EXR files."""

from pathlib import Path

import numpy as np
import OpenEXR
from jaxtyping import Float
from posecore.errors import RenderError


def read_channels(path: Path) -> dict[str, Float[np.ndarray, "h w"]]:
    """Read a multilayer EXR.

    Args:
        path: The file.

    Returns:
        Channels by their name without the view layer, e.g. 'Combined.R', 'Depth.Z', 'IndexOB.X'.

    Raises:
        RenderError: The file is missing or damaged.
    """
    try:
        with OpenEXR.File(str(path), separate_channels=True) as file:
            channels = {name: channel.pixels for name, channel in file.channels().items()}
    except (RuntimeError, OSError, ValueError) as error:
        raise RenderError(f"{path}: Blender's output cannot be read: {error}") from error
    return {name.split(".", 1)[1]: pixels for name, pixels in channels.items()}
