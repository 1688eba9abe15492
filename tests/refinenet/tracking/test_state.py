"""The tracker's rules on their own, with a method that stands for a network."""

import numpy as np
import pytest
from posecore import se3
from posecore.bop import ModelInfo
from posecore.errors import ConfigError
from posecore.mesh import Mesh
from posecore.symmetry import ContinuousSymmetry, nearest_symmetric
from refinenet.refiner import Frame, Refinement, Status
from refinenet.tracking import tracker as tracker_module
from refinenet.tracking.state import (
    Observation,
    TrackingConfig,
    TrackState,
    TrackStatus,
    at_depths,
    next_status,
    predicted,
)
from refinenet.tracking.tracker import ObjectTrack, Tracker

from ..conftest import K

CONFIG = TrackingConfig(tracking_threshold=0.6, accept_threshold=0.4, patience=3, depth_step=0.0)
T, U, L = TrackState.TRACKING, TrackState.UNCERTAIN, TrackState.LOST
EMPTY = Frame(image=np.zeros((480, 640, 3), np.uint8), K=K)
SMALL = {1: Mesh(vertices_m=np.eye(3) * 0.05 - 0.025, faces=np.array([[0, 1, 2]]), normals=np.eye(3))}


def pose(seed, z=0.7):
    rng = np.random.default_rng(seed)
    return se3.make_T(se3.random_rotation(rng), np.array([0.02, -0.03, z]))


@pytest.mark.parametrize(
    ("confidences", "states"),
    [
        ([0.9, 0.9], [T, T]),
        ([0.9, 0.5, 0.5, 0.5, 0.5, 0.9], [T, U, U, U, U, T]),  # badly fitting, and believed: never lost
        ([0.9, 0.1, 0.1, 0.1, 0.1], [T, U, U, L, L]),
        ([0.1, 0.1, 0.5, 0.1, 0.1, 0.1], [U, U, U, U, U, L]),  # a believed pose starts the count anew
        ([0.0, 0.0, 0.0, 0.5, 0.6], [U, U, L, L, T]),  # only one that fits brings a lost track back
        ([0.9, None, None, None, 0.9], [T, U, U, L, T]),  # refinement failed
    ],
)
def test_states(confidences, states):
    standing, found = TrackStatus(), []
    for confidence in confidences:
        standing = next_status(standing, confidence, CONFIG)
        found.append(standing.state)
    assert found == states


def test_thresholds_must_be_in_order():
    for wrong in (
        {"tracking_threshold": 0.3, "accept_threshold": 0.4},
        {"patience": 0},
        {"depth_step": 0.5},
        {"tracking_threshold": 1.1},
    ):
        with pytest.raises(ConfigError, match="expected"):
            TrackingConfig(**wrong)


def test_prediction_goes_on_as_between_two_sightings():
    first, axis = pose(0), np.array([0.03, -0.05, 0.02])
    step_m = np.array([0.004, 0.001, -0.002])

    def at(frames):
        return se3.apply_update(first, se3.rotation_from_rotvec(axis * frames), step_m * frames)

    before, last = Observation(frame=3, T_cam_obj=first), Observation(frame=7, T_cam_obj=at(4))
    np.testing.assert_allclose(predicted(before, last, 8), at(5), atol=1e-12)
    np.testing.assert_allclose(predicted(before, last, 10), at(7), atol=1e-12)
    np.testing.assert_allclose(predicted(before, last, 40), at(8), atol=1e-12)  # no longer than it was measured


def test_depths_are_tried_along_the_ray():
    own, near, far = at_depths(pose(1), 0.02)
    np.testing.assert_array_equal(own, pose(1))
    for other, factor in ((near, 0.98), (far, 1.02)):
        np.testing.assert_allclose(other[:3, 3], factor * own[:3, 3])
        np.testing.assert_array_equal(other[:3, :3], own[:3, :3])
    assert len(at_depths(pose(1), 0.0)) == 1


AXIS = ContinuousSymmetry((0.0, 0.6, 0.8), (0.01, 0.02, -0.01))
HALF_TURN = se3.make_T(np.diag([-1.0, -1.0, 1.0]), np.array([0.004, 0.0, 0.0]))


def turned_about(axis, offset_m, angle_rad):
    R = se3.rotation_from_rotvec(np.asarray(axis) / np.linalg.norm(axis) * angle_rad)
    return se3.make_T(R, np.asarray(offset_m) - R @ np.asarray(offset_m))


@pytest.mark.slow
@pytest.mark.parametrize("angle_rad", [-3.0, -0.4, 0.0, 1e-3, 2.0])
def test_an_object_of_revolution_does_not_spin(angle_rad):
    info = ModelInfo(diameter_m=0.1, symmetries_continuous=(AXIS,))
    before = pose(2)
    spun = before @ turned_about(*AXIS, angle_rad)
    np.testing.assert_allclose(nearest_symmetric(spun, before, info), before, atol=1e-9)
    moved = se3.apply_update(before, se3.rotation_from_rotvec(np.array([0.1, 0.05, 0.0])), np.array([0.01, 0, 0]))
    chosen = nearest_symmetric(moved @ turned_about(*AXIS, angle_rad), before, info)
    sampled = [
        se3.rotation_angle_rad((moved @ turned_about(*AXIS, a))[:3, :3] @ before[:3, :3].T)
        for a in np.linspace(0, 2 * np.pi, 2000)
    ]
    assert se3.rotation_angle_rad(chosen[:3, :3] @ before[:3, :3].T) <= min(sampled) + 1e-9


