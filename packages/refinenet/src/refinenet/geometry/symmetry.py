"""Nearest symmetry-equivalent ground truth; torch counterpart of `posecore.symmetry.nearest_symmetric`."""

from typing import NamedTuple

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from refinenet.geometry import poses

SWEEPS = 4
"""Coordinate-descent sweeps over the axes of a ball; a single axis needs one."""


class ObjectPoints(NamedTuple):
    """Model points and symmetries of every object, padded to one shape.

    Attributes:
        points_m: (o, m, 3) points of each object, object frame.
        symmetries: (o, s, 4, 4) symmetry transforms, the identity first; continuous symmetries are sampled.
        valid: (o, s) false where symmetries are padding.
        axes: (o, a, 3) unit axes of continuous symmetries, object frame; zeros are padding.
        on_axes_m: (o, 3) a point on all axes of an object, object frame.
    """

    points_m: Float[Tensor, "o m 3"]
    symmetries: Float[Tensor, "o s 4 4"]
    valid: Bool[Tensor, "o s"]
    axes: Float[Tensor, "o a 3"]
    on_axes_m: Float[Tensor, "o 3"]

    def to(self, device: torch.device) -> "ObjectPoints":
        """Copy on another device."""
        return ObjectPoints(*(x.to(device) for x in self))

    @property
    def symmetric(self) -> bool:
        """Whether any object has another symmetry than the identity."""
        return self.symmetries.shape[1] > 1


@torch.no_grad()
def nearest_by_rotation(
    T_cam_obj: Float[Tensor, "b 4 4"],
    T_gt: Float[Tensor, "b 4 4"],
    object_index: Int[Tensor, " b"],
    objects: ObjectPoints,
) -> Float[Tensor, "b 4 4"]:
    """The symmetry-equivalent ground truth whose rotation is nearest to a pose's.

    A symmetry whose axis misses the pose's origin translates the origin, too. The sample nearest by the mean L1
    distance of rotated points is rotated about the object's axes to the least squared distance. So an exact pose is its
    own nearest pose, whichever equivalent pose is annotated as ground truth.

    Args:
        T_cam_obj: Poses, metres.
        T_gt: Ground-truth poses, metres.
        object_index: Rows of `objects`.
        objects: Points and symmetries.
    """
    points = objects.points_m[object_index]
    equivalent = T_gt[:, None] @ objects.symmetries[object_index]
    points_cam = points @ T_cam_obj[:, :3, :3].transpose(1, 2)
    distance_m = (
        (points_cam[:, None] - torch.einsum("bsij,bmj->bsmi", equivalent[..., :3, :3], points)).abs().sum(-1).mean(-1)
    )
    sampled = _least(equivalent, distance_m, objects.valid[object_index])
    return _aligned(sampled, points, points_cam, object_index, objects)


@torch.no_grad()
def nearest_by_angle(
    T_cam_obj: Float[Tensor, "b 4 4"],
    T_gt: Float[Tensor, "b 4 4"],
    object_index: Int[Tensor, " b"],
    objects: ObjectPoints,
) -> Float[Tensor, "b 4 4"]:
    """`nearest_by_rotation` by the angle between both rotations."""
    equivalent = T_gt[:, None] @ objects.symmetries[object_index]
    trace = torch.einsum("bij,bsij->bs", T_cam_obj[:, :3, :3], equivalent[..., :3, :3])
    sampled = _least(equivalent, -trace, objects.valid[object_index])
    unit = torch.eye(3, device=equivalent.device, dtype=equivalent.dtype).expand(len(equivalent), 3, 3)
    return _aligned(sampled, unit, T_cam_obj[:, :3, :3].transpose(1, 2), object_index, objects)


@torch.no_grad()
def nearest_by_points(
    T_cam_obj: Float[Tensor, "b 4 4"],
    T_gt: Float[Tensor, "b 4 4"],
    object_index: Int[Tensor, " b"],
    objects: ObjectPoints,
) -> tuple[Float[Tensor, "b 4 4"], Float[Tensor, " b"]]:
    """`nearest_by_rotation` by points in camera axes, translations included; and their mean distance, metres."""
    points, on_axes = objects.points_m[object_index], objects.on_axes_m[object_index][:, None]
    equivalent = T_gt[:, None] @ objects.symmetries[object_index]
    points_cam = points @ T_cam_obj[:, :3, :3].transpose(1, 2) + T_cam_obj[:, None, :3, 3]
    true = torch.einsum("bsij,bmj->bsmi", equivalent[..., :3, :3], points) + equivalent[:, :, None, :3, 3]
    distance_m = torch.linalg.vector_norm(points_cam[:, None] - true, dim=-1).mean(-1)
    sampled = _least(equivalent, distance_m, objects.valid[object_index])
    # a rotation about an axis leaves the points on the axis in place
    fixed = on_axes @ sampled[:, :3, :3].transpose(1, 2) + sampled[:, None, :3, 3]
    nearest = _aligned(sampled, points - on_axes, points_cam - fixed, object_index, objects)
    true = points @ nearest[:, :3, :3].transpose(1, 2) + nearest[:, None, :3, 3]
    return nearest, torch.linalg.vector_norm(points_cam - true, dim=-1).mean(-1)


def _least(
    equivalent: Float[Tensor, "b s 4 4"], cost: Float[Tensor, "b s"], valid: Bool[Tensor, "b s"]
) -> Float[Tensor, "b 4 4"]:
    best = cost.masked_fill(~valid, torch.inf).argmin(-1)
    return equivalent[torch.arange(len(best), device=best.device), best]


def _aligned(
    T_cam_obj: Float[Tensor, "b 4 4"],
    vectors: Float[Tensor, "b m 3"],
    targets: Float[Tensor, "b m 3"],
    object_index: Int[Tensor, " b"],
    objects: ObjectPoints,
) -> Float[Tensor, "b 4 4"]:
    """Poses rotated about their objects' axes, aligning vectors (object frame) with targets (camera axes).

    In closed form: the sum of squared distances is a sine of the angle about an axis.
    """
    axes, on_axes = objects.axes[object_index], objects.on_axes_m[object_index]
    for _ in range(SWEEPS if axes.shape[1] > 1 else 1):
        for axis in axes.unbind(1):
            here = targets @ T_cam_obj[:, :3, :3]
            across = vectors - (vectors * axis[:, None]).sum(-1, keepdim=True) * axis[:, None]
            ahead = torch.linalg.cross(axis[:, None].expand_as(vectors), vectors)
            angle = torch.atan2((here * ahead).sum((1, 2)), (here * across).sum((1, 2)))
            R = poses.rotation_from_rotvec(angle[:, None] * axis)  # the identity where there is no axis
            R_new = T_cam_obj[:, :3, :3] @ R
            shift_m = (T_cam_obj[:, :3, :3] - R_new) @ on_axes[..., None]
            T_cam_obj = T_cam_obj.clone()
            T_cam_obj[:, :3, 3] += shift_m[..., 0]
            T_cam_obj[:, :3, :3] = R_new
    return T_cam_obj
