"""Shard datasets: round trip within the stated quantisation, commits, damage and foreign data."""

import json
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import numpy as np
import pytest
import zarr
from numcodecs import blosc
from posecore import shard
from posecore.errors import ShardError, StorageError

CARD = {"n": 10, "shard_size": 4, "patch_px": 16, "contour_points": 5, "depth_step_m": 1e-4, "seed": 3}


def samples(count: int, seed: int) -> dict[str, np.ndarray]:
    rng = np.random.default_rng(seed)
    values = {}
    for field in shard.field_table():
        shape = (count, *field.size(16, 5))
        if field.squared:
            values[field.name] = np.sqrt(rng.integers(0, 100_000, shape)).astype(np.float32)
        elif field.scale is None and not field.dtype.startswith("float"):
            values[field.name] = rng.integers(0, 200, shape).astype(field.dtype)
        else:
            values[field.name] = rng.uniform(0, 5, shape)
    return values


def write(url: str, order: tuple[int, ...] = (0, 1, 2)) -> None:
    writer = shard.ShardWriter.create(url, CARD)
    for i in order:
        writer.commit(writer.encode(i, samples(shard.samples_in(CARD, i), i)))


def contents(folder: Path) -> dict[str, bytes]:
    return {str(p.relative_to(folder)): p.read_bytes() for p in sorted(folder.rglob("*")) if p.is_file()}


@pytest.mark.parametrize("kind", ["local", "memory"])
def test_round_trip_within_half_a_step(tmp_path: Path, kind: str) -> None:
    url = str(tmp_path / "d") if kind == "local" else f"memory://{tmp_path.name}"
    write(url)
    reader = shard.ShardReader(url)
    assert reader.complete and reader.n_samples(2) == 2
    for i in range(3):
        wanted, found = samples(shard.samples_in(CARD, i), i), reader.read(i)
        for field in shard.field_table():
            step = (field.step(CARD) or 0) / 2 + 1e-6 if field.scale else 0
            got = wanted[field.name].astype(field.decoded_dtype) if field.scale is None else wanted[field.name]
            np.testing.assert_allclose(found[field.name], got, atol=step, rtol=0 if field.scale is None else 1e-6)
            assert found[field.name].dtype == field.decoded_dtype and found[field.name].flags["C_CONTIGUOUS"]


def test_fields_that_are_all_zero_come_back_as_zero(tmp_path: Path) -> None:
    zeros = {f.name: np.zeros((4, *f.size(16, 5))) for f in shard.field_table()}
    writer = shard.ShardWriter.create(str(tmp_path / "d"), CARD)
    writer.commit(writer.encode(0, {**zeros, "scene_rgb": samples(4, 0)["scene_rgb"]}))
    found = shard.ShardReader(str(tmp_path / "d")).read(0)
    np.testing.assert_array_equal(found["scene_rgb"], samples(4, 0)["scene_rgb"])
    assert all(not values.any() for name, values in found.items() if name != "scene_rgb")
    np.testing.assert_array_equal(zarr.open_group(tmp_path / "d", mode="r")["scene_mask"][:4], 0)


@pytest.mark.filterwarnings("ignore:Numcodecs codecs")
def test_any_zarr_reader_opens_it(tmp_path: Path) -> None:
    write(str(tmp_path / "d"))
    group = zarr.open_group(tmp_path / "d", mode="r")
    assert group.attrs["schema"] == "posepair"
    assert sorted(name for name, _ in group.arrays()) == sorted(field.name for field in shard.field_table())
    for field in shard.field_table():
        array = group[field.name]
        wanted = np.concatenate([samples(shard.samples_in(CARD, i), i)[field.name] for i in range(3)])
        assert array.shape == wanted.shape and array.dtype == field.dtype
        np.testing.assert_array_equal(array[:], field.encode(wanted, CARD))
        np.testing.assert_array_equal(array[6], field.encode(wanted, CARD)[6])  # one sample alone
        assert array.shards == (4, *wanted.shape[1:]) and array.attrs["unit"] == field.unit


@pytest.mark.filterwarnings("ignore:Numcodecs codecs")
def test_what_zarr_writes_is_read(tmp_path: Path) -> None:
    """zarr-python is the reference twin of our shard files, in both directions."""
    writer = shard.ShardWriter.create(str(tmp_path / "d"), CARD)
    group = zarr.open_group(tmp_path / "d", mode="r+")
    for field in shard.field_table():
        group[field.name][4:8] = field.encode(samples(4, 1)[field.name], CARD)
    line = writer.encode(1, samples(4, 1)).line
    line["bytes"] = {f.name: (tmp_path / "d" / key_of(f, 1)).stat().st_size for f in shard.field_table()}
    (tmp_path / "d/manifest.jsonl").write_text(json.dumps(line) + "\n")
    names = [field.name for field in shard.field_table()]
    write(str(tmp_path / "own"))
    found, own = (shard.ShardReader(str(tmp_path / d)).read(1, names) for d in ("d", "own"))
    for name in names:
        np.testing.assert_array_equal(found[name], own[name])


