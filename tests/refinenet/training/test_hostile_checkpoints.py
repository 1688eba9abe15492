"""Damaged and hostile files of a run: one line that names file and key, and no such weights are used."""

import json
import os
import shutil

import pytest
import torch
from click.testing import CliRunner
from fuzzing import damage, fuzz, one_line, strange
from hypothesis import given, settings
from hypothesis import strategies as st
from posecore.errors import CheckpointError, PoseError
from refinenet.cli import main
from refinenet.models import checkpoint
from refinenet.training.setup import open_run
from safetensors import safe_open
from safetensors.torch import load_file, save_file

from .test_training import small, train


@pytest.fixture(scope="module")
def run(dataset, tmp_path_factory):
    out = tmp_path_factory.mktemp("run")
    train(small("optimiser.ema_decay=0.5"), str(dataset), out)
    return out


@pytest.fixture
def copy(run, tmp_path):
    return shutil.copytree(run, tmp_path / "run")


def parts(file):
    with safe_open(file, "pt") as opened:
        return load_file(file), dict(opened.metadata())


def spoil(file, **metadata):
    tensors, stored = parts(file)
    save_file(tensors, file, {key: value for key, value in (stored | metadata).items() if value is not None})


@pytest.mark.parametrize(
    ("metadata", "line"),
    [
        ({"step": "-5"}, "step is '-5', expected str matching"),
        ({"step": None}, "the key step is missing"),
        ({"camera_fx_px": "nan"}, "camera_fx_px is 'nan', expected str matching"),
        ({"camera_fx_px": "1.2.3"}, "camera_fx_px is '1.2.3', expected str matching"),
        ({"camera_fx_px": "."}, "camera_fx_px is '.', expected str matching"),
        ({"camera_fx_px": "9e999"}, "camera_fx_px is '9e999', expected str matching"),
        ({"objects": "null"}, "objects: found null, expected JSON"),
        ({"objects": "{}"}, "objects has other keys than object ids, or none"),
        ({"objects": '{"1": {"window_side_px": 1e300, "diameter_m": 1}}'}, "objects.'1': window_side_px is 1e+300"),
        ({"config": "[" * 200_000}, "config: "),
        ({"config": "[]"}, "config is a list, expected keys"),
        ({"config": '{"network": {"patch_px": -1}}'}, "config: "),
        ({"config": '{"nonsense": 1}'}, "config: unknown key nonsense"),
    ],
    ids=str,
)
def test_metadata_out_of_bounds_is_refused(copy, metadata, line):
    file = copy / "best.safetensors"
    spoil(file, **metadata)
    with pytest.raises(CheckpointError) as caught:
        checkpoint.load(file)
    one_line(caught.value)
    assert str(caught.value).startswith(f"{file}: ")
    assert line in str(caught.value)


@pytest.mark.parametrize("value", [float("nan"), float("inf")])
def test_weights_that_are_not_finite_are_refused(copy, dataset, tmp_path, value):
    file = copy / "best.safetensors"
    tensors, metadata = parts(file)
    name = next(name for name, tensor in tensors.items() if tensor.is_floating_point())
    tensors[name].view(-1)[0] = value
    save_file(tensors, file, metadata)
    message = f"{file}: 1 of {tensors[name].numel()} numbers of {name} are NaN or infinite; choose another checkpoint"
    with pytest.raises(CheckpointError) as caught:
        checkpoint.load(file)
    assert str(caught.value) == message
    for arguments in (
        ["export", "--checkpoint", str(file), "--out", str(tmp_path / "a.onnx")],
        ["train", str(dataset), "--out", str(tmp_path / "new"), "--set", f"init={file}", "--quiet"],
    ):
        result = CliRunner().invoke(main, arguments)
        assert (result.exit_code, result.stderr.strip().splitlines()[-1]) == (1, f"Error: {message}")


