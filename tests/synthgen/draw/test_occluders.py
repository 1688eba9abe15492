import numpy as np
import pytest
from blender_scenes import box
from posecore.errors import ConfigError
from synthgen.config import OccluderConfig
from synthgen.draw import occluders
from synthgen.draw.poses import target_box
from synthgen.draw.random_streams import Purpose, Subject, stream
from synthgen.draw.target import make_target
from synthgen.inputs.assets import Assets


@pytest.mark.slow
def test_shapes_have_the_asked_sizes_and_repeat():
    config = OccluderConfig(library=12, size_diameter=(0.5, 0.8))
    shapes = occluders.primitive_shapes(config, seed=3, obj_id=1, diameter_m=0.2)
    again = occluders.primitive_shapes(config, seed=3, obj_id=1, diameter_m=0.2)
    assert len(shapes) == 12
    for shape, repeated in zip(shapes, again, strict=True):
        assert 0.1 - 1e-9 <= shape.diameter_m <= 0.16 + 1e-9
        np.testing.assert_allclose(shape.center_m, 0, atol=1e-9)
        np.testing.assert_allclose(np.linalg.norm(shape.normals, axis=1), 1, atol=1e-3)
        assert np.array_equal(shape.vertices_m, repeated.vertices_m)
        assert np.array_equal(shape.vertex_rgb, repeated.vertex_rgb)
    other = occluders.primitive_shapes(config, seed=4, obj_id=1, diameter_m=0.2)
    assert any(a.diameter_m != b.diameter_m for a, b in zip(shapes, other, strict=True))


def test_normals_point_outwards():
    for shape in occluders.primitive_shapes(OccluderConfig(library=6), seed=0, obj_id=1, diameter_m=1.0):
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
        in_front, around = occluders.draw_occluders(rng, config, tug_target.shapes, centre, diameter)
        assert (len(in_front), len(around)) == (front[0], props[0])
        placed = (*in_front, *around)
        for item in placed:
            shape = tug_target.shapes[item.mesh_key]
            position = item.T_cam_obj[:3, :3] @ shape.center_m + item.T_cam_obj[:3, 3]
            assert np.linalg.norm(position - centre) >= (diameter + shape.diameter_m) / 2 - 1e-9
            assert position[2] > shape.diameter_m / 2
            if front[0]:
                assert position[2] < centre[2]


@pytest.mark.slow
def test_front_shapes_hide_part_of_the_object_but_not_too_much(maker_of):
    maker = maker_of("occluders.front=[2, 3]", "occluders.props=[0, 0]", "occluders.min_visible=0.5", "samples=1")
    visible = np.concatenate([maker.samples(i)["visible_fraction"] for i in range(12)])
    assert visible.min() > 0.4  # accepted at a glance of 64 px, measured in the patch
    assert (visible < 0.95).mean() > 0.3


@pytest.mark.slow
def test_the_visible_fraction_is_reached(maker_of):
    maker = maker_of(
        "occluders.visible_fraction=[0.3, 0.9]",
        "occluders.min_visible=0.2",
        "occluders.front=[0, 2]",
        "occluders.props=[0, 0]",
        "view.position_jitter=0.2",
    )
    visible, goals = [], []
    for i in range(60):
        draw, attempt = maker.accepted_scene(i)
        goals.append(stream(0, Purpose.PAIRS, Subject.VISIBILITY, i, attempt).uniform(0.3, 0.9))
        visible.append(maker._visible_fraction(target_box(draw.target, maker.camera, draw.T_cam_obj), draw))
    off = np.abs(np.array(visible) - goals)
    assert np.mean(off <= 0.03) > 0.8  # a thin ring in front may skip the drawn fraction
    counts, _ = np.histogram(visible, bins=4, range=(0.28, 0.92))
    assert counts.min() >= 5


def test_without_front_shapes_nothing_is_moved_in(maker_of):
    maker = maker_of("occluders.visible_fraction=[0.4, 0.5]", "occluders.front=[0, 0]", "occluders.props=[0, 0]")
    assert maker.accepted_scene(0)[0].front == ()


def test_meshes_are_scaled_to_the_object_or_left_alone(tug, config_of):
    clutter = (box(0.4, 0.3, 0.2), box(0.03, 0.03, 0.1), box(5.0, 5.0, 5.0))
    config = config_of("occluders.size_diameter=[0.4, 0.6]")
    target = make_target(1, tug, config, Assets(occluders=clutter))
    assert len(target.shapes) == 3
    for shape, original in zip(target.shapes.values(), clutter, strict=True):
        assert 0.4 <= shape.diameter_m / tug.diameter_m <= 0.6
        assert np.ptp(shape.vertices_m / original.vertices_m) < 1e-9
    unscaled = make_target(7, tug, config_of("occluders.scale=own"), Assets(occluders=clutter))
    assert [s.diameter_m for s in unscaled.shapes.values()] == [s.diameter_m for s in clutter]
    rng = np.random.default_rng(0)
    many = OccluderConfig(front=(20, 20), props=(20, 20))
    front, props = occluders.draw_occluders(rng, many, unscaled.shapes, np.array([0.0, 0.0, 1.0]), tug.diameter_m)
    assert {unscaled.shapes[o.mesh_key].diameter_m for o in (*front, *props)} == {
        clutter[0].diameter_m,
        clutter[1].diameter_m,
    }


def test_a_visible_fraction_below_the_smallest_accepted_is_refused():
    with pytest.raises(ConfigError, match=r"visible_fraction starts at 0\.2, expected at least min_visible"):
        OccluderConfig(visible_fraction=(0.2, 1.0), min_visible=0.4)
