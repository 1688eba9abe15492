import numpy as np
import pytest
from posecore.errors import ConfigError
from synthgen.image import background
from synthgen.scene import Background


def test_a_seed_gives_the_same_image_and_another_seed_another():
    a, b = (background.draw(Background(seed=5), 90, 60) for _ in range(2))
    assert a.shape == (60, 90, 3)
    assert a.dtype == np.uint8
    assert np.array_equal(a, b)
    assert not np.array_equal(a, background.draw(Background(seed=6), 90, 60))


def test_drawn_backgrounds_differ_in_colour_and_texture():
    images = np.stack([background.draw(Background(seed=s), 48, 48) for s in range(60)]).astype(float)
    means = images.mean(axis=(1, 2))
    texture = np.abs(np.diff(images, axis=2)).mean(axis=(1, 2, 3))
    assert means.std(axis=0).min() > 20
    assert texture.min() < 3
    assert texture.max() > 15


@pytest.mark.slow
@pytest.mark.parametrize("size", [(1, 1), (3, 200), (640, 480)])
def test_any_size_can_be_drawn(size):
    for seed in range(12):
        assert background.draw(Background(seed=seed), *size).shape == (size[1], size[0], 3)


def test_photographs_are_cropped_at_random_without_distortion(tmp_path):
    import cv2

    photo = np.zeros((100, 400, 3), np.uint8)
    photo[..., 0] = np.arange(400)[None] % 256
    photo[..., 2] = 200
    cv2.imwrite(str(tmp_path / "a.png"), photo[..., ::-1])
    (tmp_path / "notes.txt").write_text("no picture")
    (path,) = background.list_photos(tmp_path)
    crops = [background.draw(Background(kind="photo", path=path, seed=s), 64, 48) for s in range(4)]
    assert all(c.shape == (48, 64, 3) for c in crops)
    assert all((c[..., 2] == 200).all() for c in crops)  # red and blue are not swapped
    assert not np.array_equal(crops[0], crops[1])


def test_missing_and_empty_folders_are_named(tmp_path):
    with pytest.raises(ConfigError, match="no such folder"):
        background.list_photos(tmp_path / "none")
    with pytest.raises(ConfigError, match="no image"):
        background.list_photos(tmp_path)


def test_a_broken_photograph_is_named(tmp_path):
    import cv2

    cv2.imwrite(str(tmp_path / "good.png"), np.zeros((9, 9, 3), np.uint8))
    (tmp_path / "broken.jpg").write_bytes(b"not a picture")
    with pytest.raises(ConfigError, match=r"broken\.jpg: is not an image; repair it or remove it"):
        background.list_photos(tmp_path)
    with pytest.raises(ConfigError, match=r"broken\.jpg"):
        background.draw(Background(kind="photo", path=str(tmp_path / "broken.jpg")), 8, 8)


def test_a_folder_without_readable_photographs_is_named(tmp_path):
    for name in ("a.jpg", "b.png"):
        (tmp_path / name).write_bytes(b"not a picture")
    with pytest.raises(ConfigError, match=rf"a\.jpg \(and 1 more\): is not an image; .*--backgrounds {tmp_path}"):
        background.list_photos(tmp_path)
