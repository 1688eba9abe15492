import math
from dataclasses import replace

import cv2
import numpy as np
import pytest
from blender_scenes import MATT, at, box, scene_of
from posecore.camera import Camera, back_project, intrinsics
from posecore.se3 import apply, inverse
from posecore.shard import BIT_FOREGROUND, BIT_OBJECT
from synthgen.config import TabletopConfig
from synthgen.draw import scene_draw, tabletop
from synthgen.draw.random_streams import Purpose
from synthgen.draw.target import make_target, make_targets
from synthgen.engines.make import make_engine
from synthgen.inputs.assets import Assets
from synthgen.pairs.data_card import depth_step_m
from synthgen.pairs.pair_maker import PairMaker
from synthgen.scene import Light, Material, SceneObject

TABLETOP = ("scene.kind=tabletop", "tabletop.tables=2", "occluders.front=[0, 0]", "tabletop.distractors=[2, 5]")


def draws(config, target, count=40):
    return [scene_draw.draw_scene(config, [target], Assets(), Purpose.PAIRS, i, 0) for i in range(count)]


def on_table(draw, item):
    """An object's vertices in the table's frame."""
    table, *_ = draw.around
    meshes = {**draw.target.shapes, draw.target.obj_id: draw.target.mesh}
    T = inverse(table.T_cam_obj) @ (draw.T_cam_obj if item is None else item.T_cam_obj)
    return apply(T, meshes[draw.target.obj_id if item is None else item.mesh_key].vertices_m)


@pytest.fixture(scope="module")
def target(tug, config_of):
    return make_target(1, tug, config_of(*TABLETOP))


@pytest.mark.slow
def test_objects_lie_on_the_table_and_touch_it(config_of, target):
    for draw in draws(config_of(*TABLETOP, "tabletop.near_fraction=0"), target):
        half = target.tables[draw.around[0].mesh_key].vertices_m.max(axis=0)
        for item in (None, *draw.around[1:]):
            points = on_table(draw, item)
            assert points[:, 2].min() == pytest.approx(0.0, abs=1e-6)
            middle = (points.min(axis=0) + points.max(axis=0)) / 2
            assert (np.abs(middle[:2]) <= half[:2]).all()
        assert (np.abs(on_table(draw, None)[:, :2]) <= half[:2] + 1e-9).all()


@pytest.mark.slow
def test_nothing_on_the_table_stands_in_something_else(config_of, target):
    count = 0
    for draw in draws(config_of(*TABLETOP), target):
        circles = []
        for item in (None, *draw.around[1:]):
            points = on_table(draw, item)[:, :2]
            middle = (points.min(axis=0) + points.max(axis=0)) / 2
            circles.append((middle, np.linalg.norm(points - middle, axis=1).max()))
        for i, (a, r) in enumerate(circles):
            for b, s in circles[:i]:
                assert np.linalg.norm(a - b) >= r + s - 1e-9
                count += 1
    assert count > 100


@pytest.mark.slow
def test_near_objects_hover_within_their_range_in_any_orientation(config_of, target):
    config = config_of(*TABLETOP, "tabletop.near_fraction=1", "tabletop.hover_diameter=[0.1, 0.4]")
    lowest = [on_table(draw, None)[:, 2].min() / target.mesh.diameter_m for draw in draws(config, target)]
    assert min(lowest) >= 0.1 - 1e-9
    assert max(lowest) <= 0.4 + 1e-9
    assert np.ptp(lowest) > 0.2


@pytest.mark.slow
def test_the_camera_looks_down_within_the_elevations_and_distances(config_of, target):
    config = config_of(*TABLETOP, "tabletop.elevation_deg=[30, 50]", "view.roll_deg=[-10, 10]")
    for draw in draws(config, target):
        up = draw.around[0].T_cam_obj[:3, 2]
        assert 30 - 1e-6 <= math.degrees(math.asin(-up[2])) <= 50 + 1e-6
        assert abs(math.degrees(math.atan2(up[0], -up[1]))) <= 10 + 1e-6
        centre = draw.T_cam_obj[:3, :3] @ target.mesh.center_m + draw.T_cam_obj[:3, 3]
        assert target.distance_m[0] <= centre[2] <= target.distance_m[1]


