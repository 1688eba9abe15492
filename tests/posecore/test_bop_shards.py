"""Webdataset shards: read where they lie as the unpacked dataset reads, and one line for a damaged tar file."""

import gzip
import io
import json
import shutil
import tarfile

import numpy as np
import pytest
from bop_folders import run_lengths, write_rendered, write_shards
from posecore.bop import BopDataset
from posecore.bop.webdataset import decode_runs
from posecore.errors import DatasetError
from posecore.mesh import load_mesh

IMAGES = ((3, 0), (3, 4), (11, 7))


@pytest.fixture(scope="module")
def plain(tmp_path_factory, tug_ply, bobbin_ply):
    meshes = {1: load_mesh(tug_ply), 5: load_mesh(bobbin_ply)}
    return write_rendered(tmp_path_factory.mktemp("plain") / "things", meshes, 5, IMAGES)


@pytest.fixture
def root(plain, tmp_path):
    copy = tmp_path / "things"
    shutil.copytree(plain / "models", copy / "models")
    shutil.copy(plain / "test_targets_bop19.json", copy)
    write_shards(plain, "test", copy / "test")
    return copy


def members(shard):
    with tarfile.open(shard) as tar:
        return {member.name: tar.extractfile(member).read() for member in tar}


def pack(shard, contents):
    with tarfile.open(shard, "w") as tar:
        for name, data in contents.items():
            member = tarfile.TarInfo(name)
            member.size = len(data)
            tar.addfile(member, io.BytesIO(data))


def test_shards_read_as_the_folders_they_were_made_from(plain, root):
    folders, shards = BopDataset(plain), BopDataset(root)
    assert shards.is_sharded
    assert (shards.split, shards.scene_ids) == ("test", [3, 11])
    assert shards.targets == folders.targets
    for scene_id, im_id in IMAGES:
        assert shards.im_ids(scene_id) == folders.im_ids(scene_id)
        assert np.array_equal(shards.camera(scene_id, im_id).K, folders.camera(scene_id, im_id).K)
        assert shards.camera(scene_id, im_id).width_px == folders.camera(scene_id, im_id).width_px
        assert np.array_equal(shards.rgb(scene_id, im_id), folders.rgb(scene_id, im_id))
        assert np.array_equal(shards.depth_m(scene_id, im_id), folders.depth_m(scene_id, im_id))
        for ours, theirs in zip(shards.gt(scene_id, im_id), folders.gt(scene_id, im_id), strict=True):
            assert np.array_equal(ours.T_cam_obj, theirs.T_cam_obj)
            assert (ours.obj_id, ours.visib_fract, ours.gt_index) == (
                theirs.obj_id,
                theirs.visib_fract,
                theirs.gt_index,
            )
            for visible in (False, True):
                mask = shards.mask(scene_id, im_id, ours.gt_index, visible=visible)
                assert np.array_equal(mask, folders.mask(scene_id, im_id, ours.gt_index, visible=visible))
    assert shards.files(3) == [root / "test/shard-000000.tar"]


def test_shards_without_a_split_folder_are_a_dataset(root):
    for shard in (root / "test").iterdir():
        shard.rename(root / shard.name)
    (root / "test").rmdir()
    dataset = BopDataset(root)
    assert (dataset.split, dataset.scene_ids) == (".", [3, 11])
    assert len(dataset.targets) == 6


def test_shards_without_depth_or_ground_truth(root):
    shard = root / "test/shard-000000.tar"
    pack(shard, {name: data for name, data in members(shard).items() if "gt" not in name and "depth" not in name})
    dataset = BopDataset(root)
    assert not dataset.has_gt(3)
    assert dataset.has_gt(11)
    assert dataset.im_ids(3) == [0, 4]
    assert dataset.depth_m(3, 0) is None
    with pytest.raises(DatasetError, match=r"no scene_gt.json, so there is nothing to compare with"):
        dataset.gt(3, 0)


def test_folders_and_other_files_in_a_tar_do_not_matter(root):
    shard = root / "test/shard-000000.tar"
    pack(shard, {"README.md": b"x"} | {f"./part/{name}": data for name, data in members(shard).items()})
    assert BopDataset(root).rgb(3, 0).shape == (90, 120, 3)


