import itertools
import json
import shutil

import numpy as np
import psutil
import pytest
import torch
from posecore.bop.models_info import ModelInfo, save_models_info
from posecore.errors import ConfigError, ShardError
from posecore.shard import ShardReader
from refinenet.config import load_config
from refinenet.data.loader import make_loader
from refinenet.data.pair_stream import PairSource, PairStream
from refinenet.data.split import choose_validation_scenes, divide, read_scenes, spread_rows
from refinenet.data.validation_set import validation_batches
from refinenet.geometry import poses

SMALL = [
    "batch=4",
    "loader.workers=0",
    "loader.shuffle_shards=2",
    "loss.contour_points=32",
    "validation.scene_fraction=0.2",
]


def split_by_scene(reader, share, seed):
    """A dataset's samples for training and for validation."""
    scene_of, _ = read_scenes(reader, reader.committed)
    return divide(scene_of, choose_validation_scenes(reader.url, scene_of, share, seed))


@pytest.fixture(scope="module")
def training(dataset):
    return split_by_scene(ShardReader(str(dataset)), 0.2, 0)[0]


def make_stream(dataset, split, overrides=(), **settings):
    return PairStream(url=str(dataset), config=load_config("compact", [*SMALL, *overrides]), split=split, **settings)


def take(stream, n):
    return list(itertools.islice(iter(stream), n))


def assert_equal(first, second):
    for a, b in zip(first, second, strict=True):
        for x, y in zip((*a.inputs, *a.target, a.sample_ids), (*b.inputs, *b.target, b.sample_ids), strict=True):
            torch.testing.assert_close(x, y, rtol=0, atol=0)


def test_the_split_is_by_scene(dataset):
    reader = ShardReader(str(dataset))
    training, validation = split_by_scene(reader, 0.25, 0)
    assert training.n + validation.n == reader.n
    assert (training.scenes, validation.scenes) == (18, 6)
    scenes = [
        {int(reader.read(s, ["scene_index"])["scene_index"][r]) for s, rows in split.rows.items() for r in rows}
        for split in (training, validation)
    ]
    assert not scenes[0] & scenes[1]
    other = split_by_scene(reader, 0.25, 1)[1]
    assert {s: rows.tolist() for s, rows in other.rows.items()} != {s: r.tolist() for s, r in validation.rows.items()}


def test_an_epoch_holds_every_sample_once(dataset, training):
    epochs = training.n * 2 // 4
    ids = torch.cat([b.sample_ids for b in take(make_stream(dataset, training, ["hypothesis.online=false"]), epochs)])
    counts = torch.unique(ids[: training.n], dim=0, return_counts=True)[1]
    assert len(counts) == training.n
    assert not torch.equal(ids[: training.n], ids[training.n : 2 * training.n])


def test_the_stream_is_deterministic_and_depends_on_the_seed(dataset, training):
    first = take(make_stream(dataset, training), 3)
    assert_equal(first, take(make_stream(dataset, training), 3))
    other = take(make_stream(dataset, training, ["seed=1"]), 3)
    assert not torch.equal(first[0].sample_ids, other[0].sample_ids)


@pytest.mark.parametrize("start", [1, 7, 23])
def test_the_stream_resumes_in_the_middle_of_an_epoch(dataset, training, start):
    whole = take(make_stream(dataset, training), start + 2)
    assert_equal(whole[start:], take(make_stream(dataset, training, start=start), 2))


def test_a_caching_stream_is_the_same(dataset, training):
    first = take(make_stream(dataset, training, ["loader.cache_mb=0"]), 14)
    assert_equal(first, take(make_stream(dataset, training, ["loader.cache_mb=100"]), 14))


