"""Mesh files as posecore and as Blender read them: box, area, triangles, silhouette and flat colours, side by side.

    python benchmarks/mesh_import.py DIR

Each PLY, OBJ, glTF, GLB and STL file below DIR is loaded by both (Blender has no importer of OFF). Both surfaces are
drawn by Cycles from two sides, every pixel in its own colour without light. A line for each file that differs or that a
side refuses; the last line is JSON. One core.
"""

import argparse
import contextlib
import json
import logging
import math
import time
from collections import Counter
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from posecore.errors import MeshError, RenderError
from posecore.mesh import Mesh
from posecore.mesh_files import METRE_SUFFIXES, SUFFIXES, mesh_bytes, read_surface
from synthgen.engines.blender.exr import read_channels
from synthgen.engines.blender.materials import make_surface, set_material
from synthgen.engines.blender.meshes import COLOUR_ATTRIBUTE, make_mesh, make_texture
from synthgen.engines.blender.quiet import blender_output_caught
from synthgen.engines.blender.scratch import make_folder
from synthgen.engines.blender.settings import set_common, set_cycles
from synthgen.image.sensor import display_from_linear
from synthgen.scene import Material

import bpy  # isort: skip  # noqa: TID251

SIDE_PX = 160
DIRECTIONS = ((0.48, -0.64, 0.6), (-0.6, 0.64, -0.48))
"""From the object to the camera."""
GREY = 160 / 255
BOX_TOLERANCE, AREA_TOLERANCE, COLOUR_TOLERANCE, OVERLAP = 1e-5, 1e-4, 3.0, 0.995
"""Fractions of the box diagonal and of the area, mean display levels of 255, and intersection over union."""


@dataclass(frozen=True, kw_only=True)
class Side:
    """A mesh as one of the two sides has it, in the file's unit: corners of all triangles, and pictures."""

    corners: np.ndarray
    rgb: np.ndarray
    alpha: np.ndarray

    @property
    def box(self) -> np.ndarray:
        """Lowest and highest corner."""
        return np.stack([self.corners.min(axis=(0, 1)), self.corners.max(axis=(0, 1))])

    @property
    def area(self) -> float:
        """Of all triangles."""
        a, b, c = self.corners.swapaxes(0, 1)
        return float(np.linalg.norm(np.cross(b - a, c - a), axis=1).sum() / 2)


def main() -> None:
    """Compare and print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folder", type=Path, metavar="DIR")
    parser.add_argument("--out", type=Path, help="JSON file with a record of each mesh. [none]")
    arguments = parser.parse_args()
    logging.getLogger("posecore").setLevel(logging.ERROR)
    files = sorted(file for file in arguments.folder.rglob("*") if file.suffix.lower() in SUFFIXES and file.is_file())
    start_s, records = time.perf_counter(), []
    for file in files:
        record = compared(file)
        records.append({"file": str(file.relative_to(arguments.folder)), **record})
        if record["differs"] or record["posecore"] != "read" or record["blender"] != "read":
            print(f"{records[-1]['file']}: {'; '.join(record['differs']) or record['reason']}")
    if arguments.out is not None:
        arguments.out.write_text(json.dumps(records, indent=1))
    kinds = Counter(difference.split(" ")[0] for record in records for difference in record["differs"])
    both = [record for record in records if record["posecore"] == record["blender"] == "read"]
    summary = {
        "files": len(files),
        "compared": len(both),
        "agree": sum(not record["differs"] for record in both),
        "differ_in": dict(kinds),
        "refused_by_posecore": sum(record["posecore"] == "refused" for record in records),
        "not_read_by_blender": sum(record["blender"] != "read" for record in records),
        "posecore_s": round(sum(record["posecore_s"] for record in records), 2),
        "blender_s": round(sum(record["blender_s"] for record in records), 2),
        "seconds": round(time.perf_counter() - start_s, 1),
    }
    print(json.dumps(summary))


def compared(file: Path) -> dict:
    """Both sides of a file, and what differs."""
    record: dict = {"posecore": "read", "blender": "read", "differs": [], "reason": "", "posecore_s": 0, "blender_s": 0}
    sides: dict[str, Side] = {}
    for name, loader in (("posecore", by_posecore), ("blender", by_blender)):
        bpy.ops.wm.read_factory_settings(use_empty=True)
        start_s = time.perf_counter()
        try:
            if name == "blender" and file.suffix.lower() == ".off":
                raise RenderError("Blender has no importer of OFF")
            loader(file)
            record[f"{name}_s"] = time.perf_counter() - start_s
            sides[name] = drawn(sides.get("posecore"), file.suffix.lower() in METRE_SUFFIXES and name == "blender")
        except (MeshError, RenderError) as error:
            record[name] = "refused"
            record["reason"] += (
                "; " if record["reason"] else ""
            ) + f"{name}: {str(error).replace(str(file), file.name)}"
    if len(sides) == 2:
        record["differs"] = differences(sides["posecore"], sides["blender"])
    return record


def by_posecore(file: Path) -> None:
    """Put posecore's surface into the scene."""
    surface = read_surface(file, mesh_bytes(file))
    mesh = Mesh(
        vertices_m=surface.vertices,
        faces=surface.faces,
        normals=surface.normals,
        vertex_rgb=surface.rgb,
        uv=surface.uv,
        texture_rgb=surface.texture_rgb,
    )
    block = make_mesh(0, mesh)
    block.materials.append(make_surface("surface", make_texture(0, mesh), has_colours=mesh.vertex_rgb is not None))
    thing = bpy.data.objects.new("mesh", block)
    set_material(thing, Material())
    bpy.context.scene.collection.objects.link(thing)


