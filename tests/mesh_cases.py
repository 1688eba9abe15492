"""Small mesh files whose look is stated: two squares side by side, 40 mm each, seen from +z with y up.

`CASES` gives, for each file, the writer and the display colours of the middle of the left and of the right square. They
hold for the loaded mesh and for its render in every engine.
"""

import base64
import json
import struct
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np

Rgb = tuple[int, int, int]

RED, GREEN, BLUE, GREY, WHITE = (220, 20, 20), (20, 220, 20), (20, 20, 220), (160, 160, 160), (255, 255, 255)
LEFT_MM = np.array([[-40, -20, 0], [0, -20, 0], [0, 20, 0], [-40, 20, 0]], np.float64)
RIGHT_MM = np.add(LEFT_MM, [40, 0, 0])
UV = np.array([[0, 0], [1, 0], [1, 1], [0, 1]], np.float64)
SQUARE = np.array([[0, 1, 2], [0, 2, 3]])
HALF_RED = np.where(np.arange(64)[None, :, None] < 32, np.uint8(RED), np.uint8(BLUE)) * np.ones((64, 1, 1), np.uint8)
"""An image whose left half is red and whose right half is blue."""


def png(rgb: Any, *flags: int, kind: str = ".png") -> bytes:
    """An encoded image; three channels are red, green, blue."""
    pixels = np.asarray(rgb)
    pixels = pixels[..., ::-1] if pixels.ndim == 3 and pixels.shape[2] == 3 else pixels
    return bytes(cv2.imencode(kind, np.ascontiguousarray(pixels), list(flags))[1].tobytes())


def plain(rgb: Rgb) -> bytes:
    """A PNG of one colour."""
    return png(np.full((64, 64, 3), rgb, np.uint8))


@dataclass(frozen=True, kw_only=True)
class MeshCase:
    """A mesh file and what it shows."""

    write: Callable[[Path], Any]
    left: Rgb = RED
    right: Rgb = BLUE


def obj(mtl: str, *, uv: Any = UV, colours: Any = None, vt: bool = True, **extra: Any) -> Callable[[Path], Path]:
    """Writes an OBJ whose left square has the material `a`, textured red, and whose right square has `b`.

    Args:
        mtl: Material `b`, without its first line.
        uv: Texture coordinates of the right square.
        colours: Vertex colours of both squares, as text.
        vt: Whether the right square has texture coordinates.
        extra: `files`: further files by name; `library`: the MTL's name; `head`: first lines of the OBJ.
    """

    def write(folder: Path) -> Path:
        library = extra.get("library", "m.mtl")
        lines = [extra.get("head", f"mtllib {library}")]
        for i, vertex in enumerate([*LEFT_MM, *RIGHT_MM]):
            lines.append("v " + " ".join(map(str, vertex)) + ("" if colours is None else f" {colours[i]}"))
        lines += [f"vt {u} {v}" for u, v in [*UV, *np.asarray(uv)]]
        lines += ["usemtl a", "f 1/1 2/2 3/3 4/4", "usemtl b", "f 5/5 6/6 7/7 8/8" if vt else "f 5 6 7 8"]
        files = {
            "red.png": plain(RED),
            "blue.png": plain(BLUE),
            "half.png": png(HALF_RED),
            library: f"newmtl a\nmap_Kd red.png\nnewmtl b\n{mtl}\n".encode(),
            "mesh.obj": ("\n".join(lines) + "\n").encode(),
        }
        write_files(folder, files | extra.get("files", {}))
        return folder / "mesh.obj"

    return write


def write_files(folder: Path, files: dict[str, bytes]) -> None:
    """Write files by name, in subfolders too."""
    for name, data in files.items():
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        (folder / name).write_bytes(data)


