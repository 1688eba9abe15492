"""Mesh files: formats, units, diameters and every kind of bad input."""

import json
from pathlib import Path

import cv2
import numpy as np
import pytest
import trimesh
from posecore import se3
from posecore.errors import MeshError
from posecore.mesh import Mesh, load_mesh, save_ply


def write_box(path: Path, extents: tuple[float, float, float] = (60, 40, 30)) -> Path:
    box = trimesh.creation.box(extents)
    box.visual.vertex_colors = np.tile([10, 200, 30, 255], (len(box.vertices), 1))
    box.export(path)
    return path


def test_ply_in_mm_with_vertex_colours(tmp_path: Path) -> None:
    mesh = load_mesh(write_box(tmp_path / "box.ply"))
    assert mesh.diameter_m == pytest.approx(np.sqrt(60**2 + 40**2 + 30**2) * 1e-3)
    assert mesh.vertex_rgb is not None
    np.testing.assert_array_equal(mesh.vertex_rgb[0], [10, 200, 30])
    np.testing.assert_allclose(mesh.center_m, 0, atol=1e-9)


def test_textured_obj_and_gltf(shared_data: Path) -> None:
    bottle = load_mesh(shared_data / "meshes/fuze/fuze.obj", units="m")
    assert bottle.texture_rgb is not None and bottle.uv is not None
    assert bottle.texture_rgb.shape == (1024, 1024, 3)
    bowl = load_mesh(shared_data / "meshes/evo_bowl/evo_bowl.gltf", units="m")
    assert bowl.diameter_m == pytest.approx(0.1469, abs=1e-3)
    assert bowl.vertex_rgb is not None


def test_saved_ply_loads_the_same(tmp_path: Path) -> None:
    mesh = load_mesh(write_box(tmp_path / "box.ply"))
    save_ply(mesh, tmp_path / "copy.ply")
    again = load_mesh(tmp_path / "copy.ply")
    np.testing.assert_allclose(again.vertices_m, mesh.vertices_m, atol=1e-9)
    np.testing.assert_array_equal(again.faces, mesh.faces)
    np.testing.assert_array_equal(again.colours, mesh.colours)
    np.testing.assert_allclose(again.normals, mesh.normals, atol=1e-6)


def test_a_saved_texture_lies_beside_the_ply_and_loads_again(tmp_path: Path) -> None:
    rng = np.random.default_rng(0)
    corners = rng.normal(size=(12, 3)) * 0.05
    mesh = Mesh(
        vertices_m=corners,
        faces=np.arange(12, dtype=np.int32).reshape(4, 3),
        normals=np.tile(np.array([0, 0, 1], np.float32), (12, 1)),
        uv=rng.random((12, 2)).astype(np.float32),
        texture_rgb=rng.integers(0, 256, (16, 24, 3), np.uint8),
    )
    save_ply(mesh, tmp_path / "copy.ply")
    copy = load_mesh(tmp_path / "copy.ply")
    assert copy.uv is not None and copy.texture_rgb is not None and mesh.texture_rgb is not None
    np.testing.assert_array_equal(copy.texture_rgb, mesh.texture_rgb)
    np.testing.assert_array_equal(copy.uv, mesh.uv)
    (tmp_path / "copy.png").unlink()
    with pytest.raises(MeshError, match=r"its texture .*copy\.png is missing"):
        load_mesh(tmp_path / "copy.ply")


@pytest.mark.slow
def test_normals_have_length_1_whatever_the_file_holds(shared_data: Path) -> None:
    cup = load_mesh(shared_data / "meshes/cup/cup.ply")  # its normals are 6.3 long
    np.testing.assert_allclose(np.linalg.norm(cup.normals, axis=1), 1, atol=1e-6)


def write_obj(folder: Path, texture: bytes | None) -> Path:
    """Two triangles that share an edge, which is a texture seam: left half and right half of the image."""
    (folder / "a.obj").write_text(
        "mtllib a.mtl\nv 0 0 0\nv 50 0 0\nv 0 50 9\nv 50 50 9\n"
        "vt 0 0\nvt 0.4 0\nvt 0.4 1\nvt 0.6 0\nvt 0.6 1\nvt 1 1\nusemtl m\nf 1/1 2/2 3/3\nf 2/4 4/6 3/5\n"
    )
    (folder / "a.mtl").write_text("newmtl m\nmap_Kd skin.png\n")
    if texture is not None:
        (folder / "skin.png").write_bytes(texture)
    return folder / "a.obj"


def test_a_texture_seam_does_not_smear(tmp_path: Path) -> None:
    mesh = load_mesh(write_obj(tmp_path, cv2.imencode(".png", np.zeros((8, 8, 3), np.uint8))[1].tobytes()))
    assert mesh.uv is not None
    left, right = mesh.uv[mesh.faces][..., 0]
    assert left.max() < 0.5 < right.min()


def test_metres_read_as_mm_are_refused_with_the_hint(tmp_path: Path) -> None:
    file = write_box(tmp_path / "box.ply", (0.06, 0.04, 0.03))
    with pytest.raises(
        MeshError, match=r"box.ply: the diameter is 0.0781.* mm when read in mm.*--units m \(78.1 mm\)\?"
    ):
        load_mesh(file)
    assert load_mesh(file, units="m").diameter_m == pytest.approx(0.0781, abs=1e-4)


def test_mm_read_as_metres_are_refused_with_the_hint(tmp_path: Path) -> None:
    with pytest.raises(MeshError, match=r"--units (cm|mm)"):
        load_mesh(write_box(tmp_path / "box.ply"), units="m")


