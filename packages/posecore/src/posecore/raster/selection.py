"""What of a mesh has to be drawn at a pose: nothing, all faces, or a level of detail."""

import numpy as np
from jaxtyping import Float

from posecore.mesh import Mesh

RMS_ERROR_PX = 0.1
"""Distance in the image between the surface that is drawn and the mesh's own, root mean square."""
MAX_ERROR_PX = 2.0
"""The largest such distance."""
SPACING_PX = 5.0
"""Largest length of an edge in the image, root mean square, where a level is drawn: colours lie at its ends."""
_REACH_DIAMETERS = 0.8661
"""No vertex is farther from the box centre: half a diagonal, no side of the box being longer than the diameter."""


def is_in_image(
    mesh: Mesh, K: Float[np.ndarray, "3 3"], T_cam_obj: Float[np.ndarray, "4 4"], width_px: int, height_px: int
) -> bool:
    """Whether the mesh's bounding sphere reaches into the image's field of view."""
    x, y, z = mesh.center_cam_m(T_cam_obj)
    reach_m = _REACH_DIAMETERS * mesh.diameter_m
    for f, c, along, side_px in ((K[0, 0], K[0, 2], x, width_px), (K[1, 1], K[1, 2], y, height_px)):
        low, high = f * along + c * z, (side_px - c) * z - f * along  # distances to two planes through the camera
        if low < -reach_m * np.hypot(f, c) or high < -reach_m * np.hypot(f, side_px - c):
            return False
    return True


def level_number(mesh: Mesh, K: Float[np.ndarray, "3 3"], T_cam_obj: Float[np.ndarray, "4 4"]) -> int:
    """Level to draw: 0 is the mesh itself, k its `levels[k - 1]`. It depends on mesh, camera and pose alone.

    The coarsest level whose errors and edges stay within `RMS_ERROR_PX`, `MAX_ERROR_PX` and `SPACING_PX` at the depth
    of the box centre.
    """
    if not mesh.levels:
        return 0
    center_m = mesh.center_cam_m(T_cam_obj)
    if center_m[2] <= mesh.diameter_m:
        return 0
    # A movement along the axis shows more the farther it is off the axis.
    off_axis = np.linalg.norm(center_m) / center_m[2]
    px_per_diameter = max(K[0, 0], K[1, 1]) * mesh.diameter_m / center_m[2] * off_axis
    fits = [
        number
        for number, level in enumerate(mesh.levels, 1)
        if level.rms_error * px_per_diameter <= RMS_ERROR_PX
        and level.max_error * px_per_diameter <= MAX_ERROR_PX
        and level.spacing * px_per_diameter <= SPACING_PX
    ]
    return max(fits, default=0)
