"""Summary of a dataset from its data card and manifest, as text and as JSON."""

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from posecore import config as config_tools
from posecore.shard import ShardReader, n_shards
from posecore.shard.layout import TEST_SET

from synthgen.bop.card import CARD as BOP_CARD
from synthgen.bop.card import read_card
from synthgen.config import CutConfig, load_config, migrate
from synthgen.pairs.data_card import migrated_card

_ASSETS = {"backgrounds": "photos", "hdris": "files", "occluders": "meshes"}  # and the counted items
_CAMERA_KEYS = ("fx", "fy", "cx", "cy")


def is_bop_dataset(url: str) -> bool:
    """Whether a path is a dataset of `synthgen bop`."""
    return "://" not in url and (Path(url) / BOP_CARD).is_file()


def dataset_info(url: str) -> dict[str, Any]:
    """Data card of a shard dataset, or of a BOP dataset of `synthgen bop`, with the extent of the committed data.

    Raises:
        ShardError: Not a dataset, or a broken one.
        DatasetError: A BOP dataset whose card is broken.
    """
    if is_bop_dataset(url):
        return _bop_info(Path(url))
    reader = ShardReader(url)
    reader.require("objects", "camera", "units")
    card, lines = migrated_card(reader.card), reader.manifest_lines
    pairs = sum(map(reader.n_samples, reader.committed))
    sizes: dict[str, int] = {}
    for line in lines.values():
        for field, size in line["bytes"].items():
            sizes[field] = sizes.get(field, 0) + int(size)
    test_set = f"{url}/{TEST_SET}"
    card_keys = (
        "n", "shard_size", "patch_px", "contour_points", "depth_step_m", "seed", "merged", "source", "objects",
        "camera", "units",
    )  # fmt: skip
    return {
        "kind": "training pairs",
        "dataset": url,
        "schema": f"{card['schema']} {card['schema_version']}",
        "digest": reader.digest,
        "complete": reader.complete,
        "pairs": {"committed": pairs, "total": reader.n},
        "shards": {"committed": len(reader.committed), "total": n_shards(card)},
        "test_images": _bop_info(Path(test_set))["frames"] if is_bop_dataset(test_set) else 0,
        "bytes": sum(sizes.values()),
        "bytes_per_pair": {name: size / max(1, pairs) for name, size in sorted(sizes.items(), key=_by_size)},
        "quarantined_scenes": sorted(int(i) for line in lines.values() for i in line.get("quarantined", ())),
        "rejected_draws": sum(int(line["rejected"]) for line in lines.values()),
        "changed_keys": changed_keys(card["cut"], CutConfig())
        if "cut" in card
        else changed_keys(card.get("config", {})),
        "card": {key: card[key] for key in card_keys if key in card},
        "assets": {name: card.get(name) for name in _ASSETS},
        "versions": card.get("versions", {}),
    }


def changed_keys(config: Mapping[str, Any], default: CutConfig | None = None) -> dict[str, tuple[Any, Any]]:
    """Keys of a resolved configuration with another value than a default (`render`'s if None): (value, default)."""
    usual = _flat(json.loads(json.dumps(config_tools.to_dict(default or load_config("default")))))
    values = _flat(json.loads(json.dumps(dict(config))))
    return {key: (value, usual.get(key)) for key, value in values.items() if value != usual.get(key)}


