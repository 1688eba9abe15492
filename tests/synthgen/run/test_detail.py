"""A dataset of a mesh of many faces: drawn with levels of detail, and its labels are those of the mesh."""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import trimesh
from posecore.detail import with_levels
from posecore.mesh import Mesh, load_mesh, save_ply
from posecore.raster import Rasteriser, rasteriser
from posecore.shard import BIT_OBJECT, BIT_VISIBLE, ShardReader
from posecore.shard.layout import TEST_SET
from synthgen.bop.frame_maker import FramePlan
from synthgen.draw.target import make_targets
from synthgen.inputs.assets import Assets
from synthgen.inputs.sources import Sources
from synthgen.pairs.pair_maker import PairMaker
from synthgen.run.bop import BopJob, render_bop_dataset
from synthgen.run.render import RenderJob, render_dataset, shard_job
from synthgen.run.test_set import images_config, render_test_set
from synthgen.verify.verify import verify

CONTOUR_PX = 80  # of an object in a patch of 48 px, about


@pytest.fixture(scope="module")
def dense(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A bumpy ball of 20 480 faces."""
    ball = trimesh.creation.icosphere(subdivisions=5)
    unit = np.asarray(ball.vertices)
    radius_m = 0.05 * (1 + 0.2 * np.sin(3 * unit[:, 0] + 1) * np.cos(4 * unit[:, 1]))
    mesh = Mesh(
        vertices_m=unit * radius_m[:, None],
        faces=np.asarray(ball.faces, np.int32),
        normals=unit.astype(np.float32),
        vertex_rgb=(127 + 100 * np.sin(2 * unit)).astype(np.uint8),
    )
    file = tmp_path_factory.mktemp("dense") / "ball.ply"
    save_ply(mesh, file)
    return file


@pytest.mark.slow
def test_a_dataset_of_many_faces_is_verified(dense: Path, config_of, tmp_path: Path) -> None:
    out = tmp_path / "shards"
    sources = Sources(objects=(dense,), occluders=dense)
    job = RenderJob(out=str(out), n=8, config=config_of("occluders.front=[1,2]"), sources=sources, workers=1)
    render_dataset(job)
    card = json.loads((out / "zarr.json").read_text())["attributes"]
    assert card["detail"] == {"rms_error_px": 0.1, "max_error_px": 2.0, "spacing_px": 5.0}
    assert [finding.name for finding in verify(str(out)).findings if not finding.ok] == []
    reader = ShardReader(str(out))
    full = load_mesh(dense)
    with Rasteriser({1: full}) as drawer:  # the labels are those of the mesh itself
        for shard in reader.committed:
            rows = reader.read(shard)
            drawn = drawer.render(1, rows["K_crop"], rows["T_cam_obj"], 48, 48, rgb=False).mask
            assert ((drawn != (rows["scene_mask"] & BIT_OBJECT > 0)).sum(axis=(1, 2)) < 0.2 * CONTOUR_PX).all()


def test_labels_with_and_without_levels_agree(dense: Path, config_of, monkeypatch: pytest.MonkeyPatch) -> None:
    """The same scenes and hypotheses, silhouettes and visible fractions; and an eighth of the faces drawn."""
    config, mesh = config_of("occluders.front=[1,2]"), load_mesh(dense)
    drawn: dict[bool, list[dict[str, np.ndarray]]] = {}
    faces: dict[bool, int] = {}
    for detailed in (False, True):
        meshes = {1: with_levels(mesh) if detailed else mesh}
        assets = Assets(occluders=tuple(meshes.values()))
        maker = PairMaker(config, make_targets(meshes, config, assets), assets, threads=1)
        count = faces.setdefault(detailed, 0)

        def counted(some: Mesh, *arguments: object, choose=rasteriser.level_number, detailed=detailed) -> int:
            number = choose(some, *arguments)
            faces[detailed] += len(some.level(number).faces)
            return number

        with monkeypatch.context() as patch:
            patch.setattr(rasteriser, "level_number", counted)
            drawn[detailed] = [maker.samples(scene) for scene in range(4)]
        maker.close()
        assert count == 0
    assert faces[True] * 8 < faces[False]
    for full, less in zip(drawn[False], drawn[True], strict=True):
        np.testing.assert_array_equal(full["T_cam_obj_hypothesis"], less["T_cam_obj_hypothesis"])
        np.testing.assert_array_equal(full["window_px"], less["window_px"])
        for bit in (BIT_OBJECT, BIT_VISIBLE):
            differs = (full["scene_mask"] & bit) != (less["scene_mask"] & bit)
            assert (differs.sum(axis=(1, 2)) < 0.3 * CONTOUR_PX).all()
        assert np.abs(full["visible_fraction"] - less["visible_fraction"]).max() < 0.02
        assert np.abs(full["scene_distance_px"] - less["scene_distance_px"]).mean() < 0.1
        assert np.abs(full["hypothesis_rgb"].astype(int) - less["hypothesis_rgb"]).mean() < 2
        assert np.abs(full["scene_rgb"].astype(int) - less["scene_rgb"]).mean() < 3


@pytest.mark.slow
def test_test_images_show_every_face_as_synthgen_bop_does(dense: Path, config_of, tmp_path: Path) -> None:
    config, sources = config_of("occluders.front=[1,2]"), Sources(objects=(dense,), occluders=dense)
    shards = shard_job(RenderJob(out=str(tmp_path), n=8, config=config, sources=sources))
    assert shards.meshes[1].levels
    assert shards.assets.occluders[0].levels
    render_test_set(str(tmp_path), 2, shards, sources, workers=1)
    job = BopJob(out=str(tmp_path / "bop"), plan=FramePlan(frames=2), config=images_config(config, 1), sources=sources)
    render_bop_dataset(job)
    assert contents(tmp_path / TEST_SET) == contents(tmp_path / "bop")


def contents(folder: Path) -> dict[Path, bytes]:
    return {path.relative_to(folder): path.read_bytes() for path in sorted(folder.rglob("*")) if path.is_file()}


def test_an_object_that_is_an_occluder_too_is_loaded_once(dense: Path) -> None:
    sources = Sources(objects=(dense,), occluders=dense)
    assert sources.meshes()[1] is sources.assets().occluders[0]
    assert replace(sources) == sources
