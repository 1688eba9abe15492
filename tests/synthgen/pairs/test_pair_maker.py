import numpy as np
import pytest
from posecore.camera import crop_K, project
from posecore.contour import contour_mask
from posecore.errors import ConfigError
from posecore.se3 import apply, inverse
from posecore.shard import BIT_FOREGROUND, BIT_OBJECT, BIT_VISIBLE, field_table
from posecore.window import Window, silhouette_box
from synthgen.pairs.pair_maker import concatenate

PLAIN = ("occluders.front=[0, 0]", "occluders.props=[0, 0]")
SHARP = (
    "sensor.blur_sigma_px=[0, 0]",
    "sensor.noise_sigma=[0, 0]",
    "sensor.motion_fraction=0",
    "sensor.jpeg_fraction=0",
)


def at(distance_px, uv):
    column, row = np.floor(uv).astype(int).T
    return distance_px[row, column]


def test_a_sample_has_every_field_of_the_table(maker_of):
    samples = maker_of().samples(0)
    assert set(samples) == {f.name for f in field_table()}
    for field in field_table():
        assert samples[field.name].shape == (2, *field.size(48, 20)), field.name


def test_contour_points_lie_on_their_contours(maker_of):
    s = maker_of("contour_points=60").samples(1)
    for i in range(2):
        K = s["K_crop"][i]
        for points, distance in (
            ("scene_contour_cam_m", "scene_distance_px"),
            ("hypothesis_contour_cam_m", "hypothesis_distance_px"),
        ):
            uv = project(K, s[points][i].astype(np.float64))
            assert at(s[distance][i], uv).max() == 0
            np.testing.assert_allclose(uv % 1, 0.5, atol=2e-2)  # pixel centres


def test_contour_points_lie_on_the_object_at_its_pose(maker_of, tug):
    s = maker_of().samples(2)
    for points, T in (("scene_contour_cam_m", "T_cam_obj"), ("hypothesis_contour_cam_m", "T_cam_obj_hypothesis")):
        p_obj = apply(inverse(s[T][0]), s[points][0].astype(np.float64))
        low, high = tug.vertices_m.min(axis=0), tug.vertices_m.max(axis=0)
        assert (p_obj > low - 1e-4).all()
        assert (p_obj < high + 1e-4).all()


def test_the_window_is_fixed_and_centred_on_the_hypothesis(maker_of, tug_target):
    maker = maker_of("window.padding=0.3")
    s = maker.samples(3)
    for i in range(2):
        x0, y0, side = s["window_px"][i]
        assert side == pytest.approx(maker.targets[0].window_side_px)
        box = silhouette_box(tug_target.mesh.vertices_m, s["K"][i], s["T_cam_obj_hypothesis"][i])
        np.testing.assert_allclose([(box[0] + box[2]) / 2, (box[1] + box[3]) / 2], [x0 + side / 2, y0 + side / 2])
        gt = silhouette_box(tug_target.mesh.vertices_m, s["K"][i], s["T_cam_obj"][i])
        assert (gt[:2] >= [x0, y0]).all()
        assert (gt[2:] <= [x0 + side, y0 + side]).all()
        np.testing.assert_allclose(s["K_crop"][i], crop_K(s["K"][i], Window(x0_px=x0, y0_px=y0, side_px=side), 48))


@pytest.mark.slow
@pytest.mark.parametrize("patch_px", [48, 300])  # coarser and finer than the camera's own pixels
def test_the_image_shows_the_object_inside_its_contour(maker_of, patch_px):
    """The colours of S change at the contour: an image that is mirrored or half a pixel off fails."""
    maker = maker_of(f"patch_px={patch_px}", *PLAIN, *SHARP, "sensor.exposure_ev=[0, 0]", "background.photo_fraction=0")
    object_on_black = []
    for scene_index in range(4):
        s = maker.samples(scene_index)
        draw, _ = maker.accepted_scene(scene_index)
        image = maker._render(draw, [Window(x0_px=x, y0_px=y, side_px=w) for x, y, w in s["window_px"]])
        for i in range(2):
            from posecore.window import cut

            x, y, side = s["window_px"][i] * image.scale
            local = Window(x0_px=x - image.region_px[0], y0_px=y - image.region_px[1], side_px=side)
            coverage = cut(image.rendered.alpha, local, patch_px)
            amodal = (s["scene_mask"][i] & BIT_OBJECT) > 0
            rows, columns = np.mgrid[:patch_px, :patch_px] + 0.5
            centre = [(m * a).sum() / a.sum() for a in (coverage, amodal * 1.0) for m in (rows, columns)]
            object_on_black.append((centre[0] - centre[2], centre[1] - centre[3]))
            pixel = max(1.0, patch_px / s["window_px"][i][2])
            far_inside = amodal & (s["scene_distance_px"][i] > 1.6 * pixel)
            far_outside = ~amodal & (s["scene_distance_px"][i] > 1.6 * pixel)
            # parts thinner than a pixel are coverage without silhouette: a few pixels may disagree
            assert np.quantile(coverage[far_inside], 0.005) > 0.99
            assert np.quantile(coverage[far_outside], 0.995) < 0.01
    offset = np.abs(np.mean(object_on_black, axis=0))
    assert offset.max() < 0.15 * max(1.0, patch_px / 200)


