"""Camera effects: exposure, white balance, defocus and motion blur, noise, JPEG."""

import cv2
import numpy as np
from jaxtyping import Float, UInt8
from posecore import srgb

from synthgen.scene import Sensor


def linear_from_display(rgb: UInt8[np.ndarray, "h w 3"]) -> Float[np.ndarray, "h w 3"]:
    """Linear light of display (sRGB) bytes."""
    return np.asarray(cv2.LUT(rgb, _LINEAR))


def display_from_linear(rgb_linear: Float[np.ndarray, "h w 3"]) -> Float[np.ndarray, "h w 3"]:
    """Display (sRGB) values of linear light, both in [0, 1]; linear light above 1 saturates."""
    x = np.clip(rgb_linear, 0.0, 1.0).astype(np.float32)
    return np.where(x <= 0.0031308, x * np.float32(12.92), np.float32(1.055) * cv2.pow(x, 1 / 2.4) - np.float32(0.055))


def expose(rgb_linear: Float[np.ndarray, "h w 3"], sensor: Sensor) -> UInt8[np.ndarray, "h w 3"]:
    """Convert linear light to the bytes of a camera image.

    Lens (blur) first, then the sensor's gains, then noise in display units, then JPEG: the order in a real camera.
    """
    image: np.ndarray = np.ascontiguousarray(rgb_linear, np.float32)
    if sensor.blur_sigma_px > 0.05:
        image = cv2.GaussianBlur(image, (0, 0), sensor.blur_sigma_px, borderType=cv2.BORDER_REPLICATE)
    if sensor.motion_px > 1.0:
        kernel = _motion_kernel(sensor.motion_px, sensor.motion_angle_rad)
        image = cv2.filter2D(image, -1, kernel, borderType=cv2.BORDER_REPLICATE)
    gain = np.asarray(sensor.white_balance, np.float32) * np.float32(2**sensor.exposure_ev)
    display_values: np.ndarray = display_from_linear(image * gain)
    if sensor.noise_sigma > 0:
        noise = np.random.default_rng(sensor.seed).standard_normal(image.shape, np.float32)
        display_values = display_values + noise * np.float32(sensor.noise_sigma)
    display = (np.clip(display_values, 0.0, 1.0) * np.float32(255.0) + np.float32(0.5)).astype(np.uint8)
    if sensor.jpeg_quality is not None:
        ok, data = cv2.imencode(".jpg", display[..., ::-1], [cv2.IMWRITE_JPEG_QUALITY, sensor.jpeg_quality])
        assert ok
        display = np.ascontiguousarray(cv2.imdecode(data, cv2.IMREAD_COLOR)[..., ::-1])
    return display


def _motion_kernel(length_px: float, angle_rad: float) -> Float[np.ndarray, "k k"]:
    """An antialiased straight line of the given length, centred (no shift), with sum 1."""
    half = int(np.ceil(length_px / 2)) + 1
    kernel = np.zeros((2 * half + 1, 2 * half + 1), np.float32)
    for s in np.linspace(-length_px / 2, length_px / 2, 4 * half + 1):
        x, y = half + s * np.cos(angle_rad), half + s * np.sin(angle_rad)
        column, row = int(np.floor(x)), int(np.floor(y))
        a, b = x - column, y - row
        kernel[row, column] += (1 - a) * (1 - b)
        kernel[row, min(column + 1, 2 * half)] += a * (1 - b)
        kernel[min(row + 1, 2 * half), column] += (1 - a) * b
        kernel[min(row + 1, 2 * half), min(column + 1, 2 * half)] += a * b
    return np.asarray(kernel / kernel.sum())


_LINEAR = srgb.linear_from_display(np.arange(256) / 255.0).astype(np.float32)
