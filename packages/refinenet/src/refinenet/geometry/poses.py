"""Rotations, projection and pose updates in torch, with gradients: counterparts of posecore.se3 and posecore.camera."""

from typing import NamedTuple

import torch
from jaxtyping import Bool, Float
from torch import Tensor

NEAR_M = 0.01
"""Depth under which `project` bends its divisor, so that points at or behind the camera stay finite."""


class Flow(NamedTuple):
    """Optical flow of a hypothesis' surface points, from the render to the scene.

    Attributes:
        p_cam_m: (b, n, 3) the points, camera frame.
        uv_px: (b, n, 2) their projections, patch pixels.
        on_object: (b, n) false for points off the surface, whose other fields are undefined.
        offset_px: (b, n, 2) flow: position in the scene minus `uv_px`.
        certainty: (b, n, 3) entries (uu, uv, vv) of the upper triangular matrices that weight errors of `offset_px`,
            1 / px; full matrices, since an edge fixes the flow across its direction only.
    """

    p_cam_m: Float[Tensor, "b n 3"]
    uv_px: Float[Tensor, "b n 2"]
    on_object: Bool[Tensor, "b n"]
    offset_px: Float[Tensor, "b n 2"]
    certainty: Float[Tensor, "b n 3"]


class PoseUpdate(NamedTuple):
    """An update in camera axes about the pose's origin, the object's pivot: R' = dR R, t' = t + dt.

    Attributes:
        dR: (b, 3, 3) rotations.
        dt: (b, 3) translations, metres.
        confidence: (b,) logit of the confidence of the hypothesis before the update; None from a network without it.
        flow: Flow that the update was solved from; None from a network without flow.
    """

    dR: Float[Tensor, "b 3 3"]
    dt: Float[Tensor, "b 3"]
    confidence: Float[Tensor, " b"] | None = None
    flow: Flow | None = None


def rotation_from_6d(x: Float[Tensor, "b 6"]) -> Float[Tensor, "b 3 3"]:
    """Gram-Schmidt of two 3-vectors, the first two columns of the rotation.

    Degenerate input (a zero vector, or parallel ones) gives a finite matrix that is not a rotation.

    Source: Zhou et al., On the Continuity of Rotation Representations in Neural Networks, CVPR 2019.
    """
    first = torch.nn.functional.normalize(x[:, :3], dim=-1, eps=1e-8)
    rest = x[:, 3:] - (first * x[:, 3:]).sum(-1, keepdim=True) * first
    second = torch.nn.functional.normalize(rest, dim=-1, eps=1e-8)
    return torch.stack((first, second, torch.linalg.cross(first, second)), dim=-1)


def rotation_from_quat_wxyz(quat_wxyz: Float[Tensor, "b 4"]) -> Float[Tensor, "b 3 3"]:
    """Rotation of a quaternion of any non-zero length (normalised here)."""
    w, x, y, z = torch.nn.functional.normalize(quat_wxyz, dim=-1, eps=1e-8).unbind(-1)
    rows = (
        1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y),
        2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x),
        2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y),
    )  # fmt: skip
    return torch.stack(rows, dim=-1).reshape(-1, 3, 3)


def quat_wxyz_from_rotation(R: Float[Tensor, "b 3 3"]) -> Float[Tensor, "b 4"]:
    """Unit quaternion with w >= 0 of rotations clearly under 180 degrees, which updates are.

    At 180 degrees w vanishes; it is held above 1e-4 there, so the result stays finite but loses precision.
    """
    w = 0.5 * torch.sqrt(torch.clamp(1 + R.diagonal(dim1=-2, dim2=-1).sum(-1), min=4e-8))
    axis = torch.stack((R[:, 2, 1] - R[:, 1, 2], R[:, 0, 2] - R[:, 2, 0], R[:, 1, 0] - R[:, 0, 1]), dim=-1)
    return torch.nn.functional.normalize(torch.cat((w[:, None], axis / (4 * w[:, None])), dim=-1), dim=-1)


def rotation_from_rotvec(rotvec: Float[Tensor, "b 3"]) -> Float[Tensor, "b 3 3"]:
    """Rotations by an axis times an angle in radians; counterpart of `posecore.se3.rotation_from_rotvec`."""
    square = rotvec.square().sum(-1)[:, None, None] + 1e-12  # keeps the root's gradient at zero
    angle = torch.sqrt(square)
    x, y, z = rotvec.unbind(-1)
    zero = torch.zeros_like(x)
    cross = torch.stack((zero, -z, y, z, zero, -x, -y, x, zero), dim=-1).reshape(-1, 3, 3)
    unit = torch.eye(3, device=rotvec.device, dtype=rotvec.dtype)
    return unit + torch.sin(angle) / angle * cross + (1 - torch.cos(angle)) / square * (cross @ cross)