def key_of(field: shard.Field, shard_id: int) -> str:
    return "/".join([field.name, "c", str(shard_id), *["0"] * len(field.shape)])


def test_bytes_do_not_depend_on_threads() -> None:
    card = {**CARD, "n": 8, "shard_size": 8, "patch_px": 160}
    rng = np.random.default_rng(0)
    arrays = {f.name: rng.integers(0, 3, (8, *f.size(160, 5))).astype(f.dtype) for f in shard.field_table()}
    for field in shard.field_table():
        if field.squared:
            arrays[field.name] = np.sqrt(arrays[field.name])
    alone = shard.encode(card, 0, arrays)
    with ThreadPoolExecutor(4) as pool:
        others = list(pool.map(lambda _: shard.encode(card, 0, arrays), range(8)))
    assert all(other.files == alone.files for other in others)
    before = blosc.set_nthreads(8)
    try:
        assert shard.encode(card, 0, arrays).files == alone.files
    finally:
        blosc.set_nthreads(before)


def test_bytes_do_not_depend_on_the_order_of_commits(tmp_path: Path) -> None:
    write(str(tmp_path / "a"), (0, 1, 2))
    write(str(tmp_path / "b"), (2, 0, 1))
    assert contents(tmp_path / "a") == contents(tmp_path / "b")


def test_two_writers_in_turn_lose_no_line(tmp_path: Path) -> None:
    """Each keeps the manifest's lines in mind, and sees that the other one has changed them."""
    one, other = (shard.ShardWriter.create(str(tmp_path / "d"), CARD) for _ in range(2))
    for writer, i in ((one, 0), (other, 2), (one, 1)):
        writer.commit(writer.encode(i, samples(shard.samples_in(CARD, i), i)))
    write(str(tmp_path / "whole"))
    assert contents(tmp_path / "d") == contents(tmp_path / "whole")


def test_reopening_the_same_dataset_keeps_what_is_there(tmp_path: Path) -> None:
    write(str(tmp_path / "d"), (1,))
    before = contents(tmp_path / "d")
    assert shard.ShardWriter.create(str(tmp_path / "d"), CARD).committed() == [1]
    assert contents(tmp_path / "d") == before


def test_what_a_killed_writer_left_does_not_count(tmp_path: Path) -> None:
    """Shard files without a manifest line, and temporary files, are not part of the dataset."""
    write(str(tmp_path / "d"), (0,))
    writer = shard.ShardWriter.create(str(tmp_path / "d"), CARD)
    encoded = writer.encode(1, samples(4, 1))
    (tmp_path / "d/scene_rgb/c/1/0/0").mkdir(parents=True)
    (tmp_path / "d/scene_rgb/c/1/0/0/0").write_bytes(encoded.files["scene_rgb"][:100])
    (tmp_path / "d/.manifest.jsonl.77.tmp").write_bytes(b"{")
    (tmp_path / "d/scene_rgb/c/1/0/0/.0.77.tmp").write_bytes(b"half")
    assert shard.ShardReader(str(tmp_path / "d")).committed == [0]
    writer.commit(encoded)
    assert not list((tmp_path / "d").rglob("*.tmp"))
    np.testing.assert_array_equal(shard.ShardReader(str(tmp_path / "d")).read(1)["K"], samples(4, 1)["K"])


def test_a_writer_killed_while_it_created_the_dataset_is_followed_by_another(tmp_path: Path) -> None:
    """The group's own file comes last: before it there are folders of fields, and nothing says what they are."""
    write(str(tmp_path / "whole"))
    (tmp_path / "d/scene_rgb").mkdir(parents=True)
    (tmp_path / "d/scene_rgb/zarr.json").write_bytes((tmp_path / "whole/scene_rgb/zarr.json").read_bytes())
    write(str(tmp_path / "d"))
    assert contents(tmp_path / "d") == contents(tmp_path / "whole")


