"""The object's origin may lie anywhere: every method and command gives the same for a mesh and its copy 2 m off.

Poses are compared as poses of the same object, to 1e-6 of its distance. Vertices are multiples of 2^-12 mm, so that
both copies are exact in the float32 of a PLY file: these tests are of geometry, not of rounding.
"""

import json
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import pytest
from click.testing import CliRunner
from evalkit.check.run import check
from evalkit.cli import main as evalkit
from evalkit.evaluation.evaluator import evaluate
from posecore import se3
from posecore.bop import (
    BopDataset,
    BopWriter,
    Estimate,
    FrameRecord,
    GroundTruth,
    ModelInfo,
    read_results,
    read_sidecar,
    write_models,
    write_results,
)
from posecore.camera import Camera, intrinsics
from posecore.mesh import Mesh, load_mesh, save_ply
from posecore.raster import DirectionalLight, Instance, Rasteriser, Shading
from posecore.shard import ShardReader
from posecore.symmetry import ContinuousSymmetry
from refinenet.cli import main as refinenet
from refinenet.models import checkpoint
from search_models import models_made_once
from synthgen.cli import main as synthgen
from synthgen.engines.make import make_engine
from synthgen.scene import Light, Material, Pattern, Scene, SceneObject

SHIFT_M = np.array([2.0, -1.0, 0.5])
"""Position of the plain mesh's origin in the shifted mesh's frame."""
GRID_MM = 2.0**-12
TUG, BOBBIN = 1, 5
pytestmark = pytest.mark.slow
CAMERA = Camera(K=intrinsics(500.0, 503.0, 161.5, 118.0), width_px=320, height_px=240)
FRAMES = 3
CHECKPOINTS = Path(__file__).resolve().parents[1] / "examples/checkpoints"


def on_grid(mesh: Mesh) -> Mesh:
    return replace(mesh, vertices_m=1e-3 * GRID_MM * np.round(mesh.vertices_m / (1e-3 * GRID_MM)))


def shifted(mesh: Mesh) -> Mesh:
    return mesh.with_origin_at(-SHIFT_M)


def as_plain(T_cam_shifted: np.ndarray) -> np.ndarray:
    """The plain mesh's pose of the same object."""
    return se3.with_origin_at(T_cam_shifted, SHIFT_M)


@dataclass(frozen=True)
class Copies:
    """A BOP dataset, and the same with the meshes' origins 2 m off; with initial poses of each."""

    plain: Path
    shifted: Path

    @property
    def roots(self) -> tuple[Path, Path]:
        return self.plain, self.shifted


def run(command, *arguments) -> str:
    done = CliRunner().invoke(command, [str(argument) for argument in arguments], catch_exceptions=False)
    assert done.exit_code == 0, done.output
    return done.output


def assert_same_poses(plain, other):
    """Estimates of both copies agree, line by line, as poses of the same object."""
    assert len(plain) == len(other) > 0
    for a, b in zip(plain, other, strict=True):
        assert (a.scene_id, a.im_id, a.obj_id) == (b.scene_id, b.im_id, b.obj_id)
        assert_same_pose(a.T_cam_obj, as_plain(b.T_cam_obj))
        assert a.score == pytest.approx(b.score, abs=1e-6)


def assert_same_pose(a, b):
    np.testing.assert_allclose(a[:3, :3], b[:3, :3], rtol=0, atol=1e-6)
    np.testing.assert_allclose(a[:3, 3], b[:3, 3], rtol=0, atol=1e-6 * np.linalg.norm(a[:3, 3]))


@pytest.fixture(scope="module", autouse=True)
def _models_made_once():
    with models_made_once():
        yield


@pytest.fixture(scope="session")
def meshes(tug_ply, bobbin_ply) -> dict[int, Mesh]:
    return {TUG: on_grid(load_mesh(tug_ply)), BOBBIN: on_grid(load_mesh(bobbin_ply))}


