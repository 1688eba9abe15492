"""Errors of training and refinement, in posecore's tree."""

from posecore.errors import PoseError


class TrainingError(PoseError, ArithmeticError):
    """Training cannot continue: the loss or the gradient is not finite."""


class LoaderError(PoseError, RuntimeError):
    """Batches cannot be loaded: a process was killed, or there is too little shared memory."""


class RefinementError(PoseError, RuntimeError):
    """Poses cannot be refined: the image is invalid, or the GPU's memory is too small for a pose."""
