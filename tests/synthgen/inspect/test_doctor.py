"""The doctor finds what is missing without falling over it, and extrapolates what it measured."""

import json
from pathlib import Path

import pytest
from click.testing import CliRunner
from synthgen.cli import main
from synthgen.inspect import doctor
from synthgen.inspect.speed import EngineSpeed
from synthgen.run.estimate import RunEstimate

MISSING_LIBRARY = "raise ImportError('libXi.so.6: cannot open shared object file: No such file or directory')"


def by_name(checks):
    return {check.name: check for check in checks}


@pytest.fixture
def no_blender(monkeypatch):
    monkeypatch.setattr(doctor, "_BPY", MISSING_LIBRARY)


@pytest.mark.slow
def test_a_missing_library_is_named_with_its_package(no_blender, tmp_path):
    checks, engines = doctor.check_machine(tmp_path, [])
    bpy = by_name(checks)["bpy"]
    assert (bpy.state, bpy.remedy) == ("warning", "apt-get install libxi6")
    assert "libXi.so.6" in bpy.text
    assert engines.names == ("raster",)
    assert by_name(doctor.check_machine(tmp_path, ["cycles"])[0])["bpy"].state == "missing"


@pytest.mark.slow
def test_a_module_that_crashes_or_is_absent_is_reported(monkeypatch, tmp_path):
    monkeypatch.setattr(doctor, "_BPY", "import os; os.abort()")
    assert by_name(doctor.check_machine(tmp_path, [])[0])["bpy"].text == "crashes (SIGABRT)"
    monkeypatch.setattr(doctor, "_BPY", "import a_module_that_is_not_there")
    bpy = by_name(doctor.check_machine(tmp_path, [])[0])["bpy"]
    assert "a_module_that_is_not_there" in bpy.text
    assert "pip install" in bpy.remedy


def test_without_gl_nothing_can_run_and_the_command_fails(no_blender, monkeypatch, tmp_path):
    monkeypatch.setattr(doctor, "_GL", "raise RuntimeError('no EGL device')")
    checks, engines = doctor.check_machine(tmp_path, [])
    assert by_name(checks)["GL"].state == "missing"
    assert engines.names == ()
    result = CliRunner().invoke(main, ["doctor", "--out", str(tmp_path), "--seconds", "5"])
    assert result.exit_code == 1
    assert "Error: missing here: GL" in result.stderr


@pytest.mark.parametrize(("device", "software"), [("llvmpipe (LLVM 15)", True), ("NVIDIA H200/PCIe/SSE2", False)])
def test_software_gl_is_warned_about(no_blender, monkeypatch, tmp_path, device, software):
    monkeypatch.setattr(doctor, "_GL", f"import json; print(json.dumps([{device!r}, {software}]))")
    gl = by_name(doctor.check_machine(tmp_path, [])[0])["GL"]
    assert device in gl.text
    assert gl.state == ("warning" if software else "ok")
    assert doctor.UsableEngines(names=("cycles", "eevee", "raster"), software_gl=software).worth_measuring() == (
        ("cycles", "raster") if software else ("cycles", "eevee", "raster")
    )


def test_time_and_space_are_extrapolated():
    measured = RunEstimate(pairs=400, seconds=20.0, bytes_per_pair=1e5, memory_bytes=10**9)
    speed = EngineSpeed(engine="cycles", measured=measured)
    assert speed.as_dict(72_000)["hours"] == pytest.approx(1.0)
    assert "72000 pairs in about 1.0 hours and 7.2 GB (20 pairs/s" in speed.text(72_000)
    assert "about 10 minutes" in speed.text(12_000)
    failed = EngineSpeed(engine="cycles", problem="why")
    assert failed.text(5) == "why"
    assert (failed.as_dict(5)["hours"], failed.as_dict(5)["pairs_per_s"]) == (None, 0.0)
    full = doctor.check_space([speed, failed], 10**12, Path())
    assert [item.state for item in full] == ["missing"]
    assert "100000000 GB" in full[0].text.replace("1e+08", "100000000")
    assert doctor.check_space([speed, failed], 10, Path()) == []
    report = doctor.DoctorReport(checks=tuple(full), speeds=(speed, failed), n=5)
    assert report.missing == ["disk space", "cycles"]


@pytest.mark.slow
def test_checks_without_measuring_are_json_on_demand(no_blender, tmp_path):
    result = CliRunner().invoke(main, ["doctor", "--seconds", "0", "--json", "--out", str(tmp_path)])
    assert result.exit_code == 0, result.output
    report = json.loads(result.stdout)
    names = {check["name"] for check in report["checks"]}
    assert {"python", "bpy", "GL", "cores", "memory", "disk", "/dev/shm"} <= names
    assert report["speed"] == []


def test_wrong_input_is_refused_before_anything_is_measured(tmp_path):
    assert CliRunner().invoke(main, ["doctor", "--set", "windw.padding=1"]).exit_code == 2
    result = CliRunner().invoke(main, ["doctor", "--object", str(tmp_path / "none.ply")])
    assert result.exit_code == 1
    assert "none.ply" in result.stderr


@pytest.mark.slow
def test_the_real_command_is_measured(no_blender, small_set, tmp_path):
    arguments = ["doctor", "--engine", "raster", "--seconds", "0.5", "--n", "1000", *small_set, "--out", str(tmp_path)]
    result = CliRunner().invoke(main, [*arguments, "--json"])
    assert result.exit_code == 0, result.output
    (speed,) = json.loads(result.stdout)["speed"]
    assert speed["engine"] == "raster"
    assert speed["pairs"] >= 16
    assert speed["hours"] == pytest.approx(1000 * speed["seconds"] / speed["pairs"] / 3600)
    assert 1000 < speed["bytes_per_pair"] < 60_000
    assert speed["memory_bytes"] > 10**8
    broken = CliRunner().invoke(main, [*arguments, "--set", "distance.min=0.5"])
    assert broken.exit_code == 1
    assert "distance.min" in broken.stdout
