"""Heads: from features to a pose update, in the configured parametrisation."""

import torch
from jaxtyping import Float
from torch import Tensor, nn

from refinenet.config import NetworkConfig
from refinenet.geometry import poses
from refinenet.geometry.poses import PoseUpdate

ROTATION_BIAS = {"6d": (1.0, 0.0, 0.0, 0.0, 1.0, 0.0), "quaternion": (1.0, 0.0, 0.0, 0.0)}
"""Outputs of the identity rotation, the initial bias of the heads."""


def forms(config: NetworkConfig) -> tuple[str, str]:
    """Outputs of the rotation and the translation head; the kind's default where the config gives none."""
    paper = config.kind == "paper"
    return (
        config.rotation or ("quaternion" if paper else "6d"),
        config.translation or ("camera" if paper else "crop"),
    )


def init_head(head: nn.Linear | nn.Conv2d, bias: tuple[float, ...], std: float) -> None:
    """Initialise a head near a constant output: weights of `std` around zero, and a bias."""
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
    """The pose update of head outputs, in camera axes about the pose's origin.

    Args:
        rotation: 6D representation or quaternion, by its length.
        translation: In the coordinates that `crop` selects.
        T_cam_obj: The hypothesis, metres.
        K_crop: Intrinsics of the patch.
        patch_px: Side of the patch.
        crop: Rotation in axes aligned with the ray through the patch and translation as in `poses.crop_update`;
            otherwise both in camera axes, metres.
        confidence: Logit of the hypothesis' confidence, if there is such a head.
    """
    six = rotation.shape[-1] == 6
    R = poses.rotation_from_6d(rotation) if six else poses.rotation_from_quat_wxyz(rotation)
    update = poses.crop_update(R, translation, T_cam_obj, K_crop, patch_px) if crop else PoseUpdate(R, translation)
    return update if confidence is None else update._replace(confidence=confidence[:, 0])
