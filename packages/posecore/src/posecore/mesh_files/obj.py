"""OBJ files: trimesh reads their numbers, from text that is brought to the one spelling that it understands."""

import io
import logging
import re
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import trimesh
from jaxtyping import Float, UInt8
from trimesh.exchange.obj import load_obj

from posecore.errors import MeshError, TextureError
from posecore.mesh_files.images import DecodedImage, beside, decode, linked_bytes, missing
from posecore.mesh_files.mtl import HOLE, NEARLY_OPAQUE, MaterialMap, MtlMaterial, read_materials
from posecore.mesh_files.part import MeshPart, Texture, decoded, two_looks
from posecore.mesh_files.polygons import concave, ears, polygon_fingerprints, repeated
from posecore.srgb import to_bytes

log = logging.getLogger(__name__)

NO_MATERIAL = ("", "none", "(null)")
"""Names that exporters write for faces without a material."""


def read_obj(file: Path, data: bytes, *, allow_missing_textures: bool = False) -> list[MeshPart]:
    """Parts of an OBJ file, one for each material.

    A texture (`map_Kd`) stands for `Kd`, as in Blender's importer: Wavefront's specification multiplies them, but
    exporters write any `Kd` beside a texture. `Kd` is a display value. Vertex colours (`v x y z r g b`) stand for `Kd`;
    beside a texture they are left out. An ambient map (`map_Ka`) is no colour of the surface.

    Args:
        file: The file.
        data: Its bytes.
        allow_missing_textures: Whether faces whose texture or material is missing or broken get the plain colour.

    Raises:
        MeshError: The file is cut off, or holds what cannot be drawn as it is described.
        TextureError: A file that its materials name is missing.
    """
    text = _one_spelling(decoded(data))
    _refuse_cut(file, text, data)
    _refuse_half_coloured(file, text)
    text, names = _numbered_materials(text)
    libraries = re.findall(r"^mtllib +(.+)$", text, re.MULTILINE | re.IGNORECASE)
    materials = _materials(file, list(dict.fromkeys(libraries)), names, allow_missing_textures)
    text = re.sub(r"^mtllib .*$", "", text, flags=re.MULTILINE | re.IGNORECASE)
    text = "mtllib m.mtl\n" + _plain_polygons(file, _absolute(file, text))
    library = "".join(f"newmtl m{i}\nKd 1 1 1\n" for i in range(len(names)))
    geometry = load_obj(io.BytesIO(text.encode()), resolver={"m.mtl": library.encode()}).get("geometry", {})
    parts = []
    for entry in geometry.values():
        visual = entry.pop("visual", None)
        mesh = trimesh.Trimesh(**{**entry, "vertex_colors": None}, process=False)
        number = re.fullmatch(r"m(\d+)", str(getattr(getattr(visual, "material", None), "name", "")))
        material = materials.get(int(number[1])) if number else None
        uv = None if visual is None or visual.uv is None else np.asarray(visual.uv, np.float64)
        colours = _vertex_colours(file, entry.get("vertex_colors"), len(mesh.vertices))
        has_normals = "vertex_normals" in entry
        part = MeshPart(
            vertices=np.asarray(mesh.vertices, np.float64),
            faces=np.asarray(mesh.faces, np.int64),
            normals=np.asarray(mesh.vertex_normals, np.float64) if has_normals else None,
            rgb=colours,
        )
        parts.append(_dressed(file, part, uv, material, allow_missing_textures))
    return parts


def _one_spelling(text: str) -> str:
    """Lines without continuation, tabs, leading blanks and trailing comments."""
    text = text.replace("\\\n", " ").replace("\t", " ")
    text = re.sub(r"^ +", "", text, flags=re.MULTILINE)
    return re.sub(r"^((?:v|vt|vn|f) [^#\n]*)#.*$", r"\1", text, flags=re.MULTILINE)


def _refuse_cut(file: Path, text: str, data: bytes) -> None:
    """Refuse a file that ends before its time; OBJ has no end mark, so that only its parts can show it."""
    lines = text.rstrip("\n").rsplit("\n", 2)
    last, is_ended = lines[-1], data.endswith((b"\n", b"\r"))
    words = last.split()
    fewest = {"v": 4, "vt": 2, "vn": 4, "f": 4}
    remedy = "copy or export it again"
    if words and len(words) < fewest.get(words[0], 0):
        raise MeshError(f"{file}: is cut off, its last line is '{last[:60]}'; {remedy}")
    faces = re.findall(r"^f .*$", text, re.MULTILINE)
    if not is_ended and words and words[0] == "f" and len(faces) > 1:
        kinds = {word.count("/") + (word.endswith("/")) for word in words[1:]}
        if len(kinds) > 1:
            raise MeshError(f"{file}: is cut off, its last line is '{last[:60]}'; {remedy}")
    short = next((face for face in faces if len(face.split()) < 4), None)
    if short is not None:
        raise MeshError(f"{file}: '{short[:60]}' has fewer than three corners; {remedy}")
    head = text[:2000]
    for kind, count in (("Vertices", len(re.findall(r"^v ", text, re.MULTILINE))), ("Faces", len(faces))):
        stated = re.search(rf"^# {kind}: (\d+)$", head, re.MULTILINE)  # as MeshLab writes
        if stated and count < int(stated[1]):
            raise MeshError(f"{file}: is cut off, it has {count} of {stated[1]} {kind.lower()}; {remedy}")
    if not is_ended and (not faces or not _uses_all(text, faces)):
        raise MeshError(f"{file}: is cut off, its last line has no end and not all vertices are used; {remedy}")


