import numpy as np
import pytest
from posecore import se3
from posecore.camera import project
from synthgen.bop.dataset_writer import write_dataset
from synthgen.bop.frame_maker import FrameMaker, FramePlan
from synthgen.bop.layout import BoundingSpheres
from synthgen.bop.motion import draw_rotation, draw_wave
from synthgen.draw.target import make_targets
from synthgen.inputs.assets import Assets

FRAMES = 150
SETTINGS = ("tabletop.tables=2", "frames.objects=[2, 3]", "frames.instances=3", "sequence.occluder_period_s=2")


@pytest.mark.slow
def test_waves_keep_their_bounds():
    t = np.linspace(0, 30, 4001)
    for seed in range(8):
        wave = draw_wave(np.random.default_rng(seed), 0.3, 0.2, 1.5)
        x = np.array([wave(s) for s in t])
        speed = np.gradient(x, t)
        assert np.abs(x).max() <= 0.3
        assert np.abs(speed).max() <= 0.2
        assert np.abs(np.gradient(speed, t)).max() <= 0.2 * 2 * np.pi / 1.5
        assert np.ptp(x) > 0.03
    still = draw_wave(np.random.default_rng(0), 0.3, 0.0, 1.5)
    assert still(0.0) == still(9.0)


@pytest.mark.slow
def test_rotations_keep_their_speed():
    for seed in range(5):
        rotation = draw_rotation(np.random.default_rng(seed), np.pi, 1.2, 2.0)
        R = np.stack([rotation(i / 100) for i in range(800)])
        step = se3.rotation_angle_rad(R[1:] @ R[:-1].swapaxes(-1, -2))
        assert step.max() * 100 <= 1.2 + 1e-6


@pytest.fixture(scope="module", params=["cutout", "tabletop"])
def filmed(request, config_of, tug):
    """Views of a whole sequence: nothing is rendered."""
    config = config_of(*SETTINGS, f"scene.kind={request.param}")
    targets = make_targets({1: tug}, config)
    maker = FrameMaker(config, targets, Assets(), FramePlan(frames=FRAMES, sequences=2))
    yield config, targets[0], [maker.view(1, i) for i in range(FRAMES)]
    maker.close()


@pytest.mark.slow
def test_nothing_jumps(filmed):
    config, target, views = filmed
    dt, diameter = 1 / config.sequence.fps, target.mesh.diameter_m
    for number in range(len(views[0].layout.labelled)):
        T = np.stack([v.T_cam_ref @ v.layout.labelled[number].T_cam_obj for v in views])
        speed_deg_s = np.degrees(se3.rotation_angle_rad(T[1:, :3, :3] @ T[:-1, :3, :3].swapaxes(-1, -2))) / dt
        assert speed_deg_s.max() <= config.sequence.max_angular_speed_deg_s + 1e-6
        centre = se3.apply(T, target.mesh.center_m[None])[:, 0]
        velocity = np.diff(centre, axis=0) / dt
        acceleration = np.diff(velocity, axis=0) / dt
        if number == 0:
            bound = config.sequence.max_speed_diameter_s * diameter
            assert np.linalg.norm(velocity, axis=1).max() <= bound
            assert np.linalg.norm(velocity, axis=1).max() > 0.05 * bound, "nothing moves"
        # the second difference of something smooth is far below its first
        assert np.linalg.norm(acceleration, axis=1).max() * dt <= 0.2 * np.linalg.norm(velocity, axis=1).max() + 1e-4


def test_the_first_object_stays_in_the_image_at_its_distances(filmed):
    config, target, views = filmed
    camera = config.camera.camera()
    for view in views:
        T = view.T_cam_ref @ view.layout.labelled[0].T_cam_obj
        z = se3.apply(T, target.mesh.center_m[None])[0, 2]
        assert target.distance_m[0] - 1e-9 <= z <= target.distance_m[1] + 1e-9
        uv = project(camera.K, se3.apply(T, target.hull_m))
        assert (uv >= 0).all() and (uv <= [camera.width_px, camera.height_px]).all()


