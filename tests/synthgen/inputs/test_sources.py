import json
import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import trimesh
from click.testing import CliRunner
from posecore.errors import ConfigError, DatasetError, MeshError
from synthgen.cli import main
from synthgen.inputs.sources import Sources, find_meshes, load_symmetries, object_ids
from synthgen.pairs.data_card import model_files


def folder_of(root, tug_ply, names):
    root.mkdir(parents=True, exist_ok=True)
    for name in names:
        (root / name).parent.mkdir(parents=True, exist_ok=True)
        shutil.copy(tug_ply, root / name)
    return root


def test_a_folder_stands_for_all_meshes_in_it_by_name(tug_ply, tmp_path):
    folder = folder_of(tmp_path / "cups", tug_ply, ["b.ply", "a.ply", "more/c.ply"])
    (folder / "notes.txt").write_text("no mesh")
    meshes = Sources(objects=(folder, tug_ply)).meshes()
    assert [Path(m.path).name for m in meshes.values()] == ["a.ply", "b.ply", "c.ply", "tug.ply"]
    assert list(meshes) == [1, 2, 3, 4]


def test_a_bop_folder_has_its_ids_its_symmetries_and_its_unit(tug_ply, tmp_path):
    folder = folder_of(tmp_path / "models", tug_ply, ["obj_000002.ply", "obj_000007.ply", "extra.ply"])
    half_turn = [-1, 0, 0, 0, 0, -1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1]
    info = {"2": {"diameter": 118.9}, "7": {"diameter": 118.9, "symmetries_discrete": [half_turn]}}
    (folder / "models_info.json").write_text(json.dumps(info))
    sources = Sources(objects=(folder,), units="m")
    meshes = sources.meshes()
    assert list(meshes) == [2, 7]
    assert meshes[2].diameter_m == pytest.approx(0.119, abs=1e-3)
    infos = sources.infos(meshes)
    assert not infos[2].is_symmetric
    assert infos[7].is_symmetric
    other = tmp_path / "other.json"
    other.write_text(json.dumps({"2": info["7"]}))
    assert Sources(objects=(folder,), models_info=other).infos(meshes)[2].is_symmetric


def test_one_bad_mesh_stops_with_its_name_or_is_left_out(tug_ply, tmp_path, caplog):
    folder = folder_of(tmp_path / "many", tug_ply, ["a.ply", "c.ply"])
    (folder / "b.ply").write_bytes(b"ply\nbroken")
    with pytest.raises(MeshError, match=r"b\.ply.*; repair it or leave it out with --skip-bad-objects"):
        Sources(objects=(folder,)).meshes()
    assert list(Sources(objects=(folder,), skip_bad_objects=True).meshes()) == [1, 3]
    assert "object 2 is left out" in caplog.text
    (tmp_path / "bad.ply").write_bytes(b"")
    with pytest.raises(MeshError, match="none of 1 meshes can be loaded"):
        Sources(objects=(tmp_path / "bad.ply",), skip_bad_objects=True).meshes()


def test_folders_without_meshes_are_named(tmp_path):
    with pytest.raises(ConfigError, match=f"--occluders {tmp_path}: no mesh in this folder"):
        find_meshes(tmp_path, "mm", "--occluders")
    (tmp_path / "models_info.json").write_text('{"1": {}}')
    with pytest.raises(ConfigError, match=r"has object numbers and there is no obj_XXXXXX\.ply"):
        find_meshes(tmp_path, "mm", "--object")


def test_a_folder_may_know_symmetries_by_its_meshes_names(tug_ply):
    sources = Sources(objects=(tug_ply.parent,))
    meshes = sources.meshes()
    assert [Path(m.path).name for m in meshes.values()] == ["bobbin.ply", "tug.ply"]
    infos = sources.infos(meshes)
    assert infos[1].is_symmetric
    assert not infos[2].is_symmetric


def test_a_missing_texture_falls_back_only_when_told_to(tmp_path):
    (tmp_path / "a.obj").write_text(
        "mtllib a.mtl\nusemtl skin\nv 0 0 0\nv 50 0 0\nv 0 50 0\nvt 0 0\nvt 1 0\nvt 0 1\nf 1/1 2/2 3/3\n"
    )
    (tmp_path / "a.mtl").write_text("newmtl skin\nKd 1.0 0.5 0.0\nmap_Kd lost.png\n")
    given = {"objects": (tmp_path / "a.obj",), "occluders": tmp_path / "a.obj"}
    for load in ("meshes", "assets"):
        with pytest.raises(MeshError, match=r"texture .*lost\.png is missing.*--allow-missing-textures"):
            getattr(Sources(**given), load)()
    allowed = Sources(**given, allow_missing_textures=True)
    assert allowed.meshes()[1].texture_rgb is None
    np.testing.assert_allclose(allowed.meshes()[1].colours[0], [255, 127, 0], atol=1)
    assert allowed.assets().occluders[0].texture_rgb is None


