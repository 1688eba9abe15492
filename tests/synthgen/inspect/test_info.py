"""What `synthgen info` says is what the dataset holds."""

import json

import pytest
from click.testing import CliRunner
from posecore.errors import DatasetError
from posecore.mesh import load_mesh
from posecore.shard import ShardReader
from small_datasets import write_dataset
from synthgen.cli import main
from synthgen.config import load_config
from synthgen.inspect.info import changed_keys, dataset_info


@pytest.fixture(scope="module")
def growing(tmp_path_factory, config_of, tug_ply):
    url = tmp_path_factory.mktemp("info") / "shards"
    config = config_of("window.padding=0.4", "seed=7")
    write_dataset(url, config, {3: load_mesh(tug_ply)}, 10, shards=2, quarantined={1, 3})
    return url


def test_the_numbers_are_the_datasets(growing):
    info = dataset_info(str(growing))
    assert info["pairs"] == {"committed": 8, "total": 10}
    assert info["shards"] == {"committed": 2, "total": 3}
    assert not info["complete"]
    assert info["quarantined_scenes"] == [1, 3]
    files = [p for p in growing.rglob("*") if p.is_file() and "c" in p.relative_to(growing).parts]
    assert info["bytes"] == sum(p.stat().st_size for p in files)
    assert sum(info["bytes_per_pair"].values()) == pytest.approx(info["bytes"] / 8)
    assert info["digest"] == ShardReader(str(growing)).digest
    assert info["changed_keys"]["window.padding"] == (0.4, 0.3)
    assert info["changed_keys"]["engine"] == ("raster", "cycles")
    assert "lights.count" not in info["changed_keys"]


def test_the_text_is_for_a_human_and_the_json_for_machines(growing):
    text = CliRunner().invoke(main, ["info", str(growing)])
    assert text.exit_code == 0, text.output
    for said in ("8 of 10, 1 shards are missing", "object 3", "tug.ply, diameter 118.9 mm", "scenes 1, 3"):
        assert said in text.stdout
    assert "window.padding: 0.4 (default 0.3)" in text.stdout
    found = json.loads(CliRunner().invoke(main, ["info", str(growing), "--json"]).stdout)
    assert found["card"]["seed"] == 7
    assert found["versions"]["posecore"]


def test_the_default_preset_has_no_changed_keys():
    from posecore import config as config_tools

    assert changed_keys(config_tools.to_dict(load_config("default"))) == {}
    assert changed_keys(config_tools.to_dict(load_config("default", ["seed=2"]))) == {"seed": (2, 0)}


def test_a_bop_folder_has_a_card_too(tug_ply, tmp_path, small_set):
    arguments = ["bop", "--object", str(tug_ply), "--frames", "1", "--out", str(tmp_path / "bop"), *small_set]
    assert CliRunner().invoke(main, arguments).exit_code == 0
    result = CliRunner().invoke(main, ["info", "--dataset", str(tmp_path / "bop")])
    assert result.exit_code == 0, result.output
    assert "BOP dataset" in result.stdout
    assert "tug.ply" in result.stdout
    assert "engine: raster (default cycles)" in result.stdout
    (tmp_path / "bop" / "synthgen.json").write_text('{"frames": 1}')
    with pytest.raises(DatasetError, match="not the card"):
        dataset_info(str(tmp_path / "bop"))
