"""Composition of rendered layers, background and sensor effects to an image."""

import numpy as np
from jaxtyping import UInt8

from synthgen.engine import RenderedScene
from synthgen.image import background, sensor
from synthgen.scene import Scene


def compose(rendered: RenderedScene, scene: Scene) -> UInt8[np.ndarray, "h w 3"]:
    """Composite the render over the scene's background in linear light, and apply the sensor effects."""
    height, width = rendered.alpha.shape
    behind = sensor.linear_from_display(background.render_background(scene, width, height))
    alpha = rendered.alpha[..., None]
    return sensor.expose(rendered.rgb_linear * alpha + behind * (1 - alpha), scene.sensor)


def on_black(rendered: RenderedScene) -> UInt8[np.ndarray, "h w 3"]:
    """The render on black in display values, as for a hypothesis."""
    display = sensor.display_from_linear(rendered.rgb_linear * rendered.alpha[..., None])
    return np.asarray((display * np.float32(255.0) + np.float32(0.5)).astype(np.uint8))
