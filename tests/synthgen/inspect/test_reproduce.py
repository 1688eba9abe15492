"""One sample made again: identical bit for bit, or told apart from the stored one by field."""

import shutil

import cv2
import numpy as np
import pytest
from click.testing import CliRunner
from posecore import shard
from posecore.mesh import load_mesh
from posecore.shard import ShardReader, ShardWriter
from small_datasets import write_dataset
from synthgen.cli import main
from synthgen.inspect.reproduce import reproduce

N = 9  # shards of 4, 4 and 1; two hypotheses on a scene, one on the last
REPLACED = 2  # a scene that is rendered as if it had crashed the renderer


@pytest.fixture(scope="module")
def dataset_and_job(tmp_path_factory, config_of, tug_ply):
    url = tmp_path_factory.mktemp("only") / "shards"
    return url, write_dataset(url, config_of(), {1: load_mesh(tug_ply)}, N, quarantined={REPLACED})


@pytest.fixture
def only(tug_ply, small_set):
    def invoke(url, index, *more):
        arguments = ["render", "--object", tug_ply, "--n", N, "--out", url, *small_set, "--only", index, *more]
        return CliRunner().invoke(main, [str(a) for a in arguments])

    return invoke


@pytest.mark.slow
@pytest.mark.parametrize("index", [0, 3, 8])
def test_a_sample_is_made_again_bit_for_bit(dataset_and_job, only, index):
    result = only(dataset_and_job[0], index)
    assert result.exit_code == 0, result.output
    expected = f"sample {index} (scene {index // 2}, hypothesis {index % 2}): identical to the stored one\n"
    assert result.stdout == expected


@pytest.mark.slow
def test_a_scene_from_quarantine_is_made_again_too(dataset_and_job, only, tmp_path, config_of, tug):
    url, job = dataset_and_job
    assert "identical" in only(url, 2 * REPLACED + 1).stdout
    plain = write_dataset(tmp_path / "plain", config_of(), {1: job.meshes[1]}, N)
    made = reproduce(str(tmp_path / "plain"), plain, 2 * REPLACED)
    stored = ShardReader(str(url)).read(1)
    assert made.differences == ()
    assert not np.array_equal(made.sample["T_cam_obj"], stored["T_cam_obj"][0]), "the quarantine changed nothing"


@pytest.mark.slow
def test_it_says_which_fields_differ_and_by_how_much(dataset_and_job, only, tmp_path):
    url = shutil.copytree(dataset_and_job[0], tmp_path / "shards")
    reader = ShardReader(str(url))
    values = {name: np.array(value) for name, value in reader.read(0).items()}
    values["scene_rgb"][2, 0, 0, 0] ^= 1
    values["K"][2, 0, 2] += 0.5
    ShardWriter(str(url), reader.card).commit(shard.encode(reader.card, 0, values))
    result = only(url, 2)
    assert result.exit_code == 1
    assert "sample 2 (scene 1, hypothesis 0): differs from the stored one: " in result.stdout
    assert f"scene_rgb (1 of {48 * 48 * 3} values, by up to 1 display RGB)" in result.stdout
    assert "K (1 of 9 values, by up to 0.5 px)" in result.stdout
    assert "hypothesis_rgb" not in result.stdout
    assert "identical" in only(url, 3).stdout


@pytest.mark.slow
def test_what_is_not_rendered_yet_is_said_and_can_be_saved(only, tmp_path, config_of, tug_ply):
    url, file, picture = tmp_path / "shards", tmp_path / "sample.npz", tmp_path / "sample.png"
    result = only(url, 5)
    assert result.exit_code == 1
    assert f"there is no dataset at {url}" in result.stderr
    assert not url.exists()
    write_dataset(url, config_of(), {1: load_mesh(tug_ply)}, N, shards=1)
    result = only(url, 5)
    assert result.exit_code == 1
    assert "its shard 1 is not rendered yet" in result.stderr
    result = only(url, 5, "--save", file)
    assert result.exit_code == 0
    assert "rendered, and not compared: its shard 1 is not rendered yet" in result.stdout
    assert np.load(file)["scene_rgb"].shape == (48, 48, 3)
    assert "identical" in only(url, 1, "--save", picture).stdout
    assert cv2.imread(str(picture)).std() > 20


def test_another_dataset_is_refused_as_when_resuming(dataset_and_job, only):
    result = only(dataset_and_job[0], 1, "--seed", 3)
    assert result.exit_code == 1
    assert "config.seed is 0 there and 3 here" in result.stderr


def test_wrong_usage_ends_with_2(dataset_and_job, only, tug_ply, tmp_path):
    url = dataset_and_job[0]
    assert "0 to 8" in only(url, N).stderr
    assert only(url, N).exit_code == 2
    assert only(url, 0, "--save", tmp_path / "sample.gif").exit_code == 2
    arguments = ["render", "--object", str(tug_ply), "--n", "4", "--out", str(url), "--save", "a.png"]
    result = CliRunner().invoke(main, arguments)
    assert result.exit_code == 2
    assert "--only" in result.stderr


@pytest.mark.blender
def test_a_path_traced_sample_is_made_again_bit_for_bit(tmp_path, config_of, tug):
    config = config_of("engine=cycles", "samples=2", "device=cpu")
    job = write_dataset(tmp_path / "shards", config, {1: tug}, 6)
    made = reproduce(str(tmp_path / "shards"), job, 3)  # another scene than the one that the engine drew last
    assert made.text == "sample 3 (scene 1, hypothesis 1): identical to the stored one"
