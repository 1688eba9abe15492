"""glTF 2.0 files, text and binary: node tree, primitives and their base colours.

Honoured: node transforms, every accessor (sparse, normalised, strided), triangles, strips and fans, texture coordinate
sets and transforms, vertex colours, base colour factors and textures, the diffuse colour of specular-glossiness.
The rest of a material (roughness, metal, normals, emission, occlusion) is left to the scene, as a finish is.
What else changes shape or look is refused by name.

Source: Khronos Group, glTF 2.0 Specification, version 2.0.1.
"""

import io
import json
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float, Int
from scipy.spatial.transform import Rotation

from posecore.errors import MeshError
from posecore.mesh_files.gltf_buffers import Buffers
from posecore.mesh_files.gltf_materials import Materials
from posecore.mesh_files.part import MeshPart
from posecore.srgb import display_from_linear, to_bytes

HONOURED = (
    "KHR_mesh_quantization", "KHR_texture_transform", "KHR_materials_pbrSpecularGlossiness", "KHR_materials_unlit",
    "EXT_texture_webp", "KHR_lights_punctual", "KHR_materials_clearcoat", "KHR_materials_specular", "KHR_materials_ior",
    "KHR_materials_sheen", "KHR_materials_emissive_strength", "KHR_materials_iridescence", "KHR_materials_anisotropy",
    "KHR_materials_variants", "KHR_materials_transmission", "KHR_materials_volume",
    "KHR_node_visibility", "KHR_xmp_json_ld", "KHR_animation_pointer",
)  # fmt: skip
"""Extensions that a file may require: read, or without effect on shape and base colour."""
SHAPE_EXTENSIONS = ("KHR_draco_mesh_compression", "EXT_meshopt_compression", "KHR_meshopt_compression")
_TRIANGLES, _STRIP, _FAN = 4, 5, 6
_MOST_DEPTH = 200


def read_gltf(file: Path, data: bytes, *, allow_missing_textures: bool = False) -> list[MeshPart]:
    """Parts of a glTF or GLB file, one for each primitive of each node, in metres.

    Args:
        file: The file.
        data: Its bytes.
        allow_missing_textures: Whether a missing or broken texture is left out.

    Raises:
        MeshError: The file is cut off, or holds what cannot be drawn as it is described.
        TextureError: A file that it names is missing.
    """
    tree, blob = _tree(file, data)
    version = str(tree.get("asset", {}).get("version", "2.0"))
    if not version.startswith("2"):
        raise MeshError(f"{file}: is glTF {version}, expected glTF 2.0; convert it")
    unread = [name for name in tree.get("extensionsRequired", ()) if name not in HONOURED]
    if unread:
        raise MeshError(
            f"{file}: requires the extension {', '.join(map(str, unread))}, which is not read; export it without"
        )
    buffers = Buffers(file=file, tree=tree, blob=blob)
    materials = Materials(file=file, tree=tree, buffers=buffers, allow_missing_textures=allow_missing_textures)
    parts = []
    for node, transform in _nodes(file, tree):
        mesh = tree["meshes"][node["mesh"]]
        _refuse_deformed(file, node, mesh)
        for primitive in mesh["primitives"]:
            part = _part(file, primitive, buffers, materials)
            if part is not None:
                parts.append(_moved(part, transform))
    return parts


def _tree(file: Path, data: bytes) -> tuple[dict[str, Any], bytes | None]:
    """The JSON part, and a GLB's binary chunk.

    Raises:
        MeshError: A chunk is cut off or the JSON is broken.
    """
    text, blob = data, None
    if data[:4] == b"glTF":
        length = int.from_bytes(data[8:12], "little")
        if int.from_bytes(data[4:8], "little") != 2:
            raise MeshError(f"{file}: is GLB version {int.from_bytes(data[4:8], 'little')}, expected 2; convert it")
        if len(data) < max(length, 20):
            raise MeshError(f"{file}: is cut off, it has {len(data)} of {length} bytes; copy it again")
        position = 12
        chunks: dict[bytes, bytes] = {}
        while position + 8 <= length:
            size, kind = int.from_bytes(data[position : position + 4], "little"), data[position + 4 : position + 8]
            if position + 8 + size > length:
                raise MeshError(f"{file}: is cut off inside a chunk; copy it again")
            chunks.setdefault(kind, data[position + 8 : position + 8 + size])
            position += 8 + size
        text, blob = chunks.get(b"JSON", b""), chunks.get(b"BIN\0")
    try:
        tree = json.load(io.TextIOWrapper(io.BytesIO(text), "utf-8-sig"))
    except (ValueError, RecursionError) as error:
        reason = str(error).splitlines()[0][:80]
        raise MeshError(
            f"{file}: cannot be read as a mesh, its JSON is cut off or broken ({reason}); copy it again"
        ) from error
    if not isinstance(tree, dict) or not tree.get("meshes"):
        raise MeshError(f"{file}: holds no triangle mesh; export the surface, not points or curves")
    return tree, blob


def _nodes(file: Path, tree: Mapping[str, Any]) -> Iterator[tuple[Mapping[str, Any], Float[np.ndarray, "4 4"]]]:
    """Nodes with a mesh, with their transforms to the scene; all meshes where there is no scene."""
    scenes, nodes = tree.get("scenes"), tree.get("nodes", [])
    roots = scenes[tree.get("scene", 0)].get("nodes", []) if scenes else _roots(nodes)
    stack = [(root, np.eye(4), 0) for root in roots]
    while stack:
        index, above, depth = stack.pop()
        node = nodes[index]
        if not node.get("extensions", {}).get("KHR_node_visibility", {}).get("visible", True):
            continue
        if depth > _MOST_DEPTH:
            raise MeshError(f"{file}: its nodes are nested deeper than {_MOST_DEPTH}; a node is its own parent")
        if node.get("extensions", {}).get("EXT_mesh_gpu_instancing") is not None:
            raise MeshError(f"{file}: uses the extension EXT_mesh_gpu_instancing, which is not read; export it without")
        transform = above @ _local(node)
        stack += [(child, transform, depth + 1) for child in node.get("children", ())]
        if "mesh" in node:
            yield node, transform
    if not nodes:
        yield from (({"mesh": i}, np.eye(4)) for i in range(len(tree["meshes"])))