@pytest.mark.parametrize("cut", ["in a header", "in a member", "between members", "to nothing"])
def test_a_shard_that_is_cut_off_is_named(root, cut):
    shard = root / "test/shard-000001.tar"
    data = shard.read_bytes()
    with tarfile.open(shard) as tar:
        last = tar.getmembers()[-1]
    end = last.offset_data + -(-last.size // 512) * 512
    keep = {
        "in a header": last.offset + 9,
        "in a member": last.offset_data + 5,
        "between members": end,
        "to nothing": 0,
    }
    shard.write_bytes(data[: keep[cut]])
    with pytest.raises(DatasetError, match=r"shard-000001.tar.*copy it again") as caught:
        BopDataset(root)
    assert "\n" not in str(caught.value)


def test_damaged_and_foreign_tar_files_are_named(root):
    shard = root / "test/shard-000001.tar"
    data = shard.read_bytes()
    for damaged, message in (
        (gzip.compress(data), "cannot be read as a tar file"),
        (b"not a tar file at all" * 100, "cannot be read as a tar file"),
        (data[:600] + b"\xff" * 600 + data[1200:], "tar"),
        (data + data, "goes on after its end mark"),
    ):
        shard.write_bytes(damaged)
        with pytest.raises(DatasetError, match=message):
            BopDataset(root)


def test_an_image_that_is_there_twice_is_refused(root):
    shutil.copy(root / "test/shard-000000.tar", root / "test/shard-000002.tar")
    with pytest.raises(DatasetError, match=r"shard-000002.tar:000003_000000.camera.json: is in shard-000000.tar"):
        BopDataset(root)


def test_a_key_without_scene_and_image_is_refused(root):
    pack(root / "test/shard-000002.tar", {"sample7.camera.json": b"{}"})
    with pytest.raises(DatasetError, match=r"sample7.camera.json: its key is not SCENE_IMAGE"):
        BopDataset(root)


def test_errors_name_the_shard_and_the_member(root):
    shard = root / "test/shard-000000.tar"
    contents = members(shard)
    contents["000003_000000.gt.json"] = b'[{"obj_id": "x"}, {}]'
    contents["000003_000004.camera.json"] = b"[]"
    contents["000003_000000.rgb.png"] = contents["000003_000000.rgb.png"][:-50]
    contents["000003_000004.mask.json"] = json.dumps({"0": {"counts": [5], "size": [90, 120]}}).encode()
    pack(shard, contents)
    dataset = BopDataset(root)
    with pytest.raises(DatasetError, match=r"shard-000000.tar:000003_000000.gt.json, entry 0: 'obj_id' is 'x'"):
        dataset.gt(3, 0)
    with pytest.raises(DatasetError, match=r"000003_000004.camera.json: found a list at the top, expected a dict"):
        dataset.camera(3, 4)
    with pytest.raises(DatasetError, match=r"shard-000000.tar:000003_000000.rgb.png: cannot be decoded"):
        dataset.rgb(3, 0)
    with pytest.raises(DatasetError, match=r"000003_000004.mask.json, mask 0: its run lengths add up to 5"):
        dataset.mask(3, 4, 0)
    with pytest.raises(DatasetError, match="tar files have only one; leave the sensor out"):
        BopDataset(root, sensor="cam1")


def test_a_shard_that_shrinks_after_it_was_opened_is_noticed(root):
    dataset = BopDataset(root)
    shard = root / "test/shard-000000.tar"
    shard.write_bytes(shard.read_bytes()[:3000])
    with pytest.raises(DatasetError, match=r"found \d+ of \d+ bytes; the tar file is cut off"):
        dataset.gt(3, 4)


@pytest.mark.parametrize("seed", range(5))
def test_run_lengths_give_back_the_mask(seed):
    rng = np.random.default_rng(seed)
    mask = np.zeros((7, 9), bool) if seed == 0 else rng.random((7, 9)) < 0.2 * seed
    assert np.array_equal(decode_runs(run_lengths(mask), "here"), mask)


@pytest.mark.parametrize(
    "entry",
    [
        None,
        {"size": [2, 2]},
        {"size": [2], "counts": [4]},
        {"size": [2, 2], "counts": "abc"},
        {"size": [2, 2], "counts": [5]},
        {"size": [2, 2], "counts": [-1, 5]},
        {"size": [10**9, 10**9], "counts": [10**18]},
    ],
)
def test_wrong_run_lengths_are_refused(entry):
    with pytest.raises(DatasetError, match=r"^here: "):
        decode_runs(entry, "here")
