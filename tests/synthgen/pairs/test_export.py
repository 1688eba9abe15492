"""Exports hold every value of the shards, appear whole or not at all, and replace nothing unasked."""

import io
import json
import shutil
import tarfile
from pathlib import Path

import cv2
import h5py
import numpy as np
import pytest
from click.testing import CliRunner
from posecore.errors import ShardError, StorageError
from posecore.mesh import load_mesh
from posecore.shard import ShardReader, field_table
from small_datasets import write_dataset
from synthgen.cli import main
from synthgen.pairs import export

N = 10


@pytest.fixture(scope="module")
def shards(tmp_path_factory, config_of, tug_ply):
    url = tmp_path_factory.mktemp("export") / "shards"
    write_dataset(url, config_of(), {1: load_mesh(tug_ply)}, N)
    return url


@pytest.fixture(scope="module")
def stored(shards):
    reader = ShardReader(str(shards))
    parts = [reader.read(i) for i in reader.committed]
    return {name: np.concatenate([part[name] for part in parts]) for name in parts[0]}


def run(shards, out, *arguments):
    return CliRunner().invoke(main, ["export", "--quiet", str(shards), "--out", str(out), *map(str, arguments)])


@pytest.mark.slow
def test_hdf5_holds_every_field(shards, stored, tmp_path):
    result = run(shards, tmp_path / "out.h5")
    assert result.exit_code == 0, result.output
    with h5py.File(tmp_path / "out.h5") as file:
        assert set(file) == {*stored, *export.ALIASES, "models"}
        for field in field_table():
            found = file[field.name]
            assert found.dtype == field.decoded_dtype and found.attrs["unit"] == field.unit
            np.testing.assert_array_equal(found[:], stored[field.name])
        for alias, name in export.ALIASES.items():
            assert file[alias] == file[name]
        assert file["colors"].compression == "gzip" and file["colors"].chunks == (1, 48, 48, 3)
        assert json.loads(file.attrs["data_card"]) == ShardReader(str(shards)).card
        assert file["models/obj_000001.ply"][:].tobytes() == (shards / "models/obj_000001.ply").read_bytes()


def test_webdataset_holds_every_field(shards, stored, tmp_path):
    result = run(shards, tmp_path / "tars", "--format", "webdataset")
    assert result.exit_code == 0, result.output
    card = json.loads((tmp_path / "tars/card.json").read_text())
    assert (tmp_path / "tars/models/obj_000001.ply").is_file()
    tars = sorted((tmp_path / "tars").glob("shards-*.tar"))
    assert [tar.name for tar in tars] == [f"shards-{i:06d}.tar" for i in range(3)]
    index = 0
    for file in tars:
        with tarfile.open(file) as tar:
            members = [(m.name.partition(".")[0], m.name.partition(".")[2], tar.extractfile(m).read()) for m in tar]
        keys = [key for key, _, _ in members]
        for key in dict.fromkeys(keys):
            count = keys.count(key)
            assert keys[keys.index(key) : keys.index(key) + count] == [key] * count, "files of a sample lie apart"
            sample = {name: data for k, name, data in members if k == key}
            assert int(key) == index
            check_sample(sample, {name: values[index] for name, values in stored.items()}, card)
            index += 1
    assert index == N


def check_sample(files, stored, card):
    values = dict(json.loads(files["json"]))
    step = np.float32(values.pop("depth_step_m"))
    assert step == np.float32(card["depth_step_m"])
    values |= dict(np.load(io.BytesIO(files["labels.npz"])))
    for name in export.PNG_FIELDS:
        image = cv2.imdecode(np.frombuffer(files[f"{name}.png"], np.uint8), cv2.IMREAD_UNCHANGED)
        values[name] = image[..., ::-1] if image.ndim == 3 else image
        if name.endswith("depth_m"):
            assert image.dtype == np.uint16
            values[name] = image * step
    assert set(values) == set(stored)
    for name, value in stored.items():
        np.testing.assert_array_equal(np.asarray(values[name], value.dtype), value)


