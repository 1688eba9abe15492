"""The contour loss on 200 random pairs out of shards from `synthgen render`: zero at home, downhill towards it."""

from pathlib import Path

import numpy as np
import pytest
import torch
from click.testing import CliRunner
from posecore.shard import ShardReader
from refinenet.batch import LossTarget
from refinenet.geometry import poses
from refinenet.geometry.poses import PoseUpdate
from refinenet.training import losses
from synthgen.cli import main

pytestmark = pytest.mark.slow

N = 200


@pytest.fixture(scope="module")
def shard_arrays(tmp_path_factory, tug_ply: Path) -> dict[str, np.ndarray]:
    out = tmp_path_factory.mktemp("pairs") / "shards"
    sampling = ["--engine", "raster", "--preset", "quickstart", "--seed", "5", "--workers", "1", "--quiet"]
    command = ["render", "--object", str(tug_ply), "--n", str(N), "--out", str(out), *sampling]
    result = CliRunner().invoke(main, command)
    assert result.exit_code == 0, result.output
    reader = ShardReader(str(out))
    parts = [reader.read(i) for i in reader.committed]
    return {name: np.concatenate([part[name] for part in parts]) for name in parts[0]}


@pytest.fixture(scope="module")
def target(shard_arrays: dict[str, np.ndarray]) -> LossTarget:
    def real(name: str) -> torch.Tensor:
        return torch.from_numpy(shard_arrays[name].astype(np.float64))

    return LossTarget(
        T_cam_obj=real("T_cam_obj"),
        T_cam_obj_hypothesis=real("T_cam_obj_hypothesis"),
        K_crop=real("K_crop"),
        scene_contour_m=real("scene_contour_cam_m"),
        hypothesis_contour_m=real("hypothesis_contour_cam_m"),
        scene_distance_px=real("scene_distance_px"),
        hypothesis_distance_px=real("hypothesis_distance_px"),
        object_index=torch.zeros(N, dtype=torch.int64),
    )


def terms_px(update: PoseUpdate, target: LossTarget) -> tuple[torch.Tensor, torch.Tensor]:
    """Both directions of the loss, (b,) each."""
    forward = losses.forward_contour_loss_px(update, target)
    return forward, losses.contour_loss_px(update, target) - forward


def no_update() -> PoseUpdate:
    return PoseUpdate(torch.eye(3, dtype=torch.float64).repeat(N, 1, 1), torch.zeros(N, 3, dtype=torch.float64))


def test_both_terms_vanish_at_the_true_update_up_to_the_contours_discretisation(target: LossTarget) -> None:
    """A turned object shows another rim, so what stays grows with the angle; moved only, it is under half a pixel."""
    true = poses.update_between(target.T_cam_obj_hypothesis, target.T_cam_obj)
    start, end = terms_px(no_update(), target), terms_px(true, target)
    angle_deg = poses.rotation_angle_deg(true.dR)
    for before, after in zip(start, end, strict=True):
        assert float(after.median()) < 0.5
        assert float(after[angle_deg < 5].max()) < 0.8
        assert float(after.max()) < 2.5  # 25 deg out of plane, 128 px patches
        assert float((after / before).median()) < 0.25


def test_the_update_turns_about_the_objects_origin(target: LossTarget) -> None:
    """The same rotation about the camera's centre instead carries the contour far away."""
    true = poses.update_between(target.T_cam_obj_hypothesis, target.T_cam_obj)
    t = target.T_cam_obj_hypothesis[:, :3, 3]
    about_camera = PoseUpdate(true.dR, (true.dR @ t[..., None])[..., 0] - t + true.dt)
    right, wrong = losses.contour_loss_px(true, target), losses.contour_loss_px(about_camera, target)
    assert float(wrong.median()) > 20 * float(right.median())


def test_the_gradient_points_home(target: LossTarget) -> None:
    """From the hypothesis, a small step along the negative gradient of either kind of motion brings the pose nearer.

    Moves: the translation's gradient lies within 90 degrees of the way home in the image plane wherever the start is
    more than two pixels off. Along the straight way home the mean loss falls at every quarter, and every
    single one ends lower.
    """
    true = poses.update_between(target.T_cam_obj_hypothesis, target.T_cam_obj)
    dt = torch.zeros(N, 3, dtype=torch.float64, requires_grad=True)
    at_true_rotation = PoseUpdate(true.dR, dt)
    losses.contour_loss_px(at_true_rotation, target).sum().backward()
    assert dt.grad is not None
    home, downhill = true.dt[:, :2], -dt.grad[:, :2]
    off_px = home.norm(dim=-1) * target.K_crop[:, 0, 0] / target.T_cam_obj[:, 2, 3]
    cosine = torch.nn.functional.cosine_similarity(home, downhill, dim=-1)[off_px > 2]
    assert len(cosine) > 100
    assert float((cosine > 0).double().mean()) > 0.99

    rotvec = rotation_vector(true.dR)
    values = []
    for share in (0.0, 0.25, 0.5, 0.75, 1.0):
        part = PoseUpdate(torch.linalg.matrix_exp(skew(share * rotvec)), share * true.dt)
        values.append(losses.contour_loss_px(part, target))
    along = torch.stack(values)
    astray = along[0] > 2.0  # the rest starts within the contour's discretisation of home
    assert int(astray.sum()) > 100
    assert bool((along[-1] < along[0])[astray].all())
    assert (along.mean(dim=1).diff() < 0).all()


def rotation_vector(dR: torch.Tensor) -> torch.Tensor:
    angle = torch.deg2rad(poses.rotation_angle_deg(dR))
    axis = torch.stack((dR[:, 2, 1] - dR[:, 1, 2], dR[:, 0, 2] - dR[:, 2, 0], dR[:, 1, 0] - dR[:, 0, 1]), dim=-1)
    return torch.nn.functional.normalize(axis, dim=-1) * angle[:, None]


def skew(v: torch.Tensor) -> torch.Tensor:
    zero = torch.zeros_like(v[:, 0])
    x, y, z = v.unbind(-1)
    return torch.stack((zero, -z, y, z, zero, -x, -y, x, zero), dim=-1).reshape(-1, 3, 3)
