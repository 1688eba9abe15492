"""Malformed files of every kind: always one clear line, never another exception, a hang or a silent wrong number."""

import json
import shutil
from pathlib import Path

import cv2
import numpy as np
import pytest
from bop_folders import write_rendered, write_shards
from click.testing import CliRunner
from evalkit.check import check
from evalkit.cli import main
from fuzzing import damage, fuzz, one_line, replaced, strange
from hypothesis import given, settings
from hypothesis import strategies as st
from posecore import se3
from posecore.bop import BopDataset, Estimate, read_result_table, result_table, write_results
from posecore.bop.images import image_size, read_depth, read_rgb
from posecore.errors import DatasetError, MeshError, PoseError
from posecore.mesh import load_mesh

IMAGES = ((2, 0), (2, 5))
CUBE = [(x, y, z) for x in (-30, 30) for y in (-20, 20) for z in (-15, 15)]
SIDES = [(0, 1, 3, 2), (4, 6, 7, 5), (0, 4, 5, 1), (2, 3, 7, 6), (0, 2, 6, 4), (1, 5, 7, 3)]
HEADER = "ply\nformat {} 1.0\nelement vertex 8\nproperty float x\nproperty float y\nproperty float z\n"
JSON_FILES = (
    "test/000002/scene_gt.json",
    "test/000002/scene_gt_info.json",
    "test/000002/scene_camera.json",
    "models/models_info.json",
    "test_targets_bop19.json",
    "test_targets_bop24.json",
    "camera.json",
)

few = settings(fuzz, max_examples=12)


def ascii_ply():
    faces = [(s[0], s[1], s[2]) for s in SIDES] + [(s[0], s[2], s[3]) for s in SIDES]
    head = HEADER.format("ascii") + f"element face {len(faces)}\nproperty list uchar int vertex_indices\nend_header\n"
    rows = [" ".join(map(str, v)) for v in CUBE] + ["3 " + " ".join(map(str, f)) for f in faces]
    return (head + "\n".join(rows) + "\n").encode()


def binary_ply():
    faces = [(s[0], s[1], s[2]) for s in SIDES] + [(s[0], s[2], s[3]) for s in SIDES]
    head = HEADER.format("binary_little_endian")
    head += f"element face {len(faces)}\nproperty list uchar int vertex_indices\nend_header\n"
    table = np.zeros(len(faces), [("n", "u1"), ("i", "<i4", 3)])
    table["n"], table["i"] = 3, faces
    return head.encode() + np.array(CUBE, "<f4").tobytes() + table.tobytes()


@pytest.fixture(scope="module")
def sound(tmp_path_factory):
    folder = tmp_path_factory.mktemp("fuzz")
    (folder / "cube.ply").write_bytes(ascii_ply())
    root = write_rendered(folder / "cubes", {1: load_mesh(folder / "cube.ply")}, 1, IMAGES)
    (root / "models/obj_000001.ply").write_bytes(ascii_ply())
    info = json.loads((root / "models/models_info.json").read_text())
    flip = [-1, 0, 0, 0, 0, -1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1]
    info["1"]["symmetries_discrete"] = [flip]
    info["1"].pop("symmetries_continuous")
    (root / "models/models_info.json").write_text(json.dumps(info))
    dataset = BopDataset(root)
    instances = [(s, i, gt) for s, i in IMAGES for gt in dataset.gt(s, i)]
    poses = [Estimate(scene_id=s, im_id=i, obj_id=gt.obj_id, T_cam_obj=gt.T_cam_obj) for s, i, gt in instances]
    write_results(folder / "poses_cubes-test.csv", poses * 2)
    return root


@pytest.fixture(scope="module")
def root(sound, tmp_path_factory):
    """A copy that tests damage one file of at a time."""
    return shutil.copytree(sound, tmp_path_factory.mktemp("damaged") / "cubes")


class Damaged:
    """A file with other bytes, for the time of a with statement."""

    def __init__(self, path, data):
        self.path, self.before = path, path.read_bytes()
        path.write_bytes(data)

    def __enter__(self):
        return self.path

    def __exit__(self, *_):
        self.path.write_bytes(self.before)