def test_copies_of_discrete_symmetries_and_balls():
    before = pose(3)
    half = ModelInfo(diameter_m=0.1, symmetries_discrete=(HALF_TURN,))
    np.testing.assert_allclose(nearest_symmetric(before @ se3.inverse(HALF_TURN), before, half), before, atol=1e-12)
    other = ContinuousSymmetry((1.0, 0.0, 0.0), AXIS.offset_m)
    ball = ModelInfo(diameter_m=0.1, symmetries_continuous=(AXIS, other))
    spun = before @ turned_about((0.3, -0.5, 0.7), AXIS.offset_m, 1.3)
    np.testing.assert_allclose(nearest_symmetric(spun, before, ball), before, atol=1e-9)
    plain = ModelInfo(diameter_m=0.1)
    np.testing.assert_array_equal(nearest_symmetric(spun, before, plain), spun)


def symmetric_copy(info):
    """A transform that maps the object onto itself, not the identity."""
    (axis,) = info.symmetries_continuous or (None,)
    return info.symmetries_discrete[0] if axis is None else turned_about(*axis, 2.0)


class Script:
    """A method whose confidences are written down; poses come back as `moved` makes them."""

    name, needs_depth, score_kind, corrects_depth, settings = "script", False, "learned", False, {}

    def __init__(self, confidences, moved=lambda T: T, meshes=SMALL):
        self.meshes = meshes
        self.confidences, self.moved, self.asked = list(confidences), moved, []

    def refine_batch(self, frame, requests):
        self.asked.append([request.T_cam_obj for request in requests])
        level = self.confidences.pop(0)
        return [
            Refinement(
                T_cam_obj=self.moved(r.T_cam_obj), status=Status.FAILED if level == 0 else Status.CONVERGED,
                iterations=1, confidence=level, failure="it cannot be seen" if level == 0 else None,
            )
            for r in requests
        ]  # fmt: skip

    def close(self):
        pass


def test_a_lost_object_is_started_again_from_an_offered_pose():
    refiner = Script([0.9, 0.0, 0.1, 0.0, 0.1, 0.9, 0.9])
    tracker = Tracker(refiner, [1], CONFIG)
    start, again = pose(4), pose(5)
    offered = {0: [start], 2: [again], 5: [again]}
    rows = [tracker.step(i, EMPTY, {1: offered.get(i, [])})[0] for i in range(7)]
    assert [row.state for row in rows] == [T, U, U, L, L, T, T]
    assert [row.T_cam_obj is None for row in rows] == [False, True, True, True, True, False, False]
    assert [row.restarted for row in rows] == [True, False, False, False, False, False, False]
    assert rows[1].failure == "it cannot be seen"
    assert rows[2].failure == "the best pose has a confidence of 0.10"
    # an offer counts only while the track is lost; there, the last place is tried beside it
    assert [len(asked) for asked in refiner.asked] == [1, 1, 1, 1, 1, 2, 1]
    np.testing.assert_array_equal(refiner.asked[5][1], again)


def test_without_any_pose_to_start_from_nothing_is_asked():
    refiner = Script([])
    (row,) = Tracker(refiner, [1], CONFIG).step(0, EMPTY)
    assert (row.state, row.T_cam_obj, row.failure) == (L, None, "there is no initial pose in this frame")
    assert not refiner.asked


def test_the_motion_model_starts_ahead():
    step_m = np.array([0.01, 0.0, 0.0])
    still = np.eye(3)
    refiner = Script([0.9] * 4, moved=lambda T: se3.apply_update(T, still, step_m))
    tracker = Tracker(refiner, [1], CONFIG, motion_model=True)
    found = [tracker.step(i, EMPTY, {1: [pose(6)]})[0].T_cam_obj for i in range(3)]
    np.testing.assert_allclose(refiner.asked[1][0], found[0])
    np.testing.assert_allclose(refiner.asked[2][0], found[1] + (found[1] - found[0]), atol=1e-12)


def test_a_symmetric_object_keeps_its_spin_through_a_track():
    """A network's spin about the axis is arbitrary; here it is a random turn each frame."""
    info = ModelInfo(diameter_m=0.1, symmetries_continuous=(AXIS,))
    rng = np.random.default_rng(0)
    refiner = Script([0.9] * 10, moved=lambda T: T @ turned_about(*AXIS, rng.uniform(-3, 3)))
    tracker = Tracker(refiner, [1], CONFIG, symmetries={1: info})
    found = [tracker.step(i, EMPTY, {1: [pose(7)]})[0].T_cam_obj for i in range(10)]
    for later in found[1:]:
        np.testing.assert_allclose(later, found[0], atol=1e-9)


