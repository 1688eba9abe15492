"""`refinenet refine`: BOP in, BOP out."""

import json
import re
import threading

import cv2
import numpy as np
import pytest
import torch
from posecore.bop import BopDataset, read_results, read_sidecar
from posecore.raster import context
from refinenet.config import load_config
from refinenet.models import checkpoint
from refinenet.models.networks import make_network
from refinenet.refine.network_refiner import Refiner
from refinenet.refiner import Frame, Request

from ..conftest import HEIGHT_PX, WIDTH_PX, K


def test_a_real_network_ranks_a_pool_by_its_own_confidence(cli, bop, mesh, frame, tmp_path):
    """Through the command, on random weights: the scores in the file are what the network says of the poses there."""
    torch.manual_seed(1)
    config = load_config("compact", ["network.confidence=true", "network.head_std=0.05"])
    objects = {"1": {"name": "thing", "diameter_m": mesh.diameter_m, "window_side_px": 150.0}}
    provenance = checkpoint.Provenance(
        config=config, step=1, dataset_sha256="0" * 64, objects=objects, camera_fx_px=K[0, 0]
    )
    path, out = tmp_path / "sure.safetensors", tmp_path / "pool.csv"
    checkpoint.save(path, make_network(config.network), provenance)
    root, start = bop
    options = ["--hypotheses", 8, "--scorer", "learned", "--iterations", 1, "--threads", 1, "--quiet"]
    result = cli("refine", "--checkpoint", path, "--dataset", root, "--init", start, "--out", out, *options)
    assert result.exit_code == 0, result.output
    settings = read_sidecar(out)["settings"]
    assert (settings["scorer"], settings["confidence"], settings["hypotheses"]) == ("learned", "learned", 8)
    found = read_results(out)
    image, _ = frame
    with Refiner.load(path, {1: mesh}) as refiner:
        said = refiner.confidences(
            Frame(image=image, K=K), [Request(obj_id=1, T_cam_obj=e.T_cam_obj) for e in found], "learned"
        )
    np.testing.assert_allclose([e.score for e in found], said, atol=2e-3)  # poses in files are rounded
    assert len({round(float(value), 4) for value in said}) == len(found) > 1


def test_a_machine_without_egl_gets_one_line(cli, bop, trained, tmp_path, monkeypatch):
    root, start = bop
    monkeypatch.setattr(context, "_threads", threading.local())

    def no_device(**settings):
        raise Exception("(standalone) XOpenDisplay: cannot open display")

    monkeypatch.setattr(context.moderngl, "create_context", no_device)
    result = cli(
        "refine", "--checkpoint", trained, "--dataset", root, "--init", start, "--out", tmp_path / "x.csv", "--quiet"
    )
    assert result.exit_code == 1
    (line,) = result.stderr.splitlines()
    assert "no EGL device for the rasteriser" in line
    assert "libegl1" in line


@pytest.mark.slow
def test_refine_command(cli, bop, trained, tmp_path):
    root, start = bop
    out = tmp_path / "results" / "refined.csv"
    arguments = [
        "--checkpoint",
        trained,
        "--dataset",
        root,
        "--init",
        start,
        "--out",
        out,
        "--overlay",
        tmp_path / "pics",
    ]
    result = cli("refine", *arguments, "--name", "mine", "--iterations", 2)
    assert result.exit_code == 0, result.output
    assert "3 initial poses, 2 refined (0 converged), 1 failed (left out of the file)" in result.stdout
    refined, starts = read_results(out, BopDataset(root)), read_results(start)
    assert all(0 < e.score < 1 and e.score != 0.9 for e in refined)  # how well the pose fits
    assert np.abs(refined[0].T_cam_obj - starts[0].T_cam_obj).max() > 1e-4
    assert len({e.time_s for e in refined}) == 1
    assert refined[0].time_s > 0
    sidecar = read_sidecar(out)
    assert sidecar["method"] == "mine"
    assert sidecar["checkpoint_sha256"] == checkpoint.load(trained).sha256
    assert sidecar["perturbation"] == {"rows": [{"line": 2}]}
    assert sidecar["initial_lines"] == [2, 3]
    assert sidecar["failed_lines"] == [4]
    assert "behind the camera" in sidecar["failures"]["4"]
    assert f"Failed: {start}:4: scene 1, image 0, object 1: at z = " in result.stderr
    picture = cv2.imread(str(tmp_path / "pics" / "000001_000000.png"))
    assert picture.shape == (HEIGHT_PX, WIDTH_PX, 3)
    result = cli("refine", *arguments[:-2], "--iterations", 1, "--keep-failed")
    assert "1 failed (initial poses kept)" in result.stdout
    kept, sidecar = read_results(out), read_sidecar(out)
    assert sidecar["settings"]["min_confidence"] == 0
    assert (len(kept), sidecar["initial_lines"], sidecar["failed_lines"]) == (3, [2, 3, 4], [4])
    assert kept[2].score == 0
    np.testing.assert_allclose(kept[2].T_cam_obj, starts[2].T_cam_obj)
    between = (kept[0].score + kept[1].score) / 2
    result = cli("refine", *arguments[:-2], "--iterations", 1, "--min-confidence", between)
    assert "2 failed" in result.stdout
    doubted, sidecar = min(kept[:2], key=lambda estimate: estimate.score), read_sidecar(out)
    why = f"after 1 updates its confidence, {doubted.score:.3f}, is below the minimum of {between:g}"
    assert sidecar["failures"][str(doubted.line)] == why
    assert sidecar["initial_lines"] == [{2: 3, 3: 2}[doubted.line]]


