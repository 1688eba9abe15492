"""The point that a checkpoint's updates are about: the centre; of version 1 the origin of the trained mesh."""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from posecore import se3
from posecore.bop import ModelInfo
from posecore.errors import CheckpointError
from posecore.mesh import load_mesh, mesh_digest
from posecore.symmetry import ContinuousSymmetry, symmetry_transforms
from refinenet.geometry.pivots import PivotFrames
from refinenet.geometry.poses import PoseUpdate
from refinenet.models import checkpoint
from refinenet.refine.input_checks import pivots_m
from refinenet.refine.network_refiner import Refiner
from refinenet.refiner import Frame, Refinement, Request, Status
from refinenet.training.setup import build_network
from safetensors import safe_open
from safetensors.torch import load_file, save_file

from ..conftest import K

SHIFT_M = np.array([0.03, -0.02, 0.01])


class Turn(torch.nn.Module):
    """Turns every pose by 20 degrees about the vertical, in place."""

    def forward(self, pair):
        dR = torch.from_numpy(se3.rotation_from_rotvec(np.array([0.0, np.deg2rad(20), 0.0]))).float()
        b = len(pair.T_cam_obj)
        return PoseUpdate(dR.expand(b, 3, 3), torch.zeros(b, 3))


def as_version_1(path: Path, out: Path) -> Path:
    """The file as earlier versions wrote it."""
    with safe_open(path, "pt") as opened:
        metadata = opened.metadata()
    config = json.loads(metadata["config"])
    assert metadata["version"] == "2" and config.pop("pivot") == "center"
    save_file(load_file(path), out, metadata | {"version": "1", "config": json.dumps(config)})
    return out


@pytest.fixture
def off_center(mesh):
    """The test object with its origin beside it."""
    return mesh.with_origin_at(SHIFT_M)


@pytest.fixture
def of_off_center(trained, off_center, tmp_path):
    """A checkpoint that was trained on that mesh, of this version and of the one before."""
    loaded = checkpoint.load(trained)
    card = loaded.provenance.objects["1"] | {"mesh_digest": mesh_digest(off_center)}
    now = tmp_path / "now.safetensors"
    checkpoint.save(now, loaded.network(), replace(loaded.provenance, objects={"1": card}))
    return {"now": now, "before": as_version_1(now, tmp_path / "before.safetensors")}


def turned_pose(path, mesh, image, T, **settings):
    refiner = Refiner.load(path, {1: mesh}, iterations=1, device="cpu", **settings)
    refiner._network = Turn()
    (result,) = refiner.refine_batch(Frame(image=image, K=K), [Request(obj_id=1, T_cam_obj=T)])
    refiner.close()
    assert not result.failed
    return result.T_cam_obj


def moved_m(mesh, point_m, T, T_other):
    before, after = (se3.apply(pose, np.array([point_m]))[0] for pose in (T, T_other))
    return np.linalg.norm(before - after)


def test_an_update_leaves_the_centre_in_place_and_one_of_version_1_the_trained_origin(of_off_center, off_center, frame):
    image, truths = frame
    T = se3.with_origin_at(truths[0], SHIFT_M)
    center_m = off_center.center_m
    assert np.linalg.norm(center_m) > 0.2 * off_center.diameter_m
    now = turned_pose(of_off_center["now"], off_center, image, T)
    before = turned_pose(of_off_center["before"], off_center, image, T)
    assert moved_m(off_center, center_m, T, now) < 1e-9 < 0.005 < moved_m(off_center, np.zeros(3), T, now)
    assert moved_m(off_center, np.zeros(3), T, before) < 1e-9 < 0.005 < moved_m(off_center, center_m, T, before)


def test_another_mesh_has_its_centre_whatever_the_version(of_off_center, off_center, frame):
    """Its origin has nothing to do with that of training, and may lie anywhere."""
    image, truths = frame
    far_m = np.array([1.0, 2.0, -1.5])
    other, T = off_center.with_origin_at(far_m), se3.with_origin_at(truths[0], SHIFT_M + far_m)
    with pytest.raises(CheckpointError, match="another mesh"):
        turned_pose(of_off_center["before"], other, image, T)
    for path in of_off_center.values():
        result = turned_pose(path, other, image, T, allow_other_mesh=True)
        assert moved_m(other, other.center_m, T, result) < 1e-9


