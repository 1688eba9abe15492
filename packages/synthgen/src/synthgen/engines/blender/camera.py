"""From an OpenCV pinhole camera and a region of its pixel plane to Blender's camera."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float
from posecore.camera import Camera, project

SENSOR_WIDTH_MM = 36.0  # any width serves: Blender keeps only the ratio of lens to sensor
MIN_SIDE_PX = 4  # Blender raises a smaller resolution to this in silence
FILTER_REACH_PX = 2  # no less than half the pixel filter: how far an object's edge colours pixels around it
USUAL_CLIP_M = (0.01, 100.0)
"""Near and far plane of a scene that fits between them."""
_NEAR_FRACTION = 0.05  # least near plane of another scene, over the camera z of its nearest object's centre

Region = tuple[int, int, int, int]

# The camera frame is the world frame. Blender's camera at the origin has its view along -z and y up: x stays, y and z
# change sign. This is the only place where axes are converted.
_BLENDER_FROM_OPENCV = np.diag([1.0, -1.0, -1.0, 1.0])


def blender_from_opencv(T_cam_x: Float[np.ndarray, "4 4"]) -> Float[np.ndarray, "4 4"]:
    """Return Blender's world matrix of an object or lamp from its pose in the OpenCV camera frame.

    Args:
        T_cam_x: Pose in the OpenCV camera frame, metres.
    """
    return np.asarray(_BLENDER_FROM_OPENCV @ T_cam_x)


@dataclass(frozen=True, kw_only=True)
class BlenderLens:
    """Settings of Blender's render and camera, with the sensor fit 'HORIZONTAL'.

    Attributes:
        width_px: Render width.
        height_px: Render height.
        pixel_aspect_x: Width of a pixel; at least 1, as Blender demands.
        pixel_aspect_y: Height of a pixel; at least 1.
        lens_mm: Focal length over a sensor of SENSOR_WIDTH_MM.
        shift_x: To the right, in render widths.
        shift_y: Upwards, in render widths too (not heights), of pixels as wide as they are.
    """

    width_px: int
    height_px: int
    pixel_aspect_x: float
    pixel_aspect_y: float
    lens_mm: float
    shift_x: float
    shift_y: float


def lens_for(camera: Camera, region_px: Region) -> BlenderLens:
    """Return the lens whose image is exactly the region, which may extend beyond the camera's image.

    The principal point is in the project's continuous pixel coordinates; Blender's viewplane runs from edge to edge
    of the pixels as well, so no half pixel is added anywhere.

    Args:
        camera: Pinhole camera; fx may differ from fy.
        region_px: x0, y0, width, height. A side under MIN_SIDE_PX is extended right or down.
    """
    x0, y0, width, height = region_px
    width, height = max(width, MIN_SIDE_PX), max(height, MIN_SIDE_PX)
    fx, fy = float(camera.K[0, 0]), float(camera.K[1, 1])
    cx, cy = float(camera.K[0, 2]) - x0, float(camera.K[1, 2]) - y0
    # A pixel's physical size is inverse to its focal length in pixels.
    aspect_x, aspect_y = max(1.0, fy / fx), max(1.0, fx / fy)
    return BlenderLens(
        width_px=width,
        height_px=height,
        pixel_aspect_x=aspect_x,
        pixel_aspect_y=aspect_y,
        lens_mm=fx * SENSOR_WIDTH_MM / width,
        shift_x=(width / 2 - cx) / width,
        shift_y=(cy - height / 2) / width * (aspect_y / aspect_x),
    )


def clip_range_m(
    corners_cam_m: Float[np.ndarray, "n 8 3"], usual_m: tuple[float, float] | None = USUAL_CLIP_M
) -> tuple[float, float]:
    """Near and far plane around the objects, metres.

    An object that reaches behind the camera does not bring the near plane closer than a twentieth of the camera z of
    the nearest object's centre, as in `posecore.raster`: the steps of a depth buffer grow with z^2 / near.

    Args:
        corners_cam_m: Corners of each object's bounding box.
        usual_m: Planes to keep where every object in front of the camera is between them. A ray starts at the near
            plane, so that another one would change the last bits of Cycles' depths.
    """
    z_m = corners_cam_m[..., 2]
    nearest_m, farthest_m, center_m = z_m.min(axis=1), float(z_m.max()), z_m.mean(axis=1)
    if not (center_m > 0).any():
        return USUAL_CLIP_M
    if usual_m is not None:
        in_front_m = nearest_m[nearest_m > 0]
        if farthest_m <= usual_m[1] and (in_front_m >= usual_m[0]).all():
            return usual_m
    near_m = max(0.99 * float(nearest_m.min()), _NEAR_FRACTION * float(center_m[center_m > 0].min()))
    return near_m, 1.01 * farthest_m


def occupied_region(
    camera: Camera, region_px: Region, corners_cam_m: Float[np.ndarray, "n 8 3"], near_m: float = USUAL_CLIP_M[0]
) -> Region | None:
    """Return the part of the region that objects can cover, or None without such a part.

    An empty pixel is a third of the work of a full one, and crops around small or distant objects are mostly empty.

    Args:
        camera: Pinhole camera.
        region_px: x0, y0, width, height.
        corners_cam_m: Corners of each object's bounding box. A box behind the camera or around it gives no bound:
            then the region itself is returned.
        near_m: Near plane.
    """
    corners = corners_cam_m.reshape(-1, 3)
    if (corners[:, 2] < near_m).any():
        return region_px
    uv = project(camera.K, corners)
    x0, y0, width, height = region_px
    low = np.maximum(np.floor(uv.min(axis=0)) - FILTER_REACH_PX, (x0, y0))
    high = np.minimum(np.ceil(uv.max(axis=0)) + FILTER_REACH_PX, (x0 + width, y0 + height))
    if (low >= high).any():
        return None
    (left, top), (right, bottom) = low.astype(int).tolist(), high.astype(int).tolist()
    return left, top, right - left, bottom - top