@pytest.mark.slow
def test_what_was_finished_is_written_when_something_ends_it(cli, two_images, trained, tmp_path, monkeypatch):
    two, start, second = two_images
    picture = second.read_bytes()
    second.write_bytes(picture[:200])
    out = tmp_path / "x.csv"
    rest = [
        "--checkpoint",
        trained,
        "--dataset",
        two,
        "--init",
        start,
        "--out",
        out,
        "--iterations",
        1,
    ]
    result = cli("refine", *rest)
    assert result.exit_code == 1
    assert f"Stopped: 1 initial poses were not reached, {out} holds the others" in result.stderr
    assert "000001" in result.stderr.splitlines()[-1]
    assert result.stderr.splitlines()[-1].startswith("Error: ")
    assert (len(read_results(out)), read_sidecar(out)["not_reached"]) == (2, 1)
    assert read_sidecar(out)["initial_lines"] == [3, 4]
    second.write_bytes(picture)
    calls = []

    def interrupted(self, frame, requests, original=Refiner.refine_batch):
        calls.append(len(requests))
        if len(calls) == interrupted.at:
            raise KeyboardInterrupt
        return original(self, frame, requests)

    monkeypatch.setattr(Refiner, "refine_batch", interrupted)
    interrupted.at = 2
    result = cli("refine", *rest)
    assert (result.exit_code, read_sidecar(out)["not_reached"]) == (130, 1)
    before = out.read_bytes()
    calls.clear()
    interrupted.at = 1
    result = cli("refine", *rest)
    assert (result.exit_code, out.read_bytes()) == (130, before)
    assert "Stopped: nothing was finished, nothing is written" in result.stderr


def test_refine_errors_are_one_line(cli, bop, trained, tmp_path):
    root, start = bop
    rest = ["--dataset", root, "--init", start, "--out", tmp_path / "x.csv"]
    for arguments, code, text in (
        (["--checkpoint", tmp_path / "none.safetensors", *rest], 1, "no such checkpoint"),
        (["--checkpoint", trained, *rest, "--object", "5"], 2, "no pose of object 5"),
        (["--checkpoint", trained, *rest, "--hypotheses", 4, "--scorer", "learned"], 1, "no confidence output"),
        (["--checkpoint", trained, "--dataset", tmp_path / "no", *rest[2:]], 1, "no such folder"),
        (
            ["--checkpoint", trained, *rest, "--scorer", "none"],
            2,
            "--scorer has no effect with one hypothesis, see --h",
        ),
        (["--checkpoint", trained, *rest, "--seed", 1], 2, "--seed has no effect with one hypothesis"),
        (["--method", "region", *rest, "--batch", 8], 2, "--batch has no effect for --method region without a network"),
        (["--method", "search", *rest, "--seed", 8], 2, "--seed has no effect for --method search; leave it out"),
    ):
        result = cli("refine", *arguments)
        assert result.exit_code == code, result.output
        assert text in result.stderr
        assert "Traceback" not in result.output
        assert len([line for line in result.stderr.splitlines() if line.startswith("Error: ")]) == 1


def test_a_method_and_its_checkpoint_belong_together(cli, bop, tmp_path):
    root, start = bop
    result = cli("refine", "--dataset", root, "--init", start, "--out", tmp_path / "x.csv")
    assert result.exit_code == 2
    assert "--method network needs a --checkpoint" in result.stderr


def test_an_overlay_that_cannot_be_is_said_before_any_work(cli, bop, tmp_path):
    root, start = bop
    out = tmp_path / "o.csv"
    out.write_text("from before")
    options = ["--method", "edge-icp", "--dataset", root, "--init", start, "--out", out, "--quiet"]
    result = cli("refine", *options, "--overlay", start)
    assert (result.exit_code, out.read_text()) == (1, "from before"), result.output
    assert "a file stands where a folder is needed" in result.stderr


@pytest.mark.slow
def test_an_image_needs_a_camera_and_no_ground_truth(cli, two_images, tmp_path):
    root, start, _ = two_images
    (file,) = root.glob("test/*/scene_gt.json")
    known = json.loads(file.read_text())
    del known["1"]
    file.write_text(json.dumps(known))
    options = ["--method", "edge-icp", "--dataset", root, "--init", start, "--keep-failed", "--quiet"]
    result = cli("refine", *options, "--out", tmp_path / "x.csv")
    assert result.exit_code == 0, result.output
    assert len(read_results(tmp_path / "x.csv")) == len(read_results(start))


@pytest.mark.slow
def test_a_camera_of_another_size_is_named_with_its_image(cli, two_images, tmp_path):
    root, start, image = two_images
    picture = cv2.imread(str(image))
    cv2.imwrite(str(image), cv2.resize(picture, None, fx=0.5, fy=0.5))
    options = ["--method", "edge-icp", "--dataset", root, "--init", start, "--out", tmp_path / "x.csv", "--quiet"]
    result = cli("refine", *options)
    assert result.exit_code == 1
    assert re.search(r"two/test/000001.*: image 1: camera matrix: .* scale K with the image", result.stderr)


def test_results_do_not_lie_on_the_sidecars_of_others(cli, bop, tmp_path):
    root, start = bop
    options = ["--method", "search", "--dataset", root, "--init", start, "--quiet"]
    for outputs, text in (
        (["--out", f"{start}.json"], "--out and the sidecar of --init are both"),
        (
            ["--out", tmp_path / "w.csv", "--candidates", tmp_path / "w.csv.json"],
            "--candidates and the sidecar of --out",
        ),
        (["--out", tmp_path / "w.csv", "--object", 1, "--object", 9], "no pose of object 9; change --object"),
    ):
        result = cli("refine", *options, *outputs)
        assert (result.exit_code, text in result.stderr) == (2, True), result.output