def test_members_of_a_category_of_version_1_have_the_origin_that_they_share(of_off_center, off_center):
    loaded = checkpoint.load(of_off_center["before"])
    config = replace(loaded.provenance.config, category=True)
    category = replace(loaded, provenance=replace(loaded.provenance, config=config))
    other = off_center.with_origin_at(np.array([0.01, 0.0, 0.0]))
    np.testing.assert_array_equal(pivots_m(category, {2: other})[2], np.zeros(3))
    now = replace(category.provenance, config=replace(config, pivot="center"))
    np.testing.assert_array_equal(pivots_m(replace(category, provenance=now), {2: other})[2], other.center_m)


def test_a_run_that_begins_with_updates_about_another_point_says_so(of_off_center, caplog):
    config = checkpoint.load(of_off_center["now"]).provenance.config
    for name, pivot, lines in (("now", "center", 0), ("before", "center", 1), ("before", "origin", 0)):
        caplog.clear()
        begun = replace(config, init=str(of_off_center[name]), pivot=pivot)
        build_network(begun, torch.device("cpu"), pretrained=True)
        assert len(caplog.messages) == lines
        for line in caplog.messages:
            assert line.startswith(
                f"{begun.init}: its updates are about the origin of meshes, and this run's about the"
            )
            assert line.endswith("--set pivot=origin keeps them")


def test_shipped_checkpoints_of_version_1_still_have_the_origin_of_the_tug(repository, tug_ply):
    mesh = load_mesh(tug_ply)
    for name in ("tug_compact", "tug_flow"):
        loaded = checkpoint.load(repository / f"examples/checkpoints/{name}.safetensors")
        assert loaded.provenance.config.pivot == "origin"
        np.testing.assert_array_equal(pivots_m(loaded, {1: mesh})[1], np.zeros(3))
        shifted = mesh.with_origin_at(np.array([0.0, 0.5, 0.0]))
        np.testing.assert_array_equal(pivots_m(loaded, {1: shifted})[1], shifted.center_m)


def test_a_checkpoint_of_a_later_version_is_refused(trained, tmp_path):
    with safe_open(trained, "pt") as opened:
        metadata = opened.metadata()
    save_file(load_file(trained), tmp_path / "later.safetensors", metadata | {"version": "3"})
    with pytest.raises(CheckpointError, match="version 3, expected refinenet version 1 or 2"):
        checkpoint.load(tmp_path / "later.safetensors")


def test_frames_of_pivots_keep_objects_symmetries_and_failed_poses(mesh):
    T = se3.make_T(se3.random_rotation(np.random.default_rng(0)), np.array([0.1, -0.2, 0.9]))
    half_turn = se3.make_T(np.diag([-1.0, -1.0, 1.0]), np.array([0.004, 0.01, 0.0]))
    info = ModelInfo(
        diameter_m=mesh.diameter_m,
        symmetries_discrete=(half_turn,),
        symmetries_continuous=(ContinuousSymmetry((0.0, 0.6, 0.8), (0.3, 0.1, 0.2)),),
    )
    frames = PivotFrames.at({1: mesh}, {1: SHIFT_M})
    (request,) = frames.requests([Request(obj_id=1, T_cam_obj=T)])
    points = se3.apply(request.T_cam_obj, frames.meshes[1].vertices_m)
    np.testing.assert_allclose(points, se3.apply(T, mesh.vertices_m), atol=1e-12)
    own, moved = symmetry_transforms(info, 0.5), symmetry_transforms(frames.models({1: info, 2: info})[1], 0.5)
    there = se3.make_T(np.eye(3), SHIFT_M)
    np.testing.assert_allclose(T @ own @ there, request.T_cam_obj @ moved, atol=1e-12)
    np.testing.assert_allclose(frames.poses(T[None], np.array([1]))[0], request.T_cam_obj, atol=0)

    def result(status, *candidates):
        return Refinement(T_cam_obj=request.T_cam_obj, status=status, iterations=1, candidates=candidates)

    for status in (Status.CONVERGED, Status.FAILED):
        (back,) = frames.own_results([result(status, result(Status.STOPPED))], [Request(obj_id=1, T_cam_obj=T)])
        np.testing.assert_allclose(back.T_cam_obj, T, atol=1e-12)
        np.testing.assert_allclose(back.candidates[0].T_cam_obj, T, atol=1e-12)
    assert np.array_equal(back.T_cam_obj, T)  # a failure has the very pose that was given