def test_a_further_file_is_written_once(tmp_path: Path) -> None:
    writer = shard.ShardWriter.create(str(tmp_path / "d"), CARD)
    for _ in range(2):
        writer.add_file("models/models_info.json", b"{}")
    with pytest.raises(ShardError, match=r"models_info.json: is not the file that these settings make"):
        writer.add_file("models/models_info.json", b"[]")
    assert (tmp_path / "d/models/models_info.json").read_bytes() == b"{}"


def test_another_dataset_is_refused_by_its_first_difference(tmp_path: Path) -> None:
    write(str(tmp_path / "d"), (0,))
    with pytest.raises(ShardError, match="seed is 3 there and 4 here"):
        shard.ShardWriter.create(str(tmp_path / "d"), {**CARD, "seed": 4})
    (tmp_path / "other").mkdir()
    (tmp_path / "other/thesis.docx").write_text("precious")
    with pytest.raises(ShardError, match="not empty"):
        shard.ShardWriter.create(str(tmp_path / "other"), CARD)
    (tmp_path / "file").write_text("x")
    with pytest.raises(StorageError, match="expected a folder"):
        shard.ShardWriter.create(str(tmp_path / "file"), CARD)


@pytest.mark.parametrize("damage", ["truncated", "missing", "flipped"])
def test_damage_is_named_by_file(tmp_path: Path, damage: str) -> None:
    write(str(tmp_path / "d"))
    file = tmp_path / "d/scene_rgb/c/1/0/0/0"
    data = file.read_bytes()
    if damage == "truncated":
        file.write_bytes(data[: len(data) // 2])
    elif damage == "missing":
        file.unlink()
    else:
        file.write_bytes(bytes([data[0] ^ 255, *data[1:-1], data[-1] ^ 255]))
    with pytest.raises(ShardError, match=r"scene_rgb/c/1/0/0/0.*(expected|decode)"):
        shard.ShardReader(str(tmp_path / "d")).read(1)
    shard.ShardReader(str(tmp_path / "d")).read(0)


def test_files_that_decode_but_are_not_the_shards_own_are_refused(tmp_path: Path) -> None:
    write(str(tmp_path / "d"))
    manifest = (tmp_path / "d/manifest.jsonl").read_text().splitlines()
    line = json.loads(manifest[1])
    line["sha256"] = json.loads(manifest[0])["sha256"]
    (tmp_path / "d/manifest.jsonl").write_text("\n".join([manifest[0], json.dumps(line), manifest[2]]) + "\n")
    reader = shard.ShardReader(str(tmp_path / "d"))
    with pytest.raises(ShardError, match=r"shard 1 differs from its checksum.*delete this file and run the same"):
        reader.read(1)
    reader.read(0)


def test_another_schema_version_is_refused(tmp_path: Path) -> None:
    write(str(tmp_path / "d"))
    group = json.loads((tmp_path / "d/zarr.json").read_text())
    group["attributes"]["schema_version"] = 99
    (tmp_path / "d/zarr.json").write_text(json.dumps(group))
    with pytest.raises(ShardError, match="version 99, expected posepair version 2"):
        shard.ShardReader(str(tmp_path / "d"))


def test_no_dataset_and_broken_manifest(tmp_path: Path) -> None:
    with pytest.raises(ShardError, match="not a shard dataset"):
        shard.ShardReader(str(tmp_path))
    write(str(tmp_path / "d"))
    with (tmp_path / "d/manifest.jsonl").open("a") as stream:
        stream.write("{oops\n")
    with pytest.raises(ShardError, match=r"manifest.jsonl, line 4"):
        shard.ShardReader(str(tmp_path / "d"))


def test_a_flipped_bit_is_found_when_few_fields_are_read(tmp_path: Path) -> None:
    write(str(tmp_path / "d"))
    file = tmp_path / "d/scene_mask/c/1/0/0"
    data = bytearray(file.read_bytes())
    data[10] ^= 1
    file.write_bytes(data)
    with pytest.raises(ShardError, match=r"scene_mask/c/1/0/0: does not decode \(checksum differs\).*shard is damaged"):
        shard.ShardReader(str(tmp_path / "d")).read(1, ["scene_mask"])
    shard.ShardReader(str(tmp_path / "d")).read(1, ["scene_rgb"])


def test_manifest_lines_by_shard(tmp_path: Path) -> None:
    write(str(tmp_path / "d"), (2, 0))
    reader = shard.ShardReader(str(tmp_path / "d"))
    stored = [json.loads(line) for line in (tmp_path / "d" / shard.MANIFEST).read_text().splitlines()]
    assert list(reader.manifest_lines) == [0, 2]
    assert list(reader.manifest_lines.values()) == sorted(stored, key=lambda line: line["shard"])