@pytest.fixture(scope="session")
def copies(meshes, tmp_path_factory) -> Copies:
    """Both objects in front of a wall, moving; images and depth are the same."""
    folder = tmp_path_factory.mktemp("origin")
    axis = ContinuousSymmetry((0.0, 0.0, 1.0), (0.0, 0.0, 0.0))
    infos = {BOBBIN: ModelInfo(diameter_m=meshes[BOBBIN].diameter_m, symmetries_continuous=(axis,))}
    rng = np.random.default_rng(3)
    poses = {
        obj_id: se3.make_T(se3.random_rotation(rng), np.array([x_m, 0.01, 0.55]))
        for obj_id, x_m in ((TUG, -0.07), (BOBBIN, 0.07))
    }
    turn, step_m = se3.rotation_from_rotvec(np.array([0.02, -0.03, 0.01])), np.array([0.002, 0.001, -0.003])
    shading = Shading(lights=(DirectionalLight(direction_cam=(0.3, -0.4, -0.866)),))
    wall = rng.integers(90, 160, (CAMERA.height_px, CAMERA.width_px, 3), dtype=np.uint8)
    made = Copies(plain=folder / "plain", shifted=folder / "shifted")
    with (
        Rasteriser(meshes) as rasteriser,
        BopWriter(made.plain, "test", 1) as plain,
        BopWriter(made.shifted, "test", 1) as other,
    ):
        for im_id in range(FRAMES):
            instances = [Instance(obj_id=obj_id, T_cam_obj=T) for obj_id, T in poses.items()]
            size = (CAMERA.width_px, CAMERA.height_px)
            layers = rasteriser.render_scene(instances, CAMERA.K, *size, shading=shading)
            masks = [layers.instance == index for index in range(len(instances))]
            image = np.where(layers.instance[..., None] >= 0, layers.rgb, wall)
            depth_m = np.where(layers.instance >= 0, layers.depth_m, 0.8)
            for writer, origin_m in ((plain, np.zeros(3)), (other, -SHIFT_M)):
                gts = [
                    GroundTruth(obj_id=obj_id, T_cam_obj=se3.with_origin_at(T, origin_m)) for obj_id, T in poses.items()
                ]
                writer.add_frame(
                    im_id,
                    FrameRecord(rgb=image, depth_m=depth_m, camera=CAMERA, gts=gts, masks=masks, masks_visib=masks),
                )
            poses = {obj_id: se3.apply_update(T, turn, step_m) for obj_id, T in poses.items()}
    write_models(made.plain, meshes, infos)
    write_models(
        made.shifted,
        {obj_id: shifted(mesh) for obj_id, mesh in meshes.items()},
        {obj_id: info.with_origin_at(-SHIFT_M) for obj_id, info in infos.items()},
    )
    for root in made.roots:
        amounts = ("--random-up-to", 12, "--random-translation", 0.06, "--depth-stretch", 1.5)
        run(evalkit, "perturb", "--dataset", root, "--out", root / "start.csv", *amounts)
    return made


@pytest.fixture(scope="session")
def networks(tmp_path_factory) -> dict[str, Path]:
    """The shipped checkpoints, whose updates are about the origin, and the same weights under today's convention."""
    folder, files = tmp_path_factory.mktemp("networks"), {}
    for name in ("compact", "flow"):
        loaded = checkpoint.load(CHECKPOINTS / f"tug_{name}.safetensors")
        assert loaded.provenance.config.pivot == "origin"
        files[f"{name}, version 1"], files[name] = loaded.path, folder / f"{name}.safetensors"
        config = replace(loaded.provenance.config, pivot="center")
        checkpoint.save(files[name], loaded.network(), replace(loaded.provenance, config=config))
    return files


def test_the_shifted_files_are_exact(copies, meshes):
    for obj_id, mesh in meshes.items():
        plain, other = (load_mesh(root / f"models/obj_{obj_id:06d}.ply") for root in copies.roots)
        np.testing.assert_allclose(plain.vertices_m, mesh.vertices_m, rtol=0, atol=1e-15)
        np.testing.assert_allclose(other.vertices_m - SHIFT_M, mesh.vertices_m, rtol=0, atol=1e-15)
        assert np.abs(other.center_m).max() > 1.9 > 0.01 > np.abs(plain.center_m).max()


