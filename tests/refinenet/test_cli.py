import subprocess
import sys

import pytest

SMALL = [
    "--steps", "2", "--batch", "4", "--workers", "0", "--threads", "1", "--set", "loss.contour_points=32",
    "--set", "validation.pairs=4", "--set", "network.encoder=[8, 8]", "--set", "network.widths=[16, 16]",
]  # fmt: skip


def test_every_command_shows_an_example(cli):
    assert cli("--help").exit_code == 0
    for command in ("train", "refine"):
        assert f"refinenet {command} " in cli(command, "--help").output


def test_train_command(cli, dataset, tmp_path):
    out = tmp_path / "run"
    result = cli("train", dataset, "--out", out, *SMALL)
    assert result.exit_code == 0, result.output
    assert "start  refined" in result.stdout
    assert str(out / "best.safetensors") in result.stdout
    again = cli("train", dataset, "--out", out, *SMALL)
    assert again.exit_code == 2
    assert "holds a run already" in again.stderr
    assert cli("train", dataset, "--out", out, *SMALL, "--resume").exit_code == 0


@pytest.mark.parametrize(
    ("arguments", "code", "text"),
    [
        (["--set", "optimiser.momentum=1"], 2, "unknown key optimiser.momentum"),
        (["--set", "optimiser.lr=fast"], 2, "optimiser.lr is 'fast', expected float"),
        (["--preset", "paper", "--set", "backbone.pretrained=false"], 2, "patches of 64 px, preset paper expects 224"),
        (["--set", "optimiser.lr=-1"], 2, "lr is -1"),
        (["--resume"], 1, "no such checkpoint"),
    ],
)
def test_train_errors_are_one_line(cli, dataset, tmp_path, arguments, code, text):
    result = cli("train", dataset, "--out", tmp_path / "run", *SMALL, *arguments)
    assert result.exit_code == code, result.output
    assert text in result.stderr
    assert len(result.stderr.strip().splitlines()) == 1


def test_a_folder_that_is_no_dataset_is_one_line(cli, tmp_path):
    result = cli("train", tmp_path, "--out", tmp_path / "run", *SMALL)
    assert result.exit_code == 1
    assert "no shard dataset" in result.stderr


@pytest.mark.slow
def test_two_ranks_train_together(dataset, tmp_path):
    """torchrun with two processes on this machine; both must end."""
    command = [
        sys.executable, "-m", "torch.distributed.run", "--nproc-per-node", "2", "-m", "refinenet", "train",
        str(dataset), "--out", str(tmp_path / "run"), *SMALL, "--device", "cpu", "--quiet",
    ]  # fmt: skip
    result = subprocess.run(command, capture_output=True, text=True, timeout=200, check=False)
    assert result.returncode == 0, result.stderr[-2000:]
    assert (tmp_path / "run" / "last.safetensors").is_file()
