import json
import shutil

import numpy as np
import pytest
import torch
from posecore.errors import CheckpointError, ConfigError, DatasetError, StorageError
from posecore.shard import MANIFEST
from refinenet.config import load_config
from refinenet.errors import TrainingError
from refinenet.models import checkpoint
from refinenet.models.networks import PaperNet
from refinenet.training.loop import train
from refinenet.training.metric_log import MetricLog
from refinenet.training.setup import open_run
from safetensors.torch import load_file

SMALL = [
    "batch=8", "loader.workers=0", "loader.shuffle_shards=2", "loss.contour_points=32", "validation.scene_fraction=0.2",
    "validation.pairs=8", "validation.every=4", "checkpoint_every=2", "log_every=1", "threads=1", "steps=6",
    "network.encoder=[8, 8]", "network.widths=[16, 16]", "network.hidden=32",
]  # fmt: skip


def small(*overrides):
    return load_config("compact", [*SMALL, *overrides])


@pytest.fixture(scope="module")
def run(dataset, tmp_path_factory):
    out = tmp_path_factory.mktemp("run")
    reports = []
    errors = train(small(), str(dataset), out, report=lambda step, values: reports.append((step, values)))
    return out, errors, reports


@pytest.mark.slow
def test_a_run_writes_checkpoints_metrics_and_config(run, dataset):
    out, errors, reports = run
    names = {path.name for path in out.iterdir()}
    assert {"best.safetensors", "last.safetensors", "metrics.jsonl", "config.yaml", "tensorboard"} <= names
    assert [name for name in names if name.startswith("optimiser-")] == ["optimiser-0000006.pt"]
    lines = [json.loads(line) for line in (out / "metrics.jsonl").read_text().splitlines()]
    assert [line["step"] for line in lines if "loss_px" in line] == [1, 2, 3, 4, 5, 6]
    assert [line["step"] for line in lines if "validation/rotation_after_deg" in line] == [4, 6]
    assert {"data_wait_ms", "compute_ms", "learning_rate"} <= set(lines[0])
    assert errors["validation/rotation_before_deg"] > 1
    assert reports[0][0] == 0
    loaded = checkpoint.load(out / "last.safetensors", "compact")
    assert loaded.provenance.step == 6
    assert loaded.provenance.config == small()
    assert loaded.provenance.objects["1"]["diameter_m"] > 0
    assert len(loaded.provenance.dataset_sha256) == 64


@pytest.mark.slow
def test_the_same_seed_trains_the_same_weights(run, dataset, tmp_path):
    train(small(), str(dataset), tmp_path)
    first, again = (load_file(out / "last.safetensors") for out in (run[0], tmp_path))
    assert all(torch.equal(first[name], again[name]) for name in first)


@pytest.mark.slow
def test_a_resumed_run_ends_with_the_same_weights(run, dataset, tmp_path):
    """Stopped right after the checkpoint of step 4, in the middle of an epoch."""

    class Stop(Exception):
        pass

    def stop(step, values):
        if step == 5:
            raise Stop

    with pytest.raises(Stop):
        train(small(), str(dataset), tmp_path, report=stop)
    assert checkpoint.load(tmp_path / "last.safetensors").provenance.step == 4
    train(small(), str(dataset), tmp_path, resume=True)
    first, again = (load_file(out / "last.safetensors") for out in (run[0], tmp_path))
    assert all(torch.equal(first[name], again[name]) for name in first)
    lines = [json.loads(line)["step"] for line in (tmp_path / "metrics.jsonl").read_text().splitlines()]
    assert lines == [1, 2, 3, 4, 4, 5, 6, 6]


