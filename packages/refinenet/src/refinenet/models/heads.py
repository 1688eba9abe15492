"""From features to a pose update: the outputs that every network can have, chosen by configuration."""

import torch
from jaxtyping import Float
from torch import Tensor, nn

from refinenet.config import NetworkConfig
from refinenet.geometry import poses
from refinenet.geometry.poses import PoseUpdate

ROTATION_BIAS = {"6d": (1.0, 0.0, 0.0, 0.0, 1.0, 0.0), "quaternion": (1.0, 0.0, 0.0, 0.0)}
"""Outputs that mean no rotation, which heads start with."""


def forms(config: NetworkConfig) -> tuple[str, str]:
    """What the rotation and the translation head put out; where the config leaves it open, the kind's own."""
    paper = config.kind == "paper"
    return (
        config.rotation or ("quaternion" if paper else "6d"),
        config.translation or ("camera" if paper else "crop"),
    )


def start_linear(head: nn.Linear | nn.Conv2d, bias: tuple[float, ...], std: float) -> None:
    """Weights of `std` around zero and a bias: a head that begins near one output."""
    assert head.bias is not None
    nn.init.normal_(head.weight, std=std)
    with torch.no_grad():
        head.bias.copy_(torch.tensor(bias))


def pose_update(
    rotation: Float[Tensor, "b r"],
    translation: Float[Tensor, "b 3"],
    T_cam_obj: Float[Tensor, "b 4 4"],
    K_crop: Float[Tensor, "b 3 3"],
    patch_px: int,
    *,
    crop: bool,
    confidence: Float[Tensor, "b 1"] | None = None,
) -> PoseUpdate:
    """The update that head outputs stand for, in camera axes about the object's origin.

    Args:
        rotation: Six numbers or a quaternion, told apart by their count.
        translation: As `crop` says.
        T_cam_obj: The hypothesis, metres.
        K_crop: Intrinsics of the patch.
        patch_px: Side of the patch.
        crop: Rotation in axes turned with the ray through the patch and translation as `geometry.crop_update` has it;
            otherwise both in camera axes, metres.
        confidence: Logit of how well the hypothesis fits, if there is such a head.
    """
    six = rotation.shape[-1] == 6
    R = poses.rotation_from_6d(rotation) if six else poses.rotation_from_quat_wxyz(rotation)
    update = poses.crop_update(R, translation, T_cam_obj, K_crop, patch_px) if crop else PoseUpdate(R, translation)
    return update if confidence is None else update._replace(confidence=confidence[:, 0])
