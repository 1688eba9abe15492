"""Each face in the colours of its file, in the rasteriser; synthgen's tests hold Blender's engines against it."""

from pathlib import Path

import numpy as np
import pytest
from mesh_cases import BLUE, CASES, GREY, RED, MeshCase, obj, ply, write_files
from posecore.camera import intrinsics
from posecore.mesh import Mesh, load_mesh, mesh_digest, save_ply
from posecore.mesh_files import atlas
from posecore.raster import Rasteriser, Shading

FLAT = Shading(ambient=1.0, diffuse=0.0)


def middles(mesh: Mesh) -> np.ndarray:
    """Colours in the middle of the two squares, unlit."""
    T = np.diag([1.0, -1.0, -1.0, 1.0])
    T[2, 3] = 0.2
    with Rasteriser({1: mesh}) as raster:
        rgb = raster.render(1, intrinsics(160, 160, 40, 20), T[None], 80, 40, shading=FLAT).rgb
    assert rgb is not None
    return rgb[0][20, [24, 56]].astype(int)


@pytest.mark.parametrize("case", CASES.values(), ids=CASES.keys())
def test_both_squares_have_the_colours_of_their_file(tmp_path: Path, case: MeshCase) -> None:
    mesh = load_mesh(case.write(tmp_path))
    np.testing.assert_allclose(middles(mesh), [case.left, case.right], atol=2)


@pytest.mark.parametrize("name", ["gltf vertex colours times texture", "obj two textures", "obj tiled", "ply faces"])
def test_a_copy_as_ply_shows_the_same_and_has_the_same_digest(tmp_path: Path, name: str) -> None:
    mesh = load_mesh(CASES[name].write(tmp_path))
    save_ply(mesh, tmp_path / "copy.ply")
    copy = load_mesh(tmp_path / "copy.ply")
    assert mesh_digest(copy) == mesh_digest(mesh)
    np.testing.assert_array_equal(middles(copy), middles(mesh))
    assert copy.mip_levels == mesh.mip_levels


@pytest.mark.parametrize("name", ["obj two textures", "obj plain", "obj plain with vt"])
def test_materials_do_not_mix_where_the_object_is_small(tmp_path: Path, name: str) -> None:
    """Eight pixels wide: a pixel of the picture is 16 of a texture wide."""
    mesh = load_mesh(CASES[name].write(tmp_path))
    assert mesh.mip_levels == 2
    T = np.diag([1.0, -1.0, -1.0, 1.0])
    T[2, 3] = 0.8
    with Rasteriser({1: mesh}) as raster:
        drawn = raster.render(1, intrinsics(80, 80, 8, 8), T[None], 16, 16, shading=FLAT)
    rows, columns = np.nonzero(drawn.mask[0])
    assert (columns.min(), columns.max(), len(rows)) == (4, 11, 32)
    expected = np.where(columns[:, None] < 8, CASES[name].left, CASES[name].right)
    np.testing.assert_allclose(drawn.rgb[0][rows, columns].astype(int), expected, atol=2)


def test_a_large_atlas_has_narrow_margins_before_textures_lose_pixels(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    file = CASES["obj two textures"].write(tmp_path)
    monkeypatch.setattr(atlas, "LARGEST_ATLAS_PX", 2 * (64 + 2 * 4))
    mesh = load_mesh(file)
    assert mesh.mip_levels == 1
    assert mesh.texture_rgb is not None and sorted(mesh.texture_rgb.shape) == [3, 72, 144]


def test_a_tiling_keeps_its_pattern_beside_other_textures(tmp_path: Path) -> None:
    """The right square repeats its image three times: red, blue, red, blue, red, blue."""
    mesh = load_mesh(obj("map_Kd half.png", uv=np.array([[0, 0], [3, 0], [3, 3], [0, 3]]))(tmp_path))
    T = np.diag([1.0, -1.0, -1.0, 1.0])
    T[2, 3] = 0.2
    with Rasteriser({1: mesh}) as raster:
        rgb = raster.render(1, intrinsics(960, 960, 0, 96), T[None], 192, 192, shading=FLAT).rgb
    columns = 16 + 32 * np.arange(6)
    np.testing.assert_allclose(rgb[0][96, columns].astype(int), [RED, BLUE] * 3, atol=2)


def test_a_single_texture_stays_as_it_is(tmp_path: Path) -> None:
    """No atlas, whatever the coordinates: other programs share these files."""
    case = ply("float s,float t", np.linspace(-3, 5, 16).reshape(8, 2), head="comment TextureFile half.png")
    mesh = load_mesh(case(tmp_path))
    assert mesh.texture_rgb is not None and mesh.texture_rgb.shape == (64, 64, 3)
    assert mesh.uv is not None and mesh.uv.max() == 5
    assert mesh.mip_levels is None
    assert mesh.vertex_rgb is None


def test_a_texture_stands_for_colours_in_a_ply_as_bop_has_it(tmp_path: Path) -> None:
    columns = [[0.7, 0.5, 0, 0, 0]] * 8
    head = "comment TextureFile half.png"
    mesh = load_mesh(ply("float s,float t,uchar red,uchar green,uchar blue", columns, head=head)(tmp_path))
    np.testing.assert_allclose(middles(mesh), [BLUE, BLUE], atol=2)


def test_materials_without_a_library_are_grey_with_a_warning(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    mesh = load_mesh(obj("", head="")(tmp_path))
    np.testing.assert_array_equal(middles(mesh), [GREY, GREY])
    assert "names the material 'a' and no material file" in caplog.text


def test_a_material_that_no_face_uses_may_lack_its_texture(tmp_path: Path) -> None:
    mesh = load_mesh(obj("Kd 0 0 1\nnewmtl c\nmap_Kd gone.png\ndisp gone.png", vt=False)(tmp_path))
    np.testing.assert_allclose(middles(mesh), [RED, (0, 0, 255)], atol=2)


def test_see_through_surfaces_are_opaque_with_a_warning(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    mesh = load_mesh(obj("Kd 0 0 1\nd 0.5", vt=False)(tmp_path))
    np.testing.assert_allclose(middles(mesh), [RED, (0, 0, 255)], atol=2)
    assert "is see-through and drawn opaque" in caplog.text


def test_allowed_missing_textures_leave_the_plain_colours(tmp_path: Path) -> None:
    write = obj("Kd 0 0 1\nmap_Kd gone.png", head="mtllib m.mtl")
    mesh = load_mesh(write(tmp_path), allow_missing_textures=True)
    np.testing.assert_allclose(middles(mesh), [RED, (0, 0, 255)], atol=2)
    write_files(tmp_path, {"m.mtl": b"newmtl other\n"})
    np.testing.assert_array_equal(middles(load_mesh(tmp_path / "mesh.obj", allow_missing_textures=True)), [GREY, GREY])
