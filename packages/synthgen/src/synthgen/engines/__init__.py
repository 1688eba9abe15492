"""Rendering of plain scenes to colour, depth and masks: Blender, or the rasteriser."""