class Gltf:
    """A glTF file in the making: arrays and images are appended, and `json` is what refers to them."""

    def __init__(self) -> None:
        self.blob = b""
        self.json: dict[str, Any] = {
            "asset": {"version": "2.0"}, "scene": 0, "scenes": [{"nodes": []}], "nodes": [], "meshes": [],
            "accessors": [], "bufferViews": [], "materials": [], "textures": [], "images": [], "samplers": [],
        }  # fmt: skip

    def view(self, data: bytes, **settings: int) -> int:
        self.blob += b"\0" * (-len(self.blob) % 4)
        self.json["bufferViews"].append(
            {"buffer": 0, "byteOffset": len(self.blob), "byteLength": len(data), **settings}
        )
        self.blob += data
        return len(self.json["bufferViews"]) - 1

    def accessor(self, values: Any, **settings: Any) -> int:
        values = np.asarray(values)
        values = values.astype({"f": "<f4", "i": "<u2"}.get(values.dtype.kind, values.dtype))
        kind = {"u1": 5121, "u2": 5123, "u4": 5125, "f4": 5126, "i1": 5120, "i2": 5122}[values.dtype.str[1:]]
        width = {1: "SCALAR", 2: "VEC2", 3: "VEC3", 4: "VEC4"}[1 if values.ndim == 1 else values.shape[1]]
        entry = {"bufferView": self.view(values.tobytes()), "componentType": kind, "count": len(values), "type": width}
        self.json["accessors"].append(entry | settings)
        return len(self.json["accessors"]) - 1

    def image(self, data: bytes | str, sampler: dict[str, int] | None = None, how: str = "view") -> dict[str, int]:
        """A texture of an image, inside the buffer, as a data URI, or by name."""
        if isinstance(data, str):
            self.json["images"].append({"uri": data})
        elif how == "uri":
            self.json["images"].append({"uri": "data:image/png;base64," + base64.b64encode(data).decode()})
        else:
            self.json["images"].append({"bufferView": self.view(data), "mimeType": "image/png"})
        texture = {"source": len(self.json["images"]) - 1}
        if sampler is not None:
            self.json["samplers"].append(sampler)
            texture["sampler"] = len(self.json["samplers"]) - 1
        self.json["textures"].append(texture)
        return {"index": len(self.json["textures"]) - 1}

    def base(self, factor: Any = None, texture: dict[str, Any] | None = None, **others: Any) -> int:
        """A material by its base colour."""
        pbr: dict[str, Any] = {"metallicFactor": 0}
        pbr |= {} if factor is None else {"baseColorFactor": list(factor)}
        pbr |= {} if texture is None else {"baseColorTexture": texture}
        self.json["materials"].append({"pbrMetallicRoughness": pbr, **others})
        return len(self.json["materials"]) - 1

    def square(
        self, corners_mm: Any = RIGHT_MM, material: int | None = None, node: Any = None, **settings: Any
    ) -> dict:
        """A primitive of two triangles, in a mesh and a node of its own; `settings` go to its attributes."""
        attributes = {"POSITION": self.accessor(np.asarray(corners_mm) / 1e3), **settings}
        primitive = {"attributes": attributes, "indices": self.accessor(SQUARE.reshape(-1))}
        primitive |= {} if material is None else {"material": material}
        self.json["meshes"].append({"primitives": [primitive]})
        self.json["nodes"].append({"mesh": len(self.json["meshes"]) - 1, **(node or {})})
        self.json["scenes"][0]["nodes"].append(len(self.json["nodes"]) - 1)
        return primitive

    def left(self) -> "Gltf":
        """Adds the left square, textured red."""
        self.square(LEFT_MM, self.base(texture=self.image(plain(RED))), TEXCOORD_0=self.accessor(UV))
        return self

    def text(self) -> bytes:
        """As .gltf, data inside."""
        uri = "data:application/octet-stream;base64," + base64.b64encode(self.blob).decode()
        return json.dumps(self._tree({"byteLength": len(self.blob), "uri": uri})).encode()

    def binary(self) -> bytes:
        """As .glb."""
        head = json.dumps(self._tree({"byteLength": len(self.blob)})).encode()
        head += b" " * (-len(head) % 4)
        blob = self.blob + b"\0" * (-len(self.blob) % 4)
        chunks = struct.pack("<I4s", len(head), b"JSON") + head + struct.pack("<I4s", len(blob), b"BIN\0") + blob
        return struct.pack("<4sII", b"glTF", 2, 12 + len(chunks)) + chunks

    def _tree(self, buffer: dict[str, Any]) -> dict[str, Any]:
        return {key: value for key, value in {**self.json, "buffers": [buffer]}.items() if value not in ([], {})}


