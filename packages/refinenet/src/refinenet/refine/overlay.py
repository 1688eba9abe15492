"""Images with the silhouette contours of poses and lines of text."""

from collections.abc import Collection, Mapping, Sequence
from pathlib import Path

import cv2
import numpy as np
from jaxtyping import Float, UInt8
from posecore.bop import BopDataset
from posecore.bop.images import write_image
from posecore.contour import contour_mask
from posecore.mesh import Mesh
from posecore.raster import Rasteriser

from refinenet.refine.image_poses import ImagePoses, ImageResults
from refinenet.refiner import Request

Colour = tuple[int, int, int]
INITIAL_RGB: Colour = (230, 60, 40)
REFINED_RGB: Colour = (60, 230, 90)


class Overlay:
    """Draws contours onto images, until it is closed.

    Args:
        meshes: Objects by id.
    """

    def __init__(self, meshes: Mapping[int, Mesh]) -> None:
        self._rasteriser = Rasteriser(meshes)

    def close(self) -> None:
        """Free the renderer."""
        self._rasteriser.close()

    def draw(
        self, image: UInt8[np.ndarray, "h w 3"], K: Float[np.ndarray, "3 3"], poses: Sequence[Request], rgb: Colour
    ) -> UInt8[np.ndarray, "h w 3"]:
        """A copy of the image with the contours of all finite poses in one colour."""
        picture = image.copy()
        height_px, width_px = image.shape[:2]
        for pose in poses:
            if np.isfinite(pose.T_cam_obj).all():
                layers = self._rasteriser.render(pose.obj_id, K, pose.T_cam_obj[None], width_px, height_px, rgb=False)
                picture[contour_mask(layers.mask[0])] = rgb
        return picture


class OverlayFolder:
    """A picture per image: contours of the initial poses in red, of the refined ones in green.

    Args:
        dataset: With the images and meshes.
        obj_ids: Objects to draw.
        folder: Folder of the pictures.
    """

    def __init__(self, dataset: BopDataset, obj_ids: Collection[int], folder: Path) -> None:
        self._dataset = dataset
        self._folder = folder
        self._overlay = Overlay({i: dataset.mesh(i) for i in sorted(obj_ids)})

    def close(self) -> None:
        """Free the renderer."""
        self._overlay.close()

    def write(self, image: ImagePoses, results: ImageResults) -> None:
        """Draw an image."""
        K = self._dataset.camera(image.scene_id, image.im_id).K
        rgb = self._dataset.rgb(image.scene_id, image.im_id)
        refined = [
            Request(obj_id=request.obj_id, T_cam_obj=refinement.T_cam_obj)
            for request, refinement in zip(image.requests, results.refinements, strict=True)
            if not refinement.failed
        ]
        picture = self._overlay.draw(self._overlay.draw(rgb, K, image.requests, INITIAL_RGB), K, refined, REFINED_RGB)
        write_image(self._folder / f"{image.scene_id:06d}_{image.im_id:06d}.png", picture)


def write_line(image: UInt8[np.ndarray, "h w 3"], text: str, rgb: Colour, line: int = 0) -> UInt8[np.ndarray, "h w 3"]:
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
