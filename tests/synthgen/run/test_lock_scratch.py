"""One render in a folder at a time, and temporary folders that do not stay."""

import subprocess
import sys
from pathlib import Path

import pytest
from posecore.errors import StorageError
from synthgen.engines.blender import scratch
from synthgen.run import lock


def test_a_folder_is_held_once_and_nothing_is_left_in_it(tmp_path):
    folder = tmp_path / "new" / "shards"
    with (
        lock.held(str(folder)),
        pytest.raises(StorageError, match="another synthgen is rendering into this folder"),
        lock.held(str(folder)),
    ):
        pass
    with lock.held(str(folder)):  # free again
        assert list(folder.iterdir()) == []
    with lock.held("memory://nothing"):
        assert not Path("memory:").exists()


def test_the_lock_goes_with_a_killed_process(tmp_path):
    code = f"import os\nfrom synthgen.run import lock\nwith lock.held({str(tmp_path)!r}):\n os.kill(os.getpid(), 9)"
    assert subprocess.run([sys.executable, "-c", code], check=False).returncode == -9
    with lock.held(str(tmp_path)):
        pass


def test_a_file_in_the_way_is_named(tmp_path):
    (tmp_path / "file").write_text("")
    with (
        pytest.raises(StorageError, match="file: a file stands where a folder is needed"),
        lock.held(f"{tmp_path}/file"),
    ):
        pass


def test_a_sweep_removes_what_killed_processes_left_and_nothing_else(tmp_path, monkeypatch):
    monkeypatch.setattr(scratch, "_SHARED_MEMORY", tmp_path)
    mine, remove = scratch.make_folder()
    (mine / "layers.exr").write_bytes(b"mine")
    (tmp_path / "synthgen_file").write_text("not a folder")
    code = (
        "import os\nfrom pathlib import Path\nfrom synthgen.engines.blender import scratch\n"
        f"scratch._SHARED_MEMORY = Path({str(tmp_path)!r})\n"
        "folder, _ = scratch.make_folder()\n(folder / 'layers.exr').write_bytes(b'lost')\nos.kill(os.getpid(), 9)"
    )
    subprocess.run([sys.executable, "-c", code], check=False)
    (lost,) = set(tmp_path.glob("synthgen_*")) - {mine, tmp_path / "synthgen_file"}
    assert scratch.sweep() == [lost]
    assert not lost.exists()
    assert (mine / "layers.exr").read_bytes() == b"mine"
    remove()
    assert [p.name for p in tmp_path.iterdir()] == ["synthgen_file"]
