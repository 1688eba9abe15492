"""Images that a mesh file names or holds: lookup beside the mesh, size limits, any usual encoding to 8-bit RGB."""

import io
import re
import warnings
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import UInt8
from PIL import Image

from posecore.errors import MeshError, TextureError
from posecore.files import read_regular

LARGEST_SIDE_PX = 16384
"""The largest texture of OpenGL's software renderer."""
LARGEST_AREA_PX = 1 << 26
_FORMATS = ("PNG", "JPEG", "BMP", "TGA", "TIFF", "GIF", "WEBP", "PPM", "DDS")
_LFS = b"version https://git-lfs.github.com/spec/"


@dataclass(frozen=True, kw_only=True, eq=False)
class DecodedImage:
    """A decoded image: (h, w, 3) display colours, row 0 at the top, and (h, w) opacity where it has one."""

    rgb: UInt8[np.ndarray, "h w 3"]
    alpha: UInt8[np.ndarray, "h w"] | None


def refuse_pointer(file: Path, name: str, data: bytes) -> None:
    """Refuse a Git LFS pointer, which stands for a file that was not fetched.

    Raises:
        MeshError: It is a pointer.
    """
    if data.startswith(_LFS):
        raise MeshError(f"{file}: {name} is a Git LFS pointer, not the file itself; run git lfs pull")


def linked_bytes(file: Path, path: Path) -> bytes:
    """Bytes of a file that a mesh file names.

    Raises:
        MeshError: It cannot be read, is no regular file, or a Git LFS pointer.
    """
    try:
        data = read_regular(path)
    except OSError as error:
        raise MeshError(f"{file}: {path} {error.strerror or error}; mend the name or the file") from error
    refuse_pointer(file, str(path), data)
    return data


def missing(file: Path, what: str, folder: Path, name: str) -> TextureError:
    """The error that a file is missing which a mesh file names."""
    clean = name.strip().strip('"').replace("\\", "/")
    shown = str(folder / clean) if len(clean) <= 200 and "\0" not in clean else f"{clean[:80]!r}..."
    return TextureError(f"{file}: its {what} {shown} is missing; put it beside the mesh")


def beside(name: str, folders: Iterable[Path]) -> Path | None:
    """The file that a mesh or material file names, or None.

    Backslashes count as slashes and letter case does not matter. Where the named path is not there, as on another
    machine, the file of that name beside the mesh or the material file is taken.

    Args:
        name: As written in the file, relative or absolute.
        folders: Where relative names start, in order of preference.
    """
    clean = name.strip().strip('"').replace("\\", "/")
    last = clean.rsplit("/", 1)[-1]
    if not last or "\0" in clean:
        return None
    is_absolute = clean.startswith("/") or re.match(r"[A-Za-z]:", clean) is not None
    try:
        if is_absolute and Path(clean).is_file():
            return Path(clean)
        for folder in folders:
            for relative in (last,) if is_absolute else (clean, last):
                file = _any_case(folder, relative)
                if file is not None:
                    return file
    except OSError:  # a name that no file can have
        return None
    return None


def _any_case(folder: Path, relative: str) -> Path | None:
    if (folder / relative).is_file():
        return folder / relative
    path = folder
    for step in relative.split("/"):
        if step in ("", "."):
            continue
        if step == ".." or (path / step).exists():
            path = path / step
            continue
        if not path.is_dir():
            return None
        alike = sorted(entry for entry in path.iterdir() if entry.name.casefold() == step.casefold())
        if not alike:
            return None
        path = alike[0]
    return path if path.is_file() else None


def decode(file: Path, name: str, data: bytes) -> DecodedImage:
    """Decode an image of 8 or 16 bits, with or without colours, palette or opacity.

    Args:
        file: Mesh, for messages.
        name: The image, for messages.
        data: Its bytes.

    Raises:
        MeshError: It is empty, a Git LFS pointer, no image, cut off, too large or of another type.
    """
    if not data:
        raise MeshError(f"{file}: its texture {name} is empty (0 bytes); export it again")
    refuse_pointer(file, f"its texture {name}", data)
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("error", Image.DecompressionBombWarning)
            image = Image.open(io.BytesIO(data), formats=_FORMATS)
    except (Image.DecompressionBombError, Image.DecompressionBombWarning) as error:
        raise _too_large(file, name, "far more") from error
    except Exception as error:  # whatever Pillow's parsers meet in a damaged file
        raise MeshError(f"{file}: its texture {name} is not an image; expected PNG, JPEG or alike") from error
    width, height = image.size
    if max(width, height) > LARGEST_SIDE_PX or width * height > LARGEST_AREA_PX:
        raise _too_large(file, name, f"{width} x {height}")
    try:
        image.load()
        return _picture(file, name, image)
    except MeshError:
        raise
    except Exception as error:
        reason = str(error).splitlines()[0][:80] if str(error) else type(error).__name__
        raise MeshError(
            f"{file}: its texture cannot be decoded: {name} is cut off or damaged ({reason}); export it again"
        ) from error


def _too_large(file: Path, name: str, size: str) -> MeshError:
    return MeshError(
        f"{file}: its texture {name} is too large ({size} pixels), expected at most {LARGEST_SIDE_PX} a side and "
        f"{LARGEST_AREA_PX / 1e6:.0f} million in all; scale it down"
    )


def _picture(file: Path, name: str, image: Image.Image) -> DecodedImage:
    if image.mode.startswith("I"):  # 16 bits of grey, which Pillow would clip at 255
        deep = np.asarray(image).astype(np.int64)
        if deep.min() < 0 or deep.max() > 65535:
            raise MeshError(f"{file}: its texture {name} holds values beyond 16 bits; export it with 8 bits")
        grey = np.rint(deep / 257.0).astype(np.uint8)
        return DecodedImage(rgb=np.repeat(grey[..., None], 3, axis=2), alpha=None)
    if image.mode == "F":
        raise MeshError(f"{file}: its texture {name} holds floating-point pixels; export it with 8 bits")
    alpha = None
    if "A" in image.getbands() or "a" in image.getbands() or "transparency" in image.info:
        alpha = np.asarray(image.convert("RGBA").getchannel("A"), np.uint8)
    return DecodedImage(rgb=np.asarray(image.convert("RGB"), np.uint8), alpha=alpha)
