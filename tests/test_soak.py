"""The soak test of `benchmarks/` in its short form."""

import json
import sys

import pytest
from children import run


@pytest.mark.slow
def test_soak(repository, tmp_path):
    small = ["patch_px=48", "contour_points=20", "hypotheses_per_scene=2", "shard_size=4", "window.min_area_px=20"]
    settings = [word for assignment in small for word in ("--set", assignment)]
    done = run(
        [
            *(sys.executable, repository / "benchmarks" / "soak.py", "--out", tmp_path / "soak"),
            *("--faults", "kills", "full_disk", "damage"),
            *("--n", 24, "--workers", 1, "--kills", 1, "--minutes", 60, "--seed", 3, *settings),
        ]
    )
    assert done.returncode == 0, done.stdout + done.stderr
    facts = json.loads(done.stdout.splitlines()[-1])
    assert facts["identical"]
    assert facts["worker_kills"] + facts["driver_kills"] == 1
    assert not (tmp_path / "soak").exists()