def test_a_float32_file_rounds_a_mesh_2_m_off_to_a_tenth_of_a_micrometre(tug_ply, tmp_path):
    """All that is left of the offset: a file's own digits."""
    mesh = load_mesh(tug_ply)
    save_ply(shifted(mesh), tmp_path / "off.ply")
    off_m = load_mesh(tmp_path / "off.ply").vertices_m - SHIFT_M - mesh.vertices_m
    assert 1e-9 < np.abs(off_m).max() < 1.3e-7


def test_perturbed_poses_are_the_same(copies):
    plain, other = (read_results(root / "start.csv") for root in copies.roots)
    assert_same_poses(plain, other)
    rows, other_rows = (read_sidecar(root / "start.csv")["perturbation"]["rows"] for root in copies.roots)
    for row, other_row in zip(rows, other_rows, strict=True):
        assert other_row == pytest.approx(row, rel=1e-6)


METHODS = {
    "edge-icp": ["--method", "edge-icp"],
    "region": ["--method", "region"],
    "depth-icp": ["--method", "depth-icp"],
    "search": ["--method", "search", "--iterations", 2, "--object", TUG],
    "compact": ["--checkpoint", "compact"],
    "compact, pool": ["--checkpoint", "compact", "--hypotheses", 6],
    "compact, pool ranked by learned confidence": ["--checkpoint", "compact", "--hypotheses", 4, "--scorer", "learned"],
    "flow": ["--checkpoint", "flow"],
    "search and flow": ["--method", "search", "--checkpoint", "flow", "--iterations", 2],
    "compact, version 1": ["--checkpoint", "compact, version 1"],
    "flow, version 1": ["--checkpoint", "flow, version 1"],
}


def with_network(arguments, networks):
    """Arguments with the checkpoint's file for its name; a network knows the tug alone."""
    if "--checkpoint" not in arguments:
        return arguments
    return [networks.get(argument, argument) for argument in arguments] + ["--allow-other-mesh", "--object", TUG]


@pytest.mark.parametrize("name", METHODS)
def test_refined_poses_are_the_same(copies, networks, name, tmp_path):
    arguments, results = with_network(METHODS[name], networks), []
    if name == "compact, pool ranked by learned confidence":
        arguments = [networks["flow"] if argument == networks["compact"] else argument for argument in arguments]
    for root in copies.roots:
        out = tmp_path / f"{root.name}.csv"
        files = ("--dataset", root, "--init", root / "start.csv", "--out", out)
        run(refinenet, "refine", *files, "--keep-failed", "--threads", 1, "--quiet", *arguments)
        results.append(out)
    plain, other = map(read_results, results)
    assert_same_poses(plain, other)
    failures = [read_sidecar(file)["failed_lines"] for file in results]
    assert failures[0] == failures[1]
    starts = {(e.im_id, e.obj_id): e.T_cam_obj for e in read_results(copies.plain / "start.csv")}
    moved = [np.abs(e.T_cam_obj - starts[e.im_id, e.obj_id]).max() for e in plain]
    assert np.median(moved) > 1e-3  # it did refine
    assert_same_errors(copies, results)


def assert_same_errors(copies, results):
    """`evalkit` measures the same: every column."""
    plain, other = (evaluate(root, file) for root, file in zip(copies.roots, results, strict=True))
    for column in plain.columns:
        if column in ("line", "time_s") or plain[column].dtype.kind not in "fi":
            continue
        scale = max(float(np.nanmax(np.abs(plain[column].to_numpy(np.float64)), initial=0.0)), 1e-3)
        a, b = (table[column].to_numpy(np.float64) for table in (plain, other))
        np.testing.assert_allclose(b, a, rtol=0, atol=2e-6 * scale, err_msg=column)


