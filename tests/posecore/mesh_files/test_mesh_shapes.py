"""Geometry of mesh files: polygons, doubled faces, stray vertices, normals, transforms, accessors and units."""

import struct
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from mesh_cases import RIGHT_MM, SQUARE, Gltf, gltf
from posecore.errors import MeshError
from posecore.mesh import Mesh, load_mesh, mesh_digest, save_ply

CUBE = np.array([[x, y, z] for x in (-50, 50) for y in (-50, 50) for z in (-50, 50)])
QUADS = np.array([[0, 1, 3, 2], [4, 6, 7, 5], [0, 4, 5, 1], [2, 3, 7, 6], [0, 2, 6, 4], [1, 5, 7, 3]])
"""Of the cube, facing outwards."""
CONCAVE = np.array([[100, 30, 0], [30, 30, 0], [30, 100, 0], [0, 100, 0], [0, 0, 0], [100, 0, 0]])
"""An L of 5 100 mm2, which a fan from its first corner would get wrong."""


def area_mm2(mesh: Mesh) -> float:
    a, b, c = (mesh.vertices_m[mesh.faces[:, i]] for i in range(3))
    return float(np.linalg.norm(np.cross(b - a, c - a), axis=1).sum() / 2 * 1e6)


def face_normals(mesh: Mesh) -> np.ndarray:
    a, b, c = (mesh.vertices_m[mesh.faces[:, i]] for i in range(3))
    normals = np.cross(b - a, c - a)
    return normals / np.linalg.norm(normals, axis=1, keepdims=True)


def text_of(kind: str, vertices: Any, polygons: Any) -> str:
    """A mesh of polygons as text."""
    rows = [" ".join(map(str, vertex)) for vertex in vertices]
    if kind == "obj":
        lines = [f"v {row}" for row in rows] + ["f " + " ".join(str(i + 1) for i in polygon) for polygon in polygons]
        return "\n".join(lines) + "\n"
    lists = [f"{len(polygon)} " + " ".join(map(str, polygon)) for polygon in polygons]
    if kind == "off":
        return "\n".join(["OFF", f"{len(rows)} {len(lists)} 0", *rows, *lists]) + "\n"
    head = ["ply", "format ascii 1.0", f"element vertex {len(rows)}", *(f"property float {axis}" for axis in "xyz")]
    head += [f"element face {len(lists)}", "property list uchar int vertex_indices", "end_header"]
    return "\n".join([*head, *rows, *lists]) + "\n"


def loaded(folder: Path, kind: str, vertices: Any, polygons: Any) -> Mesh:
    (folder / f"mesh.{kind}").write_text(text_of(kind, vertices, polygons))
    return load_mesh(folder / f"mesh.{kind}")


@pytest.mark.parametrize("kind", ["obj", "ply", "off"])
@pytest.mark.parametrize("turn", range(6))
@pytest.mark.parametrize("faces_up", [True, False])
def test_concave_polygons_keep_their_area_and_side(tmp_path: Path, kind: str, turn: int, faces_up: bool) -> None:
    polygon = np.roll(np.arange(6) if not faces_up else np.arange(6)[::-1], turn)
    mesh = loaded(tmp_path, kind, CONCAVE, [polygon.tolist()])
    assert area_mm2(mesh) == pytest.approx(5100)
    sides = face_normals(mesh)[:, 2]
    assert len(sides) == 4
    expected = (
        1.0 if np.cross(CONCAVE[1] - CONCAVE[0], CONCAVE[2] - CONCAVE[1])[2] * (-1 if faces_up else 1) < 0 else -1.0
    )
    np.testing.assert_allclose(sides, expected)


@pytest.mark.parametrize("kind", ["obj", "ply", "off"])
def test_faces_on_others_are_dropped_whichever_way_they_face(tmp_path: Path, kind: str) -> None:
    once = loaded(tmp_path, kind, CUBE, QUADS.tolist())
    twice = loaded(tmp_path, kind, CUBE, [*QUADS.tolist(), *QUADS[:, ::-1].tolist(), QUADS[0].tolist()])
    assert len(once.faces) == 12
    assert {frozenset(face) for face in twice.faces.tolist()} == {frozenset(face) for face in once.faces.tolist()}
    np.testing.assert_array_equal(face_normals(twice).sum(axis=0), [0, 0, 0])
    np.testing.assert_allclose(twice.drawn.normals[twice.drawn.faces][:, 0], face_normals(twice), atol=1e-6)
    apart = loaded(tmp_path, kind, [*CUBE, *CUBE], [*QUADS.tolist(), *(QUADS[:, ::-1] + 8).tolist()])
    assert len(apart.faces) == 12 and len(apart.vertices_m) == 8


