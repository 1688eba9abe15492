import numpy as np
import pytest
from blender_scenes import box, quad
from posecore.mesh import Mesh
from scipy.spatial import ConvexHull
from synthgen.config import OccluderConfig
from synthgen.draw import occluders
from synthgen.draw.resting_pose import find_stable_poses


def test_a_cube_rests_on_each_face_equally_often():
    rest = find_stable_poses(box(0.1, 0.1, 0.1))
    assert sorted(map(tuple, rest.down.round(6).tolist())) == sorted(
        (float(s * (a == 0)), float(s * (a == 1)), float(s * (a == 2))) for a in range(3) for s in (-1, 1)
    )
    np.testing.assert_allclose(rest.weights, 1 / 6, atol=0.01)


def test_a_tall_box_seldom_stands_and_a_flat_one_seldom_leans():
    tall = find_stable_poses(box(0.02, 0.03, 0.2))
    on_end = tall.weights[np.abs(tall.down[:, 2]) > 0.99].sum()
    assert 0 < on_end < 0.02
    plate = find_stable_poses(box(0.2, 0.2, 0.01))
    assert plate.weights[np.abs(plate.down[:, 2]) > 0.99].sum() > 0.9


def test_every_resting_pose_of_the_example_is_stable_and_the_weights_are_a_distribution(tug):
    rest = find_stable_poses(tug)
    assert rest.weights.sum() == pytest.approx(1.0)
    np.testing.assert_allclose(np.linalg.norm(rest.down, axis=1), 1.0)
    volume = ConvexHull(tug.vertices_m)
    middle = tug.vertices_m[volume.vertices].mean(axis=0)
    for down, weight in zip(rest.down, rest.weights, strict=True):
        if weight < 0.05:
            continue
        height = rest.hull_m @ down
        support = rest.hull_m[height > height.max() - 1e-4 * tug.diameter_m]
        assert len(support) >= 3, "it stands on fewer than three points"
        # the middle, a little off the centre of mass, hangs over what it stands on or near it
        off = support.mean(axis=0) - middle
        assert np.linalg.norm(off - (off @ down) * down) < 0.35 * tug.diameter_m
    again = find_stable_poses(tug)
    assert np.array_equal(rest.down, again.down)
    assert np.array_equal(rest.weights, again.weights)


def test_a_cone_does_not_stand_on_its_tip_nor_a_torus_on_its_rim():
    shapes = occluders.primitive_shapes(OccluderConfig(library=6), seed=0, obj_id=1, diameter_m=1.0)
    cone, torus = find_stable_poses(shapes[3]), find_stable_poses(shapes[4])
    tip = shapes[3].vertices_m[np.linalg.norm(shapes[3].vertices_m[:, :2], axis=1).argmin()]
    assert (cone.down @ (tip / np.linalg.norm(tip)) < 0.99).all()
    assert torus.weights[np.abs(torus.down[:, 2]) > 0.999].sum() > 0.99


def test_an_object_without_volume_rests_on_its_sides():
    rest = find_stable_poses(quad())
    np.testing.assert_allclose(np.abs(rest.down[:, 2]), 1.0)
    assert len(rest.down) == 2


def test_the_centre_of_mass_is_the_meshs_own_where_it_is_closed():
    """A heavy head on a thin board: its hull is a wedge, whose centre lies elsewhere."""
    head, board = box(0.1, 0.1, 0.1), box(0.4, 0.1, 0.004)
    board_vertices = board.vertices_m + np.array([0.25, 0.0, -0.048])
    mesh = Mesh(
        vertices_m=np.concatenate([head.vertices_m, board_vertices]),
        faces=np.concatenate([head.faces, board.faces + len(head.vertices_m)]),
        normals=np.concatenate([head.normals, board.normals]),
    )
    assert mesh.is_closed
    shell = Mesh(vertices_m=mesh.vertices_m, faces=mesh.faces[:-1], normals=mesh.normals)
    assert not shell.is_closed
    up_end = lambda rest: rest.weights[rest.down[:, 0] < -0.99].sum()  # noqa: E731
    assert up_end(find_stable_poses(mesh)) > 2 * up_end(find_stable_poses(shell))
