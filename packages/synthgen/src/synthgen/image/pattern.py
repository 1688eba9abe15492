"""Procedural solid textures; Blender's nodes evaluate the same formula (`engines/blender/materials.py`)."""

import numpy as np
from jaxtyping import Float, UInt8

from synthgen.image.sensor import display_from_linear, linear_from_display
from synthgen.scene import Material, Pattern


def accent_weight(pattern: Pattern, p_obj_m: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, " n"]:
    """Weight of the accent colour at points in object coordinates, in [0, 1].

    Args:
        pattern: Texture.
        p_obj_m: (n, 3) points on the surface, metres.
    """
    bent = pattern.bend * np.sin(p_obj_m @ np.asarray(pattern.warp))
    wave = np.sin(p_obj_m @ np.asarray(pattern.wave) + bent)
    return np.clip(0.5 + 0.5 * pattern.sharpness * wave, 0.0, 1.0)


def paint(
    rgb: UInt8[np.ndarray, "n 3"], material: Material, p_obj_m: Float[np.ndarray, "n 3"]
) -> UInt8[np.ndarray, "n 3"]:
    """Display colours of a lit surface with the material's base colour and pattern.

    Args:
        rgb: Shading of a white surface, display values.
        material: Material with a base colour and a pattern.
        p_obj_m: (n, 3) points on the surface in object coordinates, metres.
    """
    assert material.pattern is not None and material.base_rgb is not None
    base, accent = (
        linear_from_display((np.array(c) * 255 + 0.5).astype(np.uint8)[None, None])[0]
        for c in (material.base_rgb, material.pattern.accent_rgb)
    )
    weight = accent_weight(material.pattern, p_obj_m)[:, None]
    colour = display_from_linear((base * (1 - weight) + accent * weight)[None])[0]
    return np.asarray((rgb * colour + 0.5).astype(np.uint8))