def test_doubled_triangles_are_dropped(tmp_path: Path) -> None:
    triangles = [t for a, b, c, d in QUADS.tolist() for t in ([a, b, c], [a, c, d])]
    mesh = loaded(tmp_path, "obj", CUBE, [*triangles, *(t[::-1] for t in triangles)])
    assert len(mesh.faces) == 12 and mesh.is_closed


@pytest.mark.parametrize("kind", ["obj", "ply", "off"])
def test_vertices_without_a_face_count_for_nothing(tmp_path: Path, kind: str) -> None:
    mesh = loaded(tmp_path, kind, [[1000, 0, 0], *CUBE, [0, -2000, 0]], (QUADS + 1).tolist())
    assert mesh.diameter_m == pytest.approx(np.sqrt(3) * 0.1)
    np.testing.assert_allclose(mesh.center_m, 0, atol=1e-12)
    assert len(mesh.vertices_m) == 8


def test_hard_edges_stay_hard_without_normals_and_vertices_stay_as_they_are(tmp_path: Path) -> None:
    mesh = loaded(tmp_path, "ply", CUBE, QUADS.tolist())
    assert len(mesh.vertices_m) == 8 and not mesh.has_normals
    drawn = mesh.drawn
    assert len(drawn.vertices_m) == 24
    corners = drawn.normals[drawn.faces]
    np.testing.assert_allclose(corners, np.repeat(face_normals(drawn)[:, None], 3, axis=1), atol=1e-6)
    np.testing.assert_array_equal(drawn.vertices_m[drawn.faces], mesh.vertices_m[mesh.faces])
    save_ply(mesh, tmp_path / "copy.ply")
    copy = load_mesh(tmp_path / "copy.ply")
    assert not copy.has_normals and len(copy.drawn.vertices_m) == 24
    np.testing.assert_array_equal(copy.faces, mesh.faces)


@pytest.mark.parametrize(("angle_deg", "hard"), [(20, False), (29, False), (31, True), (90, True)])
def test_the_crease_angle_is_30_degrees(tmp_path: Path, angle_deg: float, hard: bool) -> None:
    c, s = 50 * np.cos(np.radians(angle_deg)), 50 * np.sin(np.radians(angle_deg))
    vertices = [[-50, 0, 0], [-50, 50, 0], [0, 0, 0], [0, 50, 0], [c, 0, s], [c, 50, s]]
    mesh = loaded(tmp_path, "obj", vertices, [[0, 2, 3, 1], [2, 4, 5, 3]])
    assert len(mesh.drawn.vertices_m) == (8 if hard else 6)


def test_a_smooth_surface_is_drawn_as_it_is(tmp_path: Path) -> None:
    import trimesh

    ball = trimesh.creation.icosphere(subdivisions=3, radius=50.0)
    ball.export(tmp_path / "ball.off")
    mesh = load_mesh(tmp_path / "ball.off")
    assert mesh.drawn is mesh
    np.testing.assert_allclose(mesh.normals, mesh.vertices_m / 0.05, atol=1e-2)


def test_gltf_without_normals_is_flat_as_it_specifies(tmp_path: Path) -> None:
    def build(made: Gltf) -> None:
        bent = RIGHT_MM + np.array([[0, 0, 0], [0, 0, 0], [0, 0, 4], [0, 0, 0]])
        made.square(bent)

    mesh = load_mesh(gltf(build, left=False)(tmp_path))
    assert len(mesh.vertices_m) == 6
    corners = mesh.drawn.normals[mesh.drawn.faces]
    np.testing.assert_allclose(corners, np.repeat(face_normals(mesh)[:, None], 3, axis=1), atol=1e-6)


