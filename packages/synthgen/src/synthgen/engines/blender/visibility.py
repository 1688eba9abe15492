"""Visibility of pooled objects, without loss of their meshes in Cycles."""

import bpy

RAYS = ("visible_camera", "visible_diffuse", "visible_glossy", "visible_transmission", "visible_shadow")


def show(thing: bpy.types.Object, *, shown: bool) -> None:
    """Show an object to every kind of ray, or hide it from them.

    `hide_render`, the obvious switch, takes the object out of the scene, and Cycles builds the mesh's BVH again when it
    is back. An object hidden from every kind of ray is taken out as well, so one kind that never occurs here stays:
    rays scattered in a volume.
    """
    for ray in RAYS:
        if getattr(thing, ray) != shown:
            setattr(thing, ray, shown)