def gltf(build: Callable[[Gltf], Any], *, left: bool = True, files: dict[str, bytes] | None = None) -> Any:
    """Writes a .gltf or .glb whose right square `build` makes."""

    def write(folder: Path, name: str = "mesh.gltf") -> Path:
        made = Gltf().left() if left else Gltf()
        build(made)
        write_files(folder, {name: made.binary() if name.endswith(".glb") else made.text(), **(files or {})})
        return folder / name

    return write


def textured(data: bytes | str, factor: Any = None, uv: Any = UV, **settings: Any) -> Callable[[Gltf], Any]:
    """Builds a right square with a texture."""

    def build(made: Gltf) -> None:
        texture = made.image(data, settings.get("sampler"), settings.get("how", "view")) | settings.get("texture", {})
        name = f"TEXCOORD_{settings.get('uv_set', 0)}"
        extra = {} if name == "TEXCOORD_0" else {"TEXCOORD_0": made.accessor(UV[:, ::-1] * 0.1)}
        accessor = made.accessor(uv, **settings.get("accessor", {}))
        made.square(material=made.base(factor, texture, **settings.get("material", {})), **{name: accessor}, **extra)

    return build


def coloured(colours: Any, factor: Any = None, **settings: Any) -> Callable[[Gltf], Any]:
    """Builds a right square with vertex colours."""

    def build(made: Gltf) -> None:
        material = None if factor is None else made.base(factor)
        made.square(material=material, COLOR_0=made.accessor(colours, **settings))

    return build


def ply(
    properties: str, columns: Any, *, head: str = "", faces: str = "", rows: Any = (), files: Any = None
) -> Callable[[Path], Path]:
    """Writes an ASCII PLY of both squares with further properties of its vertices and faces.

    Args:
        properties: `type name` of each further vertex property, separated by commas.
        columns: Their values for the eight vertices.
        head: Header lines after the format.
        faces: Further header lines of the faces.
        rows: Further values of the four faces, as text.
        files: Further files by name.
    """

    def write(folder: Path) -> Path:
        lines = ["ply", "format ascii 1.0", *filter(None, [head]), "element vertex 8"]
        lines += [f"property float {axis}" for axis in "xyz"]
        lines += [f"property {item}" for item in properties.split(",") if item]
        lines += ["element face 4", "property list uchar int vertex_indices", *filter(None, [faces]), "end_header"]
        for vertex, row in zip([*LEFT_MM, *RIGHT_MM], columns, strict=True):
            lines.append(" ".join(map(str, [*vertex, *np.atleast_1d(row).tolist()])))
        for i, face in enumerate([*SQUARE, *(SQUARE + 4)]):
            lines.append(" ".join(["3", *map(str, face), *([rows[i]] if len(rows) else [])]))
        write_files(
            folder, {"mesh.ply": ("\n".join(lines) + "\n").encode(), "half.png": png(HALF_RED), **(files or {})}
        )
        return folder / "mesh.ply"

    return write


def stl(left: int, right: int, header: bytes = b"") -> Callable[[Path], Path]:
    """Writes a binary STL with the attributes of the squares' facets."""

    def write(folder: Path) -> Path:
        data = header.ljust(80, b"\0") + struct.pack("<I", 4)
        for corners, attribute in ((LEFT_MM, left), (RIGHT_MM, right)):
            for face in SQUARE:
                data += struct.pack("<12fH", 0, 0, 1, *corners[face].reshape(-1), attribute)
        (folder / "mesh.stl").write_bytes(data)
        return folder / "mesh.stl"

    return write


