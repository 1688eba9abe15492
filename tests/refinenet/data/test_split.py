"""Growing and damaged datasets: what is trained on, and that every process and every resumed run agrees on it."""

import itertools
import json
import logging
import math
import shutil
from types import SimpleNamespace

import fsspec
import numpy as np
import pytest
import torch
from posecore.errors import CheckpointError, ConfigError, ShardError, StorageError
from posecore.files import write_atomic
from posecore.shard import ShardReader
from refinenet.config import load_config
from refinenet.data.growing_split import GrowingSplit
from refinenet.data.loader import make_loader
from refinenet.data.pair_stream import PairStream
from refinenet.data.split import DataRecord, divide, draw_validation_scenes, read_scenes
from refinenet.models import checkpoint
from refinenet.training.loop import train
from refinenet.training.setup import open_run

from ..training.test_training import small
from .test_pair_stream import SMALL, assert_equal, make_stream, split_by_scene, take

HELD_OUT = (1, 3, 13)
"""What seed 0 draws out of the 24 scenes with a share of 0.2: two in the first shard, one in the fourth."""


@pytest.fixture
def growing(dataset, tmp_path):
    """A copy with its first two shards in the manifest, and a function that adds the next ones."""
    copy = shutil.copytree(dataset, tmp_path / "growing")
    manifest = copy / "manifest.jsonl"
    lines = manifest.read_text().splitlines(keepends=True)

    def reveal(n):
        write_atomic(manifest, "".join(lines[:n]).encode())

    reveal(2)
    return copy, reveal


