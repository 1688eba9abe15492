"""Data of a training run: split, validation pairs, objects, and their provenance."""

import hashlib
import json
import logging
from collections.abc import Collection, Iterable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from posecore.errors import ConfigError
from posecore.mesh import Mesh, mesh_digest
from posecore.shard import ShardReader, load_meshes, n_shards

from refinenet.config import TrainConfig
from refinenet.data.growing_split import GrowingSplit, wait_for_dataset, wait_for_start
from refinenet.data.objects import load_models, object_ids, object_points, pivot_frames
from refinenet.data.split import DataRecord, Split, choose_validation_scenes, divide, read_scenes
from refinenet.data.validation_set import ValidationSet
from refinenet.geometry.symmetry import ObjectPoints
from refinenet.training.ranks import Ranks

log = logging.getLogger(__name__)


@dataclass(frozen=True, kw_only=True, eq=False)
class TrainingData:
    """Everything that a run reads from its dataset before the first step.

    Attributes:
        url: Shard dataset.
        training: Rows to train on.
        growing: Source of new shards between epochs; None for a complete dataset.
        validation: Validation pairs; None on ranks other than 0.
        meshes: By object id, in frames with the pivots as origins, as the pairs' poses.
        points: Model points and symmetries in the same frames, on the CPU.
        sha256: Hash of the dataset.
        objects_card: By object id as text: card of each object that is trained on.
        camera_fx_px: Focal length of the training camera; 0 where unknown.
        skipped: Errors of unreadable shards, each once, in the order of their appearance.
    """

    url: str
    training: Split
    growing: GrowingSplit | None
    validation: ValidationSet | None
    meshes: dict[int, Mesh]
    points: ObjectPoints
    sha256: str
    objects_card: dict[str, dict[str, Any]]
    camera_fx_px: float
    skipped: list[str] = field(default_factory=list)

    def report_skipped(self, *messages: str) -> None:
        """Log errors of unreadable shards that are new."""
        _report_skipped(self.skipped, messages)


def open_data(
    config: TrainConfig,
    url: str,
    out: Path,
    ranks: Ranks,
    *,
    resume: bool = False,
    validation_shards: Collection[int] = (),
) -> TrainingData:
    """Open a run's dataset; a new run with `loader.follow` waits for its first shards.

    Args:
        config: Configuration of the run.
        url: Shard dataset.
        out: Folder of the run, for the record of its split.
        ranks: This process.
        resume: Take the split from the record instead of choosing it.
        validation_shards: Shards of a growing dataset that had joined the validation pairs of a resumed run.

    Raises:
        ConfigError: An object is not in the dataset.
        ShardError: The dataset is damaged, of another schema, or empty.
        CheckpointError: The record of a resumed run is missing or damaged.
    """
    wait = config.loader.follow and not resume
    if wait:
        wait_for_dataset(url)
    reader = ShardReader(url)
    if unknown := set(config.objects) - {*object_ids(reader)}:
        names = ", ".join(map(str, object_ids(reader)))
        raise ConfigError(f"{url}: there is no object {min(unknown)} in it, only {names}; choose among those")
    if wait:  # each rank polls by itself: a barrier would time out
        wait_for_start(reader, config, ranks.world * max(1, config.loader.workers))
    skipped: list[str] = []
    training, validation, record = _split(reader, config, out, ranks, skipped, resume=resume)
    growing = GrowingSplit(out=out, record=record, config=config) if config.loader.follow else None
    meshes = load_meshes(reader)
    frames = pivot_frames(meshes, config.pivot)
    data = TrainingData(
        url=url,
        training=training,
        growing=growing,
        validation=ValidationSet(url, config, validation, growing, validation_shards) if ranks.rank == 0 else None,
        meshes=frames.meshes,
        points=object_points(
            frames.meshes, frames.models(load_models(reader)), config.loss.model_points, config.loss.symmetry_step_deg
        ),
        sha256=_dataset_sha256(reader, config),
        objects_card={
            key: {**card, "mesh_digest": mesh_digest(meshes[int(key)])}
            for key, card in reader.card["objects"].items()
            if not config.objects or int(key) in config.objects
        },
        camera_fx_px=float(reader.card.get("camera", {}).get("fx", 0.0)),
        skipped=skipped,
    )
    data.report_skipped(*(data.validation.skipped if data.validation else ()))
    return data


def _split(
    reader: ShardReader, config: TrainConfig, out: Path, ranks: Ranks, skipped: list[str], *, resume: bool
) -> tuple[Split, Split, DataRecord]:
    """Training and validation side, and record; rank 0 decides for every rank, and reports unreadable shards."""
    chosen = _chosen_split(reader, config, out, skipped, resume=resume) if ranks.rank == 0 else None
    chosen = ranks.from_first(chosen)
    assert chosen is not None
    record, scene_of = chosen
    return (*divide(scene_of, record.validation_scenes), record)


def _chosen_split(
    reader: ShardReader, config: TrainConfig, out: Path, skipped: list[str], *, resume: bool
) -> tuple[DataRecord, dict[int, Any]]:
    """Record of the split, which a new run writes, and scene of every sample by shard."""
    loader, validation = config.loader, config.validation
    record = DataRecord.load(out) if resume else None
    shards = record.shards if record is not None else reader.committed
    scene_of, bad = read_scenes(reader, shards, skip=loader.skip_bad_shards, objects=config.objects)
    _report_skipped(skipped, bad.values())  # at once: they may be the reason why no split is possible
    if not (loader.follow or reader.complete):
        log.warning(
            "%s: %d of %d shards are there, and only these are trained on; --follow takes those that come",
            reader.url, len(reader.committed), n_shards(reader.card),
        )  # fmt: skip
    if record is None:
        scenes = choose_validation_scenes(
            reader.url, scene_of, validation.scene_fraction, config.seed, growing=loader.follow
        )
        record = DataRecord(shards=tuple(scene_of), validation_scenes=tuple(int(scene) for scene in scenes))
        record.save(out)
    return record, scene_of


def _report_skipped(skipped: list[str], messages: Iterable[str]) -> None:
    for message in messages:
        if message not in skipped:
            skipped.append(message)
            log.warning("skipped: %s", message)


def _dataset_sha256(reader: ShardReader, config: TrainConfig) -> str:
    """Hash of the data card and the manifest; of the card alone while shards are still being added."""
    if config.loader.follow:
        return hashlib.sha256(json.dumps(reader.card, sort_keys=True).encode()).hexdigest()
    return reader.digest
