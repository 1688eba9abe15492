import errno
import shutil
import sys
import threading

import pytest
from children import run
from posecore.shard import ShardReader
from refinenet.config import load_config
from tensorboard.summary.writer.record_writer import RecordWriter

from ..data.test_pair_stream import split_by_scene

SHORT = [
    "--steps", "2", "--batch", "4", "--workers", "0", "--threads", "1", "--set", "loss.contour_points=32",
    "--set", "validation.pairs=4",
]  # fmt: skip
SMALL = [*SHORT, "--set", "network.encoder=[8, 8]", "--set", "network.widths=[16, 16]"]


def test_every_command_shows_an_example(cli):
    assert cli("--help").exit_code == 0
    for command in ("train", "refine", "track", "export"):
        assert f"refinenet {command} " in cli(command, "--help").output


@pytest.mark.slow
def test_train_command(cli, dataset, tmp_path):
    out = tmp_path / "run"
    result = cli("train", dataset, "--out", out, *SMALL)
    assert result.exit_code == 0, result.output
    assert "initial  refined" in result.stdout
    assert "of step 2: last.safetensors, and best.safetensors too" in result.stdout
    assert str(out / "best.safetensors") in result.stdout
    last = result.stdout.splitlines()[-1]
    assert last.startswith(
        f"{dataset}: no test images, so nothing is refined for a report; on your own images: refinenet"
    )
    again = cli("train", dataset, "--out", out, *SMALL)
    assert again.exit_code == 2
    assert "already holds a run" in again.stderr
    assert cli("train", dataset, "--out", out, *SMALL, "--resume").exit_code == 0


def test_a_switch_that_is_turned_off_by_hand_takes_its_settings_along():
    """One more option at the end of a command turns a switch off; and pools of a fixed network read their ranges."""
    on = ["on_policy.fraction=0.5", "on_policy.updates=2", "network.confidence=true"]
    off = ["on_policy.fraction=0", "network.confidence=false", "loss.confidence_weight=2"]
    assert load_config("compact", [*on, *off]).on_policy.updates == 2
    assert not load_config("compact", ["hypothesis.in_plane=false", "hypothesis.online=false"]).hypothesis.online
    assert load_config("paper", ["hypothesis.max_angle_deg=40"]).hypothesis.max_angle_deg == 40


@pytest.mark.parametrize(
    ("arguments", "code", "text"),
    [
        (["--set", "optimiser.momentum=1"], 2, "unknown key optimiser.momentum"),
        (["--set", "optimiser.lr=fast"], 2, "optimiser.lr is 'fast', expected float"),
        (
            ["--set", "hypothesis.online=false", "--set", "hypothesis.precomputed_fraction=0.5"],
            2,
            "set hypothesis.online=true",
        ),
        (["--set", "own_predictions.share=0.5"], 2, "own_predictions.share is now on_policy.fraction"),
        (["--set", "hypothesis={fresh: true}"], 2, "hypothesis.fresh is now hypothesis.online"),
        (["--set", "loss.confidence_target=closeness"], 2, "is now loss.confidence_target=pose_quality"),
        (["--set", "loss.min_pose_quality=0.1"], 2, "this network has no confidence: set network.confidence=true"),
        (["--preset", "paper", "--set", "backbone.pretrained=false"], 2, "patches of 64 px, preset paper expects 224"),
        (
            ["--preset", "paper", "--set", "hypothesis.in_plane=true"],
            2,
            "hypothesis.in_plane changes nothing here: it needs hypothesis.online=true",
        ),
        (["--backbone-weights", "stem.safetensors"], 2, "network.backbone.weights changes nothing here"),
        (["--set", "on_policy.updates=2"], 2, "it needs on_policy.fraction=0.5 or so"),
        (["--preset", "paper", "--set", "network.widths=[8, 8]"], 2, "it needs network.kind=compact, plus or flow"),
        (["--preset", "flow", "--set", "network.hidden=8"], 2, "it needs network.kind=compact or plus"),
        (["--set", "optimiser.name=adam", "--set", "optimiser.weight_decay=1"], 2, "it needs optimiser.name=adamw"),
        (["--set", "augment.min_visible_fraction=0.2"], 2, "it needs augment.occlusion=0.3 or so"),
        (["--set", "on_policy={updates: 2}"], 2, "on_policy.updates changes nothing here"),
        (["--loss", "contour", "--set", "loss.point_weight=2"], 2, "it needs loss.name=contour+point"),
        (["--set", "optimiser.lr=-1"], 2, "lr is -1"),
        (["--set", "optimiser.lr=.inf"], 2, "lr is inf"),
        (["--set", "optimiser.gradient_clip=-1"], 2, "gradient_clip is -1"),
        (["--set", "network.encoder=[0, 4]"], 2, "network.encoder[0] is 0, expected 1 or more"),
        (["--set", "loss.contour_points=0"], 2, "contour_points is 0"),
        (["--set", "loss.gamma=.nan"], 2, "gamma is nan"),
        (["--set", "loader.prefetch=0"], 2, "prefetch is 0"),
        (["--set", "seed=-1"], 2, "seed is -1"),
        (["--resume"], 1, "no run to resume"),
    ],
)
def test_train_errors_are_one_line(cli, dataset, tmp_path, arguments, code, text):
    size = SHORT if "--preset" in arguments else SMALL
    result = cli("train", dataset, "--out", tmp_path / "run", *size, *arguments)
    assert result.exit_code == code, result.output
    assert text in result.stderr
    assert len(result.stderr.splitlines()) == 1