def _uses_all(text: str, faces: list[str]) -> bool:
    """Whether the last vertex is in a face: faces come in the order of their vertices, in nearly every file."""
    count = len(re.findall(r"^v ", text, re.MULTILINE))
    used = {int(word) for face in faces for word in re.findall(r" (-?\d+)", face)}
    return len(used) >= count or any(number < 0 for number in used)


def _numbered_materials(text: str) -> tuple[str, list[str]]:
    """The text with `m0`, `m1` for the names of materials, and the names of those that faces use."""
    names: dict[str, int] = {}

    def numbered(match: re.Match[str]) -> str:
        return f"usemtl m{names.setdefault(match[1].strip(), len(names))}"

    text = re.sub(r"^usemtl\b(.*)$", numbered, text, flags=re.MULTILINE | re.IGNORECASE)
    # The last `usemtl` before a face counts.
    used = set(re.findall(r"^usemtl m(\d+)\n(?:(?!usemtl ).*\n)*?f ", text + "\n", re.MULTILINE))
    return text, [name if str(number) in used else "" for name, number in names.items()]


def _materials(
    file: Path, libraries: list[str], names: list[str], allow_missing_textures: bool
) -> Mapping[int, MtlMaterial]:
    """Materials by number."""
    by_name: dict[str, MtlMaterial] = {}
    absent: list[str] = []
    for library in libraries:
        whole = beside(library, [file.parent])
        several = [(word, beside(word, [file.parent])) for word in library.split()]
        for name, path in [(library, whole)] if whole is not None or len(several) < 2 else several:
            if path is None:
                absent.append(name)
                continue
            by_name |= read_materials(path, decoded(linked_bytes(file, path)))
    materials: dict[int, MtlMaterial] = {}
    for number, name in enumerate(names):
        if name in by_name:
            materials[number] = by_name[name]
        elif name.lower() in NO_MATERIAL:
            continue
        elif not libraries:
            log.warning("%s: names the material '%s' and no material file; its faces are mid grey", file, name)
        elif not allow_missing_textures:
            if absent:
                raise missing(file, "material file", file.parent, absent[0])
            raise TextureError(
                f"{file}: no material file defines the material '{name}', which faces use; "
                f"there are: {', '.join(by_name) or 'none'}; mend the name"
            )
    return materials


def _dressed(
    file: Path,
    part: MeshPart,
    uv: Float[np.ndarray, "v 2"] | None,
    material: MtlMaterial | None,
    allow_missing_textures: bool,
) -> MeshPart:
    """The part with its material's look."""
    if material is None:
        return part
    if material.fault:
        raise MeshError(f"{file}: {material.fault}")
    where = material.opacity_line or material.file
    if material.opacity < HOLE:
        raise MeshError(
            f"{file}: {where} cannot be seen, silhouettes are opaque here; set d to 1 or remove these faces"
        )
    if material.opacity < NEARLY_OPAQUE:
        log.warning("%s: %s is see-through and drawn opaque", file, where)
    picture = None
    try:
        _refuse_holes(file, material)
        if material.map_Kd is not None:
            picture = _image(file, material, material.map_Kd)
            if uv is None:
                raise TextureError(
                    f"{file}: {material.map_Kd.line}: faces of this material have no texture coordinates; add them "
                    "(vt, on every corner)"
                )
    except MeshError:
        if not allow_missing_textures:
            raise
        picture = None
    plain = _plain(part, material.Kd)
    if picture is None or uv is None or material.map_Kd is None:
        return plain
    entry = material.map_Kd
    wrap: Any = ("clamp", "clamp") if entry.clamp else ("repeat", "repeat")
    return MeshPart(
        vertices=part.vertices,
        faces=part.faces,
        normals=part.normals,
        uv=uv if entry.scale == (1, 1) and entry.offset == (0, 0) else uv * entry.scale + np.array(entry.offset),
        texture=Texture(rgb=picture.rgb, wrap=wrap),
    )


