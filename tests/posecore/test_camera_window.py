"""Projection, crops and windows: pixel conventions held to sub-pixel accuracy."""

import numpy as np
import pytest
from posecore import camera, se3, window
from posecore.errors import CameraError

K = camera.intrinsics(572.4, 601.3, 325.2, 221.7)
RNG = np.random.default_rng(2)


def test_project_and_back_project_are_inverse() -> None:
    p = RNG.uniform(-0.3, 0.3, (20, 3)) + np.array([0, 0, 1.2])
    np.testing.assert_allclose(camera.back_project(K, camera.project(K, p), p[:, 2]), p, atol=1e-12)


def test_projection_axes_are_right_down_forward() -> None:
    centre = camera.project(K, np.array([[0.0, 0.0, 1.0]]))[0]
    right, down = camera.project(K, np.array([[0.1, 0.0, 1.0], [0.0, 0.1, 1.0]]))
    np.testing.assert_allclose(centre, [325.2, 221.7])
    assert right[0] > centre[0] and down[1] > centre[1]


def test_crop_K_projects_to_where_cut_puts_the_pixel() -> None:
    """A point's neighbourhood in the patch, found by intensity, lies where the crop's K says."""
    columns, rows = np.meshgrid(np.arange(640) + 0.5, np.arange(480) + 0.5)
    win = window.Window(x0_px=200.3, y0_px=103.7, side_px=150.0)
    patch_px = 128
    p = camera.back_project(K, np.array([[270.2, 170.9]]), np.array([0.8]))
    uv_image, uv_patch = camera.project(K, p)[0], camera.project(camera.crop_K(K, win, patch_px), p)[0]
    spot = np.exp(-((columns - uv_image[0]) ** 2 + (rows - uv_image[1]) ** 2) / (2 * 3.0**2)).astype(np.float32)
    patch = window.cut(spot, win, patch_px)
    centres = np.arange(patch_px) + 0.5
    found = np.array([(patch.sum(axis=0) * centres).sum(), (patch.sum(axis=1) * centres).sum()]) / patch.sum()
    np.testing.assert_allclose(found, uv_patch, atol=0.01)


def test_cut_fills_outside_the_image_and_never_wraps() -> None:
    image = np.full((20, 30, 3), 200, np.uint8)
    patch = window.cut(image, window.Window(x0_px=-10, y0_px=-10, side_px=20), 20, fill=7)
    assert (patch[:9, :9] == 7).all()
    assert (patch[11:, 11:] == 200).all()


def test_cut_of_the_whole_image_is_the_image() -> None:
    image = RNG.integers(0, 255, (16, 16, 3), dtype=np.uint8)
    whole = window.Window(x0_px=0, y0_px=0, side_px=16)
    for interpolation in ("linear", "area", "nearest"):
        np.testing.assert_array_equal(window.cut(image, whole, 16, interpolation=interpolation), image)


def test_silhouette_box_holds_the_projection_and_is_infinite_behind_the_camera() -> None:
    vertices = RNG.uniform(-0.05, 0.05, (40, 3))
    T = se3.make_T(se3.random_rotation(RNG), np.array([0.1, 0.0, 0.7]))
    uv = camera.project(K, se3.apply(T, vertices))
    np.testing.assert_allclose(window.silhouette_box(vertices, K, T), [*uv.min(axis=0), *uv.max(axis=0)])
    T[2, 3] = 0.01
    assert np.isinf(window.silhouette_box(vertices, K, T)).all()


def test_fixed_side_holds_every_view_at_the_smallest_distance() -> None:
    vertices = RNG.uniform(-1, 1, (60, 3)) * [0.08, 0.03, 0.02]
    side = window.fixed_side_px(vertices, K, 0.5, padding=0.1)
    boxes = np.stack([
        window.silhouette_box(vertices, K, se3.make_T(se3.random_rotation(RNG), np.array([0.0, 0.0, 0.5])))
        for _ in range(300)
    ])  # fmt: skip
    largest = (boxes[:, 2:] - boxes[:, :2]).max()
    assert largest <= side
    assert side <= 1.1 * 1.1 * largest