@pytest.mark.slow
def test_options_reach_the_dataset(tug_ply, bobbin_ply, tmp_path, small_set, caplog):
    import cv2
    from posecore.shard import ShardReader

    cv2.imwrite(str(tmp_path / "sky.hdr"), np.full((16, 32, 3), 0.5, np.float32))
    cv2.imwrite(str(tmp_path / "wall.png"), np.full((32, 32, 3), 90, np.uint8))
    objects = folder_of(tmp_path / "objects", tug_ply, ["one.ply", "two.ply"])
    (objects / "three.ply").write_bytes(b"broken")
    clutter = folder_of(tmp_path / "clutter", bobbin_ply, ["bobbin.ply"])
    arguments = ["render", "--object", objects, "--n", 8, "--out", tmp_path / "out", "--workers", 1, *small_set]
    arguments += ["--set", "scene.kind=mixed", "--set", "tabletop.tables=2", "--skip-bad-objects", "--quiet"]
    arguments += ["--hdris", tmp_path, "--backgrounds", tmp_path, "--occluders", clutter]
    result = CliRunner().invoke(main, [str(a) for a in arguments])
    assert result.exit_code == 0, result.output
    assert "three.ply" in caplog.text
    reader = ShardReader(str(tmp_path / "out"))
    assert reader.card["hdris"]["files"] == 1
    assert reader.card["occluders"]["meshes"] == 1
    ids = np.concatenate([reader.read(i)["obj_id"] for i in reader.committed])
    assert sorted(set(ids.tolist())) == [1, 3]
    assert (ids == 1).sum() == (ids == 3).sum() == 4


def test_a_broken_panorama_is_one_line(tug_ply, tmp_path):
    (tmp_path / "broken.hdr").write_bytes(b"nothing")
    arguments = ["render", "--object", tug_ply, "--n", 4, "--out", tmp_path / "out", "--hdris", tmp_path]
    result = CliRunner().invoke(main, [str(a) for a in arguments])
    assert result.exit_code == 2
    assert "broken.hdr: cannot be decoded as an image" in result.stderr
    assert "Traceback" not in result.output
    assert not (tmp_path / "out").exists()


def test_a_mesh_alone_has_the_symmetries_that_are_listed_beside_it(tug_ply, bobbin_ply, tmp_path):
    sources = Sources(objects=(tug_ply, bobbin_ply))
    assert {i: info.is_symmetric for i, info in sources.infos(sources.meshes()).items()} == {1: False, 2: True}
    listed = json.loads((bobbin_ply.parent / "models_info.json").read_text())
    (tmp_path / "models_info.json").write_text(json.dumps({"1": listed["bobbin"]}))
    for name, known in (("obj_000001.ply", True), ("part.ply", False)):  # whose number is not the listed one's
        shutil.copy(bobbin_ply, tmp_path / name)
        alone = Sources(objects=(tmp_path / name,))
        assert bool(alone.infos(alone.meshes())) is known


def test_symmetries_are_found_by_name_or_id(tug, tmp_path):
    entry = {"diameter": 118.9, "symmetries_discrete": [[-1, 0, 0, 0, 0, -1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1]]}
    for key in ("tug", "1"):
        file = tmp_path / "models_info.json"
        file.write_text(json.dumps({key: entry}))
        infos = load_symmetries(file, {1: tug})
        assert len(infos[1].symmetries_discrete) == 1
        files = model_files({1: tug}, infos)
        assert sorted(files) == ["models/models_info.json", "models/obj_000001.ply"]
        assert "symmetries_discrete" in json.loads(files["models/models_info.json"])["1"]
    file.write_text(json.dumps({"cup": entry}))
    with pytest.raises(DatasetError, match="cup"):
        load_symmetries(file, {1: replace(tug, path="tug.ply")})
    file.write_text(json.dumps({"5": entry}))  # another dataset's numbers: no symmetry may get lost in silence
    with pytest.raises(DatasetError, match="no entry for 1, tug; its keys are 5"):
        load_symmetries(file, {1: tug})
    with pytest.raises(DatasetError, match="cannot be read"):
        load_symmetries(tmp_path / "none.json", {1: tug})


def test_a_key_that_is_an_id_and_a_file_name_is_a_file_name(tug, tmp_path):
    file = tmp_path / "models_info.json"
    turn = [-1, 0, 0, 0, 0, -1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1]
    file.write_text(json.dumps({"2": {"diameter": 118.9, "symmetries_discrete": [turn]}, "3": {"diameter": 118.9}}))
    infos = load_symmetries(file, {1: replace(tug, path="2.ply"), 2: replace(tug, path="3.ply")})
    assert {i: info.is_symmetric for i, info in infos.items()} == {1: True, 2: False}


def test_object_ids_follow_bop_names_or_the_order():
    assert object_ids(["a.ply", "b.ply"]) == [1, 2]
    assert object_ids(["x/obj_000009.ply", "obj_000002.ply"]) == [9, 2]
    assert object_ids(["obj_000009.ply", "b.ply"]) == [1, 2]
    with pytest.raises(ConfigError, match="object id 3"):
        object_ids(["a/obj_000003.ply", "b/obj_000003.ply"])


def test_a_diameter_is_printed_with_its_unit(tmp_path, tug_ply):
    box = trimesh.creation.box((0.3, 0.4, 1.2))
    box.export(tmp_path / "box.glb")
    for file, line in (
        (tmp_path / "box.glb", "box.glb: diameter 1300.0 mm (glTF is in metres)"),
        (tug_ply, "tug.ply: diameter 118.9 mm (--units mm)"),
    ):
        sources = Sources(objects=(file,), units="mm")
        assert sources.diameter_lines(sources.meshes()) == [line]
