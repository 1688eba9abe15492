import numpy as np
import pytest
from synthgen import occluders
from synthgen.config import OccluderConfig
from synthgen.streams import Purpose, Subject, stream


def test_shapes_have_the_asked_sizes_and_repeat():
    config = OccluderConfig(library=12, size_diameter=(0.5, 0.8))
    shapes = occluders.library(config, seed=3, obj_id=1, diameter_m=0.2)
    again = occluders.library(config, seed=3, obj_id=1, diameter_m=0.2)
    assert len(shapes) == 12
    for shape, twin in zip(shapes, again, strict=True):
        assert 0.1 - 1e-9 <= shape.diameter_m <= 0.16 + 1e-9
        np.testing.assert_allclose(shape.center_m, 0, atol=1e-9)
        np.testing.assert_allclose(np.linalg.norm(shape.normals, axis=1), 1, atol=1e-3)
        assert np.array_equal(shape.vertices_m, twin.vertices_m)
        assert np.array_equal(shape.vertex_rgb, twin.vertex_rgb)
    other = occluders.library(config, seed=4, obj_id=1, diameter_m=0.2)
    assert any(a.diameter_m != b.diameter_m for a, b in zip(shapes, other, strict=True))


def test_normals_point_outwards():
    for shape in occluders.library(OccluderConfig(library=6), seed=0, obj_id=1, diameter_m=1.0):
        corners = shape.vertices_m[shape.faces]
        face_normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
        vertex_normals = shape.normals[shape.faces].mean(axis=1)
        area = np.linalg.norm(face_normals, axis=1)
        assert (np.einsum("ij,ij->i", face_normals, vertex_normals) >= -1e-6 * area).all()
        volume = np.einsum("ij,ij->i", corners[:, 0], np.cross(corners[:, 1], corners[:, 2])).sum() / 6
        assert volume > 0


@pytest.mark.parametrize(("front", "props"), [((3, 3), (0, 0)), ((0, 0), (3, 3))])
def test_shapes_stand_where_they_should_and_touch_nothing(tug_target, front, props):
    config = OccluderConfig(front=front, props=props)
    centre, diameter = np.array([0.05, -0.02, 0.8]), tug_target.mesh.diameter_m
    for i in range(60):
        rng = stream(0, Purpose.PAIRS, Subject.OCCLUDERS, i)
        placed = occluders.place(rng, config, tug_target.shapes, centre, diameter)
        assert len(placed) == 3
        for item in placed:
            shape = tug_target.shapes[item.mesh_key]
            position = item.T_cam_obj[:3, :3] @ shape.center_m + item.T_cam_obj[:3, 3]
            assert np.linalg.norm(position - centre) >= (diameter + shape.diameter_m) / 2 - 1e-9
            assert position[2] > shape.diameter_m / 2
            if front[0]:
                assert position[2] < centre[2]


def test_front_shapes_hide_part_of_the_object_but_not_too_much(maker_of):
    maker = maker_of("occluders.front=[2, 3]", "occluders.props=[0, 0]", "occluders.min_visible=0.5", "samples=1")
    visible = np.concatenate([maker.samples(i)["visible_fraction"] for i in range(12)])
    assert visible.min() > 0.4  # accepted at a glance of 64 px, measured in the patch
    assert (visible < 0.95).mean() > 0.3
