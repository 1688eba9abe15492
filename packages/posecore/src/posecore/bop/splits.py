"""Choice of a dataset's split and of its storage: scene folders of a sensor, or shards."""

from pathlib import Path

from posecore.bop.sources import FolderSource, Source, has_scenes, scenes_of
from posecore.bop.webdataset import ShardSource, shard_files
from posecore.errors import DatasetError

PREFERRED_SPLITS = ("test", "val", "train_pbr", "train")


def open_source(split_path: Path, sensor: str | None) -> tuple[Source, tuple[str, ...]]:
    """Open a split.

    Args:
        split_path: folder with scene folders or shards.
        sensor: as `BopDataset` takes it.

    Returns:
        The source, and the sensors it was opened with: none for the one without a name.

    Raises:
        DatasetError: no scenes, no such sensor, or several and none named.
    """
    scenes = scenes_of(split_path)
    sensors = sorted(frozenset().union(*scenes.values()))
    if not sensors:
        if not shard_files(split_path):
            raise DatasetError(f"{split_path}: no scene folder (000001, ...) with a scene_camera.json in it")
        if sensor:
            raise DatasetError(f"{split_path}: no sensor '{sensor}', tar files have only one; leave the sensor out")
        return ShardSource(split_path), ()
    counts = {name: sum(name in available for available in scenes.values()) for name in sensors}
    listed = ", ".join(f"{name or 'one without a name'} in {count} scene(s)" for name, count in counts.items())
    if sensor is None:
        if "" not in sensors and len(sensors) > 1:
            raise DatasetError(f"{split_path}: several sensors ({listed}); choose one with --sensor")
        chosen = ["" if "" in sensors else sensors[0]]
    else:
        chosen = [name.strip() for name in sensor.split(",")]
    for name in chosen:
        if name not in sensors:
            raise DatasetError(f"{split_path}: no sensor '{name}'; there are {listed}")
    return FolderSource(split_path, scenes, chosen), tuple(name for name in chosen if name)


def _is_split(folder: Path) -> bool:
    return folder.is_dir() and (has_scenes(folder) or bool(shard_files(folder)))


def splits_of(root: str | Path) -> list[str]:
    """Split folders of a dataset by name; none where there is no dataset, or its shards lie in no folder."""
    return sorted(path.name for path in Path(root).iterdir() if _is_split(path)) if Path(root).is_dir() else []


def choose_split(root: Path) -> str:
    """The default split; "." for shards without a split folder.

    Raises:
        DatasetError: there is none, or several and none preferred.
    """
    splits = splits_of(root)
    for name in PREFERRED_SPLITS:
        typed = [split for split in splits if split == name or split.startswith(f"{name}_")]
        if name in splits or len(typed) == 1:
            return name if name in splits else typed[0]
        if len(typed) > 1:
            raise DatasetError(f"{root}: several splits ({', '.join(splits)}); choose one with --split")
    if len(splits) == 1:
        return splits[0]
    if not splits and shard_files(root):
        return "."
    if not splits:
        hint = "; this is a split folder, give the one above" if _is_split(root) else ""
        raise DatasetError(f"{root}: no split with scenes (test/000001/scene_camera.json, ...) in it{hint}")
    raise DatasetError(f"{root}: several splits ({', '.join(splits)}); choose one with --split")
