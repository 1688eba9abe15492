"""Mesh files that cannot be drawn as they are described: refused in one line that names the reason."""

import io
import json
import zlib
from collections.abc import Callable
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
import trimesh
from mesh_cases import CASES, UV, Gltf, coloured, gltf, obj, plain, png, textured
from PIL import Image
from posecore.errors import MeshError, TextureError
from posecore.mesh import load_mesh

HOLED = png(np.dstack([np.full((8, 8, 3), 90), np.where(np.arange(8) < 4, 0, 255) * np.ones((8, 1))]).astype(np.uint8))


def changed(**changes: Any) -> Callable[[Path], Path]:
    """A plain glTF with other top-level entries."""

    def build(made: Gltf) -> None:
        made.square(material=made.base([0, 0, 1, 1]))
        made.json |= changes

    return gltf(build)


def draco(made: Gltf) -> None:
    """A compressed primitive without a fallback; the extension is only said to be used."""
    primitive = made.square()
    made.json["accessors"][primitive["attributes"]["POSITION"]].pop("bufferView")
    primitive["extensions"] = {"KHR_draco_mesh_compression": {"bufferView": 0, "attributes": {"POSITION": 0}}}
    made.json["extensionsUsed"] = ["KHR_draco_mesh_compression"]


def morphed(made: Gltf) -> None:
    primitive = made.square()
    primitive["targets"] = [{"POSITION": primitive["attributes"]["POSITION"]}]
    made.json["meshes"][-1]["weights"] = [0.5]


def basisu(made: Gltf) -> None:
    made.json["textures"].append({"extensions": {"KHR_texture_basisu": {"source": 0}}})
    texture = {"index": len(made.json["textures"]) - 1}
    made.square(material=made.base(texture=texture), TEXCOORD_0=made.accessor(UV))


def without_uv(made: Gltf) -> None:
    made.square(material=made.base(texture=made.image(plain((1, 2, 3)))))


def instanced(made: Gltf) -> None:
    made.square(node={"extensions": {"EXT_mesh_gpu_instancing": {"attributes": {}}}})


def odd_dds() -> bytes:
    """A DDS picture whose pixels are of no format: Pillow raises NotImplementedError."""
    stream = io.BytesIO()
    Image.new("RGB", (8, 8)).save(stream, "DDS")
    return stream.getvalue()[:80] + bytes(4) + stream.getvalue()[84:]


def large(made: Gltf) -> None:
    head = bytearray(plain((1, 2, 3)))
    head[16:24] = (60000).to_bytes(4, "big") * 2
    head[29:33] = zlib.crc32(head[12:29]).to_bytes(4, "big")
    textured(bytes(head))(made)