@pytest.fixture
def damaged(dataset, tmp_path):
    """A copy of which shard 2 is truncated and shard 3 has a flipped byte."""
    copy = shutil.copytree(dataset, tmp_path / "damaged")
    cut, flipped = (copy / f"scene_rgb/c/{shard}/0/0/0" for shard in (2, 3))
    cut.write_bytes(cut.read_bytes()[:-100])
    content = bytearray(flipped.read_bytes())
    content[len(content) // 2] ^= 1
    flipped.write_bytes(content)
    return copy


def at_each_look(monkeypatch, happens):
    """Have something happen each time that a run waits for more of a dataset, in place of the wait."""
    monkeypatch.setattr("refinenet.data.growing_split.time", SimpleNamespace(sleep=lambda seconds: happens()))


def follow(url, out, start=0):
    scene_of, _ = read_scenes(ShardReader(str(url)), [0, 1])
    record = DataRecord(shards=(0, 1), validation_scenes=HELD_OUT[:2])
    growth = GrowingSplit(out=out, record=record, config=load_config("compact", SMALL))
    return make_stream(url, divide(scene_of, HELD_OUT)[0], ["hypothesis.online=false"], start=start, growing=growth)


def test_a_scene_is_for_validation_or_not_whatever_others_there_are():
    scenes = np.arange(24)
    assert tuple(draw_validation_scenes(scenes, 0.2, 0)) == HELD_OUT
    assert tuple(draw_validation_scenes(scenes[2:15], 0.2, 0)) == HELD_OUT[1:]
    assert abs(len(draw_validation_scenes(np.arange(2000), 0.1, 0)) - 200) < 40
    assert set(draw_validation_scenes(scenes, 0.2, 1)) != set(HELD_OUT)


def test_new_shards_join_between_epochs_and_validation_scenes_stay_out(growing, tmp_path):
    url, reveal = growing
    stream = follow(url, tmp_path)
    seen = (set(rows) for _, rows in stream._epochs())
    assert next(seen) == {0, 1}
    reveal(4)
    assert next(seen) == {0, 1, 2, 3}
    assert next(seen) == {0, 1, 2, 3}
    reveal(6)
    assert next(seen) == next(seen) == {0, 1, 2, 3, 4, 5}
    last = json.loads(max((tmp_path / "growth").iterdir()).read_text())
    assert last == {"shards": [4, 5], "complete": True}
    reader = ShardReader(str(url))
    groups = itertools.islice(stream.groups(0), 30)
    trained = {
        int(reader.read(shard, ["scene_index"])["scene_index"][row]) for group in groups for _, shard, row in group
    }
    assert trained == set(range(24)) - set(HELD_OUT)


@pytest.mark.slow
def test_processes_and_resumed_runs_agree_on_a_growing_dataset(growing, tmp_path):
    url, reveal = growing
    first = iter(follow(url, tmp_path))
    batches = list(itertools.islice(first, 5))
    reveal(3)
    batches += itertools.islice(first, 10)
    reveal(6)  # too late for the epochs that have begun: what another process, or this run again, must not see there
    assert_equal(batches, take(follow(url, tmp_path), 15))
    assert_equal(batches[7:], take(follow(url, tmp_path, start=7), 8))
    ids = torch.cat([batch.sample_ids for batch in batches])
    assert set(ids[:, 0].tolist()) == {0, 1, 2}


@pytest.mark.slow
def test_training_follows_a_dataset_that_is_being_rendered(growing, tmp_path, monkeypatch, caplog):
    url, reveal = growing
    reveal(0)
    shards = iter(range(1, 7))

    def render(*_):
        """The next shard, at every look for it and after every step."""
        if (n := next(shards, None)) is not None:
            reveal(n)

    at_each_look(monkeypatch, render)
    with caplog.at_level(logging.WARNING):
        train(small("loader.follow=true", "steps=30", "batch=4"), str(url), tmp_path / "run", report=render)
    assert "there are 0 of 1 shards to train on, 0 of 1 scene to validate on" in caplog.text
    joined = [json.loads(path.read_text())["shards"] for path in sorted((tmp_path / "run/growth").iterdir())]
    assert any(joined)
    validation_scenes_now = json.loads((tmp_path / "run/data.json").read_text())["validation_scenes"]
    # Killed and resumed when the dataset is complete: the epochs that have begun stay what they were.
    before = [path.read_text() for path in sorted((tmp_path / "run/growth").iterdir())]
    train(small("loader.follow=true", "steps=34", "batch=4"), str(url), tmp_path / "run", resume=True)
    assert [path.read_text() for path in sorted((tmp_path / "run/growth").iterdir())][: len(before)] == before
    assert json.loads((tmp_path / "run/data.json").read_text())["validation_scenes"] == validation_scenes_now


@pytest.mark.slow
def test_later_shards_bring_validation_pairs_until_there_are_enough(growing, tmp_path):
    url, reveal = growing
    options = ["loader.follow=true", "loader.workers=0", "validation.scene_fraction=0.2", "steps=16", "batch=4"]

    def trainer(out, *more, resume=False):
        return open_run(small(*options, *more), str(url), tmp_path / out, resume=resume)

    def ids(run):
        return sorted(map(tuple, torch.cat([batch.sample_ids for batch in run.data.validation.batches]).tolist()))

    run, enough = trainer("run", "validation.pairs=64"), trainer("enough", "validation.pairs=4")
    first = [(0, 2), (0, 3), (0, 6), (0, 7)]
    assert ids(run) == ids(enough) == first
    run.save(run.validate())
    assert run.validate()["validation/pairs"] == 4
    assert run.best_mm < math.inf
    reveal(6)
    for each in (run, enough):
        batches = each.stream()
        while not (each.out / "growth").is_dir():
            each.take_step(next(batches))
        before = each.best_mm
        each.validate()
        assert each.best_mm == (math.inf if each is run else before)  # others are measured now, or the same
        each.save(each.validate())
    assert ids(run) == [*first, (3, 2), (3, 3)]
    assert ids(enough) == first
    for each, pairs in ((run, 64), (enough, 4)):
        resumed = trainer(each.out.name, f"validation.pairs={pairs}", resume=True)
        assert ids(resumed) == ids(each)
        assert resumed.best_mm == each.best_mm < math.inf
        assert resumed.validate() == each.validate()


def test_a_run_that_an_earlier_version_began_does_not_follow_on(growing, tmp_path, monkeypatch):
    """It trained on scenes that would be held out now."""
    options = ["loader.follow=true", "loader.workers=0", "validation.scene_fraction=0.2", "batch=4"]
    run = open_run(small(*options), str(growing[0]), tmp_path)
    run.save(None)
    state = checkpoint.load_state(tmp_path, 0)
    del state["validation_shards"]
    monkeypatch.setattr(checkpoint, "load_state", lambda folder, step, ema: state)
    with pytest.raises(CheckpointError, match="of an earlier version, which held out less; start a new run"):
        open_run(small(*options), str(growing[0]), tmp_path, resume=True)


def test_a_new_run_forgets_what_had_joined_an_earlier_one(tmp_path):
    earlier = tmp_path / "growth/epoch-000001.json"
    earlier.parent.mkdir()
    earlier.write_text('{"shards": [2], "complete": false}')
    DataRecord(shards=(0, 1), validation_scenes=HELD_OUT).save(tmp_path)
    assert not earlier.exists()
    assert DataRecord.load(tmp_path) == DataRecord(shards=(0, 1), validation_scenes=HELD_OUT)


def test_a_resumed_run_measures_what_it_did_before_others_joined(growing, tmp_path):
    """Killed after an epoch with new shards began and before they were measured."""
    url, reveal = growing
    options = [
        "loader.follow=true",
        "loader.workers=0",
        "validation.scene_fraction=0.2",
        "validation.pairs=64",
        "batch=4",
    ]
    run = open_run(small(*options), str(url), tmp_path)
    run.save(run.validate())
    reveal(6)
    batches = run.stream()
    while not (tmp_path / "growth").is_dir():
        next(batches)
    resumed = open_run(small(*options), str(url), tmp_path, resume=True)
    assert sum(len(batch.sample_ids) for batch in resumed.data.validation.batches) == 4
    assert resumed.best_mm == run.best_mm
    assert resumed.validate()["validation/pairs"] == 6
    assert resumed.best_mm == math.inf


@pytest.mark.slow
def test_training_waits_for_a_dataset_that_is_not_there_yet(growing, tmp_path, monkeypatch, caplog):
    url, reveal = growing
    reveal(6)
    later = tmp_path / "later"
    at_each_look(monkeypatch, lambda: url.rename(later))
    with caplog.at_level(logging.WARNING):
        train(small("loader.follow=true", "steps=2", "batch=4"), str(later), tmp_path / "run")
    assert f"{later}: no dataset here yet, waiting for one" in caplog.text


def test_waiting_for_a_dataset_where_a_file_stands_is_an_error(tmp_path):
    (tmp_path / "shards").write_text("no folder")
    with pytest.raises(StorageError, match="shards: is a file, expected a folder"):
        open_run(small("loader.follow=true"), str(tmp_path / "shards"), tmp_path / "run")


def test_an_unknown_object_is_not_waited_for(growing, tmp_path):
    with pytest.raises(ConfigError, match="there is no object 99 in it, only 1"):
        open_run(small("loader.follow=true", "objects=[99]"), str(growing[0]), tmp_path / "run")


def test_training_waits_for_scenes_on_both_sides_and_shards_for_all_loaders(growing, tmp_path, monkeypatch, caplog):
    """Seed 2 draws out scene 6 first, which comes with the second shard; there are two loader processes to feed."""
    url, reveal = growing
    assert draw_validation_scenes(np.arange(12), 0.1, 2).tolist() == [6]
    reveal(1)
    shards = iter((2, 3))
    at_each_look(monkeypatch, lambda: reveal(next(shards)))
    options = ["loader.follow=true", "validation.scene_fraction=0.1", "seed=2", "loader.workers=3"]
    with caplog.at_level(logging.WARNING):
        run = open_run(small(*options), str(url), tmp_path / "run")
    assert "there are 1 of 3 shards to train on, 0 of 1 scene to validate on" in caplog.text
    assert "there are 2 of 3 shards to train on, 1 of 1 scene to validate on" in caplog.text
    assert set(run.data.training.rows) == {0, 1, 2}


@pytest.mark.slow
def test_damaged_shards_are_named_and_stop_the_run_unless_skipped(damaged, tmp_path, caplog):
    options = ["batch=4", "steps=16", "loader.shuffle_shards=3"]
    with pytest.raises(ShardError, match=r"scene_rgb/c/[23]/0/0/0: .*the shard is damaged"):
        train(small(*options), str(damaged), tmp_path / "strict")
    with caplog.at_level(logging.WARNING):
        train(small(*options, "loader.skip_bad_shards=true"), str(damaged), tmp_path / "run")
    for shard in (2, 3):
        assert caplog.text.count(f"scene_rgb/c/{shard}/0/0/0") == 1
    assert "2 damaged shards were skipped" in caplog.text
    lines = [json.loads(line) for line in (tmp_path / "run/metrics.jsonl").read_text().splitlines()]
    assert [line["skipped_shards"] for line in lines if "skipped_shards" in line][-1] == 2


@pytest.mark.slow
@pytest.mark.parametrize("group", [1, 3])
def test_others_stand_in_for_damaged_shards_and_the_stream_still_resumes(dataset, damaged, group):
    options = ["loader.skip_bad_shards=true", f"loader.shuffle_shards={group}", "hypothesis.online=false"]
    split = split_by_scene(ShardReader(str(dataset)), 0.2, 0)[0]
    whole = take(make_stream(dataset, split, options), 20)
    mended = take(make_stream(damaged, split, options), 20)
    for batch, original in zip(mended, whole, strict=True):
        good = ~torch.isin(original.sample_ids[:, 0], torch.tensor([2, 3]))
        assert torch.equal(batch.sample_ids[good], original.sample_ids[good])
        assert not torch.isin(batch.sample_ids[:, 0], torch.tensor([2, 3])).any()
        assert all(row in split.rows[shard] for shard, row in batch.sample_ids.tolist())
    assert sum(len(batch.skipped) for batch in mended) == 2
    resumed = take(make_stream(damaged, split, options, start=11), 9)
    assert_equal(mended[11:], resumed)


def test_a_dataset_without_a_readable_shard_is_an_error(damaged, dataset):
    split = split_by_scene(ShardReader(str(dataset)), 0.2, 0)[0]
    for path in (damaged / "scene_rgb/c").rglob("0"):
        if path.is_file():
            path.write_bytes(b"")
    with pytest.raises(ShardError, match="none of its shards can be read"):
        take(make_stream(damaged, split, ["loader.skip_bad_shards=true"]), 1)


def test_a_shard_without_scenes_is_left_out_from_the_start(dataset, tmp_path):
    copy = shutil.copytree(dataset, tmp_path / "copy")
    (copy / "scene_index/c/4").unlink()
    with pytest.raises(ShardError, match="scene_index/c/4: found no file"):
        open_run(small(), str(copy), tmp_path / "strict")
    run = open_run(small("loader.skip_bad_shards=true"), str(copy), tmp_path / "run")
    assert 4 not in run.data.training.rows
    assert len(run.data.skipped) == 1
    assert np.array_equal(DataRecord.load(tmp_path / "run").shards, [0, 1, 2, 3, 5])


def test_skipped_shards_are_reported_also_when_no_split_is_possible(dataset, tmp_path, caplog):
    copy = shutil.copytree(dataset, tmp_path / "copy")
    for shard in range(6):
        (copy / f"scene_index/c/{shard}").unlink()
    with caplog.at_level(logging.WARNING), pytest.raises(ShardError):
        open_run(small("loader.skip_bad_shards=true"), str(copy), tmp_path / "run")
    assert caplog.text.count("skipped: ") == 6


def test_urls_stream_what_a_folder_does(dataset):
    split = split_by_scene(ShardReader(str(dataset)), 0.2, 0)[0]
    here = take(make_stream(dataset, split), 3)
    memory = fsspec.filesystem("memory")
    memory.put(str(dataset), "/pairs", recursive=True)
    assert_equal(here, take(make_stream("memory://pairs", split), 3))
    memory.rm("/pairs", recursive=True)


@pytest.mark.slow
def test_a_url_is_read_by_loader_processes(dataset):
    split = split_by_scene(ShardReader(str(dataset)), 0.2, 0)[0]
    stream: PairStream = make_stream(f"file://{dataset}", split, ["loader.workers=1"])
    assert_equal(take(make_stream(dataset, split), 3), take(make_loader(stream), 3))
