"""Tracking of a sequence, called from Python."""

import cv2
import numpy as np
import pytest
from posecore.bop import read_results, read_sidecar
from posecore.errors import ConfigError
from refinenet.refine import MethodSettings
from refinenet.tracking.frame_sources import open_images, open_scene
from refinenet.tracking.run import TrackJob, track_to_file

from ..refine.test_workers import columns
from .conftest import FRAMES


@pytest.fixture
def job(scene, still, tmp_path):
    root, _ = scene
    method = MethodSettings(checkpoint=still, device="cpu")
    return TrackJob(method=method, dataset=root, init=root / "start.csv", out=tmp_path / "job" / "track.csv", threads=1)


@pytest.mark.slow
def test_a_job_writes_the_files_of_the_command(cli, job, tmp_path):
    calls = []
    summary = track_to_file(job, lambda done, total: calls.append((done, total)))
    assert calls == [(i, FRAMES) for i in range(FRAMES + 1)]
    assert (summary.log.frames, summary.not_reached, summary.stopped) == (FRAMES, 0, None)
    out = tmp_path / "command" / "track.csv"
    options = ["--checkpoint", job.method.checkpoint, "--init", job.init, "--out", out, "--device", "cpu"]
    result = cli("track", "--dataset", job.dataset, *options, "--threads", 1, "--quiet")
    assert result.exit_code == 0, result.output
    assert columns(job.out) == columns(out)
    assert read_sidecar(job.out) == read_sidecar(out)
    settings = read_sidecar(out)["settings"]
    assert (settings["tracking_threshold"], settings["accept_threshold"]) == (0.35, 0.2)


def test_an_early_end_keeps_the_finished_frames(job):
    def stop(done, total):
        if done == 3:
            raise KeyboardInterrupt

    summary = track_to_file(job, stop)
    assert isinstance(summary.stopped, KeyboardInterrupt)
    assert summary.not_reached == read_sidecar(job.out)["not_reached"] == FRAMES - 3
    assert [estimate.im_id for estimate in read_results(job.out)] == [0, 1, 2]


def test_settings_without_effect_are_refused(job):
    common = {"dataset": job.dataset, "out": job.out}
    edges = MethodSettings(method="edge-icp")
    with pytest.raises(ConfigError, match="give either --init or --pose"):
        TrackJob(method=edges, **common)
    with pytest.raises(ConfigError, match="--depth-step has no effect for --method edge-icp, which has no confidences"):
        TrackJob(method=edges, init=job.init, depth_step=0.1, **common)
    search = MethodSettings(method="search", checkpoint=job.method.checkpoint)
    with pytest.raises(ConfigError, match="--method search takes no --checkpoint"):
        TrackJob(method=search, init=job.init, **common)


def test_images_named_like_models_are_images(tmp_path):
    (tmp_path / "cam.json").write_text('{"fx": 600, "fy": 600, "cx": 4, "cy": 4}')
    for name in ("models_01.png", "models.png"):
        cv2.imwrite(str(tmp_path / name), np.zeros((8, 8, 3), np.uint8))
    common = {"split": None, "scene": None}
    assert len(open_images(tmp_path, camera=tmp_path / "cam.json", **common)) == 2
    with pytest.raises(ConfigError, match="found no models folder in it, expected a BOP dataset"):
        open_scene(tmp_path, camera=None, **common)
    (tmp_path / "models_eval").mkdir()
    with pytest.raises(ConfigError, match="is now track --dataset"):
        open_images(tmp_path, camera=tmp_path / "cam.json", **common)


@pytest.mark.parametrize(("old", "new"), [("--sure", "--tracking-threshold"), ("--found", "--accept-threshold")])
def test_old_options_are_refused_with_the_new_name(cli, job, old, new):
    result = cli("track", "--dataset", job.dataset, "--init", job.init, "--out", job.out, old, 0.5)
    assert result.exit_code == 2
    assert f"{old} is now {new}" in result.stderr