def test_upright_objects_stand(config_of, target):
    for draw in draws(config_of(*TABLETOP, "view.viewpoint=upright", "tabletop.near_fraction=0"), target, 10):
        T_table_obj = inverse(draw.around[0].T_cam_obj) @ draw.T_cam_obj
        np.testing.assert_allclose(T_table_obj[:3, 2], [0, 0, 1], atol=1e-9)


@pytest.mark.slow
def test_mixed_scenes_have_their_fraction_and_keep_their_kind_when_drawn_again(config_of, target):
    config = config_of(
        *TABLETOP,
        "scene.kind=mixed",
        "scene.tabletop_fraction=0.25",
        "occluders.props=[1, 1]",
        "tabletop.distractors=[0, 0]",
    )
    kinds = []
    for i in range(120):
        first, second = (
            scene_draw.draw_scene(config, [target], Assets(), Purpose.PAIRS, i, attempt) for attempt in (0, 1)
        )
        kinds.append(first.around[0].mesh_key in target.tables)
        assert kinds[-1] == (second.around[0].mesh_key in target.tables)
    assert np.mean(kinds) == pytest.approx(0.25, abs=0.1)


def test_front_occluders_float_above_the_table(config_of, target):
    config = config_of(*TABLETOP, "occluders.front=[3, 3]", "tabletop.elevation_deg=[20, 30]")
    lying = 0
    for draw in draws(config, target, 20):
        assert len(draw.front) == 3
        for item in draw.front:
            lowest = on_table(draw, item)[:, 2].min()
            assert lowest > -1e-9
            lying += int(lowest < 1e-6)
    assert lying, "none had to be lifted"


@pytest.mark.slow
def test_objects_of_about_one_size_share_their_tables_and_scenes_stay_in_the_range_of_depth(config_of, tug):
    config = config_of(*TABLETOP)
    scaled = {i: replace(tug, vertices_m=tug.vertices_m * s) for i, s in ((1, 1.0), (2, 1.1), (3, 4.0))}
    targets = make_targets(scaled, config)
    assert targets[0].tables.keys() == targets[1].tables.keys()
    assert not targets[0].tables.keys() & targets[2].tables.keys()
    assert all(
        np.array_equal(targets[0].tables[k].vertices_m, targets[1].tables[k].vertices_m) for k in targets[0].tables
    )
    for target in targets:
        deepest = 0.0
        for draw in draws(config, target, 30):
            table = draw.around[0]
            corners = apply(table.T_cam_obj, target.tables[table.mesh_key].vertices_m)
            centre = draw.T_cam_obj[:3, :3] @ target.mesh.center_m + draw.T_cam_obj[:3, 3]
            assert np.linalg.norm(corners - centre, axis=1).max() <= target.reach_m
            deepest = max(deepest, corners[:, 2].max())
        assert deepest < 65535 * depth_step_m([target])


@pytest.mark.slow
def test_tables_are_cut_from_photographs_where_there_are_some(tmp_path):

    cv2.imwrite(str(tmp_path / "red.png"), np.full((64, 64, 3), (0, 0, 250), np.uint8))
    tables = tabletop.tables(TabletopConfig(tables=12), 0, 0.1, (str(tmp_path / "red.png"),))
    red = [bool((mesh.texture_rgb == (250, 0, 0)).all()) for mesh in tables.values()]
    assert 2 <= sum(red) <= 10
    drawn = tabletop.tables(TabletopConfig(tables=12), 0, 0.1)
    assert len({mesh.texture_rgb.tobytes() for mesh in drawn.values()}) == 12


