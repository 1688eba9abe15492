"""A sound dataset passes every check, and each kind of damage fails the check that is named after it."""

import importlib.util
import json
import re
import shutil
from pathlib import Path

import numpy as np
import pytest
from click.testing import CliRunner
from posecore import shard
from posecore.errors import ShardError
from posecore.mesh import load_mesh
from posecore.se3 import rotation_from_rotvec
from posecore.shard import ShardReader, ShardWriter
from small_datasets import write_dataset
from synthgen.cli import main
from synthgen.verify import checks, coverage
from synthgen.verify.facts import SampleBatch, load_facts
from synthgen.verify.findings import DATASET_CHECKS
from synthgen.verify.page import report_page
from synthgen.verify.verify import verify

N, BAD = 10, 5  # samples, and the one that is damaged: the second of shard 1


@pytest.fixture(scope="module")
def sound(tmp_path_factory, config_of, tug_ply, bobbin_ply):
    url = tmp_path_factory.mktemp("sound") / "shards"
    config = config_of("occluders.front=[1,2]", "occluders.min_visible=0.3")
    write_dataset(url, config, {1: load_mesh(tug_ply), 2: load_mesh(bobbin_ply)}, N)
    return url


@pytest.fixture
def copy(sound, tmp_path):
    return Path(shutil.copytree(sound, tmp_path / "shards"))


def change(url, mutate, shard_id=1):
    """Write a shard again with changed arrays, as a broken renderer would have: its checksum is right."""
    reader = ShardReader(str(url))
    values = {name: np.array(value) for name, value in reader.read(shard_id).items()}
    mutate(values)
    writer = ShardWriter(str(url), reader.card)
    writer.commit(shard.encode(reader.card, shard_id, values))


def failures(url, **options):
    return {f.name: f for f in verify(str(url), **options).findings if not f.ok}


@pytest.mark.slow
def test_a_sound_dataset_passes_every_check_on_every_sample(sound):
    report = verify(str(sound))
    assert [f.name for f in report.findings if not f.ok] == []
    names = {f.name for f in report.findings}
    assert names == {*DATASET_CHECKS, *(c.name for c in checks.CHECKS)}
    assert {f.covered for f in report.findings if f.items == "samples"} == {N}
    assert report.rerendered == N
    assert report.gl
    assert (report.coverage["visible_fraction"] < 1).any(), "no occlusion: the checks of hidden parts saw nothing"


def rotated(values):
    T = values["T_cam_obj"][1]
    T[:3, :3] = T[:3, :3] @ np.array([[1.0, 0.0, 0.0], [0.0, 0.0, -1.0], [0.0, 1.0, 0.0]])
    for i in (0, 1):  # both samples of the scene, so that only the picture contradicts the pose
        values["T_cam_obj"][i] = T


def half_a_degree(values):
    """A pose error that is invisible to the eye."""
    R = rotation_from_rotvec(np.array([np.deg2rad(0.5), 0.0, 0.0]))
    T = values["T_cam_obj"][1]
    T[:3, :3] = R @ T[:3, :3]
    values["T_cam_obj"][0] = T


def five_times_as_far(values):
    values["T_cam_obj"][:2, :3, 3] *= 5
    values["T_cam_obj_hypothesis"][:2, :3, 3] *= 5


def moved_hypothesis(values):
    values["T_cam_obj_hypothesis"][1, :3, 3] += [0.0, 0.0, 0.06]


def swapped_labels(values):
    values["hypothesis_depth_m"][1] = np.fliplr(values["hypothesis_depth_m"][1])


def item(name, index, value):
    def mutate(values):
        values[name][(1, *index)] = value

    return mutate


def shifted(name, by):
    def mutate(values):
        values[name][1] = values[name][1] + np.asarray(by, values[name].dtype)

    return mutate