REFUSED = {
    "texture missing": (obj("map_Kd gone.png"), r"its texture \S*gone\.png is missing"),
    "texture missing, lower case": (obj("map_kd gone.png"), r"its texture \S*gone\.png is missing"),
    "texture missing, tabs": (obj("\tmap_Kd\tgone.png"), r"its texture \S*gone\.png is missing"),
    "texture empty": (obj("map_Kd a.png", files={"a.png": b""}), r"its texture \S*a\.png is empty \(0 bytes\)"),
    "texture cut": (obj("map_Kd a.png", files={"a.png": plain((9, 9, 9))[:-30]}), "its texture cannot be decoded"),
    "texture is text": (obj("map_Kd a.png", files={"a.png": b"hello"}), r"its texture \S*a\.png is not an image"),
    "texture odd": (obj("map_Kd a.dds", files={"a.dds": odd_dds()}), r"its texture \S*a\.dds is not an image"),
    "texture is a pointer": (
        obj("map_Kd a.png", files={"a.png": b"version https://git-lfs.github.com/spec/v1\noid"}),
        r"a\.png is a Git LFS pointer, not the file itself; run git lfs pull",
    ),
    "library missing": (obj("", head="mtllib gone.mtl"), r"its material file \S*gone\.mtl is missing"),
    "material undefined": (
        obj(
            "",
            head="mtllib m.mtl\nmtllib n.mtl",
            library="x.mtl",
            files={"m.mtl": b"newmtl c\n", "n.mtl": b"newmtl a\n"},
        ),
        "no material file defines the material 'b', which faces use; there are: c, a",
    ),
    "no texture coordinates": (obj("map_Kd blue.png", vt=False), "have no texture coordinates"),
    "map option": (obj("map_Kd -imfchan"), r"m\.mtl:4: .* the option -imfchan"),
    "map turbulence": (obj("map_Kd -t 1 1 blue.png"), "-t changes the image"),
    "map without a name": (obj("map_Kd -clamp on"), r"m\.mtl:4: 'map_Kd -clamp on' names no image"),
    "Kd of words": (obj("Kd red"), r"m\.mtl:4: 'Kd red' cannot be read"),
    "Kd beyond 1": (obj("Kd 255 0 0"), r"m\.mtl:4: 'Kd 255 0 0' is no colour"),
    "Kd spectral": (obj("Kd spectral a.rfl 1"), r"'Kd spectral a\.rfl 1' is no RGB colour"),
    "colours of some": (obj("", head="", colours=["1 0 0"] * 7 + [""]), "only some of its vertices have colours"),
    "colours of nan": (obj("", head="", colours=["1 0 0"] * 7 + ["nan 0 0"]), "a vertex colour is not a finite number"),
    "glTF colours of nan": (gltf(coloured([[1, 0, np.nan]] * 4)), "a vertex colour is not a finite number"),
    "displacement": (obj("disp a.png"), r"m\.mtl:4: 'disp a\.png' is a displacement map"),
    "invisible": (obj("d 0"), "cannot be seen"),
    "holes": (obj("map_d a.png", files={"a.png": HOLED}), r"'map_d a\.png' cuts holes"),
    "required extension": (
        changed(extensionsRequired=["VENDOR_something"]),
        "requires the extension VENDOR_something, which is not read",
    ),
    "draco": (gltf(draco), "KHR_draco_mesh_compression, which is not read"),
    "instancing": (gltf(instanced), "EXT_mesh_gpu_instancing"),
    "ktx2": (gltf(basisu), "only given as KHR_texture_basisu"),
    "skin": (gltf(lambda g: g.square(node={"skin": 0})), "deformed by a skin"),
    "morph": (gltf(morphed), "deformed by morph targets"),
    "glTF 1": (changed(asset={"version": "1.0"}), "is glTF 1.0, expected glTF 2.0"),
    "mask": (gltf(textured(HOLED, material={"alphaMode": "MASK"})), "cuts holes .alphaMode MASK"),
    "blend": (gltf(textured(HOLED, material={"alphaMode": "BLEND"})), "cuts holes .alphaMode BLEND"),
    "glTF without uv": (gltf(without_uv), "has no TEXCOORD_0"),
    "glTF texture missing": (gltf(textured("gone%20too.png")), r"its texture \S*gone too\.png is missing"),
    "glTF texture cut": (gltf(textured(plain((9, 9, 9))[:-30])), "its texture cannot be decoded: image 1"),
    "glTF texture odd": (gltf(textured(odd_dds())), "its texture image 1 is not an image"),
    "glTF texture empty": (gltf(textured("a.png"), files={"a.png": b""}), r"its texture \S*a\.png is empty"),
    "glTF texture too large": (gltf(large), "its texture image 1 is too large"),
}


@pytest.mark.parametrize(("write", "message"), REFUSED.values(), ids=REFUSED.keys())
def test_what_cannot_be_drawn_is_refused_by_name(tmp_path: Path, write: Any, message: str) -> None:
    with pytest.raises(MeshError, match=message) as caught:
        load_mesh(write(tmp_path))
    assert "\n" not in str(caught.value)


def test_holes_that_a_material_does_not_draw_are_none(tmp_path: Path) -> None:
    load_mesh(gltf(textured(HOLED))(tmp_path))
    load_mesh(gltf(textured(HOLED, material={"alphaMode": "MASK", "alphaCutoff": 0.0}))(tmp_path))


def test_vertex_colours_with_holes_are_refused_where_they_count(tmp_path: Path) -> None:
    def build(made: Gltf) -> None:
        made.square(material=made.base(alphaMode="BLEND"), COLOR_0=made.accessor([[1, 1, 1, 0.0]] * 4))

    with pytest.raises(MeshError, match="cuts holes"):
        load_mesh(gltf(build)(tmp_path))
    load_mesh(gltf(coloured([[1, 1, 1, 0.0]] * 4))(tmp_path))


@pytest.mark.parametrize("suffix", [".3mf", ".zip", ".dae", ".fbx", ".blend", ".step", ".txt", ""])
def test_suffixes_that_are_not_read_are_named_with_those_that_are(tmp_path: Path, suffix: str) -> None:
    file = tmp_path / f"part{suffix}"
    file.write_bytes(b"PK\x03\x04")
    kind = f"a {suffix} file" if suffix else "a file without a suffix"
    with pytest.raises(
        MeshError, match=f"{kind} cannot be read as a mesh; convert it to .ply, .obj, .gltf, .glb, .stl or"
    ):
        load_mesh(file)


