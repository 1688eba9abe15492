"""The headless rasteriser: meshes at poses to colour, camera z and masks."""

from posecore.raster.rasteriser import MAX_PICTURE_INSTANCES, Rasteriser
from posecore.raster.scene import (
    HEADLIGHT,
    MAX_LIGHTS,
    DirectionalLight,
    Instance,
    Layers,
    SceneLayers,
    Shading,
)

__all__ = [
    "HEADLIGHT",
    "MAX_LIGHTS",
    "MAX_PICTURE_INSTANCES",
    "DirectionalLight",
    "Instance",
    "Layers",
    "Rasteriser",
    "SceneLayers",
    "Shading",
]
