"""Image files of a BOP dataset: lookup, size, pixels."""

import struct
import zlib
from pathlib import Path

import cv2
import numpy as np
from jaxtyping import Bool, Shaped, UInt8

from posecore.bop.file_slice import StoredFile, stored
from posecore.errors import DatasetError, StorageError
from posecore.files import write_atomic

COLOUR_EXTENSIONS = ("png", "jpg", "jpeg", "tif", "tiff")
DEPTH_EXTENSIONS = ("png", "tif", "tiff")
LARGEST_IMAGE_PX = 1 << 28
_PNG = b"\x89PNG\r\n\x1a\n"
_HEAD_BYTES = 1 << 16


def find_image(folders: tuple[Path, ...], name: str, extensions: tuple[str, ...]) -> Path | None:
    """The first existing file of this name in the folders, in the order of the extensions, or None."""
    for folder in folders:
        for extension in extensions:
            path = folder / f"{name}.{extension}"
            if path.is_file():
                return path
    return None


def read_image(file: Path | StoredFile, flags: int) -> Shaped[np.ndarray, "h w *c"]:
    """Decode an image file with OpenCV's flags, as stored (EXIF orientation is ignored); colours in OpenCV's order.

    Raises:
        DatasetError: the file is missing, cut off, damaged, absurdly large or not an image.
    """
    source = stored(file)
    try:
        data = source.read()
    except DatasetError:
        data = b""
    size = _stated_size(data)
    if size is not None and not 0 < size[0] * size[1] <= LARGEST_IMAGE_PX:
        raise DatasetError(
            f"{source}: its header gives {size[0]} x {size[1]} pixels; the file is damaged, copy it again"
        )
    image = None
    if data and _is_whole(data):
        try:
            image = cv2.imdecode(np.frombuffer(data, np.uint8), flags)
        except (cv2.error, MemoryError):
            image = None
    if image is None:
        raise DatasetError(f"{source}: cannot be decoded as an image; the file is missing or cut off, copy it again")
    return np.asarray(image)


def _is_whole(data: bytes) -> bool:
    """Whether a PNG or JPEG is complete.

    OpenCV fills the rest of a truncated JPEG with grey and prints libpng's warnings about a PNG. Pillow's `verify`
    accepts truncated JPEGs and takes 80 to 150 us more for each file.
    """
    if data.startswith(_PNG):
        return _whole_png(data)
    if data.startswith(b"\xff\xd8"):
        return b"\xff\xd9" in data[-4096:]
    return True


def _whole_png(data: bytes) -> bool:
    position = len(_PNG)
    while position + 12 <= len(data):
        (length,) = struct.unpack(">I", data[position : position + 4])
        end = position + 8 + length
        if end + 4 > len(data):
            return False
        body = memoryview(data)[position + 4 : end]
        if zlib.crc32(body) != struct.unpack(">I", data[end : end + 4])[0]:
            return False
        if bytes(body[:4]) == b"IEND":
            return True
        position = end + 4
    return False


def read_rgb(file: Path | StoredFile) -> UInt8[np.ndarray, "h w 3"]:
    """Read a colour or gray image as 8-bit RGB; 16-bit images are scaled down.

    Raises:
        DatasetError: the file is not a whole image of 8 or 16 bits.
    """
    image = read_image(file, cv2.IMREAD_COLOR | cv2.IMREAD_IGNORE_ORIENTATION)
    if image.dtype != np.uint8:
        raise DatasetError(f"{file}: holds {image.dtype} pixels, expected a colour or gray image of 8 or 16 bits")
    return cv2.cvtColor(image, cv2.COLOR_BGR2RGB)


def read_depth(file: Path | StoredFile) -> Shaped[np.ndarray, "h w"]:
    """Read a depth image's stored numbers.

    Raises:
        DatasetError: the file is not a whole image with one channel.
    """
    raw = read_image(file, cv2.IMREAD_UNCHANGED)
    if raw.ndim != 2:
        raise DatasetError(f"{file}: found {raw.ndim} axes, expected a depth image with one channel")
    return raw


def read_mask(file: Path | StoredFile) -> Bool[np.ndarray, "h w"]:
    """Read a mask image: true where it is not 0.

    Raises:
        DatasetError: the file is not a whole image.
    """
    return np.asarray(read_image(file, cv2.IMREAD_GRAYSCALE | cv2.IMREAD_IGNORE_ORIENTATION) > 0)


def image_size(file: Path | StoredFile) -> tuple[int, int]:
    """Width and height in pixels, from the header of a PNG or JPEG, else by decoding.

    Raises:
        DatasetError: the file cannot be read or decoded.
    """
    source = stored(file)
    size = _stated_size(source.read(_HEAD_BYTES))
    if size is None or not 0 < size[0] * size[1] <= LARGEST_IMAGE_PX:
        height, width = read_image(source, cv2.IMREAD_UNCHANGED).shape[:2]
        return int(width), int(height)
    return size


def _stated_size(data: bytes) -> tuple[int, int] | None:
    """Width and height from the header of a PNG or JPEG; None if it has none."""
    if data.startswith(_PNG) and len(data) >= 33:
        width, height = struct.unpack(">II", data[16:24])
        is_intact = zlib.crc32(data[12:29]) == struct.unpack(">I", data[29:33])[0]
        return (int(width), int(height)) if is_intact else None
    return _jpeg_size(data) if data.startswith(b"\xff\xd8") else None


def _jpeg_size(data: bytes) -> tuple[int, int] | None:
    """Walk the segments up to the frame header; None if there is none."""
    position = 2
    while position + 9 < len(data) and data[position] == 0xFF:
        marker, length = data[position + 1], struct.unpack(">H", data[position + 2 : position + 4])[0]
        if 0xC0 <= marker <= 0xCF and marker not in (0xC4, 0xC8, 0xCC):
            height, width = struct.unpack(">HH", data[position + 5 : position + 9])
            return int(width), int(height)
        position += 2 + length
    return None


def write_image(path: Path, image: Shaped[np.ndarray, "h w *c"], jpeg_quality: int = 95) -> None:
    """Encode by the file's extension and write atomically; three channels are RGB.

    Raises:
        StorageError: the encoder refuses the image, or the file cannot be written.
    """
    pixels = cv2.cvtColor(image, cv2.COLOR_RGB2BGR) if image.ndim == 3 else image
    options = [cv2.IMWRITE_JPEG_QUALITY, jpeg_quality] if path.suffix == ".jpg" else []
    ok, data = cv2.imencode(path.suffix, pixels, options)
    if not ok:
        raise StorageError(f"{path}: an image of shape {image.shape} and {image.dtype} cannot be encoded")
    write_atomic(path, data.tobytes())
