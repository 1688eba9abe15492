"""Training on some of a dataset's objects."""

import itertools
import json
import shutil

import numpy as np
import pytest
from posecore.bop.models_info import save_models_info
from posecore.errors import ConfigError, ShardError
from posecore.mesh import save_ply
from posecore.shard import ShardReader, ShardWriter
from refinenet.data.growing_split import GrowingSplit, wait_for_start
from refinenet.data.split import (
    OTHER_OBJECT,
    DataRecord,
    choose_validation_scenes,
    divide,
    draw_validation_scenes,
    read_scenes,
)
from refinenet.models.checkpoint import load
from refinenet.training.loop import train
from refinenet.training.setup import open_run

from ..training.test_training import small


@pytest.fixture(scope="module")
def two_objects(dataset, mesh, tmp_path_factory):
    """The dataset with every second scene's object called 2."""
    folder = tmp_path_factory.mktemp("two") / "shards"
    reader = ShardReader(str(dataset))
    card = {key: value for key, value in reader.card.items() if key not in ("schema", "schema_version")}
    card["objects"] = {**card["objects"], "2": {**card["objects"]["1"], "path": "models/obj_000002.ply"}}
    writer = ShardWriter.create(str(folder), card)
    for obj_id in (1, 2):
        save_ply(mesh, folder / f"models/obj_{obj_id:06d}.ply", units="mm")
    save_models_info(folder / "models/models_info.json", {1: mesh, 2: mesh}, {})
    for shard in reader.committed:
        arrays = reader.read(shard)
        arrays["obj_id"] = (1 + arrays["scene_index"] % 2).astype(np.int32)
        writer.commit(writer.encode(shard, arrays))
    return folder


def test_only_the_chosen_objects_scenes_are_split(two_objects):
    reader = ShardReader(str(two_objects))
    scene_of, _ = read_scenes(reader, reader.committed, objects=(2,))
    flat = np.concatenate(list(scene_of.values()))
    assert set(flat) == {OTHER_OBJECT, *range(1, 24, 2)}
    scenes = choose_validation_scenes(reader.url, scene_of, 0.25, 0)
    assert len(scenes) == 3 and (scenes % 2 == 1).all()
    training, validation = divide(scene_of, scenes)
    assert (training.scenes, validation.scenes) == (9, 3)
    assert (training.n, validation.n) == (18, 6)


@pytest.mark.slow
def test_a_network_of_one_object_never_sees_the_other(two_objects, tmp_path):
    config = small("objects=[2]", "batch=4", "steps=3", "loader.workers=0")
    run = open_run(config, str(two_objects), tmp_path / "look")
    for batch in itertools.islice(run.stream(), 12):
        assert (batch.target.object_index == 1).all()
    assert all((batch.target.object_index == 1).all() for batch in run.data.validation.batches)
    run.close()
    train(config, str(two_objects), tmp_path / "run")
    assert list(load(tmp_path / "run/best.safetensors").provenance.objects) == ["2"]


@pytest.mark.slow
def test_growing_datasets_bring_only_the_chosen_objects(two_objects, tmp_path):
    config = small("objects=[1]", "batch=4", "steps=8", "loader.follow=true", "loader.workers=0")
    train(config, str(two_objects), tmp_path / "run")
    scenes = json.loads((tmp_path / "run/data.json").read_text())["validation_scenes"]
    assert all(scene % 2 == 0 for scene in scenes)
    # A run that began with two shards: the others join in its second epoch.
    (tmp_path / "grown").mkdir()
    record = DataRecord(shards=(0, 1), validation_scenes=(0,))
    growth = GrowingSplit(out=tmp_path / "grown", record=record, config=config)
    joined = next(growth.epochs(str(two_objects)))
    reader = ShardReader(str(two_objects))
    assert set(joined) == {*reader.committed} - {0, 1}
    for shard, rows in joined.items():
        assert len(rows) == 4
        assert (reader.read(shard, ["obj_id"])["obj_id"][rows] == 1).all()


def test_a_growing_dataset_is_waited_for_by_the_chosen_objects_scenes(two_objects, tmp_path, monkeypatch):
    """Of the first eight scenes seed 2 draws out the sixth, which shows object 1."""
    copy = shutil.copytree(two_objects, tmp_path / "growing")
    lines = (copy / "manifest.jsonl").read_text().splitlines(keepends=True)
    (copy / "manifest.jsonl").write_text("".join(lines[:2]))
    assert draw_validation_scenes(np.arange(8), 0.1, 2).tolist() == [6]
    reader = ShardReader(str(copy))

    class Waited(Exception):
        pass

    def wait(_):
        raise Waited

    monkeypatch.setattr("refinenet.data.growing_split.time.sleep", wait)
    options = ["loader.follow=true", "seed=2", "validation.scene_fraction=0.1"]
    wait_for_start(reader, small(*options, "objects=[1]"), 1)
    with pytest.raises(Waited):
        wait_for_start(reader, small(*options, "objects=[2]"), 1)


def test_an_unknown_object_is_one_line(two_objects, cli, tmp_path):
    with pytest.raises(ConfigError, match="there is no object 7 in it, only 1, 2"):
        open_run(small("objects=[1, 7]"), str(two_objects), tmp_path / "run")
    result = cli("train", two_objects, "--object", 7, "--out", tmp_path / "run", "--quiet")
    assert result.exit_code == 2
    assert "there is no object 7" in result.stderr


def test_a_data_card_without_objects_is_named(dataset, tmp_path):
    copy = shutil.copytree(dataset, tmp_path / "shards")
    group = json.loads((copy / "zarr.json").read_text())
    del group["attributes"]["objects"]
    (copy / "zarr.json").write_text(json.dumps(group))
    with pytest.raises(ShardError, match="the data card has no objects; make it with `synthgen render`"):
        open_run(small(), str(copy), tmp_path / "run")
