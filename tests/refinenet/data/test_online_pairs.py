import numpy as np
import pytest
from posecore import contour, se3
from posecore.camera import crop_K, project
from posecore.raster import Rasteriser
from posecore.shard import ShardReader
from posecore.window import Window, cut
from refinenet.config import AugmentConfig, HypothesisConfig, WindowConfig, load_config
from refinenet.data.online_pairs import OnlinePairMaker, draw_hypothesis
from refinenet.image import augmentation
from refinenet.image.crops import crop_affine, optical_axis_rotation, warp
from refinenet.image.masks import visible_fraction, visible_mask_iou


@pytest.fixture(scope="module")
def samples(dataset):
    arrays = ShardReader(str(dataset)).read(0)
    return [{name: values[row] for name, values in arrays.items()} for row in range(8)]


@pytest.fixture(scope="module")
def rasteriser(mesh):
    with Rasteriser({1: mesh}) as opened:
        yield opened


def make_pairs(mesh, rasteriser, samples, seed=0, augment_config=None, symmetries=None, **hypothesis):
    maker = OnlinePairMaker(
        meshes={1: mesh},
        rasteriser=rasteriser,
        patch_px=64,
        window=WindowConfig(kind="diameter", scale=1.5),
        contour_points=32,
        hypothesis=HypothesisConfig(**hypothesis),
        augment_config=augment_config or AugmentConfig(),
        symmetries=symmetries,
    )
    return maker(samples, [np.random.default_rng([seed, i]) for i in range(len(samples))])


def test_hypotheses_start_at_any_pose_that_looks_like_the_truth(mesh, rasteriser, samples):
    half_turn = np.diag([-1.0, -1.0, 1.0, 1.0])
    symmetries = {1: np.stack([np.eye(4), half_turn])}
    drawn = {"online": True, "max_angle_deg": 10.0, "symmetries": symmetries}

    def turned_deg(**more):
        pairs = [make_pairs(mesh, rasteriser, samples, seed, **drawn, **more) for seed in range(4)]
        changes = [p.T_cam_obj_hypothesis[:, :3, :3] @ p.T_cam_obj[:, :3, :3].swapaxes(1, 2) for p in pairs]
        return np.rad2deg(se3.rotation_angle_rad(np.concatenate(changes)))

    assert turned_deg().max() < 10.1
    far = turned_deg(sample_symmetries=True) > 165
    assert 0.2 < far.mean() < 0.8
    assert (turned_deg(sample_symmetries=True)[~far] < 10.1).all()


def test_recut_without_a_turn_is_the_cut_itself():
    rng = np.random.default_rng(0)
    image = rng.integers(0, 256, (200, 300, 3), dtype=np.uint8)
    K = np.array([[400.0, 0, 150], [0, 410, 100], [0, 0, 1]])
    whole = Window(x0_px=50, y0_px=20, side_px=128)
    part = Window(x0_px=70, y0_px=44, side_px=64)
    affine = crop_affine(whole, 128, K, np.eye(3), part, 64)
    np.testing.assert_array_equal(warp(cut(image, whole, 128), affine, 64), cut(image, part, 64))


def test_colours_at_the_edge_of_a_stored_patch_stay_as_they_are():
    """Faded into black, they would show where the stored window ends, which was centred near the truth."""
    turn = np.array([[0.9, 0.2, -3.0], [-0.2, 0.9, 9.0]])
    scene = warp(np.full((64, 64, 3), 200, np.uint8), turn, 64)
    assert (scene == 200).all()
    labels = warp(np.ones((64, 64), np.uint8), turn, 64, nearest=True)
    assert 0 < (labels == 0).sum() < 2000


@pytest.mark.parametrize("in_plane", [False, True])
def test_turned_and_recut_scenes_show_the_object_at_its_new_truth(mesh, rasteriser, samples, in_plane):
    """The stored silhouette, turned and cut anew, is the silhouette rendered at the new pose with the new camera."""
    pairs = make_pairs(mesh, rasteriser, samples, online=True, in_plane=in_plane)
    truth = rasteriser.render(1, pairs.K_crop, pairs.T_cam_obj, 64, 64).mask
    overlaps = []
    for k, i in enumerate(pairs.kept):
        contour_px = pairs.scene_distance_px[k] < 0.5
        true_distance = contour.distance_transform_px(contour.contour_mask(truth[k]))
        overlaps.append(true_distance[contour_px].mean())
        points = project(pairs.K_crop[k], pairs.scene_contour_m[k].astype(float))
        inside = points[((points > 0) & (points < 64)).all(axis=1)].astype(int)
        assert pairs.scene_distance_px[k][inside[:, 1], inside[:, 0]].mean() < 0.8
        if not in_plane:
            np.testing.assert_array_equal(pairs.T_cam_obj[k], samples[i]["T_cam_obj"])
    assert max(overlaps) < 0.8