def test_ranks_and_workers_take_disjoint_shards(dataset, training):
    streams = [make_stream(dataset, training, rank=rank, world=2, workers=2) for rank in range(2)]
    slots = [next(streams[s // 2].groups(s)) for s in range(4)]
    shards = [{shard for _, shard, _ in group} for group in slots]
    assert sum(map(len, shards)) == len(set().union(*shards))
    with pytest.raises(ConfigError, match=r"6 shards for 4 x 2 loader processes.*lower loader.workers"):
        make_stream(dataset, training, world=4, workers=2)


@pytest.mark.slow
def test_loader_processes_give_the_plan_and_resume(dataset, training, monkeypatch):
    overrides = ["loader.workers=2", "loader.prefetch=2"]
    monkeypatch.delenv("OPENBLAS_NUM_THREADS", raising=False)
    batches = iter(make_loader(make_stream(dataset, training, overrides, workers=2)))
    loaded = [next(batches)]
    started = psutil.Process().children()  # a second thread of OpenBLAS would wait in a busy loop
    assert [p.environ()["OPENBLAS_NUM_THREADS"] for p in started if "spawn_main" in " ".join(p.cmdline())] == ["1", "1"]
    loaded += itertools.islice(batches, 5)
    del batches
    alone = [
        batch
        for pair in zip(*(
            take(make_stream(dataset, training, overrides, rank=rank, world=2), 3) for rank in range(2)
        ), strict=True)
        for batch in pair
    ]  # fmt: skip
    assert_equal(loaded, alone)  # two workers of one rank read what one worker of each of two ranks would
    assert_equal(loaded[3:5], take(make_loader(make_stream(dataset, training, overrides, workers=2, start=3)), 2))


def test_spread_rows(training):
    few = spread_rows(training, 5)
    assert few.n == 5
    assert len(few.rows) >= 4
    assert spread_rows(training, 10_000).n == training.n


def test_stored_pairs_of_the_wrong_size_are_refused(dataset, training):
    config = load_config("paper", ["batch=4", "loader.workers=0"])
    with pytest.raises(ConfigError, match=r"patches of 64 px, .* expects 224; render with --set patch_px=224"):
        next(iter(PairStream(url=str(dataset), config=config, split=training)))


def test_a_truncated_shard_is_named(dataset, training, tmp_path):
    copy = shutil.copytree(dataset, tmp_path / "copy")
    for path in (copy / "scene_rgb" / "c").rglob("0"):
        if path.is_file():
            path.write_bytes(path.read_bytes()[:-100])
    with pytest.raises(ShardError, match=r"scene_rgb/c/.*the shard is damaged"):
        take(make_stream(copy, training), 12)


def test_another_schema_and_no_dataset_are_errors(dataset, tmp_path):
    with pytest.raises(ShardError, match="not a shard dataset"):
        ShardReader(str(tmp_path))
    copy = shutil.copytree(dataset, tmp_path / "copy")
    group = json.loads((copy / "zarr.json").read_text())
    group["attributes"]["schema_version"] = 99
    (copy / "zarr.json").write_text(json.dumps(group))
    with pytest.raises(ShardError, match="schema posepair version 99"):
        ShardReader(str(copy))


def test_any_twin_takes_the_symmetries_that_the_dataset_carries(dataset, mesh, training, tmp_path):
    copy = shutil.copytree(dataset, tmp_path / "symmetric")
    info = ModelInfo(diameter_m=mesh.diameter_m, symmetries_discrete=(np.diag([-1.0, -1.0, 1.0, 1.0]),))
    save_models_info(copy / "models" / "models_info.json", {1: mesh}, {1: info})

    def turned_deg(*overrides):
        batches = take(make_stream(copy, training, ["hypothesis.max_angle_deg=10", *overrides]), 4)
        changes = [poses.update_between(b.target.T_cam_obj, b.target.T_cam_obj_hypothesis).dR for b in batches]
        return poses.rotation_angle_deg(torch.cat(changes))

    assert turned_deg().max() < 11
    assert (turned_deg("hypothesis.sample_symmetries=true") > 165).any()


def test_validation_pairs_of_many_shards_fill_batches_and_no_cache(dataset):
    config = load_config("compact", [*SMALL, "loader.cache_mb=64", "hypothesis.online=false"])
    validation = spread_rows(split_by_scene(ShardReader(str(dataset)), 0.5, 0)[1], 10)
    assert len(validation.rows) > 3
    source = PairSource(str(dataset), config, training=False)
    batches = list(validation_batches(source, validation, 4))
    assert [len(batch.sample_ids) for batch in batches] == [4, 4, 2]
    assert torch.cat([batch.sample_ids for batch in batches]).tolist() == [
        [shard, row] for shard, rows in sorted(validation.rows.items()) for row in rows
    ]
    assert not source._cache
    source.close()