def test_a_folder_that_is_no_dataset_is_one_line(cli, tmp_path):
    result = cli("train", tmp_path, "--out", tmp_path / "run", *SMALL)
    assert result.exit_code == 1
    assert "not a shard dataset" in result.stderr


@pytest.mark.slow
@pytest.mark.parametrize("workers", [0, 1])
def test_a_damaged_shard_is_one_line_also_from_a_loader_process(cli, dataset, tmp_path, workers):
    copy = shutil.copytree(dataset, tmp_path / "shards")
    validation = split_by_scene(ShardReader(str(copy)), 0.05, 0)[1]
    damaged = next(shard for shard in range(6) if shard not in validation.rows)
    file = copy / f"scene_rgb/c/{damaged}/0/0/0"
    file.write_bytes(file.read_bytes()[:-100])
    options = ["--workers", workers, "--set", "validation.scene_fraction=0.05", "--set", "loader.shuffle_shards=6"]
    result = cli("train", copy, "--out", tmp_path / "run", *SMALL, *options, "--quiet")
    assert result.exit_code == 1
    (line,) = result.stderr.splitlines()
    assert line.startswith(f"Error: {file}: found ")


@pytest.mark.slow
def test_a_disk_that_is_full_for_tensorboard_is_one_line(cli, dataset, tmp_path, monkeypatch):
    """Its events are written by a thread, whose traceback Python would print."""

    def full(writer, data):
        raise OSError(errno.ENOSPC, "No space left on device")

    printed = []
    monkeypatch.setattr(threading, "excepthook", printed.append)
    monkeypatch.setattr(RecordWriter, "write", full)
    result = cli("train", dataset, "--out", tmp_path / "run", *SMALL, "--quiet")
    assert result.exit_code == 1
    (line,) = result.stderr.splitlines()
    assert "tensorboard: the disk is full" in line
    assert not printed


def test_refined_poses_go_to_a_file_not_a_folder(cli, tmp_path):
    result = cli("refine", "--checkpoint", "a", "--dataset", "b", "--init", "c", "--out", tmp_path)
    assert result.exit_code == 2
    assert "is a directory" in result.stderr


@pytest.mark.slow
def test_two_ranks_train_together(dataset, tmp_path):
    """torchrun with two processes on this machine; both must end."""
    command = [
        sys.executable, "-m", "torch.distributed.run", "--nproc-per-node", "2", "-m", "refinenet", "train",
        str(dataset), "--out", str(tmp_path / "run"), *SMALL, "--device", "cpu", "--quiet",
    ]  # fmt: skip
    result = run(command)
    assert result.returncode == 0, result.stderr[-2000:]
    assert (tmp_path / "run" / "last.safetensors").is_file()