def test_hypotheses_are_drawn_within_the_range(mesh):
    config = HypothesisConfig(online=True, max_angle_deg=20, max_translation_diameter=0.2, easy_fraction=0.0)
    rng = np.random.default_rng(0)
    T = se3.make_T(np.eye(3), np.array([0, 0, 1.0]))
    drawn = np.stack([draw_hypothesis(T, mesh.diameter_m, config, rng) for _ in range(300)])
    dR, dt = se3.update_between(np.broadcast_to(T, drawn.shape), drawn)
    angles, lengths = np.rad2deg(se3.rotation_angle_rad(dR)), np.linalg.norm(dt, axis=1) / mesh.diameter_m
    assert 18 < angles.max() <= 20
    assert 0.18 < lengths.max() <= 0.2
    assert angles.mean() == pytest.approx(10, abs=1)


def test_the_depth_stretch_scales_the_move_along_the_viewing_ray_alone(mesh):
    T = se3.make_T(np.eye(3), np.array([0.3, -0.2, 0.6]))
    ray = T[:3, 3] / 0.7
    for seed in range(20):
        plain, stretched = (
            draw_hypothesis(T, mesh.diameter_m, HypothesisConfig(depth_stretch=factor), np.random.default_rng(seed))
            for factor in (1.0, 5.0)
        )
        np.testing.assert_array_equal(plain[:3, :3], stretched[:3, :3])
        move, stretched_move = plain[:3, 3] - T[:3, 3], stretched[:3, 3] - T[:3, 3]
        assert stretched_move @ ray == pytest.approx(5 * (move @ ray))
        np.testing.assert_allclose(np.cross(stretched_move, ray), np.cross(move, ray), atol=1e-12)


def test_precomputed_hypotheses_are_taken_without_online_ones(mesh, rasteriser, samples):
    pairs = make_pairs(mesh, rasteriser, samples, online=False)
    for k, i in enumerate(pairs.kept):
        np.testing.assert_allclose(pairs.T_cam_obj_hypothesis[k], samples[i]["T_cam_obj_hypothesis"])


@pytest.mark.parametrize(("share", "least", "most"), [(0.0, 0, 0), (0.5, 6, 26), (1.0, 32, 32)])
def test_some_hypotheses_are_the_stored_ones(mesh, rasteriser, samples, share, least, most):
    """Turned with their scenes; each belongs to its own truth all the same."""
    stored = 0
    for seed in range(4):
        pairs = make_pairs(mesh, rasteriser, samples, seed, online=True, max_angle_deg=1.0, precomputed_fraction=share)
        for k, i in enumerate(pairs.kept):
            relative, given = (
                se3.update_between(a, b)
                for a, b in (
                    (pairs.T_cam_obj[k], pairs.T_cam_obj_hypothesis[k]),
                    (samples[i]["T_cam_obj"], samples[i]["T_cam_obj_hypothesis"]),
                )
            )
            same = se3.rotation_angle_rad(relative[0]) == pytest.approx(se3.rotation_angle_rad(given[0]), abs=1e-6)
            stored += same and np.linalg.norm(relative[1]) == pytest.approx(np.linalg.norm(given[1]), abs=1e-9)
    assert least <= stored <= most


def test_the_same_generators_make_the_same_pairs(mesh, rasteriser, samples):
    config = load_config("compact").augment
    first, again = (make_pairs(mesh, rasteriser, samples, 3, config, online=True) for _ in range(2))
    other = make_pairs(mesh, rasteriser, samples, 4, config, online=True)
    for name, value in vars(first).items():
        np.testing.assert_array_equal(value, getattr(again, name))
    assert (first.scene_rgb != other.scene_rgb).any()


def test_a_scene_without_its_object_is_replaced_by_another(mesh, rasteriser, samples):
    empty = {**samples[0], "scene_mask": np.zeros_like(samples[0]["scene_mask"])}
    pairs = make_pairs(mesh, rasteriser, [empty, *samples[1:]], online=True)
    assert len(pairs.kept) == 8
    assert 0 not in pairs.kept
    assert make_pairs(mesh, rasteriser, [empty], online=True) is None


def test_no_black_corner_shows_where_the_stored_window_ended(mesh, rasteriser, samples):
    """A stored patch of white: wherever the new patch is black, the stored window's edge could be seen."""
    white = [{**s, "scene_rgb": np.full_like(s["scene_rgb"], 255)} for s in samples]
    white = [{**s, "window_px": s["window_px"] * [1, 1, 0.6]} for s in white]  # a window that ends inside the new one
    pairs = make_pairs(mesh, rasteriser, white, online=True)
    assert (pairs.scene_rgb.max(axis=-1) > 0).mean() > 0.99


def test_background_exchange_keeps_the_object(mesh, rasteriser, samples):
    """The object's pixels stay, the rest changes."""
    kept = make_pairs(mesh, rasteriser, samples, online=True)
    exchanged = make_pairs(mesh, rasteriser, samples, online=True, augment_config=AugmentConfig(background=1.0))
    truth = rasteriser.render(1, kept.K_crop, kept.T_cam_obj, 64, 64).mask
    inner = np.stack([contour.distance_transform_px(~m) > 2 if m.any() else m for m in truth])
    same = (kept.scene_rgb == exchanged.scene_rgb).all(axis=-1)
    assert same[inner & truth].mean() > 0.95
    assert same[~truth].mean() < 0.3


