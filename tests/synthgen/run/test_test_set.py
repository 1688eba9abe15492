"""Test images beside training pairs: how many, of which scenes, and the same bytes whatever happens on the way."""

import shutil
from dataclasses import replace

import numpy as np
import pytest
from posecore.bop import BopDataset
from posecore.errors import ConfigError, DatasetError, RenderError
from synthgen.bop.frame_maker import FramePlan
from synthgen.config import load_config
from synthgen.inputs.sources import Sources
from synthgen.run import dispatcher
from synthgen.run.bop import BopJob, render_bop_dataset
from synthgen.run.render import RenderJob, render_dataset
from synthgen.run.test_set import SEED_DISTANCE, default_count, has_images, image_workers, images_config


@pytest.mark.parametrize(
    ("n", "out", "scheduler", "count"),
    [
        (200_000, "shards", None, 100),
        (256, "shards", None, 25),
        (3, "shards", None, 1),
        (200_000, "s3://bucket/shards", None, 0),
        (200_000, "shards", "tcp://node0:8786", 0),
    ],
)
def test_the_default_number(n, out, scheduler, count):
    assert default_count(n, out, scheduler) == count


def test_a_url_holds_no_test_images(tug_ply):
    with pytest.raises(ConfigError, match="--test-images 5: s3://bucket/x is a URL"):
        RenderJob(out="s3://bucket/x", n=5, config=load_config(), sources=Sources(objects=(tug_ply,)), test_images=5)


def test_a_recipe_for_many_objects_a_frame_suits_a_single_one():
    pbr = load_config("pbr")
    assert pbr.frames.objects == (5, 15)
    assert images_config(replace(pbr, frames=replace(pbr.frames, instances=1)), 1).frames.objects == (1, 1)
    assert images_config(pbr, 2).frames.objects == (5, 10)
    assert images_config(pbr, 2).seed == pbr.seed + SEED_DISTANCE
    assert images_config(replace(pbr, seed=2**63 - 1), 2).seed == SEED_DISTANCE


@pytest.mark.parametrize(
    ("engine", "workers", "has_gpu", "processes"),
    [("raster", 1, False, 1), ("raster", 4, False, 4), ("raster", 4, True, 1), ("cycles", 1, False, 2),
     ("cycles", 4, False, 4), ("cycles", 4, True, 2)],
)  # fmt: skip
def test_a_blender_engine_has_processes_of_its_own_and_a_gpu_few(engine, workers, has_gpu, processes):
    assert image_workers(load_config("default", [f"engine={engine}"]), workers, has_gpu=has_gpu) == processes


@pytest.mark.slow
def test_finished_images_stay_where_the_pairs_fail(config_of, tug_ply, tmp_path, monkeypatch):
    def fail(*arguments, **settings):
        raise ConfigError("no pairs")

    out, sources = tmp_path / "shards", Sources(objects=(tug_ply,))
    job = RenderJob(out=str(out), n=4, config=config_of(), sources=sources, workers=1, test_images=1)
    monkeypatch.setattr(dispatcher, "run", fail)
    for _ in range(2):  # the second time they are there
        with pytest.raises(ConfigError, match="no pairs"):
            render_dataset(job)
        assert has_images(out, whole=True)


@pytest.mark.parametrize(("error", "stays"), [(RenderError, True), (ConfigError, False)])
def test_some_images_stay_unless_another_setting_is_needed(config_of, tug_ply, tmp_path, monkeypatch, error, stays):
    def fail(folder, *arguments, **settings):
        (folder / "test/000001").mkdir(parents=True)
        (folder / "test/000001/scene_gt.json").write_text("{}")
        raise error("no more images")

    monkeypatch.setattr("synthgen.run.test_set.write_dataset", fail)
    out = tmp_path / "shards"
    job = RenderJob(
        out=str(out), n=4, config=config_of(), sources=Sources(objects=(tug_ply,)), workers=1, test_images=3
    )
    with pytest.raises(error, match="no more images"):
        render_dataset(job)
    assert out.exists() == stays


def contents(folder):
    return {path.relative_to(folder): path.read_bytes() for path in sorted(folder.rglob("*")) if path.is_file()}


@pytest.mark.slow
def test_they_are_bop_frames_of_another_seed_and_a_second_run_completes_them(config_of, tug_ply, tmp_path):
    sources, images = Sources(objects=(tug_ply,)), tmp_path / "shards/test_bop"
    job = RenderJob(out=str(tmp_path / "shards"), n=4, config=config_of(), sources=sources, workers=1, test_images=3)
    lines, seen = [], []
    summary = render_dataset(job, on_objects=lines.extend, on_image=seen.append)
    assert (summary.test_images, sum(seen)) == (3, 3)
    assert lines == ["tug.ply: diameter 118.9 mm (--units mm)"]
    before = contents(images)
    plan, config = FramePlan(frames=3), replace(config_of(), seed=SEED_DISTANCE)
    render_bop_dataset(BopJob(out=str(tmp_path / "bop"), plan=plan, config=config, sources=sources, workers=2))
    assert contents(tmp_path / "bop") == before

    for path in (images / "test/000001/scene_gt.json", images / "test/000001/rgb/000001.png"):
        path.unlink()
    (images / "test_targets_bop19.json").unlink()
    render_dataset(job)
    assert contents(images) == before
    with pytest.raises(DatasetError, match="its frames differ"):
        render_dataset(replace(job, test_images=4))
    assert contents(images) == before
    shutil.rmtree(images)
    render_dataset(replace(job, test_images=0))
    assert not images.exists()


@pytest.mark.slow
def test_no_image_shows_the_pose_of_a_pair(config_of, tug_ply, tmp_path):
    from posecore.shard import ShardReader

    job = RenderJob(
        out=str(tmp_path / "shards"), n=8, config=config_of(), sources=Sources(objects=(tug_ply,)), workers=1,
        test_images=4,
    )  # fmt: skip
    render_dataset(job)
    reader, dataset = ShardReader(job.out), BopDataset(tmp_path / "shards/test_bop")
    pairs = np.concatenate([reader.read(i, ["T_cam_obj"])["T_cam_obj"] for i in reader.committed])
    shown = [gt.T_cam_obj for im_id in dataset.im_ids(1) for gt in dataset.gt(1, im_id)]
    assert len(shown) == 4
    assert min(np.abs(pair - T).max() for pair in pairs for T in shown) > 1e-3
