"""The poses that look like the truth of a symmetric object, and which of them is nearest to another pose."""

from typing import NamedTuple

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from refinenet.geometry import poses

SWEEPS = 4
"""Over the axes of a ball, each turned about in its turn; one axis is done in one."""


class ObjectPoints(NamedTuple):
    """Model points and symmetries of every object, padded to one shape.

    Attributes:
        points_m: (o, m, 3) points of each object, object frame.
        symmetries: (o, s, 4, 4) transforms that leave the object as it is, the identity first; continuous ones sampled.
        valid: (o, s) which symmetries are real, not padding.
        axes: (o, a, 3) unit axes, object frame, about which any turn leaves the object as it is; zeros are padding.
        on_axes_m: (o, 3) a point on all of an object's axes, object frame.
    """

    points_m: Float[Tensor, "o m 3"]
    symmetries: Float[Tensor, "o s 4 4"]
    valid: Bool[Tensor, "o s"]
    axes: Float[Tensor, "o a 3"]
    on_axes_m: Float[Tensor, "o 3"]

    def to(self, device: torch.device) -> "ObjectPoints":
        """The same on another device."""
        return ObjectPoints(*(x.to(device) for x in self))

    @property
    def symmetric(self) -> bool:
        """Whether any of them has more than the identity."""
        return self.symmetries.shape[1] > 1


@torch.no_grad()
def nearest_by_rotation(
    T_cam_obj: Float[Tensor, "b 4 4"],
    T_true: Float[Tensor, "b 4 4"],
    object_index: Int[Tensor, " b"],
    objects: ObjectPoints,
) -> Float[Tensor, "b 4 4"]:
    """The truth's symmetric twin whose rotation is nearest to a pose's.

    A symmetry whose axis misses the object's origin moves that, too. The sample that is nearest by the mean L1 distance
    of turned points is turned about the object's axes the rest of the way, to the least squared distance: so an exact
    pose has itself as its twin, and the twin does not depend on which of them is called the truth.

    Args:
        T_cam_obj: Poses, metres.
        T_true: Truths, metres.
        object_index: Rows of `objects`.
        objects: Points and symmetries.
    """
    points = objects.points_m[object_index]
    twins = T_true[:, None] @ objects.symmetries[object_index]
    got = points @ T_cam_obj[:, :3, :3].transpose(1, 2)
    distance_m = (got[:, None] - torch.einsum("bsij,bmj->bsmi", twins[..., :3, :3], points)).abs().sum(-1).mean(-1)
    sampled = _least(twins, distance_m, objects.valid[object_index])
    return _turned(sampled, points, got, object_index, objects)


@torch.no_grad()
def nearest_by_angle(
    T_cam_obj: Float[Tensor, "b 4 4"],
    T_true: Float[Tensor, "b 4 4"],
    object_index: Int[Tensor, " b"],
    objects: ObjectPoints,
) -> Float[Tensor, "b 4 4"]:
    """The same by the angle between both rotations."""
    twins = T_true[:, None] @ objects.symmetries[object_index]
    trace = torch.einsum("bij,bsij->bs", T_cam_obj[:, :3, :3], twins[..., :3, :3])
    sampled = _least(twins, -trace, objects.valid[object_index])
    unit = torch.eye(3, device=twins.device, dtype=twins.dtype).expand(len(twins), 3, 3)
    return _turned(sampled, unit, T_cam_obj[:, :3, :3].transpose(1, 2), object_index, objects)


@torch.no_grad()
def nearest_by_points(
    T_cam_obj: Float[Tensor, "b 4 4"],
    T_true: Float[Tensor, "b 4 4"],
    object_index: Int[Tensor, " b"],
    objects: ObjectPoints,
) -> tuple[Float[Tensor, "b 4 4"], Float[Tensor, " b"]]:
    """The same by points in camera axes, translations included; and their mean distance, metres."""
    points, on_axes = objects.points_m[object_index], objects.on_axes_m[object_index][:, None]
    twins = T_true[:, None] @ objects.symmetries[object_index]
    got = points @ T_cam_obj[:, :3, :3].transpose(1, 2) + T_cam_obj[:, None, :3, 3]
    true = torch.einsum("bsij,bmj->bsmi", twins[..., :3, :3], points) + twins[:, :, None, :3, 3]
    distance_m = torch.linalg.vector_norm(got[:, None] - true, dim=-1).mean(-1)
    sampled = _least(twins, distance_m, objects.valid[object_index])
    # a turn about an axis leaves the points on it where they are
    still = on_axes @ sampled[:, :3, :3].transpose(1, 2) + sampled[:, None, :3, 3]
    twin = _turned(sampled, points - on_axes, got - still, object_index, objects)
    true = points @ twin[:, :3, :3].transpose(1, 2) + twin[:, None, :3, 3]
    return twin, torch.linalg.vector_norm(got - true, dim=-1).mean(-1)


def _least(
    twins: Float[Tensor, "b s 4 4"], cost: Float[Tensor, "b s"], valid: Bool[Tensor, "b s"]
) -> Float[Tensor, "b 4 4"]:
    best = cost.masked_fill(~valid, torch.inf).argmin(-1)
    return twins[torch.arange(len(best), device=best.device), best]


def _turned(
    T_cam_obj: Float[Tensor, "b 4 4"],
    vectors: Float[Tensor, "b m 3"],
    wanted: Float[Tensor, "b m 3"],
    object_index: Int[Tensor, " b"],
    objects: ObjectPoints,
) -> Float[Tensor, "b 4 4"]:
    """Poses turned about their objects' axes, so that vectors (object frame) come nearest to others (camera axes).

    In closed form: of a turn about one axis, the sum of squared distances is a sine of its angle.
    """
    axes, on_axes = objects.axes[object_index], objects.on_axes_m[object_index]
    for _ in range(SWEEPS if axes.shape[1] > 1 else 1):
        for axis in axes.unbind(1):
            here = wanted @ T_cam_obj[:, :3, :3]
            across = vectors - (vectors * axis[:, None]).sum(-1, keepdim=True) * axis[:, None]
            ahead = torch.linalg.cross(axis[:, None].expand_as(vectors), vectors)
            angle = torch.atan2((here * ahead).sum((1, 2)), (here * across).sum((1, 2)))
            R = poses.rotation_from_rotvec(angle[:, None] * axis)  # the identity where there is no axis
            R_new = T_cam_obj[:, :3, :3] @ R
            moved = (T_cam_obj[:, :3, :3] - R_new) @ on_axes[..., None]
            T_cam_obj = T_cam_obj.clone()
            T_cam_obj[:, :3, 3] += moved[..., 0]
            T_cam_obj[:, :3, :3] = R_new
    return T_cam_obj
