"""The applications behind `render`, `bop` and `cut`, called from Python with one job."""

import json
import shutil

import pytest
from posecore.errors import ConfigError
from posecore.shard import ShardReader
from synthgen.bop.frame_maker import FramePlan
from synthgen.config import CutConfig
from synthgen.inputs.sources import Sources
from synthgen.run.bop import BopJob, render_bop_dataset
from synthgen.run.cut import CutJob, cut_dataset
from synthgen.run.render import RenderJob, render_dataset


@pytest.fixture
def sources(tug_ply):
    return Sources(objects=(tug_ply,))


@pytest.mark.slow
def test_a_job_renders_a_dataset_and_its_second_run_has_nothing_left(sources, config_of, tmp_path):
    job = RenderJob(out=str(tmp_path / "shards"), n=6, config=config_of(), sources=sources, workers=1)
    plans, pairs = [], []
    summary = render_dataset(job, on_plan=plans.append, on_shard=lambda encoded: pairs.append(encoded.line["n"]))
    assert (summary.url, summary.pairs, summary.quarantined) == (job.out, 6, ())
    assert (plans[0].present, plans[0].total, plans[0].damaged) == (0, 6, {})
    assert sorted(pairs) == [2, 4]
    assert ShardReader(job.out).complete
    again = render_dataset(job, on_plan=plans.append, on_shard=lambda encoded: pairs.append(encoded.line["n"]))
    assert again == summary
    assert (plans[1].present, len(pairs)) == (6, 2)


@pytest.mark.slow
def test_a_damaged_shard_is_in_the_plan(sources, config_of, tmp_path):
    job = RenderJob(out=str(tmp_path / "shards"), n=6, config=config_of(), sources=sources, workers=1)
    render_dataset(job)
    file = next(path for path in (tmp_path / "shards/scene_rgb/c/0").rglob("*") if path.is_file())
    content = file.read_bytes()
    file.write_bytes(content[:-1])
    plans = []
    render_dataset(job, on_plan=plans.append)
    assert plans[0].present == 2
    assert "shard 0 is damaged" in plans[0].text
    assert file.read_bytes() == content


def test_workers_and_a_scheduler_contradict_each_other(sources, config_of):
    with pytest.raises(ConfigError, match="give only one option"):
        RenderJob(out="out", n=6, config=config_of(), sources=sources, workers=2, scheduler="tcp://node0:8786")


def test_a_bop_job_and_a_cut_job_make_pairs_of_its_images(sources, config_of, tmp_path):
    frames = BopJob(out=str(tmp_path / "frames"), plan=FramePlan(frames=2), config=config_of(), sources=sources)
    done = []
    summary = render_bop_dataset(frames, on_frame=lambda scene_id, im_id: done.append((scene_id, im_id)))
    assert (summary.frames, done) == (2, [(1, 0), (1, 1)])
    assert len(json.loads((tmp_path / "frames/test/000001/scene_gt.json").read_text())) == 2
    config = CutConfig(patch_px=48, contour_points=20, hypotheses_per_pose=2, shard_size=4)
    job = CutJob(dataset=tmp_path / "frames", out=str(tmp_path / "pairs"), config=config)
    plans, pairs = [], []
    cut = cut_dataset(job, on_plan=plans.append, on_shard=pairs.append)
    assert cut.pairs == plans[0].pairs == sum(pairs) == ShardReader(job.out).n > 0
    shutil.copytree(tmp_path / "frames/test", tmp_path / "frames/val")
    with pytest.raises(ConfigError, match="has the splits test, val: choose with --split"):
        cut_dataset(job)
