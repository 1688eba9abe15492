"""Image files of a BOP dataset: lookup, size, pixels."""

from pathlib import Path

import cv2
import numpy as np
from jaxtyping import Bool, Shaped, UInt8

from posecore.bop.file_slice import StoredFile, stored
from posecore.errors import DatasetError, StorageError
from posecore.files import write_atomic
from posecore.image_file import HEAD_BYTES, LARGEST_IMAGE_PX, decode_image, stated_size

COLOUR_EXTENSIONS = ("png", "jpg", "jpeg", "tif", "tiff")
DEPTH_EXTENSIONS = ("png", "tif", "tiff")


def find_image(folders: tuple[Path, ...], name: str, extensions: tuple[str, ...]) -> Path | None:
    """The first existing file of this name in the folders, in the order of the extensions, or None."""
    for folder in folders:
        for extension in extensions:
            path = folder / f"{name}.{extension}"
            if path.is_file():
                return path
    return None


def read_image(file: Path | StoredFile, flags: int) -> Shaped[np.ndarray, "h w *c"]:
    """Decode an image file with OpenCV's flags; colours in OpenCV's order.

    Raises:
        DatasetError: the file is missing, cut off, damaged, absurdly large or not an image.
    """
    source = stored(file)
    return decode_image(source.read(), str(source), flags)


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
    size = stated_size(source.read(HEAD_BYTES))
    if size is None or not 0 < size[0] * size[1] <= LARGEST_IMAGE_PX:
        height, width = read_image(source, cv2.IMREAD_UNCHANGED).shape[:2]
        return int(width), int(height)
    return size


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
