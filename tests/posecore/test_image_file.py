"""The one image reader: size limits, truncated files, no regular files, the name in each error."""

import os
import struct
import zlib

import cv2
import numpy as np
import pytest
from fuzzing import damage, fuzz, one_line
from hypothesis import given, settings
from posecore.errors import ConfigError, DatasetError, PoseError
from posecore.image_file import LARGEST_IMAGE_PX, decode_image, picture_fault, read_picture, stated_size

FORMATS = ("png", "jpg", "bmp", "webp", "tif")


def encoded(extension):
    pixels = np.random.default_rng(3).integers(0, 250, (20, 30, 3)).astype(np.uint8)
    return cv2.imencode(f".{extension}", pixels)[1].tobytes()


def bomb():
    """A small PNG whose header gives 100 000 x 100 000 pixels."""
    header = b"IHDR" + struct.pack(">IIBBBBB", 100_000, 100_000, 8, 2, 0, 0, 0)
    chunks = b"\x89PNG\r\n\x1a\n" + struct.pack(">I", 13) + header + struct.pack(">I", zlib.crc32(header))
    return chunks + b"\0\0\0\0IEND\xaeB`\x82"


@pytest.mark.parametrize("extension", FORMATS)
def test_every_format_is_read_as_rgb(tmp_path, extension):
    file = tmp_path / f"a.{extension}"
    file.write_bytes(encoded(extension))
    assert picture_fault(file) is None
    expected = cv2.cvtColor(cv2.imread(str(file)), cv2.COLOR_BGR2RGB)
    assert np.array_equal(read_picture(file), expected)


@pytest.mark.parametrize("extension", FORMATS)
def test_a_picture_that_is_cut_off_is_refused(tmp_path, extension, capfd):
    file = tmp_path / f"a.{extension}"
    data = encoded(extension)
    file.write_bytes(data[: len(data) * 2 // 3])
    with pytest.raises(ConfigError, match=rf"a\.{extension}: cannot be decoded as an image; .*cut off"):
        read_picture(file, ConfigError)
    if extension in ("png", "jpg"):
        assert picture_fault(file) == "is cut off"
    assert capfd.readouterr().err == ""


@pytest.mark.parametrize("extension", ["png", "jpg"])
def test_what_follows_a_picture_is_not_its_matter(tmp_path, extension, capfd):
    """Phones append a video to a photograph; a header of more than 64 KiB holds what editors write there."""
    data, file = encoded(extension), tmp_path / f"a.{extension}"
    expected = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_COLOR)[..., ::-1]
    video = np.random.default_rng(4).integers(0, 200, 20_000).astype(np.uint8).tobytes()
    note = b"\xff\xff\xe5" + struct.pack(">H", 40_000) + b"\xff\xd9" * 19_999
    several = [data + video, data + b"\0" * 9_000]
    if extension == "jpg":
        several += [data[:2] + 2 * note + data[2:], data[:2] + 2 * note + data[2:] + video]
    for whole in several:
        file.write_bytes(whole)
        assert picture_fault(file) is None
        assert np.array_equal(read_picture(file), expected)
        if not whole.endswith(video):
            continue
        for rest in (b"", video):
            file.write_bytes(whole[: len(whole) - len(video) - 40] + rest)
            assert picture_fault(file) == "is cut off"
            with pytest.raises(DatasetError, match="cut off"):
                read_picture(file)
    assert capfd.readouterr().err == ""


def test_a_picture_of_absurd_size_is_refused_before_it_is_decoded(tmp_path):
    (tmp_path / "bomb.png").write_bytes(bomb())
    with pytest.raises(DatasetError, match=r"bomb\.png: its header gives 100000 x 100000 pixels"):
        read_picture(tmp_path / "bomb.png")
    assert picture_fault(tmp_path / "bomb.png") == "its header gives 100000 x 100000 pixels"
    radiance = b"#?RADIANCE\nFORMAT=32-bit_rle_rgbe\n\n-Y 60000 +X 120000\n"
    assert stated_size(radiance) == (120000, 60000)
    with pytest.raises(DatasetError, match="its header gives 120000 x 60000 pixels"):
        decode_image(radiance, "a.hdr", cv2.IMREAD_UNCHANGED)
    bitmap = bytearray(encoded("bmp"))
    bitmap[18:26] = struct.pack("<ii", 60_000, 60_000)
    with pytest.raises(DatasetError, match="its header gives 60000 x 60000 pixels"):
        decode_image(bytes(bitmap), "a.bmp", cv2.IMREAD_COLOR)
    assert LARGEST_IMAGE_PX < 60_000**2


def test_what_is_no_file_is_refused(tmp_path):
    os.mkfifo(tmp_path / "pipe.png")
    for file, reason in ((tmp_path / "pipe.png", "is a pipe"), (tmp_path, "is a folder"), ("/dev/zero", "is a device")):
        assert picture_fault(file).startswith(reason)
        with pytest.raises(DatasetError, match=f"cannot be read \\({reason}, expected a regular file\\)"):
            read_picture(file)
    assert picture_fault(tmp_path / "none.png") == "No such file or directory"


def test_a_name_that_is_not_utf8_is_read(tmp_path):
    name = os.fsdecode(os.fsencode(tmp_path) + b"/\xff.png")
    with open(name, "wb") as stream:
        stream.write(encoded("png"))
    assert picture_fault(name) is None
    assert read_picture(name).shape == (20, 30, 3)


@pytest.mark.parametrize("extension", FORMATS)
@settings(fuzz, max_examples=60)
@given(change=damage(longest=6))
def test_pictures_of_any_bytes(tmp_path, extension, change):
    file = tmp_path / f"a.{extension}"
    file.write_bytes(change(encoded(extension)))
    fault = picture_fault(file)
    assert fault is None or "\n" not in fault
    try:
        picture = read_picture(file)
    except PoseError as error:
        one_line(error)
    else:
        assert picture.dtype == np.uint8
        assert picture.shape[2] == 3