def use(root):
    """Read all there is of a dataset; what comes out must be usable numbers."""
    dataset = BopDataset(root)
    for target in dataset.targets:
        assert target.inst_count >= 0
    for info in dataset.models_info.values():
        assert 0 < info.diameter_m < 1e4
        assert all(se3.is_rotation(S[:3, :3], 2e-2) for S in info.symmetries_discrete)
    for scene_id in dataset.scene_ids:
        for im_id in dataset.im_ids(scene_id):
            camera = dataset.camera(scene_id, im_id)
            assert np.isfinite(camera.K).all()
            assert camera.K[0, 0] > 0
            for gt in dataset.gt(scene_id, im_id):
                assert isinstance(gt.obj_id, int)
                assert gt.visib_fract is None or 0 <= gt.visib_fract <= 1
                if gt.has_pose:
                    assert se3.is_rotation(gt.T_cam_obj[:3, :3], 2e-2)
                    assert np.abs(gt.T_cam_obj).max() <= 1e6
                dataset.mask(scene_id, im_id, gt.gt_index)
            depth_m = dataset.depth_m(scene_id, im_id)
            assert depth_m is None or (np.isfinite(depth_m).all() and depth_m.min() >= 0)


def use_or_refuse(action, *arguments):
    try:
        return action(*arguments)
    except PoseError as error:
        one_line(error)
        return None


@pytest.mark.slow
@pytest.mark.parametrize("name", JSON_FILES)
@settings(fuzz, max_examples=60)
@given(which=st.integers(0, 10_000), new=strange, rename=st.booleans())
def test_json_with_anything_anywhere(root, name, which, new, rename):
    content = replaced(json.loads((root / name).read_text()), which, new, rename)
    with Damaged(root / name, json.dumps(content).encode()):
        use_or_refuse(use, root)


@pytest.mark.slow
@fuzz
@given(name=st.sampled_from(JSON_FILES), change=damage())
def test_json_with_any_bytes(root, name, change):
    with Damaged(root / name, change((root / name).read_bytes())):
        use_or_refuse(use, root)


def same_or_same_error(data, monkeypatch):
    """Read all at once, and line by line: the same numbers, or the same refusal."""

    def read():
        try:
            return result_table.parse_results(data, "r.csv")
        except PoseError as error:
            one_line(error)
            return str(error)

    fast = read()
    with monkeypatch.context() as patch:
        patch.setattr(result_table, "_plain_numbers", lambda *_: None)
        slow = read()
    assert isinstance(fast, str) == isinstance(slow, str)
    if isinstance(fast, str):
        assert fast == slow
        return None
    for name in ("scene_id", "im_id", "obj_id", "score", "T_cam_obj", "time_s", "line"):
        assert np.array_equal(getattr(fast, name), getattr(slow, name)), name
    return fast


@fuzz
@given(change=damage(longest=8))
def test_result_files_with_any_bytes(sound, monkeypatch, change):
    data = (sound.parent / "poses_cubes-test.csv").read_bytes()
    table = same_or_same_error(change(data), monkeypatch)
    if table is not None:
        assert np.isfinite(table.T_cam_obj).all()
        assert np.isfinite(table.score).all()
        assert se3.is_rotation(table.T_cam_obj[:, :3, :3], 2e-2).all()


token = st.sampled_from(
    [
        "1",
        "0",
        "-1",
        "+1",
        "1.",
        ".5",
        "1e2",
        "1E-3",
        "1-2",
        "1e5.5",
        "nan",
        "inf",
        "",
        " ",
        "  ",
        "\t",
        "\r",
        "½",
        "1_0",
    ]
) | st.floats().map(repr)


@pytest.mark.slow
@fuzz
@given(fields=st.lists(st.lists(token, max_size=10), min_size=6, max_size=8), at=st.integers(0, 2))
def test_result_lines_of_any_tokens(monkeypatch, fields, at):
    good = "1,2,3,0.5,1 0 0 0 1 0 0 0 1,10 20 900,-1"
    lines = [good, good]
    lines.insert(at, ",".join(" ".join(part) for part in fields))
    same_or_same_error("\n".join(lines).encode(), monkeypatch)


@fuzz
@given(fields=st.permutations(range(7)), changed=st.integers(0, 16), new=token)
def test_one_strange_number_in_a_line(monkeypatch, fields, changed, new):
    numbers = ["1", "2", "3", "0.5", *"100010001", "10", "20", "900", "-1"]
    numbers[changed] = new
    parts = [numbers[:1], numbers[1:2], numbers[2:3], numbers[3:4], numbers[4:13], numbers[13:16], numbers[16:]]
    header = ",".join(result_table.COLUMNS[i] for i in fields)
    line = ",".join(" ".join(parts[i]) for i in fields)
    same_or_same_error(f"{header}\n{line}\n".encode(), monkeypatch)