def test_windows_are_centred_on_the_hypothesis() -> None:
    vertices = RNG.uniform(-0.05, 0.05, (40, 3))
    T = se3.make_T(se3.random_rotation(RNG), np.array([0.1, -0.05, 0.7]))
    x0, y0, x1, y1 = window.silhouette_box(vertices, K, T)
    fixed = window.fixed_window(vertices, K, T, 100.0)
    assert (fixed.x0_px + 50, fixed.y0_px + 50) == pytest.approx(((x0 + x1) / 2, (y0 + y1) / 2))
    deep = window.diameter_window(K, T, np.zeros(3), 0.1, scale=1.5)
    assert deep.side_px == pytest.approx(1.5 * np.sqrt(572.4 * 601.3) * 0.1 / 0.7)
    centre = camera.project(K, T[None, :3, 3])[0]
    assert (deep.x0_px + deep.side_px / 2, deep.y0_px + deep.side_px / 2) == pytest.approx(tuple(centre))


@pytest.mark.parametrize(
    ("matrix", "size"),
    [
        (np.diag([0.0, 500.0, 1.0]), (640, 480)),
        (np.full((3, 3), np.nan), (640, 480)),
        (camera.intrinsics(500, 500, 320, 240) + np.array([[0, 3.0, 0], [0, 0, 0], [0, 0, 0]]), (640, 480)),
        (camera.intrinsics(500, 500, 320, 240), (0, 480)),
    ],
)
def test_camera_refuses_what_is_no_pinhole(matrix: np.ndarray, size: tuple[int, int]) -> None:
    with pytest.raises(CameraError, match="found"):
        camera.Camera(K=matrix, width_px=size[0], height_px=size[1])


def test_pixels_inside_are_those_whose_centres_lie_in_the_image() -> None:
    inside = window.pixels_inside(window.Window(x0_px=-2.0, y0_px=6.0, side_px=8.0), 4, 4, 12)
    np.testing.assert_array_equal(inside, np.outer([True, True, True, False], [False, True, True, False]))
    assert not window.pixels_inside(window.Window(x0_px=12.0, y0_px=0.0, side_px=8.0), 4, 12, 12).any()


@pytest.mark.parametrize("side_px", [24.0, 96.0])
def test_a_replicated_border_is_as_if_the_image_went_on(side_px: float) -> None:
    image = np.random.default_rng(0).integers(0, 256, (40, 50, 3), dtype=np.uint8)
    padded = np.pad(image, ((256, 256), (256, 256), (0, 0)), mode="edge")
    for x0_px, y0_px in ((-20.5, -3.25), (30.0, 25.75), (10.0, 10.0), (-60.0, 90.0)):
        w = window.Window(x0_px=x0_px, y0_px=y0_px, side_px=side_px)
        moved = window.Window(x0_px=x0_px + 256, y0_px=y0_px + 256, side_px=side_px)
        expected = window.cut(padded, moved, 32, interpolation="area")
        np.testing.assert_array_equal(window.cut_rgb(image, w, 32, border="replicate"), expected)
    outside = window.cut_rgb(image, window.Window(x0_px=-200.0, y0_px=0.0, side_px=24.0), 32)
    assert not outside.any()


@pytest.mark.parametrize("focal", [1e308, 1e8, 1e-308, 0.0, -500.0, float("inf"), float("nan")])
def test_a_camera_that_overflows_is_refused(focal):
    with pytest.raises(CameraError, match="camera matrix: found"):
        camera.Camera(K=camera.intrinsics(focal, 500.0, 320.0, 240.0), width_px=640, height_px=480)
    with pytest.raises(CameraError, match="camera matrix: found"):
        camera.Camera(K=camera.intrinsics(500.0, 500.0, 320.0, 1e300), width_px=640, height_px=480)
    with pytest.raises(CameraError, match="image size: found 100000 x 480 px"):
        camera.Camera(K=camera.intrinsics(500.0, 500.0, 320.0, 240.0), width_px=100_000, height_px=480)