def by_blender(file: Path) -> None:
    """Put what Blender's importer makes of the file into the scene, in the file's axes."""
    axes = {"forward_axis": "Y", "up_axis": "Z"}
    with blender_output_caught("Blender's importer failed"):
        match file.suffix.lower():
            case ".ply":
                bpy.ops.wm.ply_import(filepath=str(file), **axes)
            case ".obj":
                bpy.ops.wm.obj_import(filepath=str(file), **axes)
            case ".stl":
                bpy.ops.wm.stl_import(filepath=str(file), **axes)
            case _:
                bpy.ops.import_scene.gltf(filepath=str(file))
    if not any(thing.type == "MESH" and len(thing.data.polygons) for thing in bpy.context.scene.objects):
        raise RenderError("Blender's importer gives no faces")


def drawn(reference: Side | None, is_turned: bool) -> Side:
    """The scene's triangles and pictures, with the camera where the reference had it.

    Args:
        reference: The other side, or None for the first.
        is_turned: Whether the scene has glTF's y axis up, as Blender turns it.
    """
    corners = scene_corners()
    if is_turned:
        corners = np.stack([corners[..., 0], corners[..., 2], -corners[..., 1]], axis=-1)
    if not np.isfinite(corners).all() or not len(corners):
        raise RenderError("no finite triangles")
    own = Side(corners=corners, rgb=np.empty(0), alpha=np.empty(0))
    box = own.box if reference is None else reference.box
    scene = bpy.context.scene
    set_common(scene, engine="cycles", threads=1)
    set_cycles(scene, device="cpu")
    scene.cycles.samples, scene.render.filter_size = 4, 0.01
    scene.render.resolution_x = scene.render.resolution_y = SIDE_PX
    for material in {slot.material for thing in scene.objects for slot in thing.material_slots if slot.material}:
        make_unlit(material)
    for thing in scene.objects:
        if thing.type == "MESH" and not any(slot.material for slot in thing.material_slots):
            thing.data.materials.clear()
            thing.data.materials.append(plain(thing.data, 1.0 if is_turned else GREY))
    pictures = [picture(scene, box, np.array(direction), is_turned) for direction in DIRECTIONS]
    return Side(
        corners=corners,
        rgb=np.stack([rgb for rgb, _ in pictures]),
        alpha=np.stack([alpha for _, alpha in pictures]),
    )


def scene_corners() -> np.ndarray:
    """(t, 3, 3) corners of all triangles in the scene's frame."""
    blocks = [np.zeros((0, 3, 3))]
    bpy.context.view_layer.update()
    for thing in bpy.context.scene.objects:
        if thing.type != "MESH":
            continue
        thing.data.calc_loop_triangles()
        vertices = np.empty(3 * len(thing.data.vertices))
        thing.data.vertices.foreach_get("co", vertices)
        triangles = np.empty(3 * len(thing.data.loop_triangles), np.int32)
        thing.data.loop_triangles.foreach_get("vertices", triangles)
        matrix = np.array(thing.matrix_world)
        placed = vertices.reshape(-1, 3) @ matrix[:3, :3].T + matrix[:3, 3]
        blocks.append(placed[triangles].reshape(-1, 3, 3))
    return np.concatenate(blocks)


