"""Random streams by address, so that sample i never depends on sample i - 1.

A stream has the address (seed, purpose, subject, scene, attempt, ...). Each subject (pose, lights, ...) has its own
stream: changing the lamps in a configuration keeps the poses of every sample.
"""

from enum import IntEnum

import numpy as np


class Purpose(IntEnum):
    """Purpose of a scene: pairs, images of each split, sequences of each split, annotated images; none share draws."""

    PAIRS = 0
    FRAMES = 1
    VALIDATION_FRAMES = 2
    TRAINING_FRAMES = 3
    SEQUENCES = 4
    VALIDATION_SEQUENCES = 5
    TRAINING_SEQUENCES = 6
    ANNOTATED = 7


class Subject(IntEnum):
    """Subject of a draw."""

    POSE = 0
    LIGHTS = 1
    MATERIAL = 2
    OCCLUDERS = 3
    BACKGROUND = 4
    SENSOR = 5
    HYPOTHESIS = 6
    CONTOUR = 7
    LIBRARY = 8
    RENDER = 9
    TARGET = 10
    KIND = 11
    TABLE = 12
    ENVIRONMENT = 13
    VISIBILITY = 14
    TABLETOPS = 15
    VIEW = 16
    PLACEMENT = 17
    COMPANIONS = 18
    CAMERA = 19
    MOTION = 20


def stream(seed: int, purpose: Purpose, subject: Subject, *address: int) -> np.random.Generator:
    """The generator at an address of non-negative integers."""
    return np.random.default_rng(np.random.SeedSequence([seed, int(purpose), int(subject), *address]))


def child_seed(rng: np.random.Generator) -> int:
    """A seed for a later draw, in [0, 2**31)."""
    return int(rng.integers(0, 2**31))
