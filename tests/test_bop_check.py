"""What `synthgen bop` writes passes `evalkit check` without a word, and what is broken in it afterwards does not."""

import json
from pathlib import Path

import pytest
from click.testing import CliRunner
from evalkit.check.run import check
from synthgen.cli import main

SMALL = (
    *("camera.width_px=160", "camera.height_px=120", "camera.fx=143", "camera.fy=143", "camera.cx=81.5"),
    *("camera.cy=60.5", "window.min_area_px=5", "occluders.library=8"),
)


def render(out: Path, objects: Path, *arguments: str) -> Path:
    settings = [word for assignment in SMALL for word in ("--set", assignment)]
    command = ["bop", "--object", str(objects), "--out", str(out), "--engine", "raster", "--quiet"]
    done = CliRunner().invoke(main, [*command, *settings, *arguments])
    assert done.exit_code == 0, done.output
    return out


@pytest.mark.slow
@pytest.mark.parametrize(
    "arguments",
    [
        ("--frames", "4", "--objects-per-frame", "2", "5", "--set", "frames.instances=3"),
        ("--frames", "3", "--objects-per-frame", "2", "2", "--set", "scene.kind=tabletop", "--split", "val"),
        ("--frames", "4", "--frames-per-scene", "2", "--split", "train_pbr", "--preset", "pbr"),
        ("--frames", "3", "--sequence", "--sequences", "2"),
    ],
    ids=["crowd", "tabletop", "train_pbr", "sequence"],
)
def test_it_passes_the_check(arguments, tug_ply, tmp_path):
    findings = check(render(tmp_path / "set", tug_ply.parent, *arguments))
    assert findings.lines() == []
    assert findings.ok


def test_the_check_sees_a_pose_that_is_moved(tug_ply, tmp_path):
    folder = render(tmp_path / "set", tug_ply, "--frames", "2")
    file = folder / "test" / "000001" / "scene_gt.json"
    truth = json.loads(file.read_text())
    truth["1"][0]["cam_t_m2c"][0] += 2000
    file.write_text(json.dumps(truth))
    findings = check(folder)
    assert not findings.ok
    assert "000001" in findings.lines()[0]
