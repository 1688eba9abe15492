"""A pose's numbers do not depend on the other poses of a call, nor on its place among them, to the last bit.

Matrix products of BLAS do (a stack of contiguous 3 x 3 matrices has every second one at another alignment), and so
does an arc tangent of strided arrays.
"""

import numpy as np
import pytest
from evalkit.pose_errors import metrics
from evalkit.scores.failure_causes import parts_of
from posecore import se3, symmetry
from posecore.bop import ModelInfo
from posecore.symmetry import ContinuousSymmetry

PLACES = 64
POINTS_M = np.random.default_rng(5).normal(size=(40, 3))
AXIS = ContinuousSymmetry(axis=(0.6, 0.0, 0.8), offset_m=(0.3, -0.2, 0.1))
BALL = (AXIS, ContinuousSymmetry(axis=(0.0, 1.0, 0.0), offset_m=(0.3, -0.2, 0.1)))
FLIP = se3.make_T(se3.rotation_from_rotvec(np.array([0.0, np.pi, 0.0])), np.array([0.01, 0.02, 0.03]))
OBJECTS = {
    "discrete": ModelInfo(diameter_m=0.1, symmetries_discrete=(FLIP,)),
    "axis": ModelInfo(diameter_m=0.1, symmetries_discrete=(FLIP,), symmetries_continuous=(AXIS,)),
    "ball": ModelInfo(diameter_m=0.1, symmetries_continuous=BALL),
}


def _poses(seed):
    rng = np.random.default_rng(seed)
    R = np.stack([se3.random_rotation(rng) for _ in range(PLACES)])
    return se3.make_T(R, rng.normal(size=(PLACES, 3)))


def _nearest(kind, by):
    points_m = POINTS_M if by == "points" else None
    return lambda T, T_ref: symmetry.nearest_symmetric(T, T_ref, OBJECTS[kind], by=by, points_m=points_m)


NUMBERS = {
    "viewpoint": lambda T, _: np.stack(metrics.viewpoint_deg(T), axis=-1),
    "re": metrics.re,
    "te": metrics.te,
    "add": lambda T, T_ref: metrics.add(T, T_ref, POINTS_M),
    "adi": lambda T, T_ref: metrics.adi(T, T_ref, POINTS_M),
    "re_symmetric": lambda T, T_ref: metrics.re_symmetric(T, T_ref, symmetry.symmetry_transforms(OBJECTS["axis"])),
    "causes": lambda T, T_ref: np.stack(list(vars(parts_of(T, T_ref)).values()), axis=-1),
    "inverse": lambda T, _: se3.inverse(T),
    "center": lambda T, _: se3.with_origin_at(T, POINTS_M[0]),
    "rotvec": lambda T, _: se3.rotvec_from_rotation(T[:, :3, :3]),
    "angle": lambda T, T_ref: se3.rotation_angle_rad(T[:, :3, :3] @ T_ref[:, :3, :3]),
    **{f"nearest {kind} {by}": _nearest(kind, by) for kind in OBJECTS for by in ("rotation", "points")},
}


@pytest.mark.parametrize("name", NUMBERS)
def test_numbers_of_a_pose_do_not_depend_on_its_place(name):
    T, T_ref = _poses(1), _poses(2)
    alone = np.stack([NUMBERS[name](T[i : i + 1], T_ref[i : i + 1])[0] for i in range(PLACES)])
    for start in (0, 1, 2, 5, 17):  # every pose but the last ones comes to other places, in batches of other sizes
        np.testing.assert_array_equal(NUMBERS[name](T[start:], T_ref[start:]), alone[start:])