def test_nodes_place_parts_and_a_mirroring_keeps_the_outside(tmp_path: Path) -> None:
    half = np.sqrt(0.5)
    node = {"scale": [-1, 1, 1], "rotation": [0, 0, half, half], "translation": [0.1, 0.2, 0.3]}

    def build(made: Gltf) -> None:
        made.square(node=node, NORMAL=made.accessor([[0, 0, 1.0]] * 4))
        made.json["nodes"].append({"children": [0], "translation": [0, 0, 1.0]})
        made.json["scenes"][0]["nodes"] = [1]

    mesh = load_mesh(gltf(build, left=False)(tmp_path))
    x, y, z = RIGHT_MM.T / 1e3
    np.testing.assert_allclose(mesh.vertices_m, np.stack([0.1 - y, 0.2 - x, 1.3 + z], axis=1), atol=1e-8)
    np.testing.assert_allclose(face_normals(mesh)[:, 2], 1.0)
    np.testing.assert_allclose(mesh.normals, [[0, 0, 1]] * 4, atol=1e-7)


def test_hidden_nodes_are_left_out(tmp_path: Path) -> None:
    def build(made: Gltf) -> None:
        made.square()
        made.square(node={"extensions": {"KHR_node_visibility": {"visible": False}}})

    assert len(load_mesh(gltf(build, left=False)(tmp_path)).faces) == 2


@pytest.mark.parametrize("value", [0.0, float("nan")])
def test_normals_that_are_none_are_made(tmp_path: Path, value: float) -> None:
    mesh = loaded(tmp_path, "ply", CUBE, QUADS.tolist())
    text = (tmp_path / "mesh.ply").read_text().replace("element face", "property float nx\nelement face")
    text = text.replace("property float nx\n", "".join(f"property float n{axis}\n" for axis in "xyz"))
    rows = [" ".join(map(str, vertex)) for vertex in CUBE]
    text = text.replace("\n".join(rows), "\n".join(f"{row} {value} {value} {value}" for row in rows))
    (tmp_path / "mesh.ply").write_text(text)
    again = load_mesh(tmp_path / "mesh.ply")
    assert not again.has_normals
    np.testing.assert_array_equal(again.normals, mesh.normals)


def test_strips_fans_and_lists_are_the_same_square(tmp_path: Path) -> None:
    digests = set()
    for mode, order in ((5, [0, 1, 3, 2]), (6, [0, 1, 2, 3]), (4, [0, 1, 2, 0, 2, 3])):

        def build(made: Gltf, mode: int = mode, order: list[int] = order) -> None:
            primitive = made.square()
            primitive["mode"], primitive["indices"] = mode, made.accessor(np.array(order))

        mesh = load_mesh(gltf(build, left=False)(tmp_path))
        assert area_mm2(mesh) == pytest.approx(1600)
        np.testing.assert_allclose(face_normals(mesh)[:, 2], 1.0)
        digests.add(len(mesh.faces))
    assert digests == {2}


def test_points_and_lines_beside_a_surface_are_left_out(tmp_path: Path) -> None:
    def build(made: Gltf) -> None:
        made.square()
        made.square()["mode"] = 1

    assert len(load_mesh(gltf(build, left=False)(tmp_path)).faces) == 2
    with pytest.raises(MeshError, match="no faces"):
        load_mesh(gltf(lambda made: made.square().update(mode=0), left=False)(tmp_path))


@pytest.mark.parametrize("based", [True, False])
def test_sparse_accessors_are_honoured(tmp_path: Path, based: bool) -> None:
    def build(made: Gltf) -> None:
        primitive = made.square(np.zeros((4, 3)))
        entry = made.json["accessors"][primitive["attributes"]["POSITION"]]
        if not based:
            entry.pop("bufferView")
        entry["sparse"] = {
            "count": 4,
            "indices": {"bufferView": made.view(np.arange(4, dtype="<u2").tobytes()), "componentType": 5123},
            "values": {"bufferView": made.view((RIGHT_MM / 1e3).astype("<f4").tobytes())},
        }

    mesh = load_mesh(gltf(build, left=False)(tmp_path))
    np.testing.assert_allclose(mesh.vertices_m[mesh.faces], (RIGHT_MM / 1e3)[SQUARE], atol=1e-7)


