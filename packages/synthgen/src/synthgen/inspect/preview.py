"""Contact sheets: samples of a dataset with their labels overlaid."""

from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from itertools import groupby
from pathlib import Path

import cv2
import numpy as np
from jaxtyping import Float, UInt8
from posecore import se3
from posecore.camera import project
from posecore.contour import contour_mask
from posecore.errors import ConfigError, ShardError
from posecore.files import write_atomic
from posecore.mesh import Mesh
from posecore.shard import BIT_FOREGROUND, BIT_OBJECT, BIT_VISIBLE, ShardReader, load_meshes

from synthgen.inputs.sources import diameter_text

Image = UInt8[np.ndarray, "h w 3"]

CELL_PX = 256
_CAPTION_PX = 22
_FARTHEST_DOT_PX = 1e6
_TITLES = (
    "scene, ground truth green, hypothesis red",
    "hypothesis and its contour",
    "distance to ground-truth contour",
    "distance to hypothesis contour",
    "visible, hidden, other",
    "scene depth",
)
_GREEN, _RED = (60, 255, 60), (255, 60, 60)


def contact_sheet(url: str, count: int, *, first: int | None = None) -> Image:
    """Draw samples of a dataset, one row each.

    Args:
        url: Shard dataset, complete or growing.
        count: Rows at most.
        first: Index of the first of consecutive samples; None spreads the samples over the scenes.

    Raises:
        ShardError: Nothing to show.
    """
    reader = ShardReader(url)
    rendered = [i for shard in reader.committed for i in _indices_of(reader, shard)]
    indices = _spread(reader, count) if first is None else [i for i in rendered if first <= i < first + count]
    if not indices:
        raise ShardError(
            f"{url}: no rendered sample from {first or 0} on; {len(rendered)} of {reader.n} samples are rendered"
        )
    meshes = load_meshes(reader)
    rows = []
    for shard_id, shown in groupby(indices, key=lambda i: i // reader.shard_size):
        samples = reader.read_checked(shard_id)
        start = shard_id * reader.shard_size
        rows += [sample_row({k: v[i - start] for k, v in samples.items()}, i, meshes) for i in shown]
    return np.concatenate([title_row(), *rows])


def _indices_of(reader: ShardReader, shard_id: int) -> range:
    start = shard_id * reader.shard_size
    return range(start, start + reader.n_samples(shard_id))


def _spread(reader: ShardReader, count: int) -> list[int]:
    """Samples of as many scenes as possible, evenly over the dataset; a scene's further ones where scenes are few."""
    ranked: dict[int, list[int]] = {}  # samples by their number within the scene
    seen: Counter[int] = Counter()
    for shard_id in reader.committed:
        scenes = reader.read(shard_id, ["scene_index"])["scene_index"].tolist()
        for index, scene in zip(_indices_of(reader, shard_id), scenes, strict=True):
            ranked.setdefault(seen[scene], []).append(index)
            seen[scene] += 1
    chosen: list[int] = []
    for _, indices in sorted(ranked.items()):
        missing = min(count - len(chosen), len(indices))
        chosen += [indices[i * len(indices) // missing] for i in range(missing)]
    return sorted(chosen)


def save_contact_sheet(
    url: str,
    file: Path,
    count: int,
    *,
    first: int | None = None,
    on_objects: Callable[[Sequence[str]], None] = lambda lines: None,
) -> tuple[int, int]:
    """Write a contact sheet as a picture; see `contact_sheet`.

    Args:
        url: Shard dataset.
        file: Picture.
        count: Rows at most.
        first: Index of the first of consecutive samples.
        on_objects: Called once with a line for each object, its diameter.

    Returns:
        Width and height, pixels.

    Raises:
        ConfigError: The file's name does not end in .png or .jpg.
        ShardError: Nothing to show.
        StorageError: The file cannot be written.
    """
    if file.suffix.lower() not in (".png", ".jpg", ".jpeg"):
        raise ConfigError(f"--out {file}: expected a .png or .jpg file")
    objects = ShardReader(url).card["objects"].values()
    on_objects([diameter_text(card["name"], card["diameter_m"]) for card in objects])
    sheet = contact_sheet(url, count, first=first)
    ok, data = cv2.imencode(file.suffix, sheet[..., ::-1])
    assert ok
    write_atomic(file, data.tobytes())
    return sheet.shape[1], sheet.shape[0]


def sample_row(sample: Mapping[str, np.ndarray], index: int, meshes: Mapping[int, Mesh]) -> Image:
    """Row of a contact sheet from the fields of a sample and the dataset's meshes by object id."""
    K = sample["K_crop"]
    scale = CELL_PX / sample["scene_rgb"].shape[0]
    uv_scene = project(K, sample["scene_contour_cam_m"].astype(np.float64)) * scale
    uv_hypothesis = project(K, sample["hypothesis_contour_cam_m"].astype(np.float64)) * scale
    limit = max(1.0, float(np.percentile(sample["scene_distance_px"], 98)))
    cells = [
        _dots(_dots(_enlarge(sample["scene_rgb"]), uv_hypothesis, _RED), uv_scene, _GREEN),
        _dots(_enlarge(sample["hypothesis_rgb"]), uv_hypothesis, _RED),
        _enlarge(_colour_mapped(sample["scene_distance_px"], 0.0, limit)),
        _enlarge(_colour_mapped(sample["hypothesis_distance_px"], 0.0, limit)),
        _enlarge(_mask_colours(sample["scene_mask"])),
        _enlarge(_depth_colours(sample["scene_depth_m"])),
    ]
    R = sample["T_cam_obj_hypothesis"][:3, :3] @ sample["T_cam_obj"][:3, :3].T
    angle = np.rad2deg(se3.rotation_angle_rad(R))
    mesh = meshes.get(int(sample["obj_id"]))  # none in a damaged dataset
    moved_m = (
        np.nan
        if mesh is None
        else mesh.center_cam_m(sample["T_cam_obj_hypothesis"]) - mesh.center_cam_m(sample["T_cam_obj"])
    )
    shift_mm = 1e3 * np.linalg.norm(moved_m)
    caption = (
        f"sample {index}  scene {sample['scene_index']}  object {sample['obj_id']}  hypothesis off by {angle:.1f} deg, "
        f"{shift_mm:.1f} mm  visible {sample['visible_fraction']:.2f}  rejected {sample['rejected']}"
    )
    return np.concatenate([np.concatenate(cells, axis=1), _strip([caption], len(cells))])


def _enlarge(image: Image) -> UInt8[np.ndarray, "cell cell 3"]:
    return np.asarray(cv2.resize(image, (CELL_PX, CELL_PX), interpolation=cv2.INTER_NEAREST))


def _dots(image: Image, uv_px: Float[np.ndarray, "n 2"], colour: tuple[int, int, int]) -> Image:
    """Dots at continuous image coordinates; OpenCV has pixel centres at integers, in units of 1/16 px here."""
    image = np.ascontiguousarray(image)
    uv_px = uv_px[(np.abs(uv_px) < _FARTHEST_DOT_PX).all(axis=1)]  # NaN is not
    for u, v in np.rint((uv_px - 0.5) * 16).astype(int):
        cv2.circle(image, (int(u), int(v)), 16, colour, -1, cv2.LINE_AA, shift=4)
    return image


def _colour_mapped(values: Float[np.ndarray, "h w"], low: float, high: float) -> Image:
    grey = (np.clip((values - low) / max(high - low, 1e-9), 0, 1) * 255).astype(np.uint8)
    return np.ascontiguousarray(cv2.applyColorMap(grey, cv2.COLORMAP_TURBO)[..., ::-1])


def _depth_colours(depth_m: Float[np.ndarray, "h w"]) -> Image:
    hit = depth_m > 0
    low, high = (float(depth_m[hit].min()), float(depth_m[hit].max())) if hit.any() else (0.0, 1.0)
    return np.where(hit[..., None], _colour_mapped(-depth_m, -high, -low), 0).astype(np.uint8)


def _mask_colours(mask: UInt8[np.ndarray, "h w"]) -> Image:
    """Visible part white, hidden part red, other objects blue, the silhouette's contour green."""
    image = np.zeros((*mask.shape, 3), np.uint8)
    image[mask & BIT_FOREGROUND > 0] = (60, 90, 160)
    image[mask & BIT_OBJECT > 0] = (190, 60, 60)
    image[mask & BIT_VISIBLE > 0] = (235, 235, 235)
    image[contour_mask(mask & BIT_OBJECT > 0)] = _GREEN
    return image


def title_row() -> Image:
    """Headings above the rows of a contact sheet."""
    return _strip(_TITLES, len(_TITLES))


def _strip(texts: Sequence[str], cells: int) -> Image:
    strip = np.full((_CAPTION_PX, cells * CELL_PX, 3), 24, np.uint8)
    for i, text in enumerate(texts):
        size = 0.3 if len(texts) > 1 else 0.42
        origin = (i * CELL_PX + 4, _CAPTION_PX - 7)
        cv2.putText(strip, text, origin, cv2.FONT_HERSHEY_SIMPLEX, size, (230, 230, 230), 1, cv2.LINE_AA)
    return strip
