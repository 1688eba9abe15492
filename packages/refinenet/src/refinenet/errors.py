"""Errors of training and refinement, in posecore's tree."""

from posecore.errors import PoseError


class TrainingError(PoseError, ArithmeticError):
    """Training cannot go on: the loss or the gradient is not finite."""


class RefinementError(PoseError, RuntimeError):
    """Poses cannot be refined on this machine: its memory is too small for one of them."""
