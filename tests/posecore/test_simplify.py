"""Meshes with fewer faces look the same in small pictures."""

from dataclasses import replace

import numpy as np
import pytest
from posecore import se3
from posecore.detail import with_levels
from posecore.mesh import Mesh
from posecore.raster import Rasteriser
from posecore.simplify import simplified


@pytest.fixture(scope="module")
def dense():
    """A bumpy ball of 20 480 faces, 100 mm wide, colours running over it."""
    import trimesh

    ball = trimesh.creation.icosphere(subdivisions=5)
    unit = np.asarray(ball.vertices)
    radius_m = 0.05 * (1 + 0.15 * np.sin(3 * unit[:, 0] + 1) * np.cos(4 * unit[:, 1]))
    return Mesh(
        vertices_m=unit * radius_m[:, None],
        faces=np.asarray(ball.faces, np.int32),
        normals=unit.astype(np.float32),
        vertex_rgb=(127 + 100 * np.sin(2 * unit)).astype(np.uint8),
    )


@pytest.mark.parametrize("soup", [False, True], ids=["shared vertices", "three vertices a face, as in STL files"])
def test_a_mesh_with_fewer_faces_looks_the_same(dense, soup):
    if soup:
        corners = dense.faces.reshape(-1)
        dense = replace(
            dense,
            vertices_m=dense.vertices_m[corners],
            faces=np.arange(len(corners), dtype=np.int32).reshape(-1, 3),
            normals=dense.normals[corners],
            vertex_rgb=dense.vertex_rgb[corners],
        )
    few, side_px = simplified(dense, 64**2), 64
    assert len(few.faces) <= 1.01 * 64**2
    assert few.is_closed
    assert few.diameter_m == pytest.approx(dense.diameter_m, rel=0.01)
    f = side_px / 1.5 / dense.diameter_m
    K = np.array([[f, 0, side_px / 2], [0, f, side_px / 2], [0, 0, 1]])
    rng = np.random.default_rng(0)
    T = np.stack([se3.perturb(se3.make_T(np.eye(3), np.array([0, 0, 1.0])), 3.0, 0.0, rng) for _ in range(8)])
    with Rasteriser({1: dense, 2: few}) as rasteriser:
        full, less = (rasteriser.render(i, K, T, side_px, side_px) for i in (1, 2))
    differ = (full.mask != less.mask).sum(axis=(1, 2))
    assert (differ < 0.1 * np.pi * side_px / 1.5).all()  # under a tenth of a pixel of the outline
    both = full.mask & less.mask
    assert np.abs(full.rgb[both].astype(int) - less.rgb[both]).mean() < 3
    assert np.abs(full.depth_m[both] - less.depth_m[both]).mean() < 2e-4


def test_small_and_textured_meshes_stay_as_they_are(dense):
    assert simplified(dense, len(dense.faces)) is dense
    uv, texture = np.zeros((len(dense.vertices_m), 2), np.float32), np.zeros((2, 2, 3), np.uint8)
    textured = replace(dense, vertex_rgb=None, uv=uv, texture_rgb=texture)
    assert simplified(textured, 100) is textured


def test_a_mesh_without_colours_has_none_afterwards(dense):
    assert simplified(replace(dense, vertex_rgb=None), 1000).vertex_rgb is None


def test_a_mesh_and_its_copy_with_another_origin_are_simplified_alike(dense):
    exact = replace(dense, vertices_m=np.round(dense.vertices_m * 2**30) / 2**30)
    shift_m = np.array([2.0, -1.0, 0.5])
    plain, other = simplified(exact, 1000), simplified(exact.with_origin_at(-shift_m), 1000)
    np.testing.assert_allclose(other.vertices_m - shift_m, plain.vertices_m, rtol=0, atol=1e-15)
    np.testing.assert_array_equal(other.faces, plain.faces)
    np.testing.assert_array_equal(other.vertex_rgb, plain.vertex_rgb)


def test_a_simplified_mesh_has_no_levels_of_the_original(dense):
    mesh = with_levels(dense)
    assert mesh.levels
    assert simplified(mesh, 500).levels == ()
