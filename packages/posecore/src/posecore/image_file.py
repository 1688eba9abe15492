"""Decoding of picture files: size limits, truncated files, and the file's name in each error.

Photographs, Radiance panoramas and, by `posecore.bop.images`, BOP's images come through here. Textures of meshes have
`posecore.mesh_files.images`, OpenEXR panoramas `synthgen.image.hdri`.
"""

import io
import re
import struct
import warnings
import zlib
from collections import deque
from collections.abc import Iterator
from pathlib import Path

import cv2
import numpy as np
from jaxtyping import Shaped, UInt8

from posecore.errors import DatasetError, PoseError
from posecore.files import open_regular, read_regular

cv2.setLogLevel(0)  # it logs what is refused here in one line

LARGEST_IMAGE_PX = 1 << 28
HEAD_BYTES = 1 << 16
"""Bytes from the start that hold the header of a PNG or JPEG."""
_TAIL_BYTES = 1 << 12
_PNG, _JPEG, _JPEG_END = b"\x89PNG\r\n\x1a\n", b"\xff\xd8", b"\xff\xd9"
_JPEG_SCAN = 0xDA
_PNG_END = b"\0\0\0\0IEND\xaeB`\x82"
_RADIANCE_SIZE = re.compile(rb"\n[-+]Y (\d{1,9}) [-+]X (\d{1,9})\n")


def decode_image(
    data: bytes, name: str, flags: int, error: type[PoseError] = DatasetError
) -> Shaped[np.ndarray, "h w *c"]:
    """Decode with OpenCV's flags; colours are in OpenCV's order.

    Args:
        data: The file's bytes.
        name: Of the file, for errors.
        flags: OpenCV's `IMREAD_*`.
        error: Class of the errors.

    Raises:
        PoseError: Of that class: not an image, cut off, damaged, or larger than `LARGEST_IMAGE_PX`.
    """
    require_size(stated_size(data) or _size_by_pillow(data), name, error)
    image = None
    if data and _is_whole(data):
        try:
            image = cv2.imdecode(np.frombuffer(data, np.uint8), flags)
        except (cv2.error, MemoryError):
            image = None
    if image is None:
        raise error(f"{name}: cannot be decoded as an image; the file is missing or cut off, copy it again")
    return np.asarray(image)


def read_picture(
    path: str | Path, error: type[PoseError] = DatasetError, flags: int = cv2.IMREAD_COLOR
) -> UInt8[np.ndarray, "h w 3"]:
    """Read a colour or gray picture as 8-bit RGB; an EXIF orientation is followed unless the flags exclude it.

    Raises:
        PoseError: Of the class `error`: as `decode_image`, or no regular file.
    """
    try:
        data = read_regular(path)
    except OSError as reason:
        raise error(f"{path}: cannot be read ({reason.strerror}); give a picture") from reason
    return np.ascontiguousarray(decode_image(data, str(path), flags, error)[..., ::-1])


def picture_fault(path: str | Path) -> str | None:
    """Reason why a file is no whole picture; None if nothing is found.

    First and last bytes of a PNG or JPEG decide where its header and its end are in them.
    """
    try:
        with open_regular(path) as stream:
            head = stream.read(HEAD_BYTES)
            length = stream.seek(0, io.SEEK_END)
            stream.seek(max(0, length - _TAIL_BYTES))
            tail = stream.read()
            end = next((end for start, end in ((_PNG, _PNG_END), (_JPEG, _JPEG_END)) if head.startswith(start)), b"")
            size, is_whole = stated_size(head), end in tail
            if size is None or not is_whole:
                stream.seek(0)
                data = stream.read()
                size, is_whole = stated_size(data) or _size_by_pillow(data), _is_whole(data)
    except OSError as error:
        return str(error.strerror)
    if size is None:
        return "is not an image"
    if not 0 < size[0] * size[1] <= LARGEST_IMAGE_PX:
        return f"its header gives {size[0]} x {size[1]} pixels"
    return None if is_whole else "is cut off"


def require_size(size: tuple[int, int] | None, name: str, error: type[PoseError] = DatasetError) -> None:
    """Refuse an image by the width and height that its header gives; None passes.

    Raises:
        PoseError: Of the class `error`.
    """
    if size is not None and not 0 < size[0] * size[1] <= LARGEST_IMAGE_PX:
        raise error(f"{name}: its header gives {size[0]} x {size[1]} pixels; the file is damaged, copy it again")


def stated_size(data: bytes) -> tuple[int, int] | None:
    """Width and height from the header of a PNG, JPEG or Radiance HDR; None if it has none."""
    if data.startswith(_PNG) and len(data) >= 33:
        width, height = struct.unpack(">II", data[16:24])
        is_intact = zlib.crc32(data[12:29]) == struct.unpack(">I", data[29:33])[0]
        return (int(width), int(height)) if is_intact else None
    if data.startswith(b"#?"):
        match = _RADIANCE_SIZE.search(data, 0, HEAD_BYTES)
        return None if match is None else (int(match[2]), int(match[1]))
    return _jpeg_size(data) if data.startswith(_JPEG) else None


def _jpeg_size(data: bytes) -> tuple[int, int] | None:
    """Width and height of the frame header; None if there is none."""
    for position in _jpeg_segments(data):
        if 0xC0 <= data[position + 1] <= 0xCF and data[position + 1] not in (0xC4, 0xC8, 0xCC):
            height, width = struct.unpack(">HH", data[position + 5 : position + 9])
            return int(width), int(height)
    return None


def _jpeg_segments(data: bytes) -> Iterator[int]:
    """Positions of the segments before the pixels; the last is that of the pixels, where the file has them."""
    position = 2
    while position + 9 < len(data) and data[position] == 0xFF:
        if data[position + 1] == 0xFF:  # a fill byte
            position += 1
            continue
        yield position
        if data[position + 1] == _JPEG_SCAN:
            return
        position += 2 + int(struct.unpack(">H", data[position + 2 : position + 4])[0])


def _size_by_pillow(data: bytes) -> tuple[int, int] | None:
    """Width and height of other formats, which Pillow reads without decoding; None where it does not take the file."""
    if data.startswith((_PNG, _JPEG, b"#?")):
        return None
    from PIL import Image

    limit, Image.MAX_IMAGE_PIXELS = Image.MAX_IMAGE_PIXELS, None  # it would warn at a third of the limit here
    try:
        with warnings.catch_warnings(action="ignore"), Image.open(io.BytesIO(data)) as image:
            return image.size
    except Exception:  # whatever its parsers meet in a damaged file
        return None
    finally:
        Image.MAX_IMAGE_PIXELS = limit


def _is_whole(data: bytes) -> bool:
    """Whether a PNG or JPEG is complete; other data may follow, as phones append videos.

    OpenCV fills the rest of a truncated JPEG with grey and prints libpng's warnings about a PNG. Pillow's `verify`
    accepts truncated JPEGs and takes 80 to 150 us more for each file.
    """
    if data.startswith(_PNG):
        return _whole_png(data)
    if data.startswith(_JPEG):
        pixels = deque(_jpeg_segments(data), maxlen=1)  # no pixel has these bytes; a thumbnail before them may
        return bool(pixels) and data.find(_JPEG_END, pixels[0]) >= 0
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