@pytest.mark.parametrize("name", ["depth-icp", "edge-icp", "compact", "flow"])
def test_tracks_are_the_same(copies, networks, name, tmp_path):
    arguments, tracks = with_network(METHODS[name], networks), []
    arguments = [argument for argument in arguments if argument != "--allow-other-mesh"]
    arguments += ["--allow-other-mesh"] if "--checkpoint" in arguments else []
    if name == "compact":
        arguments += ["--depth-step", 0.03]
    for root in copies.roots:
        out = tmp_path / f"{root.name}.csv"
        command = (
            "track",
            "--dataset",
            root,
            "--init",
            root / "start.csv",
            "--out",
            out,
            "--motion-model",
            "--threads",
            1,
        )
        run(refinenet, *command, "--quiet", *arguments)
        tracks.append(out)
    assert_same_poses(*map(read_results, tracks))
    assert_same_errors(copies, tracks)
    tables = []
    for root, file in zip(copies.roots, tracks, strict=True):
        run(evalkit, "tracking", "--dataset", root, "--results", file, "--out", tmp_path / "table.json")
        tables.append(json.loads((tmp_path / "table.json").read_text()))
    assert_same_numbers(*tables, skip=("time",))


def assert_same_numbers(a, b, skip=(), where=""):
    """JSON values agree, numbers to 1e-4 of their size: tables are rounded."""
    if isinstance(a, dict):
        assert a.keys() == b.keys(), where
        for key in a:
            if not any(word in key for word in skip):
                assert_same_numbers(a[key], b[key], skip, f"{where}.{key}")
    elif isinstance(a, list):
        assert len(a) == len(b), where
        for i, pair in enumerate(zip(a, b, strict=True)):
            assert_same_numbers(*pair, skip, f"{where}[{i}]")
    elif isinstance(a, int | float) and not isinstance(a, bool):
        assert b == pytest.approx(a, rel=1e-4, abs=1e-4, nan_ok=True), where


def test_the_check_has_nothing_to_say_of_a_shifted_copy(copies):
    for root in copies.roots:
        findings = check(root, [root / "start.csv"])
        assert findings.ok, findings.lines()
        assert not any("behind" in line or "off-image" in line for line in findings.lines())


@pytest.fixture(scope="session")
def scanned(tug_ply, tmp_path_factory) -> Path:
    """A dataset of a mesh in the frame of the camera that scanned it: t is 0 in one image, some mm in the other."""
    root = tmp_path_factory.mktemp("scanned") / "toys"
    rng, plain = np.random.default_rng(5), load_mesh(tug_ply)
    T_scan = se3.make_T(se3.random_rotation(rng), np.array([0.05, 0.01, 0.55]))
    mesh = replace(
        plain, vertices_m=plain.vertices_m @ T_scan[:3, :3].T + T_scan[:3, 3], normals=plain.normals @ T_scan[:3, :3].T
    )
    moved = se3.make_T(np.eye(3), np.array([0.002, 0.001, -0.004]))
    size = (CAMERA.width_px, CAMERA.height_px)
    with Rasteriser({TUG: mesh}) as rasteriser, BopWriter(root, "test", 1) as writer:
        for im_id, T in enumerate((np.eye(4), moved, moved)):
            layers = rasteriser.render_scene([Instance(obj_id=TUG, T_cam_obj=T)], CAMERA.K, *size)
            gt, mask = GroundTruth(obj_id=TUG, T_cam_obj=T), layers.instance == 0
            record = FrameRecord(
                rgb=layers.rgb, depth_m=layers.depth_m, camera=CAMERA, gts=[gt], masks=[mask], masks_visib=[mask]
            )
            writer.add_frame(im_id, record)
    write_models(root, {TUG: mesh}, {})
    return root