def _plain(part: MeshPart, Kd: tuple[float, float, float] | None) -> MeshPart:
    if part.rgb is not None or Kd is None:
        return part
    rgb = np.asarray(trimesh.visual.color.to_rgba(np.array(Kd)), np.uint8)[:3]
    return MeshPart(
        vertices=part.vertices,
        faces=part.faces,
        normals=part.normals,
        rgb=np.tile(rgb, (len(part.vertices), 1)),
    )


def _image(file: Path, material: MtlMaterial, entry: MaterialMap) -> DecodedImage:
    path = beside(entry.name, [material.file.parent, file.parent])
    if path is None:
        raise missing(file, "texture", material.file.parent, entry.name)
    return decode(file, str(path), linked_bytes(file, path))


def _refuse_holes(file: Path, material: MtlMaterial) -> None:
    if material.map_d is None:
        return
    picture = _image(file, material, material.map_d)
    opacity = picture.rgb if picture.alpha is None else picture.alpha
    if opacity.min() < 255 * HOLE:
        raise MeshError(
            f"{file}: {material.map_d.line} cuts holes into its faces, silhouettes are opaque here; model the holes"
        )


def _refuse_half_coloured(file: Path, text: str) -> None:
    """Refuse colours of some vertices alone, which trimesh would leave out for all."""
    if re.search(r"^v(?: +\S+){6}", text, re.MULTILINE) and re.search(r"^v(?: +\S+){3,4} *$", text, re.MULTILINE):
        raise MeshError(f"{file}: only some of its vertices have colours; give each a colour or none")


def _vertex_colours(file: Path, values: Any, count: int) -> UInt8[np.ndarray, "v 3"] | None:
    if values is None or len(values) != count:
        return None
    colours = np.asarray(values, np.float64)
    if not np.isfinite(colours).all():
        raise MeshError(f"{file}: a vertex colour is not a finite number; export the mesh again")
    return to_bytes(colours / (255.0 if colours.max(initial=0.0) > 1.0 else 1.0))


def _absolute(file: Path, text: str) -> str:
    """Faces with counted numbers in place of those from the end (-1 is the latest), which trimesh counts wrongly."""
    if re.search(r"^f .*-\d", text, re.MULTILINE) is None:
        return text
    counts = {"v": 0, "vt": 0, "vn": 0}
    lines = text.split("\n")
    for row, line in enumerate(lines):
        key = line.split(" ", 1)[0]
        if key in counts:
            counts[key] += 1
        elif key == "f":
            corners = [corner.split("/") for corner in line.split()[1:]]
            kinds = ("v", "vt", "vn")
            try:
                fixed = [
                    "/".join(
                        str(counts[kind] + 1 + int(number)) if number.startswith("-") else number
                        for kind, number in zip(kinds, corner, strict=False)
                    )
                    for corner in corners
                ]
            except ValueError as error:
                raise MeshError(f"{file}: '{line[:60]}' is no face; export the mesh again") from error
            lines[row] = "f " + " ".join(fixed)
    return "\n".join(lines)


def _plain_polygons(file: Path, text: str) -> str:
    """The text with triangles in place of concave polygons, which trimesh would draw as fans, and no polygon twice."""
    lines = [match for match in re.finditer(r"^f [^\n]+", text, re.MULTILINE) if match[0].count(" ") > 3]
    polygons = [match[0].split()[1:] for match in lines]
    kept = [i for i, corners in enumerate(polygons) if len(corners) > 3]
    if not kept:
        return text
    numbers = re.findall(r"^v +(\S+) +(\S+) +(\S+)", text, re.MULTILINE)
    vertices = np.array(numbers, np.float64)
    sizes = np.array([len(polygons[i]) for i in kept])
    rows = np.array([int(corner.split("/", 1)[0]) for i in kept for corner in polygons[i]]) - 1
    if rows.min() < 0 or rows.max() >= len(vertices):
        return text  # refused later, with the face
    corners, starts = vertices[rows], np.concatenate([[0], np.cumsum(sizes)])
    changes = {}
    for j in np.flatnonzero(concave(corners, sizes)):
        words = polygons[kept[j]]
        triangles = ears(corners[starts[j] : starts[j + 1]])
        changes[j] = "\n".join("f " + " ".join(words[k] for k in triangle) for triangle in triangles)
    for copy, original in repeated(polygon_fingerprints(corners, sizes)):
        materials = {text.rfind("\nusemtl ", 0, lines[kept[j]].start()) for j in (copy, original)}
        if len({text[at : text.find("\n", at + 1)] if at >= 0 else "" for at in materials}) > 1:
            raise MeshError(two_looks(file))
        changes[copy] = ""
    pieces, position = [], 0
    for j in sorted(changes):
        match = lines[kept[j]]
        pieces += [text[position : match.start()], changes[j]]
        position = match.end()
    return "".join(pieces) + text[position:]
