"""Pictures of poses over images: silhouette contours, and lines of text."""

from collections.abc import Mapping, Sequence

import cv2
import numpy as np
from jaxtyping import Float, UInt8
from posecore.contour import contour_mask
from posecore.mesh import Mesh
from posecore.raster import Rasteriser

from refinenet.refiner import Request

Array = np.ndarray
Colour = tuple[int, int, int]
START_RGB: Colour = (230, 60, 40)
REFINED_RGB: Colour = (60, 230, 90)


class Overlay:
    """Draws contours onto images, until it is closed.

    Args:
        meshes: Objects by id.
    """

    def __init__(self, meshes: Mapping[int, Mesh]) -> None:
        self._rasteriser = Rasteriser(meshes)

    def close(self) -> None:
        """Free what the renderer holds."""
        self._rasteriser.close()

    def draw(
        self, image: UInt8[Array, "h w 3"], K: Float[Array, "3 3"], poses: Sequence[Request], rgb: Colour
    ) -> UInt8[Array, "h w 3"]:
        """A copy of the image with the contour of every pose in one colour; what is not finite is left out."""
        picture = image.copy()
        height_px, width_px = image.shape[:2]
        for pose in poses:
            if np.isfinite(pose.T_cam_obj).all():
                layers = self._rasteriser.render(pose.obj_id, K, pose.T_cam_obj[None], width_px, height_px, rgb=False)
                picture[contour_mask(layers.mask[0])] = rgb
        return picture


def write_line(image: UInt8[Array, "h w 3"], text: str, rgb: Colour, line: int = 0) -> UInt8[Array, "h w 3"]:
    """A copy of the image with a line of text at its top left, dark behind it; `line` counts downwards."""
    picture = image.copy()
    scale = max(0.4, image.shape[0] / 900)
    thickness = max(1, round(1.5 * scale))
    (width, height), below = cv2.getTextSize(text, cv2.FONT_HERSHEY_SIMPLEX, scale, thickness)
    step = height + below + 6
    cv2.rectangle(picture, (0, line * step), (width + 8, (line + 1) * step), (20, 20, 20), cv2.FILLED)
    origin = (4, (line + 1) * step - below - 2)
    cv2.putText(picture, text, origin, cv2.FONT_HERSHEY_SIMPLEX, scale, rgb, thickness, cv2.LINE_AA)
    return picture
