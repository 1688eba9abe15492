"""Several datasets as one: the same pairs, other scenes' numbers."""

import json

import numpy as np
import pytest
from click.testing import CliRunner
from posecore.errors import ShardError
from posecore.mesh import load_mesh
from posecore.shard import ShardReader, ShardWriter
from small_datasets import write_dataset
from synthgen.cli import main
from synthgen.inspect.info import dataset_info, info_text
from synthgen.pairs.merge import merged_card, open_parts, write_merged
from synthgen.verify.verify import verify


@pytest.fixture(scope="module")
def parts(tmp_path_factory, config_of, tug, bobbin_ply):
    """Ten pairs of the tug and six of the bobbin: two shards and a half, and one and a half."""
    folder = tmp_path_factory.mktemp("parts")
    write_dataset(folder / "tug", config_of(), {1: tug}, 10)
    write_dataset(folder / "bobbin", config_of("seed=5"), {4: load_mesh(bobbin_ply)}, 6)
    return [str(folder / "tug"), str(folder / "bobbin")]


def rows(url):
    reader = ShardReader(url)
    shards = [reader.read(i) for i in reader.committed]
    return {name: np.concatenate([one[name] for one in shards]) for name in shards[0]}


def tree(folder):
    return {str(p.relative_to(folder)): p.read_bytes() for p in sorted(folder.rglob("*")) if p.is_file()}


@pytest.mark.slow
def test_all_pairs_are_there_in_order_and_no_scene_is_two(parts, tmp_path):
    out = tmp_path / "both"
    result = CliRunner().invoke(main, ["merge", *parts, "--out", str(out), "--quiet"])
    assert result.exit_code == 0, result.output
    assert "complete, 16 pairs of 2 datasets" in result.output
    first, second, whole = (rows(url) for url in (*parts, str(out)))
    for name, values in whole.items():
        expected = np.concatenate([first[name], second[name]])
        if name == "scene_index":
            assert values.tolist() == [0, 0, 1, 1, 2, 2, 3, 3, 4, 4, 5, 5, 6, 6, 7, 7]
        else:
            np.testing.assert_array_equal(values, expected, err_msg=name)
    reader = ShardReader(str(out))
    assert reader.complete
    assert list(reader.card["objects"]) == ["1", "4"]
    assert [part["digest"] for part in reader.card["merged"]] == [ShardReader(url).digest for url in parts]
    assert reader.card["windows"] == "fixed"
    assert set(json.loads(reader.file("models/models_info.json"))) == {"1", "4"}
    for obj_id, url in ((1, parts[0]), (4, parts[1])):
        key = f"models/obj_{obj_id:06d}.ply"
        assert reader.file(key) == ShardReader(url).file(key)
    shown = info_text(dataset_info(str(out)))
    assert "part:         10 pairs" in shown
    assert "settings" not in shown
    with pytest.raises(ShardError, match="was merged from 2 datasets; verify those"):
        verify(str(out))


def test_an_interrupted_merge_ends_with_the_same_bytes(parts, tmp_path):
    def run(name, on_shard=lambda n: None):
        opened = open_parts(parts)
        write_merged(opened, ShardWriter.create(str(tmp_path / name), merged_card(opened)), on_shard)

    def stop(_):
        raise KeyboardInterrupt

    run("whole")
    with pytest.raises(KeyboardInterrupt):
        run("again", stop)
    assert len(ShardReader(str(tmp_path / "again")).committed) == 1
    run("again")
    assert tree(tmp_path / "again") == tree(tmp_path / "whole")


def test_windows_of_several_sides_are_told(parts, config_of, tug, tmp_path):
    write_dataset(tmp_path / "wide", config_of("window.padding=1.0", "seed=2"), {1: tug}, 4)
    card = merged_card(open_parts([parts[0], str(tmp_path / "wide")]))
    assert card["windows"] == "mixed"
    sides = [ShardReader(url).card["objects"]["1"]["window_side_px"] for url in (parts[0], str(tmp_path / "wide"))]
    assert card["objects"]["1"]["window_side_px"] == max(sides) > min(sides)


@pytest.mark.slow
def test_what_does_not_fit_together_is_one_line(parts, config_of, tug, bobbin_ply, tmp_path):
    write_dataset(tmp_path / "small", config_of("patch_px=32"), {1: tug}, 4)
    with pytest.raises(ShardError, match=r"small: patch_px is 32, expected 48 as in .*tug"):
        open_parts([parts[0], str(tmp_path / "small")])
    write_dataset(tmp_path / "other", config_of(), {1: load_mesh(bobbin_ply)}, 4)
    with pytest.raises(ShardError, match=r"object 1 has another mesh than in .*tug; rename its file"):
        open_parts([parts[0], str(tmp_path / "other")])
    with pytest.raises(ShardError, match=r"holds the same pairs as .*tug; name it once"):
        open_parts([parts[0], parts[0]])
    write_dataset(tmp_path / "half", config_of("seed=7"), {1: tug}, 8, shards=1)
    with pytest.raises(ShardError, match="1 of 2 shards are committed"):
        open_parts([parts[0], str(tmp_path / "half")])
    alone = CliRunner().invoke(main, ["merge", parts[0], "--out", str(tmp_path / "x")])
    assert alone.exit_code == 2
    assert "give two datasets or more" in alone.output


@pytest.mark.slow
def test_scenes_that_may_be_the_same_keep_one_number(parts, config_of, tug, tmp_path):
    """Training holds out whole scenes: with two numbers one could be on both sides."""
    write_dataset(tmp_path / "more", config_of("hypotheses_per_scene=4"), {1: tug}, 16)
    opened = open_parts([parts[0], str(tmp_path / "more"), parts[1]])
    write_merged(opened, ShardWriter.create(str(tmp_path / "all"), merged_card(opened)))
    scenes = rows(str(tmp_path / "all"))["scene_index"].tolist()
    assert scenes == [0, 0, 1, 1, 2, 2, 3, 3, 4, 4, *np.repeat(range(4), 4), 5, 5, 6, 6, 7, 7]
    with pytest.raises(
        ShardError, match=r"more: shows scenes that .*all, which is merged, may show too; merge the parts"
    ):
        open_parts([str(tmp_path / "all"), str(tmp_path / "more")])
    opened = open_parts([parts[0], parts[1]])
    write_merged(opened, ShardWriter.create(str(tmp_path / "two"), merged_card(opened)))
    with pytest.raises(
        ShardError, match=r"two: may show scenes that .*all shows, and both are merged; merge the parts"
    ):
        open_parts([str(tmp_path / "all"), str(tmp_path / "two")])
