"""Datasets of the version before the vocabulary (commit 4cbbea2) are read, verified, continued and merged.

`tests/data/dataset_before_vocabulary/` was made by that commit with `SETTINGS`, seed 3 and the rasteriser: 4 pairs in
2 shards, and 2 whole images of 96 x 72 pixels.
"""

import importlib
import json
import shutil
from pathlib import Path

import pytest
from posecore.errors import ShardError
from posecore.shard import GROUP, ShardReader
from synthgen.bop.frame_maker import FramePlan
from synthgen.config import RENAMED_KEYS, load_config
from synthgen.inputs.sources import Sources
from synthgen.inspect.info import dataset_info, info_text
from synthgen.pairs.data_card import migrated_card
from synthgen.pairs.merge import merge_datasets
from synthgen.run.bop import BopJob, render_bop_dataset
from synthgen.run.render import RenderJob, render_dataset
from synthgen.verify.verify import verify

EARLIER = Path(__file__).parent.parent / "data" / "dataset_before_vocabulary"
SETTINGS = ("engine=raster", "occluders.library=4")
PAIRS = ("patch_px=24", "contour_points=8", "window.min_area_px=10", "hypotheses_per_scene=2", "shard_size=2")
FRAMES = ("width_px=96", "height_px=72", "fx=90", "fy=90", "cx=48", "cy=36")


@pytest.fixture
def earlier(tmp_path):
    return Path(shutil.copytree(EARLIER, tmp_path / "earlier"))


def pairs_job(folder, *overrides, seed=3):
    config = load_config("tejani", [*SETTINGS, *PAIRS, f"seed={seed}", *overrides])
    sources = Sources(objects=(EARLIER / "pairs/models/obj_000001.ply",))
    return RenderJob(out=str(folder), n=4, config=config, sources=sources, workers=1)


def files(folder):
    return {p.relative_to(folder): p.read_bytes() for p in sorted(folder.rglob("*")) if p.is_file()}


def keys(config):
    return {f"{group}.{key}" for group, values in config.items() if isinstance(values, dict) for key in values}


def test_its_card_has_renamed_keys_which_are_migrated_in_one_place():
    card = ShardReader(str(EARLIER / "pairs")).card
    stored = {
        f"{group}.{key}" for group, values in card["config"].items() if isinstance(values, dict) for key in values
    }
    assert len(stored & set(RENAMED_KEYS)) > 10
    current = migrated_card(card)
    migrated = {f"{g}.{key}" for g, values in current["config"].items() if isinstance(values, dict) for key in values}
    assert not migrated & set(RENAMED_KEYS)
    assert current["config"]["tabletop"]["near_fraction"] == card["config"]["tabletop"]["near_share"] == 0.1
    assert migrated_card({"merged": [{"digest": "0", "card": card}]})["merged"][0]["card"] == current
    assert "near_share" in card["config"]["tabletop"], "the argument is not changed"


def test_it_is_verified(earlier):
    report = verify(str(earlier / "pairs"))
    assert [finding.name for finding in report.findings if not finding.ok] == []
    assert report.committed == 4


def test_its_settings_are_shown_under_their_new_names(earlier):
    for name in ("pairs", "frames"):
        info = dataset_info(str(earlier / name))
        assert info["changed_keys"]["tabletop.near_fraction"] == (0.1, 0.25)
        assert "share" not in info_text(info)


@pytest.mark.slow
def test_a_complete_one_is_left_byte_for_byte_and_a_missing_shard_is_rendered(earlier):
    folder, before = earlier / "pairs", files(earlier / "pairs")
    render_dataset(pairs_job(folder))
    assert files(folder) == before
    lines = (folder / "manifest.jsonl").read_text().splitlines(keepends=True)
    (folder / "manifest.jsonl").write_text(lines[0])
    plans = []
    render_dataset(pairs_job(folder), on_plan=plans.append)
    assert plans[0].present == 2
    assert ShardReader(str(folder)).complete
    assert files(folder).keys() == before.keys()
    assert files(folder)[Path(GROUP)] == before[Path(GROUP)]


@pytest.mark.slow
def test_other_settings_are_refused_under_the_new_name(earlier):
    with pytest.raises(ShardError, match=r"config.tabletop.near_fraction is 0.1 there and 0.3 here"):
        render_dataset(pairs_job(earlier / "pairs", "tabletop.near_fraction=0.3"))


@pytest.mark.slow
def test_it_is_merged_with_a_new_one_and_the_merge_is_continued(earlier, tmp_path):
    render_dataset(pairs_job(tmp_path / "new", seed=4))
    urls, out = [str(earlier / "pairs"), str(tmp_path / "new")], tmp_path / "merged"
    assert merge_datasets(urls, str(out)) == 8
    before = files(out)
    assert merge_datasets(urls, str(out)) == 8
    assert files(out) == before
    assert info_text(dataset_info(str(out)))


def test_its_images_are_continued(earlier):
    folder = earlier / "frames"
    before = json.loads((folder / "synthgen.json").read_text())
    config = load_config("tejani", [*SETTINGS, "seed=3", *(f"camera.{assignment}" for assignment in FRAMES)])
    sources = Sources(objects=(EARLIER / "pairs/models/obj_000001.ply",))
    render_bop_dataset(BopJob(out=str(folder), plan=FramePlan(frames=2), config=config, sources=sources))
    assert json.loads((folder / "synthgen.json").read_text()) == before


def test_modules_that_moved_are_refused_with_their_new_name():
    for old, new in (("pair", "pairs.pair_maker"), ("run.lock", "lock"), ("blender.engine", "engines.blender")):
        with pytest.raises(ImportError, match=f"is now synthgen.{new}$"):
            importlib.import_module(f"synthgen.{old}")
