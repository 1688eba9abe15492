"""Names and places of what a training run leaves for a report."""

from pathlib import Path

import pytest
from refinenet.refine.test_set import find_test_set, run_name


@pytest.mark.parametrize(
    ("run", "name"),
    [
        ("runs/compact", "compact"),
        ("runs/a/b", "a-b"),
        ("runs", "runs"),
        ("./run", "run"),
        ("a/run", "a-run"),
        ("/data/a/run", "data-a-run"),
        ("../run", "up-run"),
        ("runs/initial", "run-initial"),
    ],
)
def test_every_run_has_a_name_of_its_own(run, name):
    assert run_name(Path(run)) == name


def test_test_images_are_in_local_datasets_alone(tmp_path):
    assert find_test_set(str(tmp_path)) == find_test_set("s3://bucket/shards") == "no test images"
    (tmp_path / "test_bop").mkdir()
    assert "not complete" in find_test_set(str(tmp_path))
    (tmp_path / "test_bop/test_targets_bop19.json").write_text("[]")
    assert find_test_set(f"{tmp_path}/") == tmp_path / "test_bop"
