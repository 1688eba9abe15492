"""Estimates come from real renders."""

import os
import time

import pytest
from posecore.errors import PoseError, RenderError
from posecore.mesh import load_mesh
from posecore.shard import ShardReader
from small_datasets import write_dataset
from synthgen.inputs.assets import Assets
from synthgen.pairs import data_card
from synthgen.run import estimate
from synthgen.run.shard_job import ShardJob


@pytest.fixture
def job_of(config_of, tug_ply):
    def make(n, *overrides):
        config, meshes = config_of(*overrides), {1: load_mesh(tug_ply)}
        return ShardJob(config=config, card=data_card.rendered_card(config, n, meshes, Assets()), meshes=meshes)

    return make


@pytest.mark.slow
def test_the_estimate_is_near_what_a_dataset_takes(job_of, tmp_path):
    job = job_of(16, "shard_size=8")
    measured = estimate.estimate(job, scenes=3)
    assert measured.pairs == 8 and measured.seconds_per_pair > 0
    write_dataset(tmp_path / "d", job.config, job.meshes, 16)
    reader = ShardReader(str(tmp_path / "d"))
    real = sum(sum(line["bytes"].values()) for line in reader._lines.values())
    assert measured.size_bytes(16) == pytest.approx(real, rel=0.5)
    assert measured.duration_s(1000, 4) == pytest.approx(250 * measured.seconds_per_pair)


def test_the_last_shard_alone_is_enough(job_of):
    assert estimate.measure_scenes(job_of(1), 4, 5.0).pairs == 2  # one scene of one sample, rendered twice


@pytest.mark.slow
def test_settings_that_cannot_be_rendered_fail_the_estimate(job_of):
    job = job_of(8, "window.min_area_px=2000")
    with pytest.raises(PoseError, match="scene 0"):
        estimate.estimate(job)


@pytest.mark.slow
def test_a_process_that_dies_or_hangs_is_one_line():
    with pytest.raises(RenderError, match="the renderer died at the first scenes, exit code -6"):
        estimate.in_own_process(os.abort, timeout_s=7200)
    with pytest.raises(RenderError, match="gave no result in 0 s"):
        estimate.in_own_process(time.sleep, 7200, timeout_s=0.2)
