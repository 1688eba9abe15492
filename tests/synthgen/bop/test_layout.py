import math

import numpy as np
import pytest
from posecore import se3
from posecore.camera import project
from posecore.mesh import load_mesh
from synthgen.bop.layout import BoundingSpheres, clearance_m, draw_camera, draw_layout
from synthgen.draw import scene_draw
from synthgen.draw.appearance import draw_ceiling_lights
from synthgen.draw.poses import level_rotation
from synthgen.draw.random_streams import Purpose
from synthgen.draw.target import make_targets
from synthgen.inputs.assets import Assets


@pytest.fixture(scope="module")
def meshes(tug, bobbin_ply):
    return {1: tug, 4: load_mesh(bobbin_ply)}


@pytest.fixture(scope="module")
def layouts(config_of, meshes):
    """Makes some layouts of a configuration."""

    def make(*overrides, together=False, count=8):
        config = config_of("frames.objects=[4, 6]", "frames.instances=3", "tabletop.tables=2", *overrides)
        targets = make_targets(meshes, config)
        made = []
        for i in range(count):
            base = scene_draw.draw_scene(config, targets, Assets(), Purpose.FRAMES, i, 0)
            made.append((base, draw_layout(config, targets, base, together=together)))
        return config, {t.obj_id: t for t in targets}, made

    return make


@pytest.mark.parametrize("together", [False, True])
def test_floating_objects_keep_apart(layouts, together):
    _, targets, made = layouts(together=together)
    several = 0
    for base, layout in made:
        shapes = base.target.shapes
        spheres = BoundingSpheres({**{i: t.mesh for i, t in targets.items()}, **shapes})
        for i, placed in enumerate(layout.labelled[1:], 1):
            centre, radius = spheres.sphere(placed)
            for other in (*layout.labelled[:i], *layout.others):
                c, r = spheres.sphere(other)
                assert np.linalg.norm(centre - c) >= radius + r
        ids = [o.mesh_key for o in layout.labelled]
        assert max(ids.count(1), ids.count(4)) <= 3
        several += len(ids) >= 4
    assert several >= 6


@pytest.mark.slow
def test_objects_on_a_table_stand_on_it_beside_each_other(layouts):
    _, targets, made = layouts(
        "scene.kind=tabletop",
        "occluders.front=[0, 0]",
        "tabletop.near_fraction=0",
        "tabletop.size_diameter=[10, 12]",
        "tabletop.distractors=[1, 3]",
    )
    for base, layout in made:
        assert layout.on_table and len(layout.labelled) >= 4
        T = se3.inverse(layout.T_ref_level)
        meshes = {**{i: t.mesh for i, t in targets.items()}, **base.target.shapes}
        circles = []
        for placed in (*layout.labelled, *layout.others[1:]):
            points = se3.apply(T @ placed.T_cam_obj, meshes[placed.mesh_key].vertices_m)
            assert abs(points[:, 2].min()) < 1e-6
            middle = (points[:, :2].min(axis=0) + points[:, :2].max(axis=0)) / 2
            circles.append((middle, np.linalg.norm(points[:, :2] - middle, axis=1).max()))
        for i, (a, r) in enumerate(circles):
            for b, s in circles[:i]:
                assert np.linalg.norm(a - b) >= r + s - 1e-6


def test_one_object_is_a_pairs_scene(layouts):
    _, _, made = layouts("frames.objects=[1, 1]")
    for base, layout in made:
        (only,) = layout.labelled
        assert np.array_equal(only.T_cam_obj, base.T_cam_obj)
        assert (layout.others, layout.lights, layout.background) == (base.others, base.lights, base.background)


@pytest.mark.slow
def test_cameras_are_aimed_at_an_object_from_its_distances(layouts):
    config, targets, made = layouts("scene.kind=tabletop", "tabletop.elevation_deg=[30, 50]", together=True)
    camera, rng = config.camera.camera(), np.random.default_rng(0)
    for _, layout in made:
        number, T = draw_camera(rng, config, targets, layout)
        aim = layout.labelled[number]
        target = targets[aim.mesh_key]
        centre = se3.apply(T @ aim.T_cam_obj, target.mesh.center_m[None])
        assert target.distance_m[0] <= centre[0, 2] <= target.distance_m[1]
        u, v = project(camera.K, centre)[0]
        assert abs(u - 320) <= 0.6 * 320 + 1e-6 and abs(v - 240) <= 0.6 * 240 + 1e-6
        # the camera's axis in the table's frame: elevation 30 to 50 degrees, looking down
        down = (T @ layout.T_ref_level)[:3, :3].T @ np.array([0.0, 0.0, 1.0])
        assert -math.sin(math.radians(50)) - 1e-9 <= down[2] <= -math.sin(math.radians(30)) + 1e-9


def test_a_level_camera_has_up_at_the_top_of_the_image():
    R = level_rotation(math.radians(40), 1.0, 0.0)
    up = R @ np.array([0.0, 0.0, 1.0])
    assert up[1] < 0 and abs(up[0]) < 1e-12
    assert np.allclose(
        R @ np.array([np.cos(1.0), np.sin(1.0), 0.0]), [0, np.sin(np.radians(40)), -np.cos(np.radians(40))]
    )


def test_the_ceiling_lamp_hangs_over_the_table(layouts):
    config, _, made = layouts("scene.kind=tabletop", count=1)
    T = made[0][1].T_ref_level
    lights, ambient = draw_ceiling_lights(np.random.default_rng(0), config.lights, T, T[:3, 3], 0.1)
    area, point = lights
    above = se3.apply(se3.inverse(T), np.array([area.position_cam_m, point.position_cam_m]))
    assert np.allclose(above[0, :2], 0, atol=1e-9) and above[0, 2] > above[1, 2] > 0
    assert area.kind == "area" and point.kind == "point"
    irradiance = np.pi * ambient[0] + area.strength / (np.pi * above[0, 2] ** 2)
    irradiance += point.strength / (4 * np.pi * np.sum(above[1] ** 2))
    assert np.pi * 0.5 <= irradiance <= np.pi * 1.6


def test_clearance_is_to_the_nearest_sphere(layouts):
    _, targets, made = layouts(count=1)
    layout = made[0][1]
    spheres = BoundingSpheres({i: t.mesh for i, t in targets.items()})
    centre, radius = spheres.sphere(layout.labelled[0])
    T = se3.make_T(np.eye(3), -centre + [0, 0, 3 * radius])
    assert clearance_m(spheres, layout.labelled[:1], T) == pytest.approx(2 * radius)
    assert clearance_m(spheres, (), T) == math.inf