def test_resuming_is_refused_where_it_would_be_another_run(run, dataset, tmp_path):
    out = run[0]
    with pytest.raises(ConfigError, match="already holds a run; continue it with --resume"):
        train(small(), str(dataset), out)
    with pytest.raises(ConfigError, match=r"seed was 0 and is now 1; resume with the same settings"):
        train(small("seed=1"), str(dataset), out, resume=True)
    with pytest.raises(ConfigError, match=r"validation.scene_fraction was 0.2 and is now 0.4"):
        train(small("validation.scene_fraction=0.4"), str(dataset), out, resume=True)
    with pytest.raises(CheckpointError, match="no run to resume"):
        train(small(), str(dataset), tmp_path, resume=True)
    with pytest.raises(CheckpointError, match="a checkpoint of preset compact, expected preset paper"):
        checkpoint.load(out / "last.safetensors", "paper")


@pytest.mark.slow
def test_a_run_begins_with_the_weights_of_another(run, dataset, tmp_path):
    first = checkpoint.load(run[0] / "best.safetensors")
    config = small(f"init={first.path}", "optimiser.lr=1e-12", "optimiser.weight_decay=0", "steps=1")
    train(config, str(dataset), tmp_path / "second")
    second = checkpoint.load(tmp_path / "second/last.safetensors")
    assert second.provenance.step == 1
    assert second.provenance.config.init == str(first.path)
    learned = dict(first.network().named_parameters())
    for name, weights in learned.items():
        torch.testing.assert_close(second.tensors[name], weights, rtol=0, atol=1e-6)
    wider = small(f"init={first.path}", "network.hidden=48")
    with pytest.raises(CheckpointError, match=r"weights of another network \(size mismatch.*\); begin"):
        train(wider, str(dataset), tmp_path / "third")
    with pytest.raises(CheckpointError, match=r"none\.safetensors: no such checkpoint"):
        train(small("init=none.safetensors"), str(dataset), tmp_path / "fourth")


def test_metrics_that_cannot_be_written_name_their_file(tmp_path):
    with MetricLog(tmp_path, 0) as log:
        log.write(1, {"loss_px": 1.0})
        (tmp_path / "metrics.jsonl").unlink()
        (tmp_path / "metrics.jsonl").symlink_to("/dev/full")
        with pytest.raises(StorageError, match=r"metrics.jsonl: the disk is full"):
            log.write(2, {"loss_px": 1.0})
    (tmp_path / "file").write_text("")
    with pytest.raises(StorageError, match="a file stands where a folder is needed"):
        MetricLog(tmp_path / "file", 0)


