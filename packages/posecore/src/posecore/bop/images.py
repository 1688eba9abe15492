"""Image files of a BOP folder: which one there is, its size, its pixels."""

import struct
from pathlib import Path

import cv2
import numpy as np
from jaxtyping import Shaped, UInt8

from posecore.errors import DatasetError, StorageError
from posecore.files import write_atomic

Array = np.ndarray
COLOUR_FILES = tuple((folder, ext) for folder in ("rgb", "gray") for ext in ("png", "jpg", "jpeg", "tif", "tiff"))
DEPTH_FILES = tuple(("depth", ext) for ext in ("png", "tif", "tiff"))
_ENDINGS = ((b"\x89PNG", b"IEND"), (b"\xff\xd8", b"\xff\xd9"))  # how a whole file starts and ends


def find_image(scene: Path, im_id: int, choices: tuple[tuple[str, str], ...]) -> Path | None:
    """The first existing file among (folder, extension) `choices`, or None."""
    for folder, extension in choices:
        path = scene / folder / f"{im_id:06d}.{extension}"
        if path.is_file():
            return path
    return None


def read_image(path: Path, flags: int) -> Shaped[Array, "h w *c"]:
    """Decode an image file with OpenCV's flags; colours stay in OpenCV's order.

    Raises:
        DatasetError: the file is missing, cut off or not an image.
    """
    try:
        data = path.read_bytes()
    except OSError:
        data = b""
    # OpenCV fills the rest of a JPEG that is cut off with grey, and lets libpng complain on stderr about a PNG.
    ending = next((end for start, end in _ENDINGS if data.startswith(start)), b"")
    image = cv2.imdecode(np.frombuffer(data, np.uint8), flags) if data and ending in data[-4096:] else None
    if image is None:
        raise DatasetError(f"{path}: cannot be decoded as an image; the file is missing or cut off, copy it again")
    return image


def read_rgb(path: Path) -> UInt8[Array, "h w 3"]:
    """Read a colour or gray image as 8-bit RGB; 16-bit images are scaled down."""
    image = read_image(path, cv2.IMREAD_COLOR)
    return cv2.cvtColor(image, cv2.COLOR_BGR2RGB)


def image_size(path: Path) -> tuple[int, int]:
    """Width and height in pixels, from the header of a PNG or JPEG, else by decoding.

    Raises:
        DatasetError: the file cannot be decoded.
    """
    data = path.read_bytes()
    if data[:8] == b"\x89PNG\r\n\x1a\n" and len(data) >= 24:
        width, height = struct.unpack(">II", data[16:24])
        return int(width), int(height)
    size = _jpeg_size(data) if data[:2] == b"\xff\xd8" else None
    if size is not None:
        return size
    height, width = read_image(path, cv2.IMREAD_UNCHANGED).shape[:2]
    return width, height


def _jpeg_size(data: bytes) -> tuple[int, int] | None:
    """Walk the segments up to the frame header; None if there is none, or an EXIF orientation may turn the image."""
    position = 2
    while position + 9 < len(data) and data[position] == 0xFF:
        marker, length = data[position + 1], struct.unpack(">H", data[position + 2 : position + 4])[0]
        if marker == 0xE1:
            return None
        if 0xC0 <= marker <= 0xCF and marker not in (0xC4, 0xC8, 0xCC):
            height, width = struct.unpack(">HH", data[position + 5 : position + 9])
            return int(width), int(height)
        position += 2 + length
    return None


def write_image(path: Path, image: Shaped[Array, "h w *c"], jpeg_quality: int = 95) -> None:
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
