"""Stores behind URLs: a whole dataset on a local S3 server, and one clear line for everything that S3 refuses."""

import os
import sys
import urllib.request
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
import s3fs
from moto.server import ThreadedMotoServer
from posecore import shard
from posecore.errors import ConfigError, ShardError, StorageError
from posecore.files import require_writable, write_atomic
from posecore.store import open_store

CARD = {"n": 6, "shard_size": 4, "patch_px": 8, "contour_points": 3, "depth_step_m": 1e-4, "seed": 3}


@pytest.fixture(scope="module")
def endpoint() -> Iterator[str]:
    moto = ThreadedMotoServer(ip_address="127.0.0.1", port=0, verbose=False)
    moto.start()
    host, port = moto.get_host_and_port()
    yield f"http://{host}:{port}"
    moto.stop()


@pytest.fixture
def bucket(endpoint: str, monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> Iterator[str]:
    settings = {"ACCESS_KEY_ID": "test", "SECRET_ACCESS_KEY": "test", "ENDPOINT_URL": endpoint, "MAX_ATTEMPTS": "1"}
    for name, value in {**settings, "DEFAULT_REGION": "us-east-1", "EC2_METADATA_DISABLED": "true"}.items():
        monkeypatch.setenv(f"AWS_{name}", value)
    for name in ("PROFILE", "SESSION_TOKEN"):
        monkeypatch.delenv(f"AWS_{name}", raising=False)
    for name in ("CONFIG_FILE", "SHARED_CREDENTIALS_FILE"):
        monkeypatch.setenv(f"AWS_{name}", str(tmp_path / "none"))
    s3fs.S3FileSystem.clear_instance_cache()
    urllib.request.urlopen(urllib.request.Request(f"{endpoint}/moto-api/reset", method="POST")).close()
    s3fs.S3FileSystem().mkdir("bucket")
    yield "s3://bucket/data/shards"
    s3fs.S3FileSystem.clear_instance_cache()


def arrays(count: int, seed: int) -> dict[str, np.ndarray]:
    rng = np.random.default_rng(seed)
    return {f.name: rng.integers(0, 2, (count, *f.size(8, 3))) for f in shard.field_table()}


@pytest.mark.slow
def test_a_dataset_on_s3_is_resumed_and_read(bucket: str, tmp_path: Path) -> None:
    first = shard.ShardWriter.create(bucket, CARD)
    first.commit(first.encode(1, arrays(2, 1)))
    first.add_file("models/obj_000001.ply", b"ply")
    again = shard.ShardWriter.create(bucket, CARD)  # after an interruption
    assert again.committed() == [1] and again.damaged() == {}
    again.commit(again.encode(0, arrays(4, 0)))
    reader = shard.ShardReader(bucket)
    assert reader.complete and reader.file("models/obj_000001.ply") == b"ply"
    local = shard.ShardWriter.create(str(tmp_path / "d"), CARD)
    for i in (0, 1):
        local.commit(local.encode(i, arrays(4 - 2 * i, i)))
        for name, values in reader.read(i).items():
            np.testing.assert_array_equal(values, shard.ShardReader(local.url).read(i)[name])
    with pytest.raises(ShardError, match="seed is 3 there and 4 here"):
        shard.ShardWriter.create(bucket, {**CARD, "seed": 4})


def test_what_an_interrupted_commit_left_on_s3_does_not_count(bucket: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """The manifest comes last: without it, a shard whose objects lie there is not part of the dataset."""
    writer = shard.ShardWriter.create(bucket, CARD)
    encoded = writer.encode(0, arrays(4, 0))

    def refuse(key: str, data: bytes) -> None:
        assert key != "manifest.jsonl"
        original(key, data)

    original = writer._store.set
    monkeypatch.setattr(writer._store, "set", refuse)
    with pytest.raises(AssertionError):
        writer.commit(encoded)
    again = shard.ShardWriter.create(bucket, CARD)
    assert again.committed() == []
    again.commit(encoded)
    key, size = "scene_mask/c/0/0/0", len(encoded.files["scene_mask"])
    s3fs.S3FileSystem().rm(f"{bucket}/{key}")
    assert again.damaged() == {0: f"{key} is missing, expected {size} bytes"}


def one_line(error: pytest.ExceptionInfo[StorageError]) -> str:
    text = str(error.value)
    assert "\n" not in text and text.startswith("s3://")
    return text


def test_a_bucket_that_is_missing_is_named_and_not_made(bucket: str) -> None:
    with pytest.raises(
        StorageError, match=r"^s3://typo/shards/zarr.json: the bucket does not exist; create it"
    ) as error:
        shard.ShardWriter.create("s3://typo/shards", CARD)
    one_line(error)
    with pytest.raises(StorageError, match="the bucket does not exist"):
        open_store("s3://typo/shards").set("a/b", b"x")
    assert not s3fs.S3FileSystem().exists("typo")


def test_missing_credentials_are_asked_for(bucket: str, monkeypatch: pytest.MonkeyPatch) -> None:
    for name in ("ACCESS_KEY_ID", "SECRET_ACCESS_KEY"):
        monkeypatch.delenv(f"AWS_{name}")
    s3fs.S3FileSystem.clear_instance_cache()
    with pytest.raises(StorageError, match=r"no credentials found; set AWS_ACCESS_KEY_ID") as error:
        shard.ShardWriter.create(bucket, CARD)
    assert bucket in one_line(error)


def require_rights(endpoint: str, after: str) -> None:
    """Have the server refuse unknown keys after so many requests."""
    url, kind = f"{endpoint}/moto-api/reset-auth", {"Content-Type": "text/plain"}
    urllib.request.urlopen(urllib.request.Request(url, data=after.encode(), headers=kind, method="POST")).close()


def test_denied_access_is_said(bucket: str, endpoint: str) -> None:
    require_rights(endpoint, "0")
    try:
        with pytest.raises(StorageError, match=r"zarr.json: access denied \(.*\); use credentials") as error:
            shard.ShardWriter.create(bucket, CARD)
    finally:
        require_rights(endpoint, "inf")
    one_line(error)


def test_a_host_that_does_not_answer_is_said(bucket: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("AWS_ENDPOINT_URL", "http://127.0.0.1:9")
    s3fs.S3FileSystem.clear_instance_cache()
    with pytest.raises(StorageError, match=r"cannot reach the store \(.*127.0.0.1:9.*\); check the network") as error:
        shard.ShardReader(bucket)
    one_line(error)


def test_an_unknown_kind_of_url_and_a_missing_backend(monkeypatch: pytest.MonkeyPatch) -> None:
    with pytest.raises(ConfigError, match="nothing://here: Protocol not known"):
        open_store("nothing://here")
    monkeypatch.setitem(sys.modules, "s3fs", None)
    monkeypatch.delitem(sys.modules["fsspec.registry"]._registry, "s3", raising=False)
    with pytest.raises(ConfigError, match=r"s3://bucket/x: .*pip install 'posecore\[s3\]'"):
        open_store("s3://bucket/x")


def test_memory_and_local_stores_list_the_same(tmp_path: Path) -> None:
    for url in (str(tmp_path / "d"), f"memory://{tmp_path.name}/d"):
        store = open_store(url)
        assert store.get("a/b/c") is None and store.list_names() == [] and store.sizes("a") == {}
        store.set("a/b/c", b"xyz")
        store.set("top", b"")
        assert store.get("a/b/c") == b"xyz" and store.list_names() == ["a", "top"]
        assert store.sizes("a") == {"a/b/c": 3}


def test_a_device_or_a_pipe_is_not_replaced_and_a_link_stays(tmp_path):
    pipe, link, target = tmp_path / "pipe", tmp_path / "link", tmp_path / "far" / "file"
    os.mkfifo(pipe)
    for write in (lambda: write_atomic(pipe, b"x"), lambda: require_writable(pipe)):
        with pytest.raises(StorageError, match="pipe: is a device or a pipe, expected a file or a free name"):
            write()
    assert pipe.is_fifo()
    with pytest.raises(StorageError, match="a folder stands where a file is needed"):
        require_writable(tmp_path)
    circle = tmp_path / "circle"
    circle.symlink_to(circle)
    for wrong in (circle, tmp_path / ("n" * 300)):
        for write in (lambda path=wrong: write_atomic(path, b"x"), lambda path=wrong: require_writable(path)):
            with pytest.raises(StorageError):
                write()
    link.symlink_to(target)
    require_writable(link)
    for data in (b"one", b"two"):
        write_atomic(link, data)
        assert link.is_symlink()
        assert target.read_bytes() == data