@pytest.mark.parametrize("suffix", [".ply", ".obj", ".stl", ".off", ".gltf", ".glb"])
def test_pointers_and_folders_are_named(tmp_path: Path, suffix: str) -> None:
    file = tmp_path / f"part{suffix}"
    file.write_bytes(b"version https://git-lfs.github.com/spec/v1\noid sha256:0\nsize 1\n")
    with pytest.raises(MeshError, match="is a Git LFS pointer, not the file itself; run git lfs pull"):
        load_mesh(file)
    file.unlink()
    file.mkdir()
    with pytest.raises(MeshError, match="is a folder, expected a regular file"):
        load_mesh(file)


def exported(kind: str) -> bytes:
    """A ball as another program writes it."""
    ball = trimesh.creation.icosphere(subdivisions=2, radius=0.04 if kind == "glb" else 40.0)
    data = ball.export(file_type=kind)
    return data if isinstance(data, bytes) else data.encode()


@pytest.mark.parametrize("kind", ["ply", "stl", "stl_ascii", "off", "obj", "glb"])
@pytest.mark.parametrize("fraction", [0.3, 0.62, 0.9, 0.995])
def test_cut_files_are_refused_as_cut(tmp_path: Path, kind: str, fraction: float) -> None:
    """An OBJ that lacks its last few faces alone cannot be told from a whole one."""
    if kind == "obj" and fraction > 0.95:
        pytest.skip("OBJ has no end mark")
    data = exported(kind)
    file = tmp_path / f"ball.{kind.removesuffix('_ascii')}"
    file.write_bytes(data)
    assert len(load_mesh(file).faces) == 320
    file.write_bytes(data[: int(fraction * len(data))])
    with pytest.raises(MeshError, match="cut off"):
        load_mesh(file)


def test_an_obj_may_end_without_a_line_end(tmp_path: Path) -> None:
    (tmp_path / "ball.obj").write_bytes(exported("obj").rstrip())
    assert len(load_mesh(tmp_path / "ball.obj").faces) == 320


def test_meshlabs_counts_give_a_cut_away(tmp_path: Path) -> None:
    lines = ["# Vertices: 3", "# Faces: 2", "v 0 0 0", "v 50 0 0", "v 0 50 0", "f 1 2 3", ""]
    (tmp_path / "a.obj").write_text("\n".join(lines))
    with pytest.raises(MeshError, match="is cut off, it has 1 of 2 faces"):
        load_mesh(tmp_path / "a.obj")


def test_a_cut_buffer_beside_a_gltf_is_refused(tmp_path: Path) -> None:
    file = CASES["gltf plain"].write(tmp_path)
    tree = json.loads(file.read_bytes())
    blob = Gltf().left().blob
    tree["buffers"] = [{"byteLength": len(blob), "uri": "mesh.bin"}]
    file.write_text(json.dumps(tree))
    with pytest.raises(TextureError, match=r"its buffer \S*mesh\.bin is missing"):
        load_mesh(file)
    (tmp_path / "mesh.bin").write_bytes(blob[:100])
    with pytest.raises(MeshError, match=r"its buffer 0 is cut off, it has 100 bytes"):
        load_mesh(file)


def test_a_mesh_without_area_is_refused(tmp_path: Path) -> None:
    (tmp_path / "a.obj").write_text("v 0 0 0\nv 50 0 0\nv 90 0 0\nf 1 2 3\n")
    with pytest.raises(MeshError, match="its faces have no area"):
        load_mesh(tmp_path / "a.obj")


def test_faces_on_each_other_with_different_looks_are_refused(tmp_path: Path) -> None:
    text = obj("map_Kd blue.png")(tmp_path).read_text()
    (tmp_path / "mesh.obj").write_text(text.replace("f 5/5 6/6 7/7 8/8", "f 4/5 3/6 2/7 1/8"))
    with pytest.raises(MeshError, match="two faces lie on each other and have different colours"):
        load_mesh(tmp_path / "mesh.obj")


def test_a_texture_beyond_the_limit_is_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("posecore.mesh_files.images.LARGEST_SIDE_PX", 100)
    wide = cv2.imencode(".png", np.zeros((2, 101, 3), np.uint8))[1].tobytes()
    with pytest.raises(MeshError, match=r"its texture \S*a\.png is too large \(101 x 2 pixels\), expected at most 100"):
        load_mesh(obj("map_Kd a.png", files={"a.png": wide})(tmp_path))
