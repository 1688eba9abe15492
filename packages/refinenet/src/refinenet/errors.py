"""Errors of training, in posecore's tree."""

from posecore.errors import PoseError


class TrainingError(PoseError, ArithmeticError):
    """Training cannot go on: the loss or the gradient is not finite."""
