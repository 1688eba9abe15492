"""Display (sRGB) values and linear light; bytes."""

import numpy as np
from jaxtyping import Float, UInt8


def linear_from_display(values: Float[np.ndarray, "*b"]) -> Float[np.ndarray, "*b"]:
    """Linear light of display (sRGB) values in [0, 1] (IEC 61966-2-1)."""
    return np.asarray(np.where(values <= 0.04045, values / 12.92, ((values + 0.055) / 1.055) ** 2.4))


def display_from_linear(values: Float[np.ndarray, "*b"]) -> Float[np.ndarray, "*b"]:
    """Display (sRGB) values of linear light, which is clipped to [0, 1] (IEC 61966-2-1)."""
    light = np.clip(values, 0.0, 1.0)
    return np.asarray(np.where(light <= 0.0031308, light * 12.92, 1.055 * light ** (1 / 2.4) - 0.055))


def to_bytes(values: Float[np.ndarray, "*b"]) -> UInt8[np.ndarray, "*b"]:
    """8-bit values of values in [0, 1]."""
    return np.asarray(np.rint(np.clip(values, 0.0, 1.0) * 255.0).astype(np.uint8))
