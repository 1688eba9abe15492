"""Refinement of a result file, called from Python."""

import pkgutil
import subprocess
import sys
from pathlib import Path

import pytest
from posecore.bop import read_results, read_sidecar
from posecore.errors import ConfigError, DatasetError
from refinenet.refine import MethodSettings, RefineJob, refine_result_file
from refinenet.renamed import MODULES

from .test_workers import columns


@pytest.fixture
def job(two_images, trained, tmp_path):
    """Two images with four initial poses, one of which is behind the camera."""
    root, initial, _ = two_images
    method = MethodSettings(checkpoint=trained, iterations=1, device="cpu")
    return RefineJob(method=method, dataset=root, init=initial, out=tmp_path / "job" / "refined.csv", threads=1)


def test_a_job_writes_the_files_of_the_command(cli, job, tmp_path):
    calls = []
    summary = refine_result_file(job, lambda done, total: calls.append((done, total)))
    assert calls == [(0, 4), (3, 4), (4, 4)]
    assert (summary.not_reached, summary.stopped) == (0, None)
    assert (len(summary.refined.poses), len(summary.refined.failed), summary.refined.converged) == (4, 1, 0)
    assert [estimate.obj_id for estimate in read_results(job.out)] == [1, 1, 1]
    out = tmp_path / "command" / "refined.csv"
    options = ["--checkpoint", job.method.checkpoint, "--dataset", job.dataset, "--init", job.init, "--out", out]
    result = cli("refine", *options, "--iterations", 1, "--device", "cpu", "--threads", 1, "--quiet")
    assert result.exit_code == 0, result.output
    assert columns(job.out) == columns(out)
    assert read_sidecar(job.out) == read_sidecar(out)
    assert read_sidecar(out)["initial_lines"] == [2, 3, 4]


@pytest.mark.parametrize("error", [KeyboardInterrupt, DatasetError])
def test_an_early_end_keeps_the_finished_images(job, error):
    def stop(done, total):
        if done:
            raise error("stop")

    summary = refine_result_file(job, stop)
    assert isinstance(summary.stopped, error)
    assert summary.not_reached == 1
    sidecar = read_sidecar(job.out)
    assert sidecar["not_reached"] == 1
    assert len(read_results(job.out)) == len(sidecar["initial_lines"]) == 2


def test_an_error_before_the_first_image_is_raised_and_writes_nothing(job):
    def stop(done, total):
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        refine_result_file(job, stop)
    assert not job.out.exists()


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({}, "--method network needs a --checkpoint"),
        ({"method": "region", "checkpoint": Path("x")}, "--method region takes no --checkpoint"),
        ({"method": "search", "hypotheses": 4}, "--hypotheses is for --method network"),
        ({"method": "region", "min_confidence": 0.2}, "region has no confidences"),
    ],
)
def test_settings_without_effect_are_refused(settings, message):
    with pytest.raises(ConfigError, match=message):
        MethodSettings(**settings)


def test_an_unknown_method_is_refused_by_name():
    settings = MethodSettings(method="region")
    object.__setattr__(settings, "method", "regions")  # past the type checks of the tests
    with pytest.raises(ConfigError, match="found 'regions', expected network, edge-icp"):
        settings.__post_init__()


def test_candidates_are_those_of_a_search(job):
    edges = MethodSettings(method="edge-icp")
    with pytest.raises(ConfigError, match="--candidates is for --method search, edge-icp follows one pose"):
        RefineJob(method=edges, dataset=job.dataset, init=job.init, out=job.out, candidates=job.out)


@pytest.mark.slow
def test_the_commands_import_torch_only_to_run():
    code = "import sys, refinenet.cli, refinenet.refine; sys.exit('torch' in sys.modules)"
    assert subprocess.run([sys.executable, "-c", code], check=False).returncode == 0


def test_old_module_names_are_refused_with_the_new():
    with pytest.raises(ImportError, match=r"refinenet\.methods is now refinenet\.refiner"):
        import refinenet.methods  # noqa: F401
    with pytest.raises(ImportError, match=r"refinenet\.tracking\.TrackingConfig is now refinenet\.tracking\.state"):
        from refinenet.tracking import TrackingConfig  # noqa: F401


def test_every_old_module_name_has_a_new_one_that_exists():
    for new in MODULES.values():
        for name in new.split(" and "):
            pkgutil.resolve_name(name)