def test_a_mesh_of_the_camera_s_own_frame_is_not_in_metres(scanned, tmp_path):
    poses = [
        Estimate(scene_id=1, im_id=im_id, obj_id=TUG, T_cam_obj=gt.T_cam_obj)
        for im_id in range(3)
        for gt in BopDataset(scanned).gt(1, im_id)
    ]
    init = tmp_path / "init_toys-test.csv"
    write_results(init, poses)
    assert len(read_results(init, BopDataset(scanned))) == 3
    findings = check(scanned, [init])
    assert findings.ok, findings.lines()
    method = ("--method", "edge-icp", "--threads", 1, "--quiet")
    run(refinenet, "refine", "--dataset", scanned, "--init", init, "--out", tmp_path / "refined.csv", *method)
    run(refinenet, "track", "--dataset", scanned, "--init", init, "--out", tmp_path / "track.csv", *method)
    entry = {"obj_id": TUG, "cam_R_m2c": np.eye(3).ravel().tolist(), "cam_t_m2c": [0.5, 0.0, 0.1]}
    (tmp_path / "pose.json").write_text(json.dumps([entry]))
    K = {name: float(CAMERA.K[row]) for name, row in (("fx", (0, 0)), ("fy", (1, 1)), ("cx", (0, 2)), ("cy", (1, 2)))}
    (tmp_path / "cam.json").write_text(json.dumps(K))
    files = ("--pose", tmp_path / "pose.json", "--camera", tmp_path / "cam.json")
    mesh = scanned / f"models/obj_{TUG:06d}.ply"
    images = scanned / "test/000001/rgb"
    run(refinenet, "track", images, *files, "--mesh", mesh, "--out", tmp_path / "images.csv", *method)
    for name in ("refined", "track", "images"):
        assert len((tmp_path / f"{name}.csv").read_text().splitlines()) == 4, name


SMALL = [
    word
    for assignment in (
        *("patch_px=64", "contour_points=48", "hypotheses_per_scene=2", "shard_size=8", "window.min_area_px=20"),
        *("occluders.library=8",),
    )
    for word in ("--set", assignment)
]


@pytest.fixture(scope="session")
def pairs(copies, tmp_path_factory) -> tuple[Path, Path]:
    """Training pairs of the tug and of its copy, from the same seed."""
    folder = tmp_path_factory.mktemp("pairs")
    for root in copies.roots:
        mesh = root / f"models/obj_{TUG:06d}.ply"
        command = (
            "render",
            "--object",
            mesh,
            "--n",
            32,
            "--test-images",
            0,
            "--out",
            folder / root.name,
            "--engine",
            "raster",
        )
        run(synthgen, *command, "--workers", 1, "--quiet", *SMALL)
    return folder / "plain", folder / "shifted"


def assert_same_pairs(plain: ShardReader, other: ShardReader):
    assert plain.committed == other.committed
    for shard in plain.committed:
        a, b = plain.read(shard), other.read(shard)
        for name in a:
            if name.startswith("T_cam_obj"):
                np.testing.assert_allclose(as_plain(b[name]), a[name], rtol=0, atol=1e-12, err_msg=name)
            elif a[name].dtype.kind in "iub":
                np.testing.assert_array_equal(b[name], a[name], err_msg=name)
            else:
                np.testing.assert_allclose(b[name], a[name], rtol=1e-6, atol=1e-9, err_msg=name)


def test_rendered_pairs_are_the_same(pairs):
    assert_same_pairs(*(ShardReader(str(path)) for path in pairs))


def test_cut_pairs_are_the_same(copies, tmp_path):
    readers = []
    for root in copies.roots:
        out = tmp_path / root.name
        run(
            synthgen,
            "cut",
            "--dataset",
            root,
            "--out",
            out,
            "--quiet",
            "--set",
            "patch_px=64",
            "--set",
            "min_area_px=20",
        )
        readers.append(ShardReader(str(out)))
    assert_same_pairs(*readers)