def deeper(name, by_m):
    def mutate(values):
        depth = values[name][1]
        values[name][1] = np.where(depth > 0, depth + np.float32(by_m), 0)

    return mutate


def replaced(name, value):
    def mutate(values):
        values[name][1] = value

    return mutate


def hidden_contour_moved(values):
    """Points on the hidden part of the ground-truth contour: only the mesh contradicts them, no stored depth does."""
    values["scene_contour_cam_m"][1] *= np.float32(1.01)


def one_wrong_scene(values):
    values["scene_index"][1] += 1


def copied(values):
    for value in values.values():
        value[1] = value[0]


def nothing_lit(values):
    values["hypothesis_rgb"][1] = 0


DAMAGE = [
    ("finite", item("scene_contour_cam_m", (3, 2), np.nan)),
    ("poses", item("T_cam_obj_hypothesis", (slice(0, 3), 0), 0.5)),
    ("poses", item("T_cam_obj_hypothesis", (3, 0), 1e-6)),
    ("camera", shifted("K", np.diag([1.0, 0.0, 0.0]))),
    ("camera", shifted("K_crop", [[0, 0, 0.01], [0, 0, 0], [0, 0, 0]])),
    ("object", replaced("obj_id", 3)),
    ("window", shifted("window_px", [1.0, 0.0, 0.0])),
    ("distance", five_times_as_far),
    ("angle", rotated),
    ("translation", moved_hypothesis),
    ("scene", one_wrong_scene),
    ("scene", shifted("T_cam_obj", [[0, 0, 0, 1e-9], [0] * 4, [0] * 4, [0] * 4])),
    ("rejected", replaced("rejected", -1)),
    ("scene patch", replaced("scene_rgb", 90)),
    ("hypothesis patch", nothing_lit),
    ("hypothesis patch", replaced("hypothesis_rgb", 1)),
    ("mask", item("scene_mask", (0, 0), 8)),
    ("mask", item("scene_depth_m", (0, 0), 0.5)),
    ("outside", shifted("window_px", [1000.0, 0.0, 0.0])),
    ("visible fraction", shifted("visible_fraction", 0.01)),
    ("distance zeros", item("scene_distance_px", (0, 0), 0)),
    ("distance values", item("hypothesis_distance_px", (0, 0), 60)),
    ("contour pixels", shifted("hypothesis_contour_cam_m", [0.002, 0.0, 0.0])),
    ("contour depth", deeper("hypothesis_depth_m", 0.0005)),
    ("vertices", rotated),
    ("ground truth re-rendered", rotated),
    ("hypothesis re-rendered", swapped_labels),
    ("scene depth re-rendered", deeper("scene_depth_m", 0.0005)),
    ("scene depth re-rendered", half_a_degree),
    ("hypothesis depth re-rendered", deeper("hypothesis_depth_m", 0.0005)),
    ("contour on surface", hidden_contour_moved),
    ("duplicates", copied),
]


@pytest.mark.parametrize(("name", "mutate"), DAMAGE, ids=[f"{i} {name}" for i, (name, _) in enumerate(DAMAGE)])
def test_damage_fails_the_check_of_its_name(copy, name, mutate):
    change(copy, mutate)
    failed = failures(copy)
    assert name in failed, f"failed instead: {sorted(failed)}"
    assert BAD in failed[name].first
    assert set(failed[name].first) <= {BAD - 1, BAD}, "sound samples fail, too"


def test_every_check_of_samples_has_its_damage():
    assert {name for name, _ in DAMAGE} == {c.name for c in checks.CHECKS} | {"duplicates"}


def test_a_missing_shard_is_a_failure_unless_allowed(copy):
    manifest = copy / "manifest.jsonl"
    lines = manifest.read_text().splitlines(keepends=True)
    manifest.write_text("".join(lines[:1] + lines[2:]))
    failed = failures(copy)
    assert list(failed) == ["complete"]
    assert failed["complete"].first == (1,)
    assert failures(copy, allow_incomplete=True) == {}