@pytest.mark.parametrize("turned", [{"symmetries_continuous": (AXIS,)}, {"symmetries_discrete": (HALF_TURN,)}])
def test_spins_are_compared_between_poses_of_one_point(monkeypatch, turned):
    """A mesh with its origin 0.5 m off: the pose before is given as one of the origin, as the new one is."""
    shift_m = np.array([0.3, -0.4, 0.0])
    far = {1: SMALL[1].with_origin_at(-shift_m)}
    info = ModelInfo(diameter_m=0.1, **turned).with_origin_at(-shift_m)
    T, compared = se3.with_origin_at(pose(7), -shift_m), []

    def nearest(T_cam_obj, T_reference, symmetries):
        compared.append(far[1].center_cam_m(T_cam_obj) - far[1].center_cam_m(T_reference))
        return nearest_symmetric(T_cam_obj, T_reference, symmetries)

    monkeypatch.setattr(tracker_module, "nearest_symmetric", nearest)
    spins = iter([np.eye(4), symmetric_copy(info)])
    tracker = Tracker(Script([0.9] * 2, moved=lambda T: T @ next(spins), meshes=far), [1], CONFIG, symmetries={1: info})
    found = [tracker.step(i, EMPTY, {1: [T]})[0].T_cam_obj for i in range(2)]
    np.testing.assert_allclose(found[1], found[0], atol=1e-9)
    assert len(compared) == 1 and np.linalg.norm(compared[0]) < 0.1


def test_each_depth_is_asked_for():
    track = ObjectTrack(obj_id=1, config=TrackingConfig(depth_step=0.03), center_m=np.zeros(3))
    assert len(track.hypotheses(0, [pose(8)])) == 1  # what is offered is taken as it is
    track.update(0, [Refinement(T_cam_obj=pose(8), status=Status.CONVERGED, iterations=1, confidence=0.9)])
    depths = [request.T_cam_obj[2, 3] / pose(8)[2, 3] for request in track.hypotheses(1, [])]
    np.testing.assert_allclose(depths, [1.0, 0.97, 1.03])


def test_a_depth_is_left_only_for_one_that_is_clearly_better():
    nearer = pose(8, z=0.68)
    for confidence, z in ((0.61, 0.7), (0.63, 0.68)):
        track = ObjectTrack(obj_id=1, config=TrackingConfig(), center_m=np.zeros(3))
        track.update(0, [Refinement(T_cam_obj=pose(8), status=Status.CONVERGED, iterations=1, confidence=0.9)])
        track.hypotheses(1, [])
        results = [(pose(8), 0.6), (nearer, confidence), (pose(8, z=0.72), 0.5)]
        tracked = track.update(
            1, [Refinement(T_cam_obj=T, status=Status.CONVERGED, iterations=1, confidence=c) for T, c in results]
        )
        assert tracked.T_cam_obj[2, 3] == pytest.approx(z)


def test_a_pose_whose_refinement_failed_is_believed_under_no_threshold():
    config = TrackingConfig(tracking_threshold=0.0, accept_threshold=0.0, patience=2, depth_step=0.0)
    track = ObjectTrack(obj_id=1, config=config, center_m=np.zeros(3))
    for frame, (status, state) in enumerate([(Status.STOPPED, T), (Status.FAILED, U), (Status.FAILED, L)]):
        track.hypotheses(frame, [pose(0)])
        found = Refinement(T_cam_obj=pose(0), status=status, iterations=1, confidence=0.0, failure="gone")
        told = track.update(frame, [found])
        assert (told.state, told.T_cam_obj is None) == (state, status is Status.FAILED)


def test_depths_and_motion_are_about_the_centre():
    """A mesh with its origin 2 m off: the centre stays on its ray, and goes on straight."""
    shift_m = np.array([2.0, -1.0, 0.5])
    far = {1: SMALL[1].with_origin_at(-shift_m)}
    center_m = far[1].center_m
    track = ObjectTrack(obj_id=1, config=TrackingConfig(depth_step=0.03), center_m=center_m)
    T = se3.with_origin_at(pose(8), -shift_m)
    track.hypotheses(0, [T])
    track.update(0, [Refinement(T_cam_obj=T, status=Status.CONVERGED, iterations=1, confidence=0.9)])
    tried = np.stack([far[1].center_cam_m(request.T_cam_obj) for request in track.hypotheses(1, [])])
    at_m = far[1].center_cam_m(T)
    np.testing.assert_allclose(tried, at_m * np.array([[1.0], [0.97], [1.03]]), atol=1e-12)

    turn, step_m = se3.rotation_from_rotvec(np.array([0.1, 0.2, -0.1])), np.array([0.01, 0.0, 0.002])

    def moved(T_cam_obj):
        return se3.with_origin_at(se3.apply_update(se3.with_origin_at(T_cam_obj, center_m), turn, step_m), -center_m)

    refiner = Script([0.9] * 4, moved=moved, meshes=far)
    tracker = Tracker(refiner, [1], CONFIG, motion_model=True)
    found = [tracker.step(i, EMPTY, {1: [T]})[0].T_cam_obj for i in range(3)]
    np.testing.assert_allclose(refiner.asked[2][0], moved(found[1]), atol=1e-9)