def off(head: str, vertex_tail: Any = ("",) * 8, face_tail: Any = ("", "")) -> Callable[[Path], Path]:
    """Writes an OFF file of two quads."""

    def write(folder: Path) -> Path:
        lines = [head, "8 2 0"]
        lines += [f"{x} {y} {z} {tail}" for (x, y, z), tail in zip([*LEFT_MM, *RIGHT_MM], vertex_tail, strict=True)]
        lines += [f"4 0 1 2 3 {face_tail[0]}", f"4 4 5 6 7 {face_tail[1]}"]
        (folder / "mesh.off").write_text("\n".join(lines) + "\n")
        return folder / "mesh.off"

    return write


def both(left: Any, right: Any) -> list[Any]:
    """A value for the left square's four vertices and one for the right's."""
    return [left] * 4 + [right] * 4


def lr(scale: float = 1.0, alpha: Any = None) -> list[list[float]]:
    """RED and BLUE vertex colours as numbers."""
    extra = [] if alpha is None else [alpha]
    return both([scale * c for c in RED] + extra, [scale * c for c in BLUE] + extra)


_LINEAR_BLUE = [0.006995, 0.006995, 0.715694]
_TO_BLUE_HALF = {"extensions": {"KHR_texture_transform": {"offset": [0.5, 0.0], "scale": [0.5, 0.5]}}}
_GREY16 = np.full((64, 64), 160 * 257, np.uint16)
_COLOURS = "uchar red,uchar green,uchar blue"
_FACE_RGB = "property uchar red\nproperty uchar green\nproperty uchar blue"
_UV_RIGHT_HALF = np.array([[0.6, 0], [0.9, 0], [0.9, 1], [0.6, 1]])
_UV_LEFT_HALF = np.array([[0.1, 0], [0.4, 0], [0.4, 1], [0.1, 1]])
_HALVES = [*_UV_LEFT_HALF.tolist(), *_UV_RIGHT_HALF.tolist()]

