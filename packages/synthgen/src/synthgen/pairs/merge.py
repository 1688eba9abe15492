"""Merging of pair datasets: rendered pairs with pairs cut from images, or more scenes of a recipe."""

import json
from collections.abc import Callable, Iterator, Mapping, Sequence
from typing import Any

import numpy as np
from posecore import shard
from posecore.bop.jsonfile import id_of, parse_bop_json
from posecore.bop.models_info import load_model_info
from posecore.errors import ShardError
from posecore.mesh import mesh_digest
from posecore.schema import shown
from posecore.shard import MODELS_INFO, ShardReader, ShardWriter, load_meshes, model_keys

from synthgen import lock
from synthgen.pairs.data_card import create_writer
from synthgen.pairs.export import complete_dataset

_SAME = ("schema", "schema_version", "patch_px", "contour_points", "units")
_CAMERA = ("width_px", "height_px", "fx", "fy", "cx", "cy")


def merge_datasets(
    urls: Sequence[str],
    out: str,
    *,
    on_start: Callable[[int], None] = lambda pairs: None,
    on_shard: Callable[[int], None] = lambda pairs: None,
) -> int:
    """Merge datasets into a new one, or continue an unfinished merge of the same datasets.

    Args:
        urls: Complete datasets.
        out: Folder or fsspec URL.
        on_start: Called with the number of pairs of all datasets before the first shard.
        on_shard: Called with the number of pairs of each shard, earlier ones included.

    Returns:
        The number of pairs.

    Raises:
        ShardError: See `open_parts`; or the folder holds another dataset.
        StorageError: The dataset cannot be written, or another process writes it.
    """
    parts = open_parts(urls)
    card = merged_card(parts)
    with lock.held(out):
        writer = create_writer(out, card)
        on_start(card["n"])
        write_merged(parts, writer, on_shard)
    return int(card["n"])


def open_parts(urls: Sequence[str]) -> list[ShardReader]:
    """Datasets that can be merged.

    Raises:
        ShardError: A dataset is incomplete, listed twice, or differs from the first in a property that all samples must
            have in common; or two datasets number the same scenes differently.
    """
    parts = [complete_dataset(url) for url in urls]
    for part in parts:
        part.require("objects", "camera", "units", "versions")
    _require_one_numbering(parts)
    first = parts[0]
    digests: dict[str, str] = {}
    objects: dict[int, tuple[str, str, str]] = {}
    for part in parts:
        if part.digest in digests:
            raise ShardError(f"{part.url}: holds the same pairs as {digests[part.digest]}; name it once")
        digests[part.digest] = part.url
        for key in _SAME:
            if part.card[key] != first.card[key]:
                raise ShardError(
                    f"{part.url}: {key} is {part.card[key]}, expected {first.card[key]} as in {first.url}; only "
                    "datasets that agree in it can be merged"
                )
        infos = _model_entries(part)
        for obj_id, mesh in load_meshes(part).items():
            symmetries = {
                key: value for key, value in infos.get(str(obj_id), {}).items() if key.startswith("symmetries")
            }
            described = mesh_digest(mesh), json.dumps(symmetries, sort_keys=True), part.url
            expected = objects.setdefault(obj_id, described)
            if expected[:2] != described[:2]:
                what = "another mesh" if expected[0] != described[0] else "other symmetries"
                raise ShardError(
                    f"{part.url}: object {obj_id} has {what} than in {expected[2]}; rename its file, whose number is "
                    "the object's, or make all datasets from the same one"
                )
    return parts


def _model_entries(part: ShardReader) -> dict[str, Any]:
    """Entries of a dataset's `models_info.json` by object id as text, each one checked."""
    where = f"{part.url}/{MODELS_INFO}"
    entries: dict[str, Any] = parse_bop_json(part.file(MODELS_INFO), where)
    for obj_id, entry in entries.items():
        load_model_info(entry, f"{where}, object {obj_id}")
        if id_of(obj_id) is None:
            raise ShardError(f"{where}: the key {shown(obj_id)} is no object id; render the dataset again")
    return entries


def _source(card: Mapping[str, Any]) -> tuple[Any, ...]:
    """Identity of a dataset's scenes according to its card; datasets with equal ones may have common scenes."""
    if "source" in card:
        return "cut", card["source"]["dataset"], card["source"]["split"]
    return "rendered", card["seed"], *sorted(entry["sha256"] for entry in card["objects"].values())


def _require_one_numbering(parts: Sequence[ShardReader]) -> None:
    """Refuse parts in which one scene would get two numbers: validation holds out whole scenes."""
    blocks: dict[tuple[Any, ...], tuple[int, str]] = {}
    inside: dict[tuple[Any, ...], str] = {}
    for part in parts:
        if "merged" in part.card:
            for below in _sources_below(part.card):
                if inside.setdefault(below, part.url) != part.url:
                    raise ShardError(
                        f"{part.url}: may show scenes that {inside[below]} shows, and both are merged; merge the parts "
                        "of both instead"
                    )
            continue
        size = int(part.card["cut"].get("images_per_scene", 0)) if "cut" in part.card else 0
        first, url = blocks.setdefault(_source(part.card), (size, part.url))
        if first != size:
            raise ShardError(
                f"{part.url}: images_per_scene is {size}, expected {first} as in {url}, which was cut from images of "
                "the same name: else validation would not hold out whole scenes; if these are other images, rename "
                "their folder and cut them again"
            )
    for source, (_, url) in blocks.items():
        if source in inside:
            raise ShardError(
                f"{url}: shows scenes that {inside[source]}, which is merged, may show too; merge the parts of the "
                "merged dataset instead"
            )