@pytest.mark.parametrize(
    ("name", "content", "message"),
    [
        ("gone.ply", None, "no such mesh file"),
        ("empty.ply", b"", "empty"),
        ("noise.ply", b"\x00\x01garbage", "cannot be read as a mesh"),
        ("mesh.xyz123", b"hello", "cannot be read as a mesh"),
        (
            "points.ply",
            b"ply\nformat ascii 1.0\nelement vertex 2\nproperty float x\nproperty float y\nproperty float z\n"
            b"end_header\n0 0 0\n1 1 1\n",
            "no faces",
        ),
        (
            "nan.ply",
            b"ply\nformat ascii 1.0\nelement vertex 3\nproperty float x\nproperty float y\nproperty float z\n"
            b"element face 1\nproperty list uchar int vertex_indices\nend_header\n0 0 0\nnan 1 1\n0 50 0\n3 0 1 2\n",
            "vertex 1 is",
        ),
        (
            "torn.ply",
            b"ply\nformat ascii 1.0\nelement vertex 3\nproperty float x\nproperty float y\nproperty float z\n"
            b"element face 1\nproperty list uchar int vertex_indices\nend_header\n0 0 0\n50 1 1\n0 50 0\n3 0 1 7\n",
            r"face 0 names the vertices \[0, 1, 7\], expected 0 to 2",
        ),
    ],
)
def test_bad_files_give_one_line_that_names_them(
    tmp_path: Path, name: str, content: bytes | None, message: str
) -> None:
    file = tmp_path / name
    if content is not None:
        file.write_bytes(content)
    with pytest.raises(MeshError, match=message) as caught:
        load_mesh(file)
    assert name in str(caught.value) and "\n" not in str(caught.value)


def test_a_missing_texture_is_an_error_not_grey(tmp_path: Path) -> None:
    write_obj(tmp_path, None)
    with pytest.raises(MeshError, match=r"texture .*skin.png is missing"):
        load_mesh(tmp_path / "a.obj")
    (tmp_path / "a.mtl").unlink()
    with pytest.raises(MeshError, match=r"material file .*a.mtl is missing"):
        load_mesh(tmp_path / "a.obj")


def test_a_texture_that_is_no_image_is_an_error_not_grey(tmp_path: Path) -> None:
    with pytest.raises(MeshError, match=r"texture .*skin.png is not an image"):
        load_mesh(write_obj(tmp_path, b"no picture"))
    noise = np.random.default_rng(0).integers(0, 255, (64, 64, 3), np.uint8)
    whole = cv2.imencode(".png", noise)[1].tobytes()
    with pytest.raises(MeshError, match=r"a.obj: its texture cannot be decoded"):
        load_mesh(write_obj(tmp_path, whole[: len(whole) // 2]))


@pytest.mark.parametrize("texture", [None, b"nothing", b"\x89PNG\r\n\x1a\nand then nothing"])
def test_a_bad_texture_is_passed_over_when_told_to(tmp_path: Path, texture: bytes | None) -> None:
    mesh = load_mesh(write_obj(tmp_path, texture), allow_missing_textures=True)
    assert mesh.texture_rgb is None
    assert len(mesh.colours) == len(mesh.vertices_m)


def test_a_missing_gltf_texture_is_an_error_not_grey(shared_data: Path, tmp_path: Path) -> None:
    bowl = shared_data / "meshes/evo_bowl"
    (tmp_path / "evo_bowl.bin").write_bytes((bowl / "evo_bowl.bin").read_bytes())
    content = json.loads((bowl / "evo_bowl.gltf").read_text()) | {
        "images": [{"uri": "a%20skin.png"}],
        "textures": [{"source": 0}],
    }
    content["materials"][0]["pbrMetallicRoughness"]["baseColorTexture"] = {"index": 0}
    (tmp_path / "bowl.gltf").write_text(json.dumps(content))
    with pytest.raises(MeshError, match=r"texture .*a skin.png is missing"):
        load_mesh(tmp_path / "bowl.gltf", units="m")


def test_the_box_centre_in_the_camera_is_that_of_each_pose(tmp_path: Path) -> None:
    cube = load_mesh(write_box(tmp_path / "box.ply"))
    rng = np.random.default_rng(0)
    T = np.stack([se3.make_T(se3.random_rotation(rng), rng.normal(size=3)) for _ in range(6)]).reshape(2, 3, 4, 4)
    found = cube.center_cam_m(T)
    assert found.shape == (2, 3, 3)
    np.testing.assert_allclose(found, se3.apply(T, cube.center_m[None])[..., 0, :], atol=1e-12)
    np.testing.assert_array_equal(cube.center_cam_m(T[1, 2]), T[1, 2, :3, :3] @ cube.center_m + T[1, 2, :3, 3])


def test_the_centre_is_that_of_the_vertices_that_faces_use(tmp_path: Path) -> None:
    mesh = load_mesh(write_box(tmp_path / "box.ply"))
    stray = np.vstack([mesh.vertices_m, [[0.4, 0.0, 0.0]]])
    with_stray = Mesh(vertices_m=stray, faces=mesh.faces, normals=np.vstack([mesh.normals, [[0, 0, 1]]]))
    np.testing.assert_allclose(with_stray.center_m, mesh.center_m, atol=1e-12)
    moved = mesh.with_origin_at(np.array([2.0, -1.0, 0.5]))
    np.testing.assert_allclose(moved.center_m, mesh.center_m - [2.0, -1.0, 0.5], atol=1e-12)
    assert moved.diameter_m == pytest.approx(mesh.diameter_m, rel=1e-12)
