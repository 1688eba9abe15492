"""Files of earlier versions: shipped checkpoints load, and a run that an earlier version began goes on."""

import json
from pathlib import Path

import pytest
import torch
from refinenet.models import checkpoint, migration
from refinenet.training.loop import train
from safetensors import safe_open
from safetensors.torch import load_file, save_file

from ..training.test_training import small

CHECKPOINTS = Path(__file__).resolve().parents[3] / "examples/checkpoints"
OLD_KEYS = {
    "on_policy": {"fraction": "share"},
    "hypothesis": {
        "online": "fresh",
        "easy_fraction": "easy_share",
        "precomputed_fraction": "stored_share",
        "sample_symmetries": "any_twin",
    },
    "augment": {"min_visible_fraction": "occlusion_leaves"},
    "loss": {"min_pose_quality": "min_closeness"},
    "validation": {"scene_fraction": "scene_share"},
}
OLD_TARGETS = {"visible_iou": "overlap", "pose_quality": "closeness"}


def old_config(config):
    """A configuration under the keys of the version before."""
    groups = {key: OLD_KEYS.get(key, {}) for key in config}
    old = {
        key: {groups[key].get(name, name): item for name, item in value.items()} if groups[key] else value
        for key, value in config.items()
    }
    old["own_predictions"] = old.pop("on_policy")
    old["loss"]["confidence_target"] = OLD_TARGETS[old["loss"]["confidence_target"]]
    return old


def rewrite_as_old(out):
    """Give the files of a run the keys that the version before wrote."""
    for path in out.glob("*.safetensors"):
        with safe_open(path, "pt") as opened:
            metadata = opened.metadata()
        config = json.loads(metadata["config"])
        assert config.pop("pivot") == "origin"
        metadata["config"] = json.dumps(old_config(config))
        save_file(load_file(path), path, metadata | {"version": "1"})
    (path,) = out.glob("optimiser-*.pt")
    state = torch.load(path, weights_only=True)
    state["held_out_shards"] = state.pop("validation_shards")
    torch.save(state, path)
    record = json.loads((out / "data.json").read_text())
    record["held_out_scenes"] = record.pop("validation_scenes")
    (out / "data.json").write_text(json.dumps(record))
    text = (out / "metrics.jsonl").read_text()
    for old, new in migration.METRIC_KEYS.items():
        text = text.replace(new, old)
    (out / "metrics.jsonl").write_text(text)


@pytest.mark.parametrize(("name", "target"), [("tug_compact", "visible_iou"), ("tug_flow", "pose_quality")])
def test_the_shipped_checkpoints_load(name, target):
    loaded = checkpoint.load(CHECKPOINTS / f"{name}.safetensors")
    with safe_open(CHECKPOINTS / f"{name}.safetensors", "pt") as opened:
        stored = json.loads(opened.metadata()["config"])
    config = loaded.provenance.config
    assert "fresh" in stored["hypothesis"]  # of the version before
    assert config.hypothesis.online == stored["hypothesis"]["fresh"]
    assert config.hypothesis.easy_fraction == stored["hypothesis"]["easy_share"]
    assert config.validation.scene_fraction == stored["validation"]["scene_share"]
    if "own_predictions" in stored:  # later than `tug_compact`
        assert config.on_policy.updates == stored["own_predictions"]["updates"]
    assert config.loss.confidence_target == target
    loaded.network()


@pytest.mark.slow
def test_a_run_of_the_version_before_resumes_as_it_would_have_gone_on(dataset, tmp_path):
    options = ["optimiser.ema_decay=0.9", "optimiser.schedule=constant", "checkpoint_every=3", "log_every=1"]
    train(small(*options, "steps=6", "pivot=origin"), str(dataset), tmp_path / "whole")
    train(small(*options, "steps=3", "pivot=origin"), str(dataset), tmp_path / "old")
    rewrite_as_old(tmp_path / "old")
    train(small(*options, "steps=6"), str(dataset), tmp_path / "old", resume=True)
    assert checkpoint.load(tmp_path / "old/last.safetensors").provenance.config.pivot == "origin"
    whole, resumed = (load_file(tmp_path / name / "last.safetensors") for name in ("whole", "old"))
    assert all(torch.equal(whole[key], resumed[key]) for key in whole)
    lines = [json.loads(line) for line in (tmp_path / "old/metrics.jsonl").read_text().splitlines()]
    steps = [line for line in lines if "learning_rate" in line]
    assert len(steps) == 6
    assert all({"visible_fraction", "data_wait_fraction"} <= set(line) for line in steps)
    assert set(json.loads((tmp_path / "old/data.json").read_text())) == {"shards", "held_out_scenes"}  # only read


def test_current_files_are_left_as_they_are(dataset):
    state = {"optimiser": {"state": {0: {}}}, "best_mm": 1.0, "world": 1, "validation_shards": [2]}
    assert migration.migrated_state(state) == state
    assert migration.migrated_record({"shards": [0], "validation_scenes": [1]}) == {
        "shards": [0],
        "validation_scenes": [1],
    }