def test_a_damaged_checkpoint_is_one_clean_error(run, tmp_path):
    whole = (run[0] / "last.safetensors").read_bytes()
    path = tmp_path / "cut.safetensors"
    path.write_bytes(whole[: len(whole) // 2])
    with pytest.raises(CheckpointError, match="no readable safetensors file"):
        checkpoint.load(path)
    torch.save({}, tmp_path / "other.safetensors")
    with pytest.raises(CheckpointError):
        checkpoint.load(tmp_path / "other.safetensors")


@pytest.mark.slow
def test_a_batch_can_be_overfitted(dataset, tmp_path):
    """The whole chain learns: one fixed batch, its loss well down, its poses much nearer."""
    overrides = ["steps=200", "optimiser.lr=0.002", "optimiser.warmup_steps=0", "augment.background=0"]
    trainer = open_run(small(*overrides, "network.widths=[32, 64]", "network.hidden=128"), str(dataset), tmp_path)
    batch = next(trainer.stream())
    losses = [trainer.take_step(batch)["loss_px"] for _ in range(200)]
    assert losses[-1] < 0.5 * losses[0]


def test_a_loss_that_is_not_finite_stops_before_the_step(dataset, tmp_path):
    trainer = open_run(small(), str(dataset), tmp_path)
    batch = next(trainer.stream())
    broken = batch.target.scene_distance_px.clone()
    broken[3] = torch.nan
    batch = batch._replace(target=batch.target._replace(scene_distance_px=broken))
    before = {name: value.clone() for name, value in trainer.network.state_dict().items() if "num_batches" not in name}
    shard, row = batch.sample_ids[3].tolist()
    with pytest.raises(TrainingError, match=rf"loss of step 0 is not finite, samples: shard {shard} row {row};"):
        trainer.take_step(batch)
    weights = dict(trainer.network.named_parameters())
    assert all(torch.equal(before[name], value) for name, value in weights.items())
    assert trainer.step == 0


@pytest.mark.slow
def test_every_loss_trains(dataset, tmp_path):
    for name in ("contour", "contour-forward", "mse", "point", "contour+point"):
        trainer = open_run(small(f"loss.name={name}"), str(dataset), tmp_path)
        values = trainer.take_step(next(trainer.stream()))
        assert all(np.isfinite(value) for value in values.values())
        assert ("loss_px" in values) == (name != "mse")


@pytest.mark.slow
def test_the_paper_preset_takes_a_step(mesh, tmp_path):
    from ..conftest import make_dataset

    dataset = make_dataset(tmp_path / "shards", mesh, 8, 4, 224, contour_points=100)
    options = ["backbone.pretrained=false", "batch=2", "loader.workers=0", "steps=1", "validation.pairs=2", "threads=1"]
    config = load_config("paper", options)
    errors = train(config, str(dataset), tmp_path / "run")
    loaded = checkpoint.load(tmp_path / "run" / "best.safetensors", "paper")
    assert isinstance(loaded.network(), PaperNet)
    assert errors["validation/add_after_mm"] > 0
    weights = loaded.network().state_dict()
    begun = load_config("paper", [*options[1:], f"init={loaded.path}"])  # which has a stem already
    trainer = open_run(begun, str(dataset), tmp_path / "begun", resume=False)
    assert all(torch.equal(value, weights[key]) for key, value in trainer.eval_network.state_dict().items())
    trainer.close()


@pytest.mark.slow
def test_an_unfinished_dataset_is_said_to_be_one(dataset, tmp_path, caplog):
    part = tmp_path / "part"
    shutil.copytree(dataset, part)
    lines = (part / MANIFEST).read_text().splitlines(keepends=True)
    (part / MANIFEST).write_text("".join(lines[:-2]))
    out = tmp_path / "run"
    train(small("steps=2"), str(part), out)
    assert f"{part}: {len(lines) - 2} of {len(lines)} shards are there, and only these are trained on" in caplog.text
    (part / MANIFEST).write_text("".join(lines))
    with pytest.raises(CheckpointError, match="holds now, which may have got more shards; start a new run"):
        train(small("steps=4"), str(part), out, resume=True)


def test_weights_whose_outputs_mean_something_else_are_refused(run, dataset, tmp_path):
    """Heads for both kinds of translation have the same shape."""
    init = f"init={run[0] / 'best.safetensors'}"
    with pytest.raises(CheckpointError, match=r"are 6d and crop, this run's are 6d and camera; .*translation=crop"):
        train(small(init, "network.translation=camera"), str(dataset), tmp_path)


@pytest.mark.parametrize("text", ["{}\n", "[1]\n", '{"step": "x"}\n', "\udcff\n"])
def test_a_damaged_log_of_metrics_is_cut_off_where_it_is_damaged(tmp_path, text):
    good = '{"step": 1, "loss": 2.0}\n'
    (tmp_path / "metrics.jsonl").write_bytes((good + text + good).encode("utf-8", "surrogateescape"))
    with MetricLog(tmp_path, 5):
        pass
    assert (tmp_path / "metrics.jsonl").read_text() == good


def test_an_optimiser_state_that_lacks_something_is_named(run, dataset, tmp_path):
    out = tmp_path / "run"
    shutil.copytree(run[0], out)
    (state,) = out.glob("optimiser-*.pt")
    torch.save({"optimiser": {}}, state)
    with pytest.raises(CheckpointError, match=rf"{state.name}: the key optimiser.state is missing; the run"):
        train(small(), str(dataset), out, resume=True)


def test_a_damaged_file_of_symmetries_is_named_where_it_is(dataset, tmp_path):
    copy = tmp_path / "data"
    shutil.copytree(dataset, copy)
    (copy / "models" / "models_info.json").write_text("{")
    with pytest.raises(DatasetError, match=f"^{copy}/models/models_info.json"):
        train(small(), str(copy), tmp_path / "run")