@pytest.mark.parametrize("original", [ascii_ply(), binary_ply()], ids=["ascii", "binary"])
@fuzz
@given(change=damage(longest=10))
def test_meshes_with_any_bytes(tmp_path, original, change):
    file = tmp_path / "cube.ply"
    file.write_bytes(change(original))
    mesh = use_or_refuse(load_mesh, file)
    if mesh is not None:
        assert np.isfinite(mesh.vertices_m).all()
        assert len(mesh.faces) > 0
        assert mesh.faces.min() >= 0
        assert mesh.faces.max() < len(mesh.vertices_m)
        assert 2e-3 <= mesh.diameter_m <= 10


@pytest.mark.parametrize(
    ("before", "after", "said"),
    [
        (b"3 1 7 3\n", b"", "has 11 rows of 'face', its header gives 12; the file is cut off"),
        (b"\n30 20 15\n", b"\n30 20 1S\n", "the vertex is '30 20 1S', expected numbers"),
        (b"\n30 20 15\n", b"\n30 20-15\n", "the vertex is '30 20-15', expected numbers"),
        (b"\n30 20 15\n", b"\n30 20 15 9\n", "the vertex has 4 numbers, its header gives 3"),
        (b"\n30 20 15\n", b"\n\n30 20 15\n", "the vertex has 0 numbers, its header gives 3"),
        (b"3 1 7 3\n", b"3 1 7.9 3\n", "names a vertex by something that is not a whole number"),
        (b"3 1 7 3\n", b"2 1 7 3\n", "the face has 4 numbers, its header gives 3"),
        pytest.param(b"3 1 7 3\n", b"9" * 5000 + b" 1 7 3\n", "has no count of its list", id="endless count"),
        pytest.param(ascii_ply()[-120:], b"", "of 'vertex', its header gives 8; the file is cut off", id="cut"),
    ],
)
def test_an_ascii_mesh_that_a_lenient_reader_would_take_is_refused(tmp_path, before, after, said):
    """These readers skip what they cannot read, so a letter O makes 3 of 30 and a cut file loses faces."""
    file = tmp_path / "cube.ply"
    assert ascii_ply().count(before) == 1
    file.write_bytes(ascii_ply().replace(before, after))
    with pytest.raises(MeshError) as caught:
        load_mesh(file)
    assert said in str(caught.value)


line = st.sampled_from(
    [
        "element vertex 99999999999",
        "element vertex -1",
        "element face 3000000000",
        "element vertex 8.5",
        "element",
        "property",
        "property list uchar int",
        "property list float float vertex_indices",
        "property double x",
        "property quad x",
        "comment TextureFile ",
        "comment TextureFile " + "a" * 5000,
        "comment TextureFile \x00.png",
        "comment TextureFile ../../cube.ply",
        "format binary_big_endian 1.0",
        "format none 9",
        "obj_info ½",
        "end_header",
        "ply",
        "",
    ]
)


@pytest.mark.parametrize("original", [ascii_ply(), binary_ply()], ids=["ascii", "binary"])
@fuzz
@given(at=st.integers(0, 9), new=line, insert=st.booleans())
def test_meshes_with_any_header(tmp_path, original, at, new, insert):
    head, end, body = original.partition(b"end_header\n")
    rows = head.decode().splitlines()
    rows[min(at, len(rows) - 1) : min(at, len(rows) - 1) + (not insert)] = [new]
    file = tmp_path / "cube.ply"
    file.write_bytes("\n".join(rows).encode() + b"\n" + end + body)
    mesh = use_or_refuse(load_mesh, file)
    assert mesh is None or (np.isfinite(mesh.vertices_m).all() and mesh.faces.max() < len(mesh.vertices_m))


@fuzz
@given(length=st.integers(0, 5000))
def test_a_jpeg_that_is_cut_off_is_refused(tmp_path, length):
    """Its decoder would fill the rest with grey: no bytes of its own give that away."""
    original = encoded("jpg")
    file = tmp_path / "a.jpg"
    file.write_bytes(original[: length % (len(original) - 1)])
    with pytest.raises(DatasetError, match="cut off"):
        read_rgb(file)


def encoded(extension, dtype=np.uint8):
    rng = np.random.default_rng(3)
    shape = (20, 30) if dtype == np.uint16 else (20, 30, 3)
    return cv2.imencode(f".{extension}", rng.integers(0, 250, shape).astype(dtype))[1].tobytes()