def info_text(info: Mapping[str, Any]) -> str:
    """The summary in lines to read."""
    lines = [f"{info['dataset']}: {info['kind']}"]
    if info["kind"] == "training pairs":
        lines += _pair_lines(info)
    else:
        each = f" of each of {info['sequences']} sequences" if info["sequences"] else ""
        lines += [_entry("split", info["split"]), _entry("frames", f"{info['frames']}{each}")]
    card = info["card"]
    for part in card.get("merged", ()):
        lines.append(_entry("part", f"{part['card']['n']} pairs, digest {part['digest'][:16]}"))
    if "source" in card:
        lines += _source_lines(card["source"])
    if "camera" in card:
        lines.append(_entry("camera", _camera(card["camera"])))
    for obj_id, entry in card.get("objects", {}).items():
        size = f", diameter {1e3 * entry['diameter_m']:.4g} mm" if "diameter_m" in entry else ""
        lines.append(_entry(f"object {obj_id}", f"{entry['name']}{size}, sha256 {str(entry['sha256'])[:16]}"))
    if "merged" not in card:
        lines.append(_entry("settings", "the defaults" if not info["changed_keys"] else "differ in"))
    lines += [f"    {key}: {value} (default {usual})" for key, (value, usual) in info["changed_keys"].items()]
    for name, entry in info["assets"].items():
        if entry:
            count, digest = (entry.get(key) for key in (_ASSETS[name], "sha256"))
            lines.append(_entry(name, f"{count} {_ASSETS[name]}, sha256 {str(digest)[:16]}"))
    if "units" in card:
        lines.append(_entry("units", ", ".join(f"{name} {unit}" for name, unit in card["units"].items())))
    lines.append(_entry("versions", ", ".join(f"{name} {number}" for name, number in info["versions"].items())))
    return "\n".join(lines)


def _source_lines(source: Mapping[str, Any]) -> list[str]:
    hypotheses = {"drawn": "drawn", "given": "of a result file"}[source["hypotheses"]]
    dataset = f"{source['dataset']}, split {source['split']}, sha256 {source['sha256'][:16]}"
    lines = [_entry("images", f"{source['images']} of {dataset}"), _entry("hypotheses", hypotheses)]
    return lines + [_entry("left out", f"{count} {why}") for why, count in sorted(source["left_out"].items())]


def _pair_lines(info: Mapping[str, Any]) -> list[str]:
    card, pairs, shards = info["card"], info["pairs"], info["shards"]
    state = "complete" if info["complete"] else f"{shards['total'] - shards['committed']} shards are missing"
    each = info["bytes"] / max(1, pairs["committed"])
    lines = [
        _entry("pairs", f"{pairs['committed']} of {pairs['total']}, {state}"),
        _entry("shards", f"{shards['committed']} of {shards['total']}, {card['shard_size']} pairs each"),
        _entry("test images", f"{info['test_images']} in {TEST_SET}" if info["test_images"] else "none"),
        _entry("size", f"{info['bytes'] / 1e9:.3g} GB, {each / 1e3:.4g} kB a pair"),
    ]
    lines += [f"    {name}: {size / 1e3:.4g} kB" for name, size in info["bytes_per_pair"].items() if size >= 50]
    quarantined = info["quarantined_scenes"]
    lines += [
        _entry("seed", str(card["seed"])),
        _entry("patch", f"{card['patch_px']} px, {card['contour_points']} contour points"),
        _entry("depth step", f"{1e3 * card['depth_step_m']:g} mm"),
        _entry("rejected", f"{info['rejected_draws']} draws"),
        _entry("quarantined", f"scenes {', '.join(map(str, quarantined))}" if quarantined else "no scene"),
        _entry("schema", info["schema"]),
        _entry("digest", info["digest"]),
    ]
    return lines


def _bop_info(folder: Path) -> dict[str, Any]:
    card = read_card(folder)
    config = card["config"]
    return {
        "kind": "BOP dataset",
        "dataset": str(folder),
        "split": card["split"],
        "frames": card["frames"],
        "sequences": card.get("sequences"),
        "changed_keys": changed_keys(migrate(config)),
        "card": {"objects": card["objects"], "camera": config["camera"], "seed": config["seed"]},
        "assets": {name: card.get(name) for name in _ASSETS},
        "versions": card["versions"],
    }


def _camera(camera: Mapping[str, Any]) -> str:
    numbers = ", ".join(f"{key} {camera[key]:g}" for key in _CAMERA_KEYS)
    return f"{camera['width_px']} x {camera['height_px']} px, {numbers}"


def _entry(name: str, text: str) -> str:
    return f"  {name + ':':<13} {text}"


def _by_size(entry: tuple[str, int]) -> tuple[int, str]:
    return -entry[1], entry[0]


def _flat(group: Mapping[str, Any], prefix: str = "") -> dict[str, Any]:
    flat: dict[str, Any] = {}
    for key, value in group.items():
        flat |= _flat(value, f"{prefix}{key}.") if isinstance(value, Mapping) else {prefix + key: value}
    return flat
