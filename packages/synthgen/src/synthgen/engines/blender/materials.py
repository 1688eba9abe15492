"""A node material per mesh; it reads the differences between objects from custom properties of the object."""

import bpy
import numpy as np
from posecore.srgb import linear_from_display

from synthgen.engines.blender.meshes import COLOUR_ATTRIBUTE, UV_LAYER
from synthgen.scene import Material, Pattern

INDEX_AOV = "object_index"
# Custom properties of the object, three numbers each, that the nodes read.
PAINT, ADJUST, FINISH, PAINTED = "paint", "adjust", "finish", "painted"
ACCENT, WAVE, WARP, BAND = "accent", "wave", "warp", "band"


def make_surface(name: str, texture: bpy.types.Image | None, *, has_colours: bool = False) -> bpy.types.Material:
    """Create the material of a mesh: original or painted colour -> hue, saturation, value -> Principled BSDF.

    The paint is a single colour or a pattern of two (`scene.Pattern`).

    A material per object would be obvious, but Cycles would then keep a copy of the mesh for each object and rebuild
    its BVH at every render.

    Args:
        name: Names the datablock.
        texture: The mesh's texture; None takes its vertex colours.
        has_colours: Whether its vertex colours are a factor on its texture.
    """
    block = bpy.data.materials.new(name)
    block.use_nodes = True
    tree = block.node_tree
    tree.nodes.clear()
    mix = tree.nodes.new("ShaderNodeMixRGB")
    tree.links.new(_mesh_colour(tree, texture, has_colours), mix.inputs["Color1"])
    paint = tree.nodes.new("ShaderNodeMixRGB")
    tree.links.new(_attribute(tree, PAINT).outputs["Color"], paint.inputs["Color1"])
    tree.links.new(_attribute(tree, ACCENT).outputs["Color"], paint.inputs["Color2"])
    tree.links.new(_pattern(tree), paint.inputs["Fac"])
    tree.links.new(paint.outputs["Color"], mix.inputs["Color2"])
    tree.links.new(_attribute(tree, PAINTED).outputs["Fac"], mix.inputs["Fac"])
    adjust = tree.nodes.new("ShaderNodeHueSaturation")
    tree.links.new(mix.outputs["Color"], adjust.inputs["Color"])
    _link_xyz(tree, ADJUST, adjust, ("Hue", "Saturation", "Value"))
    principled = tree.nodes.new("ShaderNodeBsdfPrincipled")
    tree.links.new(adjust.outputs["Color"], principled.inputs["Base Color"])
    _link_xyz(tree, FINISH, principled, ("Roughness", "Metallic", "Specular IOR Level"))
    output = tree.nodes.new("ShaderNodeOutputMaterial")
    tree.links.new(principled.outputs["BSDF"], output.inputs["Surface"])
    info = tree.nodes.new("ShaderNodeObjectInfo")
    aov = tree.nodes.new("ShaderNodeOutputAOV")
    aov.aov_name = INDEX_AOV
    tree.links.new(info.outputs["Object Index"], aov.inputs["Value"])
    return block


def set_material(thing: bpy.types.Object, material: Material) -> None:
    """Set the custom properties of an object to `material`."""
    rgb = (0.0, 0.0, 0.0) if material.base_rgb is None else linear_from_display(np.array(material.base_rgb)).tolist()
    pattern = material.pattern or Pattern(accent_rgb=(0.0, 0.0, 0.0), wave=(0.0, 0.0, 0.0))
    properties = {
        PAINT: tuple(rgb),
        ACCENT: tuple(linear_from_display(np.array(pattern.accent_rgb)).tolist()),
        WAVE: pattern.wave,
        WARP: pattern.warp,
        # bend, steepness, offset; without a pattern the accent's fraction is 0
        BAND: (pattern.bend, pattern.sharpness / 2, 0.5) if material.pattern else (0.0, 0.0, 0.0),
        PAINTED: float(material.base_rgb is not None),
        ADJUST: (0.5 + material.hue_shift, material.saturation, material.value),
        FINISH: (material.roughness, material.metallic, material.specular),
    }
    for name, value in properties.items():
        thing[name] = value
    thing.update_tag(refresh={"OBJECT"})


def _mesh_colour(tree: bpy.types.NodeTree, texture: bpy.types.Image | None, has_colours: bool) -> bpy.types.NodeSocket:
    if texture is None:
        return _vertex_colour(tree)
    uv = tree.nodes.new("ShaderNodeUVMap")
    uv.uv_map = UV_LAYER
    image = tree.nodes.new("ShaderNodeTexImage")
    image.image = texture
    tree.links.new(uv.outputs["UV"], image.inputs["Vector"])
    if not has_colours:
        return image.outputs["Color"]
    product = tree.nodes.new("ShaderNodeMixRGB")
    product.blend_type = "MULTIPLY"
    product.inputs["Fac"].default_value = 1.0
    tree.links.new(image.outputs["Color"], product.inputs["Color1"])
    tree.links.new(_vertex_colour(tree), product.inputs["Color2"])
    return product.outputs["Color"]


def _vertex_colour(tree: bpy.types.NodeTree) -> bpy.types.NodeSocket:
    vertex = tree.nodes.new("ShaderNodeVertexColor")
    vertex.layer_name = COLOUR_ATTRIBUTE
    return vertex.outputs["Color"]


def _pattern(tree: bpy.types.NodeTree) -> bpy.types.NodeSocket:
    """Weight of the accent colour, by the formula of `pattern.accent_weight`."""
    position = tree.nodes.new("ShaderNodeTexCoord").outputs["Object"]
    band = tree.nodes.new("ShaderNodeSeparateXYZ")
    tree.links.new(_attribute(tree, BAND).outputs["Vector"], band.inputs["Vector"])

    def math(operation: str, *sockets: bpy.types.NodeSocket, clamp: bool = False) -> bpy.types.NodeSocket:
        node = tree.nodes.new("ShaderNodeMath")
        node.operation, node.use_clamp = operation, clamp
        for socket, target in zip(sockets, node.inputs, strict=False):
            tree.links.new(socket, target)
        return node.outputs["Value"]

    def phase(name: str) -> bpy.types.NodeSocket:
        node = tree.nodes.new("ShaderNodeVectorMath")
        node.operation = "DOT_PRODUCT"
        tree.links.new(position, node.inputs[0])
        tree.links.new(_attribute(tree, name).outputs["Vector"], node.inputs[1])
        return node.outputs["Value"]

    bent = math("MULTIPLY_ADD", math("SINE", phase(WARP)), band.outputs["X"], phase(WAVE))
    return math("MULTIPLY_ADD", math("SINE", bent), band.outputs["Y"], band.outputs["Z"], clamp=True)


def _attribute(tree: bpy.types.NodeTree, name: str) -> bpy.types.Node:
    node = tree.nodes.new("ShaderNodeAttribute")
    node.attribute_type = "OBJECT"
    node.attribute_name = name
    return node


def _link_xyz(tree: bpy.types.NodeTree, name: str, node: bpy.types.Node, inputs: tuple[str, str, str]) -> None:
    split = tree.nodes.new("ShaderNodeSeparateXYZ")
    tree.links.new(_attribute(tree, name).outputs["Vector"], split.inputs["Vector"])
    for axis, socket in zip("XYZ", inputs, strict=True):
        tree.links.new(split.outputs[axis], node.inputs[socket])