def test_quantised_and_interleaved_positions_are_honoured(tmp_path: Path) -> None:
    def build(made: Gltf) -> None:
        primitive = made.square(node={"scale": [0.1, 0.1, 0.1]})
        rows = np.zeros((4, 8), "<i2")
        rows[:, :3] = np.rint(RIGHT_MM / 100 * 32767)
        entry = made.json["accessors"][primitive["attributes"]["POSITION"]]
        entry |= {"bufferView": made.view(rows.tobytes(), byteStride=16), "componentType": 5122, "normalized": True}
        made.json["extensionsRequired"] = ["KHR_mesh_quantization"]

    mesh = load_mesh(gltf(build, left=False)(tmp_path))
    np.testing.assert_allclose(mesh.vertices_m[mesh.faces], (RIGHT_MM / 1e3)[SQUARE], atol=2e-6)


def test_gltf_is_in_metres_whatever_the_units(tmp_path: Path) -> None:
    file = gltf(lambda made: made.square())(tmp_path)
    for units in ("mm", "cm", "m"):
        assert load_mesh(file, units=units).diameter_m == pytest.approx(np.hypot(0.08, 0.04))
    huge = gltf(lambda made: made.square(RIGHT_MM * 1000))(tmp_path)
    with pytest.raises(MeshError, match=r"when read in m, expected 2 mm to 10 m; check the mesh's scale"):
        load_mesh(huge)


@pytest.mark.parametrize("order", ["little", "big"])
def test_binary_ply_of_several_polygon_sizes(tmp_path: Path, order: str) -> None:
    sign = "<" if order == "little" else ">"
    polygons = [*QUADS[1:].tolist(), QUADS[0, :3].tolist(), QUADS[0, [0, 2, 3]].tolist()]
    head = f"ply\nformat binary_{order}_endian 1.0\nelement vertex 8\n"
    head += "property float x\nproperty float y\nproperty float z\n"
    head += "property uchar red\nproperty uchar green\nproperty uchar blue\n"
    head += f"element face {len(polygons)}\nproperty list uchar int vertex_indices\nproperty uchar flag\nend_header\n"
    body = b"".join(struct.pack(f"{sign}3f3B", *vertex, 1, 2, 3) for vertex in CUBE)
    body += b"".join(struct.pack(f"{sign}B{len(p)}iB", len(p), *p, 7) for p in polygons)
    file = tmp_path / "mesh.ply"
    file.write_bytes(head.encode() + body)
    mesh = load_mesh(file)
    assert mesh.is_closed and len(mesh.faces) == 12
    np.testing.assert_array_equal(mesh.vertex_rgb, [[1, 2, 3]] * 8)
    file.write_bytes(head.encode() + body[:-7])
    with pytest.raises(MeshError, match="is cut off, it has 6 of 7 rows of 'face'"):
        load_mesh(file)


def test_obj_spellings_give_one_mesh(tmp_path: Path) -> None:
    """Relative indices, tabs, continued lines, comments, blanks, CR LF: all are the same cube."""
    plain = text_of("obj", CUBE, QUADS.tolist())
    reference = loaded(tmp_path, "obj", CUBE, QUADS.tolist())
    faces = [line for line in plain.splitlines() if line.startswith("f")]
    relative = ["f " + " ".join(str(int(word) - 9) for word in face.split()[1:]) for face in faces]
    spellings = {
        "relative": plain.replace("\n".join(faces), "\n".join(relative)),
        "tabs": plain.replace(" ", "\t"),
        "indented": "\n".join(f"   {line}  " for line in plain.splitlines()) + "\n",
        "continued": plain.replace("f 1 2", "f 1 2\\\n"),
        "comments": "\n".join(f"{line} # comment {i}" for i, line in enumerate(plain.splitlines())) + "\n",
        "windows": plain.replace("\n", "\r\n"),
        "mac": plain.replace("\n", "\r"),
        "mark": "\ufeff" + plain,
    }
    for name, text in spellings.items():
        (tmp_path / "other.obj").write_bytes(text.encode())
        other = load_mesh(tmp_path / "other.obj")
        assert mesh_digest(other) == mesh_digest(reference), name


def test_a_face_with_a_corner_that_is_not_there_is_named(tmp_path: Path) -> None:
    for kind in ("obj", "ply", "off"):
        with pytest.raises(MeshError, match=r"cannot be read as a mesh|names the vertices"):
            loaded(tmp_path, kind, CUBE, [*QUADS.tolist(), [0, 1, 99]])