def _sources_below(card: Mapping[str, Any]) -> set[tuple[Any, ...]]:
    """Identities of the scenes in the parts of a merged dataset."""
    sources: set[tuple[Any, ...]] = set()
    for part in card["merged"]:
        sources |= _sources_below(part["card"]) if "merged" in part["card"] else {_source(part["card"])}
    return sources


def merged_card(parts: Sequence[ShardReader]) -> dict[str, Any]:
    """Data card of the merged dataset; it holds the cards of the parts with their digests."""
    cards = [part.card for part in parts]
    camera = {key: cards[0]["camera"][key] for key in _CAMERA}
    shared = all(
        card["camera"].get("shared", True) and {key: card["camera"][key] for key in _CAMERA} == camera for card in cards
    )
    objects: dict[str, dict[str, Any]] = {}
    windows = {card.get("windows", "fixed") for card in cards}
    for card in cards:
        for obj_id, entry in card["objects"].items():
            common = objects.setdefault(obj_id, dict(entry))
            if common["window_side_px"] != entry["window_side_px"]:
                windows.add("mixed")
                common["window_side_px"] = max(common["window_side_px"], entry["window_side_px"])
    return {
        "n": sum(part.n for part in parts),
        "shard_size": cards[0]["shard_size"],
        **{key: cards[0][key] for key in _SAME if not key.startswith("schema")},
        "depth_step_m": max(card["depth_step_m"] for card in cards),
        "seed": [card["seed"] for card in cards],
        "windows": windows.pop() if len(windows) == 1 else "mixed",
        "objects": dict(sorted(objects.items(), key=lambda item: int(item[0]))),
        "camera": camera | {"shared": shared},
        "versions": cards[0]["versions"],
        "merged": [{"digest": part.digest, "card": dict(part.card)} for part in parts],
    }


def write_merged(
    parts: Sequence[ShardReader], writer: ShardWriter, on_shard: Callable[[int], None] = lambda n: None
) -> None:
    """Write the pairs of all parts in their order; scenes are renumbered so that different scenes differ in number.

    Parts with possibly equal scenes, e.g. cut from the same images, have common numbers. Committed shards are kept.

    Args:
        parts: Result of `open_parts`.
        writer: Writer of a dataset with their `merged_card`.
        on_shard: Called with the number of pairs of each shard, earlier ones included.
    """
    infos: dict[str, Any] = {}
    copied: set[str] = set()
    for part in parts:
        for key in model_keys(part):
            if key != MODELS_INFO and key not in copied:
                copied.add(key)
                writer.add_file(key, part.file(key))
        infos = _model_entries(part) | infos
    text = json.dumps(dict(sorted(infos.items(), key=lambda item: int(item[0]))), indent=2)
    writer.add_file(MODELS_INFO, text.encode())
    committed = set(writer.committed()) - set(writer.damaged())
    rows = _Rows(parts)
    for shard_id in range(shard.n_shards(writer.card)):
        count = shard.samples_in(writer.card, shard_id)
        if shard_id not in committed:
            first = shard_id * int(writer.card["shard_size"])
            writer.commit(writer.encode(shard_id, rows.between(first, first + count)))
        on_shard(count)


class _Rows:
    """Rows of the parts by their index in the merged dataset; caches the last shard."""

    def __init__(self, parts: Sequence[ShardReader]) -> None:
        self._parts = parts
        self._first = np.cumsum([0, *(part.n for part in parts)]).tolist()
        sources = [(number,) if "merged" in part.card else _source(part.card) for number, part in enumerate(parts)]
        scenes: dict[tuple[Any, ...], int] = {}
        for part, source in zip(parts, sources, strict=True):
            last = max(int(part.read_checked(i, ["scene_index"])["scene_index"].max()) for i in part.committed)
            scenes[source] = max(scenes.get(source, 0), last + 1)
        first = dict(zip(scenes, np.cumsum([0, *scenes.values()]).tolist(), strict=False))
        self._scenes = [first[source] for source in sources]
        self._last: tuple[tuple[int, int], dict[str, np.ndarray]] | None = None

    def between(self, start: int, end: int) -> dict[str, np.ndarray]:
        """Every field of the rows from `start` to `end`, exclusive."""
        pieces = list(self._pieces(start, end))
        return {name: np.concatenate([piece[name] for piece in pieces]) for name in pieces[0]}

    def _pieces(self, start: int, end: int) -> Iterator[Mapping[str, np.ndarray]]:
        for number, part in enumerate(self._parts):
            low, high = max(start, self._first[number]), min(end, self._first[number + 1])
            row = low - self._first[number]
            while low < high:
                shard_id, offset = divmod(row, part.shard_size)
                values = self._shard(number, shard_id)
                count = min(part.n_samples(shard_id) - offset, high - low)
                yield {name: rows[offset : offset + count] for name, rows in values.items()}
                low, row = low + count, row + count

    def _shard(self, number: int, shard_id: int) -> dict[str, np.ndarray]:
        if self._last is None or self._last[0] != (number, shard_id):
            values = self._parts[number].read_checked(shard_id)
            values["scene_index"] = values["scene_index"] + self._scenes[number]
            self._last = (number, shard_id), values
        return self._last[1]