def make_unlit(material: "bpy.types.Material") -> None:
    """Let a material shine in its base colour."""
    material.use_nodes = True
    tree = material.node_tree
    shader = next((node for node in tree.nodes if node.type == "BSDF_PRINCIPLED"), None)
    output = next((node for node in tree.nodes if node.type == "OUTPUT_MATERIAL"), None)
    emission = tree.nodes.new("ShaderNodeEmission")
    if output is None:
        output = tree.nodes.new("ShaderNodeOutputMaterial")
    if shader is not None:
        base = shader.inputs["Base Color"]
        if base.links:
            tree.links.new(base.links[0].from_socket, emission.inputs["Color"])
        else:
            emission.inputs["Color"].default_value = base.default_value
    tree.links.new(emission.outputs["Emission"], output.inputs["Surface"])


def plain(mesh: "bpy.types.Mesh", grey: float) -> "bpy.types.Material":
    """A material for a mesh without one: its colours, or a display value of grey (glTF: white)."""
    block = bpy.data.materials.new("plain")
    block.use_nodes = True
    tree = block.node_tree
    make_unlit(block)
    emission = next(node for node in tree.nodes if node.type == "EMISSION")
    light = ((grey + 0.055) / 1.055) ** 2.4
    emission.inputs["Color"].default_value = (light, light, light, 1.0)
    colours = [attribute.name for attribute in mesh.color_attributes]
    if colours:
        node = tree.nodes.new("ShaderNodeVertexColor")
        node.layer_name = COLOUR_ATTRIBUTE if COLOUR_ATTRIBUTE in colours else colours[0]
        tree.links.new(node.outputs["Color"], emission.inputs["Color"])
    return block


def picture(scene: "bpy.types.Scene", box: np.ndarray, direction: np.ndarray, is_turned: bool) -> tuple:
    """Display colours and coverage, seen from far away without perspective."""
    from mathutils import Matrix  # noqa: TID251

    middle, diagonal = box.mean(axis=0), float(np.linalg.norm(box[1] - box[0]))
    eye = middle + 3 * diagonal * direction / np.linalg.norm(direction)
    up = np.array([0.0, 0.0, 1.0])
    if is_turned:  # to the scene's axes
        eye, direction, up = (np.array([v[0], -v[2], v[1]]) for v in (eye, direction, up))
    back = direction / np.linalg.norm(direction)
    right = np.cross(up, back)
    right /= np.linalg.norm(right)
    settings = bpy.data.cameras.new("camera")
    settings.type, settings.ortho_scale = "ORTHO", 1.02 * diagonal
    settings.clip_start, settings.clip_end = 0.1 * diagonal, 10 * diagonal
    camera = bpy.data.objects.new("camera", settings)
    matrix = np.eye(4)
    matrix[:3] = np.stack([right, np.cross(back, right), back, eye], axis=1)
    camera.matrix_world = Matrix(matrix.tolist())
    scene.collection.objects.link(camera)
    scene.camera = camera
    folder, remove = make_folder()
    scene.render.filepath = str(folder / "picture.exr")
    with blender_output_caught("Blender failed to render"):
        bpy.ops.render.render(write_still=True)
    channels = read_channels(folder / "picture.exr")
    remove()
    alpha = channels["Combined.A"]
    rgb = np.stack([channels[f"Combined.{c}"] for c in "RGB"], axis=-1) / np.maximum(alpha, 1e-3)[..., None]
    return 255 * display_from_linear(rgb), alpha > 0.5


def differences(ours: Side, theirs: Side) -> list[str]:
    """What differs, each beginning with its kind."""
    found = []
    diagonal = float(np.linalg.norm(ours.box[1] - ours.box[0]))
    if len(ours.corners) != len(theirs.corners):
        found.append(f"faces {len(ours.corners)}, Blender {len(theirs.corners)}")
    if np.abs(ours.box - theirs.box).max() > BOX_TOLERANCE * diagonal:
        found.append(f"box {ours.box.round(5).tolist()}, Blender {theirs.box.round(5).tolist()}")
    if not math.isclose(ours.area, theirs.area, rel_tol=AREA_TOLERANCE):
        found.append(f"area {ours.area:.6g}, Blender {theirs.area:.6g}")
    union = (ours.alpha | theirs.alpha).sum()
    both = ours.alpha & theirs.alpha
    if union and both.sum() / union < OVERLAP:
        found.append(f"silhouette overlap {both.sum() / union:.3f}")
    if both.any():
        mean = float(np.abs(ours.rgb - theirs.rgb)[both].mean())
        if mean > COLOUR_TOLERANCE:
            means = (np.round(side.rgb[both].mean(axis=0)).astype(int).tolist() for side in (ours, theirs))
            found.append(f"colour by {mean:.1f} levels, mean {next(means)}, Blender {next(means)}")
    return found


if __name__ == "__main__":
    with contextlib.suppress(BrokenPipeError):
        main()