def _roots(nodes: list[Mapping[str, Any]]) -> list[int]:
    children = {child for node in nodes for child in node.get("children", ())}
    return [i for i in range(len(nodes)) if i not in children]


def _local(node: Mapping[str, Any]) -> Float[np.ndarray, "4 4"]:
    if "matrix" in node:
        return np.array(node["matrix"], np.float64).reshape(4, 4).T
    transform = np.eye(4)
    transform[:3, 3] = node.get("translation", (0.0, 0.0, 0.0))
    rotation = Rotation.from_quat(node.get("rotation", (0.0, 0.0, 0.0, 1.0))).as_matrix()
    transform[:3, :3] = rotation * np.array(node.get("scale", (1.0, 1.0, 1.0)))
    return transform


def _refuse_deformed(file: Path, node: Mapping[str, Any], mesh: Mapping[str, Any]) -> None:
    if "skin" in node:
        raise MeshError(f"{file}: is deformed by a skin, which is not read; export it as a rigid mesh, pose applied")
    weights = node.get("weights", mesh.get("weights", ()))
    if any(weights) and any("targets" in primitive for primitive in mesh["primitives"]):
        raise MeshError(f"{file}: is deformed by morph targets, which are not read; export it with them applied")


def _part(file: Path, primitive: Mapping[str, Any], buffers: Buffers, materials: Materials) -> MeshPart | None:
    """A primitive's triangles with its colours; None for points and lines, which are no surface."""
    mode, attributes = primitive.get("mode", _TRIANGLES), primitive["attributes"]
    if mode not in (_TRIANGLES, _STRIP, _FAN) or "POSITION" not in attributes:
        return None
    for name in SHAPE_EXTENSIONS:
        if name in primitive.get("extensions", {}) and not buffers.is_stored(attributes["POSITION"]):
            raise MeshError(f"{file}: uses the extension {name}, which is not read; export it without")
    vertices = buffers.values(attributes["POSITION"])
    indices = buffers.indices(primitive["indices"]) if "indices" in primitive else np.arange(len(vertices))
    faces = _faces(indices, mode)
    normals = buffers.values(attributes["NORMAL"]) if "NORMAL" in attributes else None
    base = materials.base_colour(primitive.get("material"))
    rgb = base.factor
    if "COLOR_0" in attributes:
        colours = buffers.values(attributes["COLOR_0"])
        if not np.isfinite(colours).all():
            raise MeshError(f"{file}: a vertex colour is not a finite number; export the mesh again")
        materials.refuse_see_through(primitive.get("material"), colours)
        rgb = colours[:, :3] * rgb
    uv = None
    if base.texture is not None:
        name = f"TEXCOORD_{base.uv_set}"
        if name not in attributes:
            raise MeshError(f"{file}: a textured primitive has no {name}; export its texture coordinates")
        uv = base.placed(buffers.values(attributes[name]))
        uv[:, 1] = 1.0 - uv[:, 1]
    plain = base.texture is not None and "COLOR_0" not in attributes  # its factor is in the texture
    return MeshPart(
        vertices=vertices,
        faces=faces,
        normals=normals,
        rgb=None if plain else to_bytes(display_from_linear(np.broadcast_to(rgb, (len(vertices), 3)))),
        uv=uv,
        texture=base.texture if plain else base.unscaled,
        is_flat=True,
    )


def _faces(indices: Int[np.ndarray, " n"], mode: int) -> Int[np.ndarray, "f 3"]:
    if mode == _STRIP:
        strip = np.stack([indices[:-2], indices[1:-1], indices[2:]], axis=1)
        strip[1::2] = strip[1::2, [1, 0, 2]]  # every other triangle of a strip faces the other way
        return np.asarray(strip)
    if mode == _FAN:
        n = max(len(indices) - 2, 0)
        return np.stack([np.repeat(indices[:1], n), indices[1 : n + 1], indices[2 : n + 2]], axis=1)
    return indices[: len(indices) // 3 * 3].reshape(-1, 3)


def _moved(part: MeshPart, transform: Float[np.ndarray, "4 4"]) -> MeshPart:
    """The part in the scene's frame; a mirroring turns the faces over, so that they keep their outside."""
    if np.allclose(transform, np.eye(4), atol=1e-8):
        return part
    linear = transform[:3, :3]
    is_mirrored = np.linalg.det(linear) < 0
    normals = part.normals
    if normals is not None:
        adjugate = np.cross(linear.T[[1, 2, 0]], linear.T[[2, 0, 1]])  # normals of a transformed surface
        normals = normals @ (-adjugate if is_mirrored else adjugate)
        length = np.linalg.norm(normals, axis=1, keepdims=True)
        normals = np.divide(normals, length, out=np.zeros_like(normals), where=length > 0)
    return MeshPart(
        vertices=part.vertices @ linear.T + transform[:3, 3],
        faces=part.faces[:, ::-1] if is_mirrored else part.faces,
        normals=normals,
        rgb=part.rgb,
        uv=part.uv,
        texture=part.texture,
        is_flat=part.is_flat,
    )
