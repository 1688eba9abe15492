import numpy as np
import pytest
from synthgen.engine import RenderedScene
from synthgen.image import sensor
from synthgen.image.compose import compose
from synthgen.scene import Background, Sensor


def test_display_and_linear_are_inverse():
    display = np.arange(256, dtype=np.uint8).reshape(1, 256, 1).repeat(3, axis=2)
    back = sensor.display_from_linear(sensor.linear_from_display(display))
    assert np.abs(back * 255 - display).max() < 1e-3


def test_a_plain_sensor_changes_nothing():
    display = np.random.default_rng(0).integers(0, 256, (20, 30, 3), dtype=np.uint8)
    assert np.array_equal(sensor.expose(sensor.linear_from_display(display), Sensor()), display)


def test_exposure_and_white_balance_are_gains_on_linear_light():
    grey = np.full((4, 4, 3), 0.1, np.float32)
    shown = sensor.expose(grey, Sensor(exposure_ev=1.0, white_balance=(1.0, 0.5, 2.0)))
    back = sensor.linear_from_display(shown)
    np.testing.assert_allclose(back[0, 0], [0.2, 0.1, 0.4], rtol=0.03)


def test_noise_has_the_given_deviation_and_repeats_with_its_seed():
    grey = np.full((100, 100, 3), 0.2, np.float32)
    a, b, c = (sensor.expose(grey, Sensor(noise_sigma=0.03, seed=s)) for s in (1, 1, 2))
    assert np.array_equal(a, b)
    assert not np.array_equal(a, c)
    assert a.std() == pytest.approx(0.03 * 255, rel=0.05)


@pytest.mark.parametrize("settings", [{"blur_sigma_px": 1.5}, {"motion_px": 4.0, "motion_angle_rad": 0.7}])
def test_blur_moves_nothing(settings):
    image = np.zeros((41, 41, 3), np.float32)
    image[20, 20] = 1.0
    light = sensor.linear_from_display(sensor.expose(image, Sensor(**settings)))[..., 0].astype(float)
    rows, columns = np.mgrid[:41, :41]
    assert light[20, 20] < 0.6
    assert (light * rows).sum() / light.sum() == pytest.approx(20, abs=0.05)
    assert (light * columns).sum() / light.sum() == pytest.approx(20, abs=0.05)


def test_jpeg_keeps_the_channels_in_order():
    red = np.zeros((16, 16, 3), np.float32)
    red[..., 0] = 0.8
    shown = sensor.expose(red, Sensor(jpeg_quality=90))
    assert shown[..., 0].min() > 200
    assert shown[..., 2].max() < 30


def test_compose_puts_the_background_behind(config_of, tug_target):
    from synthgen.draw import scene_draw
    from synthgen.draw.random_streams import Purpose
    from synthgen.image import background
    from synthgen.inputs.assets import Assets

    config = config_of()
    draw = scene_draw.draw_scene(config, [tug_target], Assets(), Purpose.PAIRS, 0, 0)
    scene = draw.scene(config.camera.camera(), (0, 0, 16, 8), 1)
    scene = type(scene)(**{**vars(scene), "sensor": Sensor(), "background": Background(seed=3)})
    alpha = np.zeros((8, 16), np.float32)
    alpha[:, 8:] = 1.0
    rendered = RenderedScene(
        rgb_linear=np.ones((8, 16, 3), np.float32),
        alpha=alpha,
        depth_m=alpha,
        index=np.where(alpha > 0, 0, -1).astype(np.int16),
    )
    image = compose(rendered, scene)
    assert (image[:, 8:] == 255).all()
    assert np.array_equal(image[:, :8], background.draw(Background(seed=3), 16, 8)[:, :8])