def test_occluders_hide_part_of_the_object_and_nothing_else(mesh, rasteriser, samples):
    """The visible share falls, never under its limit; pixels and masks change together; truth and contour stay."""
    plain = make_pairs(mesh, rasteriser, samples, online=True)
    config = AugmentConfig(occlusion=1.0, min_visible_fraction=0.4)
    covered = make_pairs(mesh, rasteriser, samples, online=True, augment_config=config)
    assert (plain.visible_fraction == 1).all()
    assert (covered.visible_fraction >= 0.4).all()
    assert (covered.visible_fraction < 0.98).sum() >= 4
    changed = (plain.scene_rgb != covered.scene_rgb).any(axis=-1)
    over = (covered.scene_bits & 4 > 0) & (covered.scene_bits & 2 == 0)
    assert not (changed & ~over).any()
    np.testing.assert_array_equal(covered.scene_bits & 1, plain.scene_bits & 1)
    np.testing.assert_array_equal(covered.scene_distance_px, plain.scene_distance_px)


def test_fixed_windows_keep_their_side_in_the_image(mesh, rasteriser, samples):
    maker = OnlinePairMaker(
        meshes={1: mesh}, rasteriser=rasteriser, patch_px=64, window=WindowConfig(kind="fixed"), contour_points=32,
        hypothesis=HypothesisConfig(online=True), augment_config=AugmentConfig(), fixed_sides_px={1: 188.0},
    )  # fmt: skip
    pairs = maker(samples, [np.random.default_rng([0, i]) for i in range(len(samples))])
    np.testing.assert_allclose(pairs.K_crop[:, 0, 0], samples[0]["K"][0, 0] * 64 / 188)


def test_overlap_is_one_at_the_truth_whatever_covers_it_and_zero_apart():
    """Bits: 1 the object, 2 its visible part, 4 the foreground."""
    bits = np.zeros((8, 8), np.uint8)
    bits[2:6, 2:6] = 1 | 2 | 4
    truth = bits > 0
    apart = np.roll(truth, 4, axis=1) & ~truth
    assert visible_mask_iou(truth, bits) == 1
    for background in (np.uint8(0), np.uint8(4)):  # a wall is foreground too, and hides nothing
        assert visible_mask_iou(np.roll(truth, 2, axis=0), bits | background) == pytest.approx(8 / 24)
    bits[2:6, 2:4] = 1 | 4
    assert visible_fraction(bits) == 0.5
    assert visible_mask_iou(truth, bits) == 1
    assert visible_mask_iou(apart, bits) == 0
    bits[2:6, 2:6] = 1 | 4
    assert visible_mask_iou(truth, bits) == 0
    assert visible_fraction(np.zeros((3, 8, 8), np.uint8)).tolist() == [0, 0, 0]


def test_colour_augmentation_keeps_black_and_moves_both_patches_together():
    rng = np.random.default_rng(0)
    hypothesis = np.zeros((6, 16, 16, 3), np.uint8)
    hypothesis[:, 4:12, 4:12] = [200, 100, 20]
    config = AugmentConfig(permute_channels=1.0)
    scene, render, colours = augmentation.colour(hypothesis, hypothesis, config, rng)
    np.testing.assert_allclose(np.einsum("bij,bhwj->bhwi", colours, hypothesis), render)
    np.testing.assert_array_equal(scene, render)
    assert (render[:, 0, 0] == 0).all()
    assert len(np.unique(render[:, 8, 8], axis=0)) > 1
    assert (np.sort(render[:, 8, 8], axis=-1) == [20, 100, 200]).all()
    same = augmentation.colour(hypothesis, hypothesis, AugmentConfig(), rng)
    np.testing.assert_array_equal(same[0], hypothesis)


def test_the_optical_axis_rotation_keeps_depth():
    R = optical_axis_rotation(0.7)
    assert se3.is_rotation(R)
    np.testing.assert_array_equal(R[2], [0, 0, 1])


def test_crop_camera_is_that_of_the_window(mesh, rasteriser, samples):
    """The window of every online hypothesis is the one that inference cuts: centred on it, 1.5 diameters wide."""
    pairs = make_pairs(mesh, rasteriser, samples, online=True)
    for K_crop, T in zip(pairs.K_crop, pairs.T_cam_obj_hypothesis, strict=True):
        centre = T[:3, :3] @ mesh.center_m + T[:3, 3]
        np.testing.assert_allclose(project(K_crop, centre[None])[0], 32.0, atol=1e-6)
        focal = np.sqrt(K_crop[0, 0] * K_crop[1, 1])
        assert focal * mesh.diameter_m / centre[2] == pytest.approx(64 / 1.5)
    assert crop_K(np.eye(3), Window(x0_px=0, y0_px=0, side_px=64), 64) == pytest.approx(np.eye(3))