def test_hidden_parts_are_where_something_else_is_nearer(maker_of):
    maker = maker_of("occluders.front=[2, 3]", "occluders.min_visible=0.3")
    s = concatenate(maker.samples(i) for i in range(8))
    mask = s["scene_mask"]
    amodal, visible, foreground = ((mask & bit) > 0 for bit in (BIT_OBJECT, BIT_VISIBLE, BIT_FOREGROUND))
    assert (visible <= amodal).all()
    assert (visible <= foreground).all()
    assert np.array_equal(foreground, s["scene_depth_m"] > 0)
    assert (amodal & ~visible).any()
    np.testing.assert_allclose(s["visible_fraction"], visible.sum((1, 2)) / amodal.sum((1, 2)), rtol=1e-6)


def test_the_contour_is_not_cut_by_occluders(maker_of):
    free = maker_of(*PLAIN).samples(5)
    hidden = maker_of("occluders.front=[2, 2]", "occluders.min_visible=0.2").samples(5)
    same = np.array_equal(free["T_cam_obj"], hidden["T_cam_obj"])
    assert same  # occluders have a random stream of their own
    assert np.array_equal(free["scene_distance_px"], hidden["scene_distance_px"])
    assert np.array_equal(free["scene_contour_cam_m"], hidden["scene_contour_cam_m"])


@pytest.mark.slow
def test_outside_the_image_is_black_and_not_visible(maker_of):
    maker = maker_of(*PLAIN, "view.position_jitter=1.0", "view.min_inside=0.3", "occluders.min_visible=0.1")
    found = 0
    for scene_index in range(30):
        s = maker.samples(scene_index)
        for i in range(2):
            x0, y0, side = s["window_px"][i]
            x = x0 + (np.arange(48) + 0.5) * side / 48
            y = y0 + (np.arange(48) + 0.5) * side / 48
            outside = ((x < 0) | (x >= 640))[None, :] | ((y < 0) | (y >= 480))[:, None]
            well_outside = ((x < -6) | (x >= 646))[None, :] | ((y < -6) | (y >= 486))[:, None]
            found += int(well_outside.any())
            assert (s["scene_rgb"][i][well_outside] == 0).all()
            assert (s["scene_mask"][i][outside] & (BIT_VISIBLE | BIT_FOREGROUND) == 0).all()
            assert (s["scene_depth_m"][i][outside] == 0).all()
    assert found > 3


def test_hypotheses_share_the_scene_and_keep_is_a_prefix(maker_of):
    maker = maker_of("hypotheses_per_scene=4", "shard_size=4")
    s, first = maker.samples(6), maker.samples(6, keep=2)
    assert (s["T_cam_obj"] == s["T_cam_obj"][0]).all()
    assert len({h.tobytes() for h in s["T_cam_obj_hypothesis"]}) == 4
    for name in s:
        assert np.array_equal(s[name][:2], first[name]), name


@pytest.mark.slow
def test_samples_do_not_depend_on_what_was_rendered_before(maker_of):
    a, b = maker_of(), maker_of()
    for i in (4, 0, 7):
        a.samples(i)
    for name, values in a.samples(3).items():
        assert np.array_equal(values, b.samples(3)[name]), name


@pytest.mark.slow
def test_silhouettes_are_large_enough(maker_of):
    s = concatenate(maker_of("window.min_area_px=120").samples(i) for i in range(10))
    assert ((s["scene_mask"] & BIT_OBJECT) > 0).sum((1, 2)).min() >= 120
    assert (s["hypothesis_depth_m"] > 0).sum((1, 2)).min() >= 120
    assert s["rejected"].sum() > 0, "the bound was never felt"


def test_hypothesis_patches_are_the_object_on_black(maker_of):
    s = maker_of().samples(0)
    outside = s["hypothesis_depth_m"] == 0
    assert (s["hypothesis_rgb"][outside] == 0).all()
    assert (s["hypothesis_rgb"][~outside].max(axis=-1) > 0).mean() > 0.99
    contour = contour_mask(~outside[0])
    assert np.array_equal(contour, s["hypothesis_distance_px"][0] == 0)


@pytest.mark.slow
def test_a_configuration_that_accepts_nothing_names_the_key_to_change(maker_of, monkeypatch):
    with pytest.raises(ConfigError, match=r"tug\.ply\): all 100 draws .* lower window\.min_area_px \(is 100000\)"):
        maker_of("window.min_area_px=100000").samples(0)
    with pytest.raises(ConfigError, match=r"100 x the object too occluded.*lower occluders\.min_visible \(is 1\)"):
        maker_of("occluders.front=[20, 20]", "occluders.min_visible=1.0").samples(0)
    with pytest.raises(ConfigError, match=r"outside the image.*lower view\.position_jitter \(is 0\.6\)"):
        maker_of("view.min_inside=1.0", "camera.fx=9000", "camera.fy=9000").samples(0)
    monkeypatch.setattr("synthgen.pairs.pair_maker.MAX_ATTEMPTS", 5)
    monkeypatch.setattr("synthgen.pairs.pair_maker.MAX_HYPOTHESIS_ATTEMPTS", 2)
    far = maker_of("perturbation.max_translation_diameter=2", "perturbation.easy_fraction=0", "window.padding=0")
    with pytest.raises(ConfigError, match=r"no hypothesis.*left the window.*max_translation_diameter \(is 2\)"):
        concatenate(far.samples(index) for index in range(20))