@pytest.mark.parametrize(
    ("extension", "read"),
    [("png", read_rgb), ("jpg", read_rgb), ("tif", read_rgb), ("png", read_depth), ("tif", read_depth)],
)
@settings(fuzz, max_examples=80)
@given(change=damage(longest=6))
def test_images_with_any_bytes(tmp_path, extension, read, change):
    original = encoded(extension, np.uint16 if read is read_depth else np.uint8)
    file = tmp_path / f"a.{extension}"
    file.write_bytes(original)
    before = read(file)
    file.write_bytes(change(original))
    after = use_or_refuse(read, file)
    size = use_or_refuse(image_size, file)
    if after is not None:
        assert after.dtype == before.dtype
        assert size == (after.shape[1], after.shape[0])
    if extension == "png":  # it has checksums, so nothing else may come out
        assert after is None or np.array_equal(after, before)


@fuzz
@given(change=damage())
def test_shards_with_any_bytes(sound, tmp_path, change):
    root = tmp_path / "cubes"
    if not root.exists():
        write_shards(sound, "test", root / "test")
        shutil.copytree(sound / "models", root / "models")
    shard = root / "test/shard-000000.tar"
    with Damaged(shard, change(shard.read_bytes())):
        use_or_refuse(use, root)


FILES = (*JSON_FILES, "models/obj_000001.ply", "test/000002/rgb/000005.png", "test/000002/depth/000005.png")


def checked(root, results=()):
    findings = check(root, results)
    assert all("\n" not in line for line in findings.lines())
    json.loads(findings.as_json())
    return findings


@pytest.mark.slow
@settings(fuzz, max_examples=100)
@given(name=st.sampled_from(FILES), change=damage())
def test_check_survives_any_file(root, name, change):
    with Damaged(root / name, change((root / name).read_bytes())):
        findings = checked(root)
        if findings.ok:  # then everything that was checked can be used
            use(root)


@pytest.mark.slow
@settings(fuzz, max_examples=100)
@given(name=st.sampled_from(JSON_FILES), which=st.integers(0, 10_000), new=strange, rename=st.booleans())
def test_check_survives_anything_in_json(root, name, which, new, rename):
    content = replaced(json.loads((root / name).read_text()), which, new, rename)
    with Damaged(root / name, json.dumps(content).encode()):
        findings = checked(root)
        if findings.ok:
            use(root)


@pytest.mark.slow
@settings(fuzz, max_examples=60)
@given(change=damage(longest=8))
def test_check_survives_any_result_file(root, tmp_path, sound, change):
    file = tmp_path / "poses_cubes-test.csv"
    file.write_bytes(change((sound.parent / "poses_cubes-test.csv").read_bytes()))
    findings = checked(root, [file])
    if findings.ok:
        read_result_table(file, BopDataset(root))


def reported(root, results, out):
    options = ["--dataset", str(root), "--results", str(results), "--out", str(out), "--worst", "1"]
    result = CliRunner().invoke(main, ["report", *options])
    assert result.exception is None or isinstance(result.exception, SystemExit), result.exception
    assert result.exit_code in (0, 1)
    if result.exit_code:
        (said,) = [text for text in result.output.splitlines() if text.startswith("Error: ")]
        one_line(said)
    else:
        json.loads((out / "summary.json").read_text(), parse_constant=pytest.fail)


@pytest.mark.slow
@few
@given(name=st.sampled_from(FILES), change=damage())
def test_report_survives_any_file_of_the_dataset(root, sound, tmp_path, name, change):
    with Damaged(root / name, change((root / name).read_bytes())):
        reported(root, sound.parent / "poses_cubes-test.csv", tmp_path / "report")


@pytest.mark.slow
@few
@given(name=st.sampled_from(JSON_FILES), which=st.integers(0, 10_000), new=strange, rename=st.booleans())
def test_report_survives_anything_in_json(root, sound, tmp_path, name, which, new, rename):
    content = replaced(json.loads((root / name).read_text()), which, new, rename)
    with Damaged(root / name, json.dumps(content).encode()):
        reported(root, sound.parent / "poses_cubes-test.csv", tmp_path / "report")


@few
@given(change=damage(longest=8), sidecar=strange)
def test_report_survives_any_result_file_and_sidecar(root, sound, tmp_path, change, sidecar):
    file = tmp_path / "poses_cubes-test.csv"
    file.write_bytes(change((sound.parent / "poses_cubes-test.csv").read_bytes()))
    content = {"dataset": str(root), "method": "x", "perturbation": sidecar, "initial_lines": sidecar}
    Path(f"{file}.json").write_text(json.dumps(content))
    reported(root, file, tmp_path / "report")