OBJ_CASES = {
    "plain": obj("Kd 0 0 1", vt=False),
    "plain with vt": obj("Kd 0 0 1"),
    "two textures": obj("map_Kd blue.png"),
    "texture stands for Kd": obj("Kd 1 0 0\nmap_Kd blue.png"),
    "black Kd": obj("Kd 0 0 0\nmap_Kd blue.png"),
    "lower case": obj("Kd 1 0 0\nmap_kd blue.png"),
    "upper case": obj("KD 1 0 0\nMAP_KD blue.png"),
    "tabs": obj("\tKd 1 0 0\n\tmap_Kd\tblue.png"),
    "options": obj("map_Kd -s 1 1 1 -o 0 0 0 -blendu on -mm 0 1 -texres 512 blue.png"),
    "scale and offset": obj("map_Kd -s 0.5 1 -o 0.5 half.png"),
    "clamp": obj("map_Kd -clamp on half.png", uv=UV * [1, 1] + [1.5, 0]),
    "backslash": obj("map_Kd tex\\in side.png", files={"tex/in side.png": plain(BLUE)}),
    "dot backslash": obj("map_Kd .\\blue.png"),
    "other case": obj("map_Kd Blue.PNG"),
    "absolute": obj("map_Kd /home/someone/blue.png"),
    "drive": obj("map_Kd C:\\work\\blue.png"),
    "quoted": obj('map_Kd "blue.png"'),
    "parent": obj("map_Kd ../blue.png", library="sub/m.mtl", files={"sub/red.png": plain(RED)}),
    "beside the library": obj("map_Kd sky.png", library="sub/m.mtl", files={"sub/sky.png": plain(BLUE)}),
    "library with spaces": obj("map_Kd my blue.png", library="my lib.mtl", files={"my blue.png": plain(BLUE)}),
    "tiled": obj("map_Kd half.png", uv=UV * [2, 3] + [0.75, 0]),
    "tiled far away": obj("map_Kd half.png", uv=UV * [0.3, 3] + [4000.6, -70]),
    "16-bit texture": obj("map_Kd deep.png", files={"deep.png": png(np.full((8, 8, 3), BLUE).astype(np.uint16) * 257)}),
    "two libraries": obj("", head="mtllib m.mtl\nmtllib n.mtl", files={"n.mtl": b"newmtl b\nKd 0 0 1\n"}),
    "two libraries in a line": obj("", head="mtllib m.mtl n.mtl", files={"n.mtl": b"newmtl b\nKd 0 0 1\n"}),
    "d 1": obj("Kd 0 0 1\nd 1.0\nTr 1.0", vt=False),
}
GLTF_CASES = {
    "plain": gltf(lambda g: g.square(material=g.base([0, 0, 1, 1]))),
    "two textures": gltf(textured(plain(BLUE))),
    "data URI": gltf(textured(plain(BLUE), how="uri")),
    "external": gltf(textured("my%20blue.png"), files={"my blue.png": plain(BLUE)}),
    "jpeg": gltf(textured(png(np.full((64, 64, 3), BLUE, np.uint8), cv2.IMWRITE_JPEG_QUALITY, 100, kind=".jpg"))),
    "webp": gltf(textured(png(np.full((64, 64, 3), BLUE, np.uint8), cv2.IMWRITE_WEBP_QUALITY, 101, kind=".webp"))),
    "opacity of 1": gltf(
        textured(png(np.full((8, 8, 4), (*BLUE[::-1], 255), np.uint8)), material={"alphaMode": "BLEND"})
    ),
    "uv set 1": gltf(textured(png(HALF_RED), uv=_UV_RIGHT_HALF, uv_set=1, texture={"texCoord": 1})),
    "transform": gltf(textured(png(HALF_RED), texture=_TO_BLUE_HALF)),
    "normalised uv": gltf(
        textured(png(HALF_RED), uv=np.rint(_UV_RIGHT_HALF * 65535).astype(np.uint16), accessor={"normalized": True})
    ),
    "clamp": gltf(textured(png(HALF_RED), uv=np.add(UV, [1.5, 0]), sampler={"wrapS": 33071, "wrapT": 33071})),
    "mirror": gltf(textured(png(HALF_RED), uv=np.add(_UV_LEFT_HALF, [1, 0]), sampler={"wrapS": 33648, "wrapT": 33648})),
    "vertex colours": gltf(coloured([_LINEAR_BLUE] * 4)),
    "vertex colours of bytes": gltf(coloured(np.full((4, 4), (0, 0, 255, 255), np.uint8), normalized=True)),
    "colour times factor": gltf(coloured([[1, 1, 0.715694]] * 4, [0.006995, 0.006995, 1, 1])),
}


