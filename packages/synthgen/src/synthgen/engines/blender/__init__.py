"""Blender (Cycles and EEVEE), headless and in process: the one folder that imports bpy."""