def rotation_angle_deg(R: Float[Tensor, "b 3 3"]) -> Float[Tensor, " b"]:
    """Angle of each rotation, degrees in [0, 180].

    From sine and cosine together: acos of the trace alone loses half its digits near zero, in float32 about 0.03 deg.
    """
    axis = torch.stack((R[:, 2, 1] - R[:, 1, 2], R[:, 0, 2] - R[:, 2, 0], R[:, 1, 0] - R[:, 0, 1]), dim=-1)
    cosine = R.diagonal(dim1=-2, dim2=-1).sum(-1) - 1
    return torch.rad2deg(torch.atan2(torch.linalg.vector_norm(axis, dim=-1), cosine))


def positive_depth_m(z_m: Tensor, near_m: float = NEAR_M) -> Tensor:
    """Depth itself from `near_m` on; below, a once differentiable bend that stays positive and keeps a gradient."""
    # The bend's argument is clamped too: a division by zero poisons gradients even where torch.where discards it.
    bent = near_m**2 / (2 * near_m - torch.clamp(z_m, max=near_m))
    return torch.where(z_m > near_m, z_m, bent)


def project(K: Float[Tensor, "b 3 3"], p_cam_m: Float[Tensor, "b n 3"]) -> Float[Tensor, "b n 2"]:
    """Continuous pixels (pixel centre at + 0.5) of camera-frame points.

    In front of the camera this equals `posecore.camera.project`. Points nearer than `NEAR_M` or behind are
    divided by `positive_depth_m`: they project far outside the patch, on their own side, with a finite gradient.
    """
    xy = p_cam_m[..., :2] / positive_depth_m(p_cam_m[..., 2:])
    return xy @ K[:, :2, :2].transpose(1, 2) + K[:, None, :2, 2]


def ray_rotation(K_crop: Float[Tensor, "b 3 3"], patch_px: int) -> Float[Tensor, "b 3 3"]:
    """Smallest rotation that takes the optical axis to the ray through the patch's centre."""
    x = (0.5 * patch_px - K_crop[:, 0, 2]) / K_crop[:, 0, 0]
    y = (0.5 * patch_px - K_crop[:, 1, 2]) / K_crop[:, 1, 1]
    ray = torch.nn.functional.normalize(torch.stack((x, y, torch.ones_like(x)), dim=-1), dim=-1)
    dx, dy, dz = ray.unbind(-1)
    shared = -dx * dy / (1 + dz)
    rows = (1 - dx * dx / (1 + dz), shared, dx, shared, 1 - dy * dy / (1 + dz), dy, -dx, -dy, dz)
    return torch.stack(rows, dim=-1).reshape(-1, 3, 3)


def crop_update(
    rotation_ray: Float[Tensor, "b 3 3"],
    v: Float[Tensor, "b 3"],
    T_cam_obj: Float[Tensor, "b 4 4"],
    K_crop: Float[Tensor, "b 3 3"],
    patch_px: int,
) -> PoseUpdate:
    """Convert an update in crop coordinates to camera axes about the pose's origin, the object's pivot.

    The rotation is given in axes aligned with the ray through the crop's centre: the same crop then has the same
    output wherever it lies in the image. Translation, in units of the patch: the projection of the
    origin moves by v_xy, and log z grows by v_z patch_px / f_crop. So scaled, one unit of v_z moves the object as far
    in metres as one unit of v_x, for any focal length; log z itself would be a tenth as large as xy and learnt late.

    Args:
        rotation_ray: rotation in ray axes.
        v: image-plane x, y and depth, dimensionless.
        T_cam_obj: the hypothesis, metres, z > 0.
        K_crop: intrinsics of the patch.
        patch_px: side of the patch.

    Source: the parametrisation of DeepIM and CosyPose, normalised by the crop.
    """
    A = ray_rotation(K_crop, patch_px)
    t = T_cam_obj[:, :3, 3]
    focal = K_crop.diagonal(dim1=-2, dim2=-1)[:, :2]
    xy_over_z = t[:, :2] / t[:, 2:] + v[:, :2] * patch_px / focal
    z = t[:, 2] * torch.exp(v[:, 2] * patch_px / focal.mean(-1))
    t_new = torch.cat((xy_over_z * z[:, None], z[:, None]), dim=-1)
    return PoseUpdate(A @ rotation_ray @ A.transpose(1, 2), t_new - t)


def apply_update(T_cam_obj: Float[Tensor, "b 4 4"], update: PoseUpdate) -> Float[Tensor, "b 4 4"]:
    """The updated pose, (b, 4, 4)."""
    R = update.dR @ T_cam_obj[:, :3, :3]
    t = T_cam_obj[:, :3, 3] + update.dt
    bottom = T_cam_obj[:, 3:]
    return torch.cat((torch.cat((R, t[..., None]), dim=-1), bottom), dim=1)


def update_between(T_from: Float[Tensor, "b 4 4"], T_to: Float[Tensor, "b 4 4"]) -> PoseUpdate:
    """The update that takes one pose to the other."""
    return PoseUpdate(T_to[:, :3, :3] @ T_from[:, :3, :3].transpose(1, 2), T_to[:, :3, 3] - T_from[:, :3, 3])