STATES = [
    (lambda state: {**state, "best_mm": float("nan")}, "best_mm is nan, expected float >= 0.0"),
    (lambda state: {**state, "world": 0}, "world is 0, expected int >= 1"),
    (lambda state: {**state, "validation_shards": [-1]}, "validation_shards[0] is -1, expected int >= 0"),
    (lambda state: {**state, "optimiser": None}, "optimiser is None, expected object"),
    (lambda state: {key: state[key] for key in state if key != "optimiser"}, "the key optimiser is missing"),
    (lambda state: {**state, "weights": None}, "weights is None, expected object"),
    (lambda state: {key: state[key] for key in state if key != "weights"}, "the key weights is missing"),
    (lambda state: {**state, "weights": {}}, "weights of another network"),
    (lambda state: {**state, "weights": {key: w * torch.nan for key, w in state["weights"].items()}}, "are NaN or"),
    (lambda state: changed_moment(state, lambda moment: moment * torch.inf), "are NaN or infinite"),
    (lambda state: changed_moment(state, lambda moment: moment[:1].clone()), "expected the shape of weight"),
    (lambda state: changed_moment(state, lambda moment: "x"), "is str, expected the shape of weight"),
    (lambda state: [state], "the content is"),
]  # fmt: skip


def changed_moment(state, change):
    entries = dict(state["optimiser"]["state"])
    index = max(entries, key=lambda i: entries[i]["exp_avg"].numel())
    entries[index] = {**entries[index], "exp_avg": change(entries[index]["exp_avg"] + 1)}
    return {**state, "optimiser": {**state["optimiser"], "state": entries}}


@pytest.mark.parametrize(("change", "line"), STATES, ids=[line for _, line in STATES])
def test_an_optimiser_state_out_of_bounds_is_refused(copy, dataset, change, line):
    (file,) = copy.glob("optimiser-*.pt")
    torch.save(change(torch.load(file, weights_only=True)), file)
    with pytest.raises(CheckpointError) as caught:
        open_run(small("optimiser.ema_decay=0.5"), str(dataset), copy, resume=True)
    one_line(caught.value)
    assert str(caught.value).startswith(f"{file}: ")
    assert line in str(caught.value)


@pytest.mark.parametrize("content", [b"[" * 200_000, b"{}", b'{"shards": [-1], "validation_scenes": []}', b"null"])
def test_a_record_of_the_split_out_of_bounds_is_refused(copy, dataset, content):
    (copy / "data.json").write_bytes(content)
    with pytest.raises(CheckpointError, match=r"data.json: .*start a new one") as caught:
        open_run(small("optimiser.ema_decay=0.5"), str(dataset), copy, resume=True)
    one_line(caught.value)


@pytest.mark.parametrize("name", ["last.safetensors", "data.json", "optimiser"])
def test_a_pipe_in_place_of_a_file_does_not_block(copy, dataset, name):
    (file,) = copy.glob(f"{name}*.pt" if name == "optimiser" else name)
    file.unlink()
    os.mkfifo(file)
    with pytest.raises(CheckpointError, match="is a pipe, expected a regular file"):
        open_run(small("optimiser.ema_decay=0.5"), str(dataset), copy, resume=True)


def load_or_refuse(file):
    try:
        loaded = checkpoint.load(file)
    except PoseError as error:
        one_line(error)
    else:
        assert loaded.provenance.step >= 0
        assert all(torch.isfinite(tensor).all() for tensor in loaded.tensors.values())


@settings(fuzz, max_examples=40)
@given(key=st.sampled_from(["config", "step", "objects", "camera_fx_px", "dataset_sha256"]), value=strange)
def test_metadata_of_anything(run, tmp_path, key, value):
    file = shutil.copy(run / "best.safetensors", tmp_path / "a.safetensors")
    text = json.dumps(value)
    spoil(file, **{key: text})
    load_or_refuse(file)


@settings(fuzz, max_examples=40)
@given(change=damage())
def test_a_checkpoint_of_any_bytes(run, tmp_path, change):
    file = tmp_path / "a.safetensors"
    file.write_bytes(change((run / "best.safetensors").read_bytes()))
    load_or_refuse(file)
