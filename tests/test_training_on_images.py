"""From annotated images to a network: a search's candidates cut out, merged with rendered pairs, trained on."""

import json
from pathlib import Path

import pytest
from click.testing import CliRunner
from posecore.shard import ShardReader
from refinenet.cli import main as refinenet
from synthgen.cli import main as synthgen

pytestmark = pytest.mark.slow

CAMERA = "width_px: 160, height_px: 120, fx: 143, fy: 143, cx: 81.5, cy: 60.5"
RASTER = f"camera: {{{CAMERA}}}\nengine: raster\ncontour_points: 48\npatch_px: 64\nshard_size: 8\n"


def run(command, *arguments):
    result = CliRunner().invoke(command, [str(a) for a in arguments], catch_exceptions=False)
    assert result.exit_code == 0, result.output
    return result


@pytest.fixture(scope="module")
def work(tmp_path_factory, tug_ply: Path) -> Path:
    """Four images, the poses that search weighed in them, and pairs cut out at those."""
    work = tmp_path_factory.mktemp("images")
    (work / "raster.yaml").write_text(RASTER)
    rendered = ("--object", tug_ply, "--preset", work / "raster.yaml", "--quiet")
    run(synthgen, "bop", *rendered, "--frames", 4, "--out", work / "bop")
    run(synthgen, "render", *rendered, "--n", 16, "--workers", 1, "--out", work / "rendered")
    from evalkit.cli import main as evalkit

    run(evalkit, "perturb", "--dataset", work / "bop", "--random-up-to", 20, "--out", work / "start.csv")
    given = ("--dataset", work / "bop", "--init", work / "start.csv", "--threads", 1, "--quiet")
    found = ("--out", work / "found.csv", "--candidates", work / "all.csv", "--keep-failed")
    run(refinenet, "refine", "--method", "search", *given, *found, "--iterations", 1)
    settings = ("--patch-px", 64, "--set", "contour_points=48", "--set", "shard_size=8", "--set", "min_area_px=30")
    run(
        synthgen,
        "cut",
        "--dataset",
        work / "bop",
        "--hypotheses",
        work / "all.csv",
        *settings,
        "--out",
        work / "cut",
        "--quiet",
    )
    run(synthgen, "merge", work / "rendered", work / "cut", "--out", work / "both", "--quiet")
    return work


def test_a_network_learns_to_judge_from_a_searchs_candidates(work: Path) -> None:
    assert ShardReader(str(work / "cut")).n > 12
    settings = ("hypothesis.precomputed_fraction=0.5", "loss.min_pose_quality=0.02", "batch=8", "loader.workers=0")
    network = ("network.patch_px=32", "network.match_radius=2", "network.encoder=[8, 8]", "network.widths=[8, 8]")
    arguments = [word for s in (*settings, *network) for word in ("--set", s)]
    run(
        refinenet, "train", work / "both", "--preset", "flow", "--steps", 2, "--threads", 1, *arguments,
        "--out", work / "run",
    )  # fmt: skip
    lines = [json.loads(line) for line in (work / "run" / "metrics.jsonl").read_text().splitlines()]
    told = [line["validation/confidence_error"] for line in lines if "validation/confidence_error" in line]
    assert 0 < told[-1] < 0.6
    assert (work / "run" / "best.safetensors").is_file()


def test_windows_that_follow_the_distance_are_not_for_a_fixed_one(work: Path) -> None:
    for shards in ("cut", "both"):
        settings = ("--set", "backbone.pretrained=false", "--set", "loader.workers=0")
        arguments = ["train", str(work / shards), "--preset", "paper", *settings, "--out", str(work / "no")]
        result = CliRunner().invoke(refinenet, arguments)
        assert result.exit_code == 2, result.output
        assert "windows differ in side between poses of an object" in result.stderr
        assert "--set window=fixed" in result.stderr
