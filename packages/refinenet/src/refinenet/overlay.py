"""Pictures of poses over images: silhouette contours of start and result."""

from collections.abc import Mapping

import numpy as np
from jaxtyping import Float, Int, UInt8
from posecore.contour import contour_mask
from posecore.mesh import Mesh
from posecore.raster import Rasteriser

Array = np.ndarray
START_RGB = (230, 60, 40)
REFINED_RGB = (60, 230, 90)


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
        self,
        image: UInt8[Array, "h w 3"],
        K: Float[Array, "3 3"],
        T_cam_obj: Float[Array, "b 4 4"],
        obj_id: Int[Array, " b"],
        rgb: tuple[int, int, int],
    ) -> UInt8[Array, "h w 3"]:
        """A copy of the image with the contour of every pose in one colour."""
        picture = image.copy()
        height_px, width_px = image.shape[:2]
        for pose, i in zip(T_cam_obj, obj_id, strict=True):
            layers = self._rasteriser.render(int(i), K, pose[None], width_px, height_px, rgb=False)
            picture[contour_mask(layers.mask[0])] = rgb
        return picture