def test_changed_bytes_fail_the_checksum_and_the_rest_is_still_checked(copy):
    file = next(path for path in (copy / "scene_rgb" / "c" / "1").rglob("*") if path.is_file())
    data = bytearray(file.read_bytes())
    data[len(data) // 2] ^= 1
    file.write_bytes(bytes(data))
    failed = failures(copy)
    assert list(failed) == ["checksums"]
    assert failed["checksums"].first == (1,)
    assert "shard" in failed["checksums"].note
    file.unlink()
    assert list(failures(copy)) == ["checksums"]
    assert "Random samples" in report_page(verify(str(copy)))  # the page leaves that shard's samples out


def test_a_wrong_line_of_the_manifest_is_found(copy):
    manifest = copy / "manifest.jsonl"
    lines = [json.loads(text) for text in manifest.read_text().splitlines()]
    lines[2]["rejected"] += 1
    manifest.write_text("".join(json.dumps(line) + "\n" for line in lines))
    failed = failures(copy)
    assert list(failed) == ["manifest"]
    assert failed["manifest"].first == (2,)


def test_an_array_of_another_shape_is_found(copy):
    file = copy / "scene_mask" / "zarr.json"
    file.write_text(re.sub(r'"shape":\s*\[\s*10', '"shape": [11', file.read_text(), count=1))
    failed = failures(copy)
    assert list(failed) == ["arrays"]
    assert failed["arrays"].first == ("scene_mask/zarr.json",)


def test_another_mesh_in_models_is_found(copy):
    shutil.copy(copy / "models/obj_000002.ply", copy / "models/obj_000001.ply")
    assert failures(copy, samples=0)["objects"].first == (1,)
    (copy / "models/obj_000001.ply").unlink()
    with pytest.raises(ShardError, match=r"obj_000001\.ply: missing"):
        verify(str(copy))
    (copy / "models/obj_000001.ply").write_text("no mesh")
    with pytest.raises(ShardError, match=r"models/obj_000001\.ply: cannot be read"):
        verify(str(copy))


def test_a_card_without_what_checks_need_is_one_line(copy):
    group = json.loads((copy / "zarr.json").read_text())
    del group["attributes"]["config"]["perturbation"]
    (copy / "zarr.json").write_text(json.dumps(group))
    with pytest.raises(
        ShardError, match=r"the data card's config: the key perturbation is missing; only datasets made by"
    ):
        verify(str(copy))


def test_only_the_chosen_samples_are_rerendered_and_the_seed_decides_which(sound):
    report = verify(str(sound), samples=3, seed=1)
    covered = {c.name: f.covered for c in checks.CHECKS for f in report.findings if f.name == c.name}
    assert {covered[c.name] for c in checks.CHECKS if c.rerendered} == {3}
    assert {covered[c.name] for c in checks.CHECKS if not c.rerendered} == {N}
    none = verify(str(sound), samples=0)
    assert none.gl is None
    assert none.ok


@pytest.mark.slow
def test_processes_find_what_one_process_finds(copy):
    change(copy, swapped_labels)
    assert verify(str(copy), workers=2).as_json() == verify(str(copy), workers=1).as_json()


def test_a_dataset_in_an_object_store(config_of, tug, tmp_path):
    url = f"memory://{tmp_path.name}/shards"
    write_dataset(url, config_of(), {1: tug}, 3)
    assert verify(url, workers=4).ok


def test_the_command_reports_failures_and_the_number_of_checked_samples(copy, tmp_path):
    page, findings = tmp_path / "report.html", tmp_path / "findings.json"
    arguments = ["verify", str(copy), "--workers", "1", "--quiet", "--report", str(page), "--json", str(findings)]
    result = CliRunner().invoke(main, arguments)
    assert result.exit_code == 0, result.output
    assert len(result.stdout.splitlines()) == len(checks.CHECKS) + len(DATASET_CHECKS) + 1
    assert f"{N} of {N} samples are committed and were read, {N} were re-rendered" in result.stdout
    change(copy, swapped_labels)
    result = CliRunner().invoke(main, [*arguments, "--samples", "9"])
    assert result.exit_code == 1
    assert "Error: " in result.stderr and "distance zeros" in result.stderr
    assert "9 were re-rendered" in result.stdout
    content = json.loads(findings.read_text())
    assert not content["ok"]
    zeros = next(c for c in content["checks"] if c["name"] == "distance zeros")
    assert (zeros["covered"], zeros["failed"], zeros["first"]) == (N, 1, [BAD])
    assert sum(content["coverage"]["samples_by_object"].values()) == N
    text = page.read_text()
    assert "Failed samples" in text
    assert text.count("<svg") == text.count('role="img"') >= 8
    for loads in re.findall(r'(?:src|href)="([^"]+)"', text):
        assert loads == "data:," or loads.startswith("data:image/jpeg;base64,")  # no icon, pictures inside


def test_a_folder_without_a_dataset_is_one_line(tmp_path):
    for command in (["verify"], ["info"]):
        result = CliRunner().invoke(main, [*command, str(tmp_path)])
        assert result.exit_code == 1
        assert result.stderr.count("Error: ") == 1 and "not a shard dataset" in result.stderr


def test_a_dataset_without_shards_is_refused(config_of, tug, tmp_path):
    write_dataset(tmp_path / "d", config_of(), {1: tug}, 4, shards=0)
    with pytest.raises(ShardError, match="no shard is rendered yet"):
        verify(str(tmp_path / "d"))


def test_view_maps_keep_areas_and_show_the_camera_where_it_is():
    rng = np.random.default_rng(0)
    view = rng.normal(size=(40_000, 3))
    view /= np.linalg.norm(view, axis=1, keepdims=True)
    upper, lower = coverage.view_counts(view, 4)
    assert len(upper) == len(lower) == sum(coverage.sectors_in(ring) for ring in range(4)) == 48
    assert upper.sum() + lower.sum() == len(view)
    cells = np.concatenate([upper, lower])  # of equal area, so they hold equally many but for chance
    expected = len(view) / len(cells)
    assert np.abs(cells - expected).max() < 5 * np.sqrt(expected)
    upper, lower = coverage.view_counts(np.array([[np.cos(0.1), np.sin(0.1), 0.0], [0.0, 0.0, -1.0]]), 4)
    assert np.flatnonzero(upper).tolist() == [3 * 3**2]  # the rim's first cell starts at +x
    assert np.flatnonzero(lower).tolist() == [0]


def test_the_view_is_the_cameras_direction_in_the_objects_frame(sound):
    reader = ShardReader(str(sound))
    values = reader.read(0)
    facts = load_facts(reader)
    numbers = coverage.measure_coverage(SampleBatch(values, np.arange(4), facts))
    for i in range(4):
        T = values["T_cam_obj"][i]
        camera_obj = np.linalg.inv(T)[:3, 3] - facts.meshes[int(values["obj_id"][i])].center_m
        np.testing.assert_allclose(numbers["view"][i], camera_obj / np.linalg.norm(camera_obj), atol=1e-9)


def test_the_documentation_has_every_check(repository):
    spec = importlib.util.spec_from_file_location("docs_hooks", repository / "docs" / "hooks.py")
    hooks = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(hooks)
    assert "\n<!-- checks -->\n" in (repository / "docs" / "verifying.md").read_text()
    rows = hooks.checks_table().splitlines()[2:]
    assert len(rows) == len(checks.CHECKS) + len(DATASET_CHECKS)
    for check, row in zip(checks.CHECKS, rows[len(DATASET_CHECKS) :], strict=True):
        assert row.startswith(f"| {check.name} | ")
        assert check.what and check.why