@pytest.mark.slow
@pytest.mark.parametrize("elevation", [20, 70])
def test_labels_of_the_table_are_those_of_its_plane(tug, config_of, elevation):
    """Also where the table goes on behind the camera: the near plane cuts it, and nothing else does."""
    range_deg = f"tabletop.elevation_deg=[{elevation}, {elevation}]"
    config = config_of(*TABLETOP, range_deg, "tabletop.size_diameter=[30, 30]", "tabletop.distractors=[0, 0]")
    maker = PairMaker(config, make_targets({1: tug}, config))
    engine, region = make_engine("raster"), (0, 0, maker.camera.width_px, maker.camera.height_px)
    target = maker.targets[0]
    engine.load({1: tug, **target.shapes, **target.tables})
    behind = 0
    for index in range(6):
        draw, _ = maker.accepted_scene(index)
        rendered = engine.render(draw.scene(maker.camera, region, 1))
        table = draw.around[0]
        normal, point = table.T_cam_obj[:3, 2], table.T_cam_obj[:3, 3]
        v, u = np.nonzero(rendered.index == 1)
        assert len(v) > 0.2 * rendered.index.size
        p = back_project(maker.camera.K, np.stack([u, v], -1) + 0.5, rendered.depth_m[v, u])
        np.testing.assert_allclose((p - point) @ normal, 0.0, atol=2e-4 * rendered.depth_m[v, u].max())
        inside = apply(inverse(table.T_cam_obj), p)
        assert (np.abs(inside) <= draw.target.tables[table.mesh_key].vertices_m.max(axis=0) + 2e-3).all()
        corners = apply(table.T_cam_obj, draw.target.tables[table.mesh_key].vertices_m)
        behind += int((corners[:, 2] < 0).any())
    maker.close()
    assert behind


@pytest.mark.blender
@pytest.mark.parametrize("name", ["cycles", pytest.param("eevee", marks=pytest.mark.slow)])
def test_a_box_on_a_table_throws_a_shadow_that_starts_at_its_foot(name):
    """A sun from the left: the table is dark right of the box and lit left of it, up to the contact."""
    plate = tabletop.tables(TabletopConfig(tables=1), 0, 0.1)
    (key,) = plate
    white = Material(base_rgb=(0.9, 0.9, 0.9), roughness=1.0, specular=0.0)
    T_cam_table = at(0.0, 0.0, 0.5, (math.pi / 2 + 0.6, 0.0, 0.0))  # its z is up, towards the camera by 34 degrees
    assert T_cam_table[1, 2] < 0 and T_cam_table[2, 2] < 0
    engine = make_engine(name, threads=1)
    engine.load({1: box(0.06, 0.06, 0.06), **plate})
    T_cam_box = T_cam_table @ at(0.0, 0.0, 0.03)
    right = T_cam_table[:3, 0]
    towards = tuple((-right + 2.0 * T_cam_table[:3, 2]).tolist())
    layers = engine.render(
        scene_of(
            SceneObject(mesh_key=1, T_cam_obj=T_cam_box, material=MATT),
            SceneObject(mesh_key=key, T_cam_obj=T_cam_table, material=white),
            camera=Camera(K=intrinsics(128.0, 128.0, 32.0, 32.0), width_px=64, height_px=64),
            lights=(Light(kind="sun", direction_cam=towards, strength=3.0, size_m=0.05),),
            ambient_rgb=(0.1, 0.1, 0.1),
            samples=8,
        )
    )
    engine.close()

    def at_table(x, y):
        p = apply(T_cam_table, np.array([[x, y, 0.0]]))[0]
        u, v = 128.0 * p[:2] / p[2] + 32.0
        assert layers.index[int(v), int(u)] == 1
        return layers.rgb_linear[int(v), int(u)].mean()

    assert at_table(-0.05, -0.01) > 3 * at_table(0.04, -0.01)
    assert at_table(0.04, -0.01) < 0.4 * at_table(0.09, -0.01)


def test_labels_have_no_gap_between_object_and_table(tug, config_of):
    """Also where the camera's pixels are coarser than the patch's, so that its layers show the object too large."""
    steep = ("tabletop.elevation_deg=[70, 70]", "tabletop.size_diameter=[30, 30]", "tabletop.distractors=[0, 0]")
    far = ("distance.min=20", "distance.max=20", "patch_px=96")
    config = config_of(*TABLETOP, *steep, *far)
    maker = PairMaker(config, make_targets({1: tug}, config))
    assert maker.targets[0].window_side_px < 0.75 * config.patch_px
    for index in range(3):
        values = maker.samples(index, 1)
        silhouette = (values["scene_mask"][0] & BIT_OBJECT) > 0
        ring = (cv2.dilate(silhouette.astype(np.uint8), np.ones((7, 7), np.uint8)) > 0) & ~silhouette
        assert ring.sum() > 100
        assert (values["scene_depth_m"][0][ring] > 0).all()
        assert ((values["scene_mask"][0][ring] & BIT_FOREGROUND) > 0).all()
    maker.close()