def test_nothing_touches_and_an_occluder_passes_in_front_of_the_object(filmed):
    config, target, views = filmed
    meshes = {1: target.mesh, **target.shapes, **target.tables}
    spheres, camera = BoundingSpheres(meshes), config.camera.camera()
    still = len(views[0].layout.others) - 1
    before = 0
    for view in views:
        layout = view.layout
        items = [o for o in (*layout.labelled, *layout.others) if o.mesh_key not in target.tables]
        passing = layout.others[still:] if len(layout.others) > still else ()
        if layout.on_table:
            items = [*layout.labelled[:1], *passing]  # what lies there keeps apart seen from above: see test_frames
        for i, a in enumerate(items):
            for b in items[:i]:
                (c, r), (d, s) = spheres.sphere(a), spheres.sphere(b)
                assert np.linalg.norm(c - d) >= r + s - 1e-9
        for shape in passing:
            ends = [
                view.T_cam_ref[:3, :3] @ spheres.sphere(o)[0] + view.T_cam_ref[:3, 3]
                for o in (shape, layout.labelled[0])
            ]
            distance_px = np.linalg.norm(np.diff(project(camera.K, np.stack(ends)), axis=0))
            before += distance_px < 60 and ends[0][2] < ends[1][2]
    assert before >= 2


def test_materials_are_those_of_the_sequence_and_light_varies(filmed):
    config, _, views = filmed
    first = views[0]
    for view in views[1:]:
        assert [o.material for o in view.layout.labelled] == [o.material for o in first.layout.labelled]
        assert view.layout.background == first.layout.background
        style, other = view.layout.sensor, first.layout.sensor
        assert (style.exposure_ev, style.white_balance, style.noise_sigma) == (
            other.exposure_ev,
            other.white_balance,
            other.noise_sigma,
        )
        assert style.seed != other.seed
    strengths = np.array([[light.strength for light in v.layout.lights] for v in views])
    assert np.ptp(strengths, axis=0).max() > 0.02 * strengths.max()
    assert (np.abs(np.diff(strengths, axis=0)) <= strengths.max() * 0.4 / config.sequence.fps / 0.6 + 1e-12).all()


def test_blur_and_background_follow_the_motion(filmed):
    config, target, views = filmed
    camera = config.camera.camera()
    T = np.stack([v.T_cam_ref @ v.layout.labelled[0].T_cam_obj for v in views])
    uv = project(camera.K, se3.apply(T, target.mesh.center_m[None]))[:, 0]
    shift = np.array([v.background_shift_px for v in views])
    assert np.allclose(np.diff(shift, axis=0), np.diff(uv, axis=0), atol=1e-6)
    reach = np.array(views[0].background_reach_px)
    assert (np.abs(shift) <= reach).all()
    length = np.array([v.layout.sensor.motion_px for v in views])
    moved = np.linalg.norm(np.diff(uv, axis=0), axis=1)
    assert (length[1:] <= config.sequence.shutter[1] * 1.2 * moved + 0.05).all()


@pytest.mark.slow
def test_a_frame_does_not_depend_on_the_one_before(config_of, tug, filmed):
    config, _, views = filmed
    maker = FrameMaker(config, make_targets({1: tug}, config), Assets(), FramePlan(frames=FRAMES, sequences=2))
    view = maker.view(1, 77)
    maker.close()
    assert np.array_equal(view.T_cam_ref, views[77].T_cam_ref)
    for a, b in zip(view.layout.labelled, views[77].layout.labelled, strict=True):
        assert np.array_equal(a.T_cam_obj, b.T_cam_obj)
    assert view.layout.sensor == views[77].layout.sensor


@pytest.mark.slow
def test_sequences_are_bop_scenes_from_1_on(tmp_path, config_of, tug):
    from posecore.bop import BopDataset

    config = config_of(
        "camera.width_px=160", "camera.height_px=120", "camera.fx=143", "camera.fy=143", "window.min_area_px=5"
    )
    write_dataset(tmp_path / "s", config, {1: tug}, FramePlan(frames=3, sequences=2))
    dataset = BopDataset(tmp_path / "s")
    assert [(s, dataset.im_ids(s)) for s in dataset.scene_ids] == [(1, [0, 1, 2]), (2, [0, 1, 2])]
    first, second = (dataset.gt(s, 0)[0].T_cam_obj for s in (1, 2))
    assert not np.allclose(first, second, atol=1e-2)
