"""Pose update from flow: weighted least squares on a hypothesis' surface points."""

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from refinenet.geometry import poses
from refinenet.geometry.poses import Flow, PoseUpdate

CELL_PX = 4
"""Side of a flow cell; each has one surface point."""
STEPS = 3
"""Gauss-Newton steps, enough to converge for the flow of a rigid motion."""
DAMPING = 1e-4
"""Fraction of the mean diagonal added to the diagonal: an unobservable rotation gets no step."""


def surface_points(
    depth_m: Float[Tensor, "b p p"], K_crop: Float[Tensor, "b 3 3"]
) -> tuple[Float[Tensor, "b n 3"], Float[Tensor, "b n 2"], Bool[Tensor, "b n"]]:
    """One point of each cell's render, row by row: camera frame, patch pixels, and whether there is a surface."""
    half = CELL_PX // 2
    z = depth_m[:, half::CELL_PX, half::CELL_PX]
    b, n, _ = z.shape
    centre = torch.arange(n, device=z.device, dtype=z.dtype) * CELL_PX + half + 0.5
    v, u = torch.meshgrid(centre, centre, indexing="ij")
    uv_px = torch.stack((u, v), -1).flatten(0, 1).expand(b, -1, -1)
    z = z.flatten(1)
    focal, middle = K_crop.diagonal(dim1=-2, dim2=-1)[:, None, :2], K_crop[:, None, :2, 2]
    xy = (uv_px - middle) / focal * z[..., None]
    return torch.cat((xy, z[..., None]), -1), uv_px, z > 0


def offsets_to_px(
    flow: Flow, T_cam_obj_hypothesis: Float[Tensor, "b 4 4"], T_cam_obj: Float[Tensor, "b 4 4"],
    K_crop: Float[Tensor, "b 3 3"],
) -> Float[Tensor, "b n 2"]:  # fmt: skip
    """Offsets of a flow's points in the scene for a pose."""
    update = poses.update_between(T_cam_obj_hypothesis, T_cam_obj)
    t = T_cam_obj_hypothesis[:, None, :3, 3]
    updated_m = (flow.p_cam_m - t) @ update.dR.transpose(1, 2) + t + update.dt[:, None]
    return poses.project(K_crop, updated_m) - flow.uv_px


def weighted(error_px: Float[Tensor, "b n 2"], certainty: Float[Tensor, "b n 3"]) -> Float[Tensor, "b n 2"]:
    """Errors times the square root of their information, about in standard deviations."""
    u, v = error_px.unbind(-1)
    return torch.stack((certainty[..., 0] * u + certainty[..., 1] * v, certainty[..., 2] * v), -1)


def update_from_flow(
    flow: Flow, T_cam_obj: Float[Tensor, "b 4 4"], K_crop: Float[Tensor, "b 3 3"], length_m: Float[Tensor, " b"]
) -> PoseUpdate:
    """The update whose projected points fit a flow best: Gauss-Newton on weighted errors, robust; differentiable.

    Args:
        flow: Flow of the hypothesis' surface.
        T_cam_obj: The hypothesis.
        K_crop: Intrinsics of the patch.
        length_m: Unit of translation; at about the object's radius, one damping suits rotation and translation.
    """
    origin_m = T_cam_obj[:, :3, 3]
    arm_m = flow.p_cam_m - origin_m[:, None]
    focal = K_crop.diagonal(dim1=-2, dim2=-1)[:, None, :2]
    dR, dt = (
        torch.eye(3, device=arm_m.device, dtype=arm_m.dtype).expand(arm_m.shape[0], 3, 3),
        torch.zeros_like(origin_m),
    )
    for _ in range(STEPS):
        rotated_m = arm_m @ dR.transpose(1, 2)
        p_cam_m = rotated_m + (origin_m + dt)[:, None]
        z_m = poses.positive_depth_m(p_cam_m[..., 2:])
        error = weighted(poses.project(K_crop, p_cam_m) - flow.uv_px - flow.offset_px, flow.certainty)
        per_z, zero = focal / z_m, torch.zeros_like(z_m)
        ray = p_cam_m[..., :2] / z_m
        by_u = torch.cat((per_z[..., :1], zero, -per_z[..., :1] * ray[..., :1]), -1)
        by_v = torch.cat((zero, per_z[..., 1:], -per_z[..., 1:] * ray[..., 1:]), -1)
        certainty = flow.certainty[..., None]
        by_point = torch.stack(
            (certainty[..., 0, :] * by_u + certainty[..., 1, :] * by_v, certainty[..., 2, :] * by_v), -2
        )
        by_rotation = torch.linalg.cross(rotated_m[..., None, :].expand_as(by_point), by_point)
        J = torch.cat((by_rotation, by_point * length_m[:, None, None, None]), -1).flatten(1, 2)
        # weights of the Laplace likelihood's |W e|, smoothed at 1
        robust = flow.on_object / torch.sqrt(error.detach().square().sum(-1) + 1.0)
        weighted_J = J * robust[..., None].expand(-1, -1, 2).flatten(1)[..., None]
        step = -_solved(weighted_J.transpose(1, 2) @ J, (weighted_J * error.flatten(1)[..., None]).sum(1))
        dR = poses.rotation_from_rotvec(step[:, :3]) @ dR
        dt = dt + step[:, 3:] * length_m[:, None]
    return PoseUpdate(dR, dt, flow=flow)


def _solved(H: Float[Tensor, "b 6 6"], g: Float[Tensor, "b 6"]) -> Float[Tensor, "b 6"]:
    """Solution of damped H x = g by elimination, in operations that every runtime has."""
    damping = DAMPING * H.diagonal(dim1=1, dim2=2).mean(-1) + 1e-6
    unit = torch.eye(6, device=H.device, dtype=H.dtype)
    table = torch.cat((H + damping[:, None, None] * unit, g[..., None]), -1)
    for k in range(6):
        row = table[:, k : k + 1] / table[:, k : k + 1, k : k + 1]
        # row k is divided by its pivot and subtracted from the others
        table = table - (table[:, :, k : k + 1] - unit[k][:, None]) * row
    return table[..., 6]