def test_rendered_frames_are_the_same(copies, tmp_path):
    for root in copies.roots:
        command = ("bop", "--object", root / "models", "--out", tmp_path / root.name, "--engine", "raster")
        size = ("camera.width_px=160", "camera.height_px=120", "camera.fx=143", "camera.fy=143", "camera.cx=81.5")
        words = [word for item in (*size, "camera.cy=60.5", "window.min_area_px=5") for word in ("--set", item)]
        kinds = ("--frames", 3, "--objects-per-frame", 2, 2, "--set", "scene.kind=tabletop")
        run(synthgen, *command, "--quiet", *words, *kinds)
    folders = [tmp_path / root.name / "test/000001" for root in copies.roots]
    plain, other = (json.loads((folder / "scene_gt.json").read_text()) for folder in folders)
    for im_id, entries in plain.items():
        for a, b in zip(entries, other[im_id], strict=True):
            T, T_other = (
                se3.make_T(np.reshape(e["cam_R_m2c"], (3, 3)), 1e-3 * np.array(e["cam_t_m2c"])) for e in (a, b)
            )
            assert_same_pose(T, as_plain(T_other))
    for file in sorted(folders[0].rglob("*.png")):
        assert file.read_bytes() == (folders[1] / file.relative_to(folders[0])).read_bytes(), file


PRECOMPUTED = ("window.kind=fixed", "hypothesis.online=false", "loss.name=contour")


@pytest.mark.parametrize(
    ("preset", "settings"),
    [("compact", ("on_policy.fraction=0.5", "on_policy.begin=0")), ("compact", PRECOMPUTED), ("flow", ())],
    ids=["online", "precomputed", "flow"],
)
def test_training_is_the_same(pairs, preset, settings, tmp_path):
    """Hypotheses, labels, on-policy updates and validation: the same errors after the same steps."""
    logs = []
    for path in pairs:
        out = tmp_path / path.name
        settings = (*settings, "validation.every=4", "validation.pairs=8", "log_every=1")
        words = [word for setting in settings for word in ("--set", setting)]
        command = ("train", path, "--preset", preset, "--steps", 4, "--batch", 8, "--workers", 0, "--threads", 1)
        run(refinenet, *command, "--out", out, "--quiet", *words)
        logs.append([json.loads(line) for line in (out / "metrics.jsonl").read_text().splitlines()])
    keys = {key for line in logs[0] for key in line if key.startswith(("loss", "validation/"))}
    assert "validation/add_after_mm" in keys
    for a, b in zip(*logs, strict=True):
        for key in keys & set(a):
            assert b[key] == pytest.approx(a[key], rel=1e-5), key


PATTERN = Pattern(accent_rgb=(0.9, 0.2, 0.1), wave=(150.0, 80.0, -60.0), warp=(40.0, -90.0, 30.0))


@pytest.mark.parametrize("name", ["raster", "cycles"])
def test_an_engine_draws_a_copy_alike_bit_for_bit(name, meshes):
    """Patterns and lamps are about the centre; coordinates are exact in binary here."""
    exact = replace(meshes[TUG], vertices_m=np.round(meshes[TUG].vertices_m * 2**20) / 2**20)
    T = se3.make_T(se3.random_rotation(np.random.default_rng(4)), np.array([0.01, -0.02, 0.5]))
    lamp = Light(kind="point", position_cam_m=(-0.4, 0.1, 0.1), strength=3.0)
    layers = []
    for mesh, pose in ((exact, T), (shifted(exact), se3.with_origin_at(T, -SHIFT_M))):
        engine = make_engine(name)
        engine.load({1: mesh})
        thing = SceneObject(mesh_key=1, T_cam_obj=pose, material=Material(base_rgb=(0.2, 0.5, 0.8), pattern=PATTERN))
        region = (0, 0, CAMERA.width_px, CAMERA.height_px)
        scene = Scene(camera=CAMERA, region_px=region, objects=(thing,), lights=(lamp,), samples=4)
        layers.append(engine.render(scene))
        engine.close()
    plain, other = layers
    assert (plain.index == 0).any()
    for field in ("rgb_linear", "alpha", "depth_m", "index"):
        np.testing.assert_array_equal(getattr(other, field), getattr(plain, field), err_msg=field)