def _cases() -> dict[str, MeshCase]:
    cases = {}
    pure_blue = {"plain", "plain with vt", "two libraries", "two libraries in a line", "d 1", "vertex colours of bytes"}
    for kind, group in (("obj", OBJ_CASES), ("gltf", GLTF_CASES)):
        for name, write in group.items():
            right = (0, 0, 255) if name in pure_blue else BLUE
            cases[f"{kind} {name}"] = MeshCase(write=write, right=right)

    def add(name: str, write: Any, left: Rgb = RED, right: Rgb = BLUE) -> None:
        cases[name] = MeshCase(write=write, left=left, right=right)

    add("obj map_Ka alone", obj("Kd 0 0 1\nmap_Ka half.png"), right=(0, 0, 255))
    add("obj vertex colours", obj("", head="", colours=both("0.2 0.4 0.6", "1 0.5 0")), (51, 102, 153), (255, 128, 0))
    add(
        "obj vertex colours to 255",
        obj("", head="", colours=both("51 102 153", "255 128 0")),
        (51, 102, 153),
        (255, 128, 0),
    )
    add("gltf without a material", gltf(lambda g: g.square()), right=WHITE)
    add("gltf without a factor", gltf(lambda g: g.square(material=g.base())), right=WHITE)
    add("gltf linear factor", gltf(lambda g: g.square(material=g.base([0.2, 0.2, 0.2, 1]))), right=(124, 124, 124))
    add("gltf factor times texture", gltf(textured(plain(RED), [0.2, 0.2, 0.2, 1])), right=(106, 5, 5))
    add("gltf 16-bit grey", gltf(textured(png(_GREY16))), right=GREY)
    add("gltf grey", gltf(textured(png(np.full((8, 8), 160, np.uint8)))), right=GREY)
    specular = {"extensions": {"KHR_materials_pbrSpecularGlossiness": {"diffuseFactor": [0, 0, 1, 1]}}}
    add("gltf spec-gloss", gltf(lambda g: g.square(material=g.base(**specular))), right=(0, 0, 255))
    add("glb", lambda folder: gltf(textured(plain(BLUE)))(folder, "mesh.glb"))
    add("gltf vertex colours times texture", gltf(_colours_times_texture), right=(106, 5, 5))
    add("ply bytes", ply(_COLOURS, lr()))
    add("ply shorts", ply(_COLOURS.replace("uchar", "ushort"), [[257 * int(c) for c in row] for row in lr()]))
    add("ply floats", ply(_COLOURS.replace("uchar", "float"), lr(1 / 255)))
    add("ply doubles to 255", ply(_COLOURS.replace("uchar", "double"), lr()))
    add("ply ints to 255", ply(_COLOURS.replace("uchar", "int"), lr()))
    add("ply diffuse", ply("uchar diffuse_red,uchar diffuse_green,uchar diffuse_blue", lr()))
    add("ply r g b", ply("uchar r,uchar g,uchar b", lr()))
    add("ply alpha", ply(f"{_COLOURS},uchar alpha", lr(alpha=0)))
    add("ply uv and colours", ply(f"float s,float t,{_COLOURS}", [[0, 0, *c] for c in lr()]))
    add("ply faces", ply("", [[]] * 8, faces=_FACE_RGB, rows=["220 20 20"] * 2 + ["20 20 220"] * 2))
    for names in ("texture_u,texture_v", "s,t", "u,v"):
        properties = ",".join(f"float {name}" for name in names.split(","))
        add(f"ply texture {names}", ply(properties, _HALVES, head="comment TextureFile half.png"))
    wedges = ["6 " + " ".join(str(x) for c in face for x in _HALVES[c]) for face in [*SQUARE, *(SQUARE + 4)]]
    add(
        "ply texture of corners",
        ply("", [[]] * 8, head="comment TextureFile half.png", faces="property list uchar float texcoord", rows=wedges),
    )
    add(
        "ply two textures",
        ply(
            "float s,float t", [*UV, *UV], head="comment TextureFile red.png\ncomment TextureFile blue.png",
            faces="property int texnumber", rows=["0", "0", "1", "1"],
            files={"red.png": plain(RED), "blue.png": plain(BLUE)},
        ),
    )  # fmt: skip
    add("stl VisCAM", stl(0x8000 | 31 << 10, 0x8000 | 31), (255, 0, 0), (0, 0, 255))
    add("stl Magics", stl(31, 0x8000, b"COLOR=\x00\x00\xff\xff"), (255, 0, 0), (0, 0, 255))
    add("off vertices", off("COFF", both("220 20 20 255", "20 20 220 255")))
    add("off faces", off("OFF", face_tail=("220 20 20", "20 20 220")))
    add("off faces of fractions", off("OFF", face_tail=("1.0 0.0 0.0", "0.0 0.0 1.0")), (255, 0, 0), (0, 0, 255))
    return cases


def _colours_times_texture(made: Gltf) -> None:
    """Vertex colours that differ, over a red texture: 0.2 in linear light where it is looked at."""
    square = [[0.2, 0.2, 0.2], [0.2, 0.2, 0.2], [0.2, 0.2, 0.2], [0.2, 0.2, 0.3]]
    material = made.base(texture=made.image(plain(RED)))
    made.square(material=material, TEXCOORD_0=made.accessor(UV), COLOR_0=made.accessor(square))


CASES = _cases()