@pytest.mark.parametrize("layout", ["hdf5", "webdataset"])
def test_the_same_bytes_twice_and_nothing_replaced_unasked(shards, tmp_path, layout):
    def tree(path):
        return {p.name: p.read_bytes() for p in ([path] if path.is_file() else sorted(path.rglob("*"))) if p.is_file()}

    out = tmp_path / ("x.h5" if layout == "hdf5" else "x")
    (tmp_path / f".{out.name}.99.tmp").write_bytes(b"left by a killed export")
    assert run(shards, out, "--format", layout).exit_code == 0
    before = tree(out)
    result = run(shards, out, "--format", layout)
    assert result.exit_code == 1 and f"{out}: exists; choose another name, or add --overwrite" in result.output
    assert run(shards, out, "--format", layout, "--overwrite").exit_code == 0
    assert tree(out) == before
    assert [p.name for p in tmp_path.iterdir()] == [out.name]


def test_a_foreign_folder_is_never_replaced(shards, tmp_path):
    (tmp_path / "home").mkdir()
    (tmp_path / "home/thesis.tex").write_text("precious")
    result = run(shards, tmp_path / "home", "--format", "webdataset", "--overwrite")
    assert result.exit_code == 1 and "is not an exported folder" in result.output
    assert (tmp_path / "home/thesis.tex").read_text() == "precious"


@pytest.mark.parametrize("out", ["out.h5", "out"])
def test_damaged_and_unfinished_datasets_leave_nothing(shards, tmp_path, out):
    write = export.to_hdf5 if out.endswith(".h5") else export.to_webdataset
    copy = shutil.copytree(shards, tmp_path / "copy")
    file = copy / "scene_mask/c/2/0/0"
    file.write_bytes(file.read_bytes()[:-3])
    with pytest.raises(ShardError, match=r"scene_mask/c/2/0/0.*the shard is damaged"):
        write(str(copy), tmp_path / out)
    lines = (copy / "manifest.jsonl").read_text().splitlines()
    (copy / "manifest.jsonl").write_text("\n".join(lines[:2]) + "\n")
    with pytest.raises(ShardError, match="2 of 3 shards are committed; complete it first"):
        write(str(copy), tmp_path / out)
    assert [p.name for p in tmp_path.iterdir()] == ["copy"]


def test_names_that_do_not_suit_the_format(shards, tmp_path):
    for out, layout, text in (("x", "hdf5", "add --format webdataset"), ("x.h5", "webdataset", "a folder of tars")):
        result = run(shards, tmp_path / out, "--format", layout)
        assert result.exit_code == 2 and text in result.output


def test_a_place_that_cannot_be_written(shards, tmp_path):
    (tmp_path / "file").write_text("x")
    for write, out in ((export.to_hdf5, "file/x.h5"), (export.to_webdataset, "file/x")):
        with pytest.raises(StorageError, match="a file stands where a folder is needed"):
            write(str(shards), tmp_path / out)


def test_a_full_disk_is_one_line(shards, tmp_path, monkeypatch):
    """HDF5 would say so too, with the number of the error hidden in a message of its own, and crash at the end."""
    monkeypatch.setattr(export, "free_bytes", lambda path: 2**24 + 2**16)
    with pytest.raises(StorageError, match=r"x.h5: the disk is full, this write of \d+ bytes failed"):
        export.to_hdf5(str(shards), tmp_path / "x.h5")
    assert list(tmp_path.iterdir()) == []
    error = OSError("Can't synchronously write data (file write failed: time = Mon, errno = 28, error message = 'No')")
    assert "x.h5: the disk is full" in str(export._as_storage_error(Path("x.h5"), error))


def test_an_object_named_outside_of_the_dataset_is_refused(shards, tmp_path):
    copy = shutil.copytree(shards, tmp_path / "copy")
    group = json.loads((copy / "zarr.json").read_text())
    group["attributes"]["objects"]["1"]["path"] = "../../elsewhere"
    (copy / "zarr.json").write_text(json.dumps(group))
    with pytest.raises(ShardError, match=r"zarr.json: objects.'1': path is '../../elsewhere', expected str matching"):
        export.to_webdataset(str(copy), tmp_path / "x")
