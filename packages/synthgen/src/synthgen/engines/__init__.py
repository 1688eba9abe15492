"""From a plain scene to colour, depth and masks: Blender, or the rasteriser."""
