"""Memory, cores and free space as this process may use them."""

import pytest
from posecore.errors import StorageError
from synthgen import machine


def test_a_disk_without_room_is_refused(tmp_path, monkeypatch):
    monkeypatch.setattr(machine, "free_bytes", lambda path: 10**9)
    machine.require_free_space(str(tmp_path / "d"), 10**8)
    machine.require_free_space("s3://bucket/d", 10**15)
    with pytest.raises(StorageError, match=r"d: 1 GB free, about 1.27 GB needed; free some space, choose another"):
        machine.require_free_space(str(tmp_path / "d"), 10**9)


def test_resources_respect_the_control_group(monkeypatch, tmp_path):
    monkeypatch.setattr(machine, "_CGROUP", tmp_path)
    (tmp_path / "cpu.max").write_text("50000 100000\n")
    (tmp_path / "memory.max").write_text(f"{256 * 2**20}\n")
    here = machine.machine()
    assert here.cores == 0.5
    assert here.memory_bytes == 256 * 2**20
    (tmp_path / "cpu.max").write_text("max 100000\n")
    (tmp_path / "memory.max").write_text("max\n")
    here = machine.machine()
    assert here.cores == machine.cores()
    assert here.memory_bytes > 256 * 2**20
    assert machine.free_bytes(tmp_path / "not" / "there") == machine.free_bytes(tmp_path)
